// Perfect spatial hash [Lefebvre 2006], [ADF]. Host side: voxtool/adf/field/hashing.py.
//
// A key is stored as a code: three numbers, z in the highest bits, each with as many bits as `top`,
// the largest number of any key. A slot is a uint of three numbers of SLOT_BITS bits. Slots in this
// file are table slots divided by r modulo m.

#include "adf/field/hashing.h"

#define WORD 64 // bits of a ulong

// Parameter groups. KEYS: the codes of the keys. BUCKETS: the buckets of a window, which are
// searched in parallel: start and number of each bucket's keys, and the offset of each key from the
// bucket's first.
#define KEYS __global const ulong *codes, const uint top
#define BUCKETS                                                                                        \
    __global const uint *window, __global const uint *firsts, __global const uint *sizes,              \
        __global uint *apart

uint bits_of(uint top)
{
    return 32 - clz(top);
}

uint3 key_of(ulong code, uint top)
{
    const uint bits = bits_of(top), mask = (1u << bits) - 1;
    return (uint3)((uint)code & mask, (uint)(code >> bits) & mask, (uint)(code >> 2 * bits));
}

uint packed(uint3 p)
{
    return p.x | p.y << SLOT_BITS | p.z << 2 * SLOT_BITS;
}

uint3 unpacked(uint p)
{
    const uint mask = (1u << SLOT_BITS) - 1;
    return (uint3)(p & mask, p >> SLOT_BITS & mask, p >> 2 * SLOT_BITS);
}

// The linear index of a point in a cubic array, x fastest.
uint flat(uint3 p, uint side)
{
    return p.x + side * (p.y + side * p.z);
}

// p mod m, for p < 2 m.
uint3 wrapped(uint3 p, uint m)
{
    return (uint3)(p.x < m ? p.x : p.x - m, p.y < m ? p.y : p.y - m, p.z < m ? p.z : p.z - m);
}

__kernel void encode_keys(const uint n, __global const uint *keys, const uint top,
                          __global ulong *codes)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint3 key = vload3(gid, keys);
    codes[gid] = (ulong)key.x | (ulong)key.y << bits_of(top) | (ulong)key.z << 2 * bits_of(top);
}

// repeated = the first sorted code that equals its successor.
__kernel void find_repeated(const uint n, __global const ulong *codes, __global uint *repeated)
{
    const uint gid = get_global_id(0);
    if (gid + 1 < n && codes[gid] == codes[gid + 1])
        atomic_min(repeated, gid);
}

// ---- buckets

// sizes[cell] = number of keys that are congruent to it mod r.
__kernel void count_keys(const uint n, KEYS, const uint r, __global uint *sizes)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        atomic_inc(&sizes[flat(key_of(codes[gid], top) % r, r)]);
}

// cells[i] = key i mod r; order[i] = i.
__kernel void find_cells(const uint n, KEYS, const uint r, __global uint *cells,
                         __global uint *order)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    cells[gid] = flat(key_of(codes[gid], top) % r, r);
    order[gid] = gid;
}

// Whether all keys of a bucket differ mod w. Keys that are equal mod w and mod r differ by at least
// r w. Returns false for more than MOST_PARTED keys that may be equal: their pairwise comparison
// costs too much.
bool parts(uint w, __global const ulong *codes, __global const uint *keys, uint size, uint top,
           uint r)
{
    if ((ulong)r * w >= top)
        return true;
    if (size > MOST_PARTED)
        return false;
    for (uint i = 1; i < size; ++i)
        for (uint j = 0; j < i; ++j)
            if (all(key_of(codes[keys[i]], top) % w == key_of(codes[keys[j]], top) % w))
                return false;
    return true;
}

// Algorithm 3.1 of [ADF]: w for each bucket of a window. w is the first of the `choices`, starting
// at first_choice[gid], that separates the bucket's keys; 0 if none does. The kernel then computes
// the slot of each bucket's first key at offset 0, and the offsets of its other keys.
__kernel void place_keys(const uint n, BUCKETS, KEYS, __global const uint *order,
                         __global const uint *first_choice, __global const uint *choices,
                         const uint choice_count, const uint m, const uint r, const uint inverse,
                         __global uint *ws, __global uint *places, __global uint *steps)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint bucket = window[gid], first = firsts[bucket], size = sizes[bucket];
    uint w = 0;
    for (uint i = 0; i < choice_count && w == 0; ++i) {
        const uint choice = choices[(first_choice[gid] + i) % choice_count];
        if (parts(choice, codes, order + first, size, top, r))
            w = choice;
    }
    ws[bucket] = w;
    steps[bucket] = 0;
    if (w == 0)
        return;
    const uint3 place = key_of(codes[order[first]], top) % w * inverse % m;
    places[bucket] = packed(place);
    for (uint i = first; i < first + size; ++i) {
        const uint3 other = key_of(codes[order[i]], top) % w * inverse % m;
        apart[i] = packed(wrapped(other + m - place, m));
    }
}

