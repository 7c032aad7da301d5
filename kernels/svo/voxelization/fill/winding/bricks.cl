// Winding numbers near holes, at all voxels of bricks. Host side: voxtool/svo/voxelization/fill/winding.py. Options:
// CODE=ulong, WIDE.

#include "svo/voxelization/fill/winding/near.h"
#include "spatial/arctangent.h"
#include "svo/voxelization/fill/winding/bricks.h"

// The sums of the caps over a brick; false if more than `most` leaves are near it.
bool sum_brick(brick_sums *sums, int3 low, double4 frame, CAPS, __global const double *moments,
               __global const double *cap_areas, __global const double *cap_dipoles, double reach, uint most)
{
    const int3 first = low * VOXEL + HALF;
    const double3 first_voxel = convert_double3(low) + 0.5;
    const double3 p = to_local(low * VOXEL + 2 * VOXEL, frame), p0 = to_local(first, frame);
    const double voxel = VOXEL * frame.w, voxels = 1 / voxel;
    uint ids[STACK], top = 1, leaves = 0;
    ids[0] = 0;
    while (top) {
        const uint id = ids[--top], child = ARITY * id + 1;
        __global const double *m = moments + (size_t)id * (MOMENTS * ARITY);
        const double8 x = vload8(0, m) - p.x, y = vload8(1, m) - p.y, z = vload8(2, m) - p.z;
        const double8 reaches = vload8(3, m), area = vload8(0, cap_areas + child) * (voxels * voxels);
        const long8 exists = reaches >= 0.0;
        const double8 distance = exists ? sqrt(x * x + y * y + z * z) * voxels : 0.0;
        const double8 far = sqrt(exists ? reaches : 0.0) * voxels, radius = far / reach;
        const long8 linear = linear_children(sums, distance, far, radius, area);
        if (any(linear))
            add_to_corners(sums, m, p, SPREAD * (float)voxel, linear);
        const double8 gap = distance - HALF_DIAGONAL - radius;
        const long8 distant = (distance > BEYOND * far + HALF_DIAGONAL) & (gap > 0.0);
        long left[ARITY], is_distant[ARITY];
        double parts[ARITY];
        vstore8(exists & ~linear, 0, left);
        vstore8(distant, 0, is_distant);
        vstore8(area / (gap * gap), 0, parts);
        for (uint i = 0; i < ARITY; ++i) {
            if (!left[i])
                continue;
            if (is_distant[i]) {
                add_to_voxels(sums, m + i, p0, (float)voxel);
                sums->error += FAR_ERROR * parts[i];
                continue;
            }
            if (child < cap_first_leaf) {
                ids[top++] = child + i;
                continue;
            }
            if (++leaves > most)
                return false;
            const uint leaf = child + i - cap_first_leaf, at = leaf * LEAF;
            const dipoles d = dipoles_of(cap_dipoles + (size_t)at * DIPOLE_FIELDS, first_voxel);
            if (any(d.flat))
                add_flat(sums, &d);
            int flat[LEAF], apart[LEAF];
            vstore4(d.flat, 0, flat);
            vstore4(d.apart, 0, apart);
            for (uint k = 0; k < min((uint)LEAF, cap_count - at); ++k) {
                if (flat[k])
                    continue;
                if (apart[k]) {
                    add_dipole(sums, &d, k);
                    continue;
                }
                const triangle t = fetch_triangle(vertices, faces, first_cap + cap_names[at + k] / 3);
                add_triangle(sums, &t, first);
            }
        }
    }
    return true;
}

