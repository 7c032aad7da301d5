// Whether every edge has two faces that run along it in opposite directions. Host side:
// voxtool/mesh/watertight.py. The order of atomic operations changes neither answer nor doubt.

#include "mesh/watertight.h"

// A work-item processes BATCH vertices or faces: it first reads the places that all of them will change,
// because a read does not wait for the one before it, as an atomic operation does.

// The bits of a coordinate, where -0.0 is 0.0.
ulong bits_of(ulong coordinate) { return coordinate << 1 ? coordinate : 0; }

typedef struct {
    ulong x, y, z;
} position;

position position_of(__global const ulong *points, uint vertex)
{
    __global const ulong *p = points + 3 * (size_t)vertex;
    const position found = {bits_of(p[0]), bits_of(p[1]), bits_of(p[2])};
    return found;
}

bool is_at(position p, __global const ulong *points, uint vertex)
{
    const position q = position_of(points, vertex);
    return p.x == q.x && p.y == q.y && p.z == q.z;
}

ulong mixed(ulong code)
{
    code = (code ^ code >> 32) * 0x9E3779B97F4A7C15ul;
    return code ^ code >> 29;
}

// first[i] = the same number for all vertices at the position of vertex i: one of them. `table` has
// mask + 1 slots, which hold a vertex plus 1, or 0. *merged becomes 1 if two vertices have one position,
// *unsure if a chain is too long.
__kernel void merge_vertices(__global const ulong *points, const uint n, volatile __global uint *table,
                             const uint mask, __global uint *first, volatile __global uint *merged,
                             volatile __global uint *unsure)
{
    const uint begin = BATCH * (uint)get_global_id(0), end = min(begin + BATCH, n);
    uint places[BATCH];
    for (uint i = begin; i < end; ++i) {
        const position p = position_of(points, i);
        places[i - begin] = (uint)(mixed(mixed(mixed(p.x) ^ p.y) ^ p.z) >> 20);
        (void)table[places[i - begin] & mask]; // fetches it
    }
    for (uint i = begin; i < end; ++i) {
        const position p = position_of(points, i);
        uint other = 0, probe = 0;
        for (; probe < MOST_PROBES; ++probe) {
            volatile __global uint *slot = table + ((places[i - begin] + probe) & mask);
            other = *slot; // most slots are taken for good when vertices repeat
            if (other == 0)
                other = atomic_cmpxchg(slot, 0, i + 1);
            if (other == 0 || is_at(p, points, other - 1))
                break;
        }
        first[i] = other ? other - 1 : i;
        if (other)
            *merged = 1;
        if (probe == MOST_PROBES)
            *unsure = 1;
    }
}

// The positions of the faces of a batch, `first` of their vertices if that is given.
typedef struct {
    uint at[BATCH][3], begin;
    bool proper[BATCH]; // false beyond the last face, and if two positions are the same
} batch;

void fetch_faces(batch *b, __global const uint *faces, uint n, __global const uint *first,
                 volatile __global const uint *lists)
{
    b->begin = BATCH * (uint)get_global_id(0);
    for (uint f = 0; f < BATCH; ++f) {
        const uint face = min(b->begin + f, n - 1);
        uint *at = b->at[f];
        for (uint i = 0; i < 3; ++i) {
            const uint vertex = faces[3 * (size_t)face + i];
            at[i] = first ? first[vertex] : vertex;
            (void)lists[LIST * (size_t)at[i]]; // fetches it
        }
        b->proper[f] = b->begin + f < n && at[0] != at[1] && at[1] != at[2] && at[2] != at[0];
    }
}

// List the sides that run to their higher end at their lower one: the number of those at position i is
// lists[LIST i], the higher ends of the first ones follow it, and `more` has the others: heads[i] is the
// last one plus 1, or 0, and more[s] = (the higher end of side s, the one listed before it plus 1, or 0).
__kernel void list_sides(__global const uint *faces, const uint n, __global const uint *first,
                         volatile __global uint *lists, volatile __global uint *heads,
                         __global uint2 *more)
{
    batch b;
    fetch_faces(&b, faces, n, first, lists);
    for (uint k = 0; k < 3 * BATCH; ++k) {
        const uint f = k / 3, start = b.at[f][k % 3], end = b.at[f][(k + 1) % 3];
        if (!b.proper[f] || start > end)
            continue;
        volatile __global uint *list = lists + LIST * (size_t)start;
        const uint place = atomic_inc(list) + 1, side = 3 * b.begin + k;
        if (place < LIST)
            list[place] = end;
        else
            more[side] = (uint2)(end, atomic_xchg(&heads[start], side + 1));
    }
}

// MARK the listed side to which each other side runs back; *open becomes 1 if there is none, or if
// another one runs back to it. *unsure becomes 1 if too many are listed.
__kernel void mark_sides(__global const uint *faces, const uint n, __global const uint *first,
                         volatile __global uint *lists, __global const uint *heads,
                         volatile __global uint *more, volatile __global uint *open,
                         volatile __global uint *unsure)
{
    batch b;
    fetch_faces(&b, faces, n, first, lists);
    for (uint k = 0; k < 3 * BATCH; ++k) {
        const uint f = k / 3, start = b.at[f][k % 3], end = b.at[f][(k + 1) % 3];
        if (!b.proper[f] || start < end)
            continue;
        volatile __global uint *list = lists + LIST * (size_t)end, *side = list;
        uint left = list[0];
        if (left > MOST_SIDES) {
            *unsure = 1;
            return;
        }
        for (uint place = 1; side == list && place < LIST && left > 0; ++place, --left)
            if ((list[place] & ~MARK) == start)
                side = list + place;
        for (uint other = heads[end]; side == list && left > 0; --left) {
            volatile __global uint *entry = more + 2 * (size_t)(other - 1);
            if ((entry[0] & ~MARK) == start)
                side = entry;
            other = entry[1];
        }
        if (side == list || atomic_or(side, MARK) & MARK)
            *open = 1;
    }
}

// *some becomes 1 if a side is listed, and *open if one of them is not marked.
__kernel void check_sides(__global const uint *lists, const uint n, __global const uint *heads,
                          __global const uint *more, volatile __global uint *open,
                          volatile __global uint *some)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    __global const uint *list = lists + LIST * (size_t)gid;
    uint left = list[0], place = 1;
    if (left > 0 && !*some)
        *some = 1;
    for (; place < LIST && left > 0; ++place, --left)
        if (!(list[place] & MARK))
            *open = 1;
    for (uint side = heads[gid]; left > 0; --left) {
        if (!(more[2 * (size_t)(side - 1)] & MARK))
            *open = 1;
        side = more[2 * (size_t)(side - 1) + 1];
    }
}