// ---- search

// The bit table: 1 where a slot is vacant. A row along x holds its slots twice, so that an offset
// slot needs no mod, followed by zeros. The search advances in spans of WORDS words; a row has
// twice as many words as `spans`.
__kernel void vacate(const uint n, const uint m, const uint spans, __global ulong *vacant)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint begin = gid % (2 * WORDS * spans) * WORD;
    vacant[gid] = begin >= 2 * m ? 0 : ~0ul >> (WORD - min(2 * m - begin, (uint)WORD));
}

// The lowest bit.
uint lowest(ulong4 bits)
{
    const ulong word = bits.x ? bits.x : bits.y ? bits.y : bits.z ? bits.z : bits.w;
    const uint begin = bits.x ? 0 : bits.y ? 1 : bits.z ? 2 : 3;
    return WORD * begin + WORD - 1 - (uint)clz(word & -word);
}

// The claim that bucket gid of a window writes to its slots; the smallest claim is kept. Later
// rounds have smaller claims; within a round the first bucket has the smallest.
uint claim_of(uint gid, uint round)
{
    return ~(round * LANES) - (LANES - 1 - gid);
}

// For each bucket of a window: finds the next vacant slot for its first key for which the slots of
// its other keys are vacant too, and claims these slots. steps[bucket] spans have already failed.
// The bucket is LOST until its slots are assigned, and NO_PLACE after `reach` spans.
__kernel void search(const uint n, BUCKETS, __global const ulong *vacant, const uint m,
                     const uint spans, __global const uint *starts, const uint reach,
                     __global uint *steps, const uint round, __global uint *claims,
                     __global uint *targets, __global uchar *outcome)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint bucket = window[gid], first = firsts[bucket], size = sizes[bucket];
    uint step = steps[bucket];
    const uint at = (starts[bucket] + step) % (m * m * spans);
    uint span = at % spans, y = at / spans % m, z = at / spans / m;
    ulong4 fits = 0;
    for (; step < reach; ++step) {
        fits = vload4((z * m + y) * 2 * spans + span, vacant);
        // farthest first: nearer keys often fit together
        for (uint i = size - 1; i > 0 && any(fits != 0); --i) {
            const uint3 d = unpacked(apart[first + i]);
            const uint3 row = wrapped((uint3)(0, y + d.y, z + d.z), m);
            __global const ulong *from =
                vacant + ((row.z * m + row.y) * 2 * spans + span) * WORDS + d.x / WORD;
            const ulong shift = d.x % WORD;
            fits &= vload4(0, from) >> shift | vload4(0, from + 1) << 1 << (WORD - 1 - shift);
        }
        if (any(fits != 0))
            break;
        if (++span == spans) {
            span = 0;
            if (++y == m) {
                y = 0;
                if (++z == m)
                    z = 0;
            }
        }
    }
    steps[bucket] = step;
    outcome[gid] = step < reach ? LOST : NO_PLACE;
    if (step == reach)
        return;
    const uint3 target = wrapped((uint3)(WORD * WORDS * span + lowest(fits), y, z), m);
    targets[bucket] = packed(target);
    for (uint i = first; i < first + size; ++i)
        atomic_min(&claims[flat(wrapped(target + unpacked(apart[i]), m), m)], claim_of(gid, round));
}

// Assigns slots to the buckets whose claims all succeeded.
__kernel void settle(const uint n, BUCKETS, __global uint *vacant, const uint m, const uint spans,
                     const uint round, __global const uint *claims, __global const uint *targets,
                     __global uchar *outcome)
{
    const uint gid = get_global_id(0);
    if (gid >= n || outcome[gid] == NO_PLACE)
        return;
    const uint bucket = window[gid], first = firsts[bucket], size = sizes[bucket];
    const uint3 target = unpacked(targets[bucket]);
    for (uint i = first; i < first + size; ++i)
        if (claims[flat(wrapped(target + unpacked(apart[i]), m), m)] != claim_of(gid, round))
            return;
    for (uint i = first; i < first + size; ++i) {
        const uint3 slot = wrapped(target + unpacked(apart[i]), m);
        const uint row = (slot.z * m + slot.y) * 2 * WORDS * spans * WORD;
        for (uint bit = row + slot.x; bit <= row + slot.x + m; bit += m)
            atomic_and(&vacant[bit / 32], ~(1u << bit % 32)); // atomics have 32 bits
    }
    outcome[gid] = WON;
}
