// Whether every edge has two faces that run along it in opposite directions. Host side:
// voxtool/mesh/watertight.py. The order of atomic operations changes neither answer nor doubt.

#include "mesh/watertight.h"

// The bits of a coordinate, where -0.0 is 0.0.
ulong bits_of(ulong coordinate) { return coordinate << 1 ? coordinate : 0; }

ulong mixed(ulong code)
{
    code = (code ^ code >> 32) * 0x9E3779B97F4A7C15ul;
    return code ^ code >> 29;
}

// first[i] = the same number for all vertices at the position of vertex i: one of them, which `table`
// holds. `table` has mask + 1 slots, NOTHING in each. *unsure becomes 1 if a chain is too long.
__kernel void merge_vertices(__global const ulong *points, const uint n, volatile __global uint *table,
                             const uint mask, __global uint *first, volatile __global uint *unsure)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const ulong x = bits_of(points[3 * (size_t)gid]), y = bits_of(points[3 * (size_t)gid + 1]),
                z = bits_of(points[3 * (size_t)gid + 2]);
    const uint place = (uint)(mixed(mixed(mixed(x) ^ y) ^ z) >> 20);
    for (uint probe = 0; probe < MOST_PROBES; ++probe) {
        volatile __global uint *slot = table + ((place + probe) & mask);
        uint other = *slot; // most slots are taken for good when vertices repeat
        if (other == NOTHING)
            other = atomic_cmpxchg(slot, NOTHING, gid);
        if (other == NOTHING || other == gid) {
            first[gid] = gid;
            return;
        }
        __global const ulong *p = points + 3 * (size_t)other;
        if (bits_of(p[0]) == x && bits_of(p[1]) == y && bits_of(p[2]) == z) {
            first[gid] = other;
            return;
        }
    }
    first[gid] = gid;
    *unsure = 1;
}

// The three positions of a face; false if two are the same.
bool corners_of(__global const uint *faces, __global const uint *first, uint face, uint *at)
{
    for (uint i = 0; i < 3; ++i)
        at[i] = first[faces[3 * (size_t)face + i]];
    return at[0] != at[1] && at[1] != at[2] && at[2] != at[0];
}

// Of the sides that run to their higher end, count those at each lower end; or, with `sides`, store the
// higher end from places[lower end] on. *degenerate is increased for faces without three positions.
__kernel void list_sides(__global const uint *faces, const uint n, __global const uint *first,
                         volatile __global uint *places, __global uint *sides,
                         volatile __global uint *degenerate)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    uint at[3];
    if (!corners_of(faces, first, gid, at)) {
        atomic_inc(degenerate);
        return;
    }
    for (uint i = 0; i < 3; ++i) {
        const uint start = at[i], end = at[(i + 1) % 3];
        if (start > end)
            continue;
        const uint place = atomic_inc(&places[start]);
        if (sides)
            sides[place] = end;
    }
}

// Mark the listed side to which each other side runs back; *open becomes 1 if there is none. The sides
// at position i are listed from ends[i - 1] to ends[i]. *unsure becomes 1 if they are too many.
__kernel void mark_sides(__global const uint *faces, const uint n, __global const uint *first,
                         __global const uint *ends, volatile __global uint *sides,
                         volatile __global uint *open, volatile __global uint *unsure)
{
    const uint gid = get_global_id(0);
    uint at[3];
    if (gid >= n || !corners_of(faces, first, gid, at))
        return;
    for (uint i = 0; i < 3; ++i) {
        const uint start = at[i], end = at[(i + 1) % 3];
        if (start < end)
            continue;
        const uint begin = end ? ends[end - 1] : 0, stop = ends[end];
        if (stop - begin > MOST_SIDES) {
            *unsure = 1;
            return;
        }
        uint k = begin;
        while (k < stop && (sides[k] & ~MARK) != start)
            ++k;
        if (k < stop)
            sides[k] = start | MARK;
        else
            *open = 1;
    }
}

// *open becomes 1 if a side is not marked.
__kernel void check_sides(__global const uint *sides, const uint n, volatile __global uint *open)
{
    const uint gid = get_global_id(0);
    if (gid < n && !(sides[gid] & MARK))
        *open = 1;
}