// For each brick: inside[i] = the voxels of winding number 1/2 or more; open[i] = those that are left to
// decide, because their number may be within `doubt` of 1/2, or more than `most` leaves of the caps are
// near the brick; same[i] = 1 if none is left, and those inside are those that N >= 1 gives.
__kernel void decide_bricks(__global const ulong *bricks, const uint n, const double4 frame, CROSSINGS,
                            CAPS, __global const double *moments, __global const double *cap_areas,
                            __global const double *cap_dipoles, const double reach, const uint most,
                            const double doubt,
                            __global ulong *inside, __global ulong *open, __global uchar *same)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const int3 low = convert_int3(morton_decode(bricks[gid])) << BRICK_LEVEL;
    brick_sums sums = {0};
    const bool summed = sum_brick(&sums, low, frame, cap_names, cap_count, cap_first_leaf, vertices, faces,
                                  first_cap, moments, cap_areas, cap_dipoles, reach, most);
    float caps[16 * PER_BRICK], doubts[16 * PER_BRICK], far[8];
    for (uint g = 0; g < PER_BRICK; ++g) {
        vstore16(sums.near[g], g, caps);
        vstore16(sums.doubt[g], g, doubts);
    }
    vstore8(sums_at_corners(&sums), 0, far);
    ulong in = 0, left = 0, enclosed = 0;
    for (uint row = 0; row < 16; ++row) {
        const int j = row & 3, k = row >> 2;
        const double y = j / (2 * SPREAD), z = k / (2 * SPREAD);
        const double begin = mix_of(mix_of(far[0], far[2], y), mix_of(far[4], far[6], y), z);
        const double end = mix_of(mix_of(far[1], far[3], y), mix_of(far[5], far[7], y), z);
        if (low.y + j >= shape.y || low.z + k >= shape.z)
            continue;
        uint at = first_crossing(shape, crossings, count, x_bits, low.y + j, low.z + k);
        int number = 0;
        for (int i = 0; i < 4 && low.x + i < shape.x; ++i) {
            number += number_until(shape, crossings, count, x_bits, low.x + i, low.y + j, low.z + k, &at);
            const uint place = voxel_place((uint3)(i, j, k));
            const double part = mix_of(begin, end, i / (2 * SPREAD)) / (4 * PI);
            const double over = number - caps[place] / (2 * PI) - part - 0.5;
            const double margin = doubt + sums.error + SINGLE * doubts[place];
            in |= (ulong)(over >= 0) << place;
            left |= (ulong)(!(over > margin || over < -margin) || !summed) << place;
            enclosed |= (ulong)(number >= 1) << place;
        }
    }
    inside[gid] = in;
    open[gid] = left;
    same[gid] = in == enclosed && !left;
}

// Decide the voxels of bricks as decide_bricks does, by the expansion of brick i's block, parents[i].
// `values` holds the winding number of the mesh about the voxel beyond the block's middle; that of its
// caps, negated, if `counted`: then the mesh crosses the block and no cap does, and the crossings
// before each voxel are added.
__kernel void decide_by_expansions(__global const ulong *bricks, const uint n, const double4 frame,
                                   CROSSINGS, __global const uint *parents,
                                   __global const ulong *blocks, __global const uchar *levels,
                                   __global const double *expansions, __global const double *values,
                                   __global const uchar *counted, __global ulong *inside,
                                   __global ulong *open, __global uchar *same)
{
    const uint gid = get_global_id(0);
    if (gid >= n)
        return;
    const uint block = parents[gid];
    const int3 low = convert_int3(morton_decode(bricks[gid])) << BRICK_LEVEL;
    const int3 middle = middle_of(centres_of(blocks[block], levels[block]));
    const double3 d0 = convert_double3(low * VOXEL + HALF - middle) * frame.w;
    __global const double *e = expansions + (size_t)block * EXPANSION;
    const double margin = e[EXPANSION - 1], voxel = VOXEL * frame.w;
    ulong in = 0, left = 0, enclosed = 0;
    for (uint row = 0; row < 16; ++row) {
        const int j = row & 3, k = row >> 2;
        if (low.y + j >= shape.y || low.z + k >= shape.z)
            continue;
        const double y = d0.y + j * voxel, z = d0.z + k * voxel;
        // the polynomial of x along the row
        const double none = y * (e[1] + y * (e[4] + y * e[10] + z * e[15]) + z * e[6]) +
                            z * (e[2] + z * (e[5] + z * e[11] + y * e[17]));
        const double one = e[0] + y * (e[8] + y * e[14] + z * e[18]) + z * (e[7] + z * e[16]);
        const double two = e[3] + y * e[12] + z * e[13];
        uint at = first_crossing(shape, crossings, count, x_bits, low.y + j, low.z + k);
        int number = 0;
        for (int i = 0; i < 4 && low.x + i < shape.x; ++i) {
            const double x = d0.x + i * voxel;
            number += number_until(shape, crossings, count, x_bits, low.x + i, low.y + j, low.z + k, &at);
            const double change = none + x * (one + x * (two + x * e[9]));
            const double over = values[block] - change + (counted[block] ? number : 0) - 0.5;
            const uint place = voxel_place((uint3)(i, j, k));
            in |= (ulong)(over >= 0) << place;
            left |= (ulong)!(over > margin || over < -margin) << place;
            enclosed |= (ulong)(number >= 1) << place;
        }
    }
    inside[gid] = in;
    open[gid] = left;
    same[gid] = in == enclosed && !left;
}

// bricks[places[i]] = masks[i].
__kernel void place_bricks(__global const ulong *masks, __global const uint *places, const uint n,
                           __global ulong *bricks)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        bricks[places[gid]] = masks[gid];
}
