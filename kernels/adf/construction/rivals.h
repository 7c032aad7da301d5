// The triangles that may be nearest somewhere in the child of a block.

#include "adf/construction/lists.h"
#include "adf/construction/narrow.h"

// The triangles needed by a child of a block: the entries of the block's list that have the child's
// bit. count: their number.
typedef struct {
    scene_of_lists scene;
    __global uchar *masks;
    uint begin, end, child, count;
} child_list;

// The index of the first such entry at or after a given index; `end` if there is none.
uint from(const child_list *list, uint place)
{
    while (place < list->end && !(list->masks[place] >> list->child & 1))
        ++place;
    return place;
}

// The slots of the next triangles of the list from `place` on, sixteen at most; the last one pads
// them. Returns the index after them.
uint next_sixteen(const child_list *list, uint place, uint *slots)
{
    uint count = 0;
    for (; place < list->end && count < 16; ++place) {
        slots[count] = list->scene.items[place];
        count += list->masks[place] >> list->child & 1;
    }
    const uint last = count < 16 ? slots[count - 1] : 0;
    for (; count < 16; ++count)
        slots[count] = last;
    return from(list, place);
}

// The corners of a child; in single precision, relative to its centre.
typedef struct {
    ways exact;
    float at[3][8];
    float3 centre;
} child_corners;

child_corners corners_of(uint3 cell, uint level, double extent)
{
    child_corners c;
    c.exact = lattice_points(cell, CELL, 0, level, extent);
    const double scale = 2.0 / (2ul << level);
    const double3 middle = (double3)(2 * cell.x + 1, 2 * cell.y + 1, 2 * cell.z + 1);
    c.centre = convert_float3(extent * (middle * scale - 1.0));
    vstore8(convert_float8(c.exact.x - c.centre.x), 0, c.at[0]);
    vstore8(convert_float8(c.exact.y - c.centre.y), 0, c.at[1]);
    vstore8(convert_float8(c.exact.z - c.centre.z), 0, c.at[2]);
    return c;
}

// The triangles nearest to the corners of a child, if it has many: first those of the triangles with a
// side, then those of all; and the points of them that are nearest: away[k][i] = an upper bound of the
// distance of corner k from point i, infinite if there is none.
typedef struct {
    bool many;
    narrow_triangles triangles;
    float away[8][16];
} rivals;

// Finds the rivals in a child of a block; places and sided: the nearest triangles, and the nearest ones
// with a side, of the block's vertices.
NOINLINE void find_rivals(const child_list *list, const child_corners *c, __global const uint *places,
                 __global const uint *sided, float edge, rivals *known)
{
    known->many = list->count > FEW || list->end - list->begin >= LONG;
    if (!known->many)
        return;
    uint slots[16];
    float at[3][16], none[16];
    for (uint i = 0; i < 16; ++i) {
        const uint vertex = CORNERS[8 * list->child + i % 8];
        none[i] = i < 8 && sided[vertex] == NO_TRIANGLE ? INFINITY : 0.0f;
        slots[i] = list->scene.items[i < 8 && none[i] == 0 ? sided[vertex] : places[vertex]];
        for (uint axis = 0; axis < 3; ++axis)
            at[axis][i] = c->at[axis][i % 8];
    }
    known->triangles = sixteen_narrow(&list->scene, slots, c->centre, edge);
    const float16 x = vload16(0, at[0]), y = vload16(0, at[1]), z = vload16(0, at[2]);
    narrow_ways way;
    int16 feature;
    narrow_squares(&known->triangles, x, y, z, &way, &feature);
    for (uint k = 0; k < 8; ++k) {
        const float16 dx = c->at[0][k] - (x - way.x), dy = c->at[1][k] - (y - way.y);
        const float16 dz = c->at[2][k] - (z - way.z);
        const float16 away = sqrt(dx * dx + dy * dy + dz * dz) + 2 * known->triangles.doubt +
                             vload16(0, none);
        vstore16(away, 0, known->away[k]);
    }
}

// Whether each of sixteen triangles, at these distances from the corners, may be nearest somewhere.
//
// For points t and r of the mesh, |p - t|^2 - |p - r|^2 is linear in p: positive in a cell if it is at
// the corners. So a triangle is nowhere nearest in a cell if all corners are nearer to r. Only rivals
// with a side count, so that the nearest triangle with a side stays, too.
int16 may_be_nearest(const rivals *known, const float16 *distances, float16 doubt)
{
    float16 least[8];
    for (uint k = 0; k < 8; ++k)
        least[k] = distances[k] - doubt;
    int16 may = -1;
    for (uint i = 0; i < 8; ++i) {
        float16 farther = INFINITY;
        for (uint k = 0; k < 8; ++k)
            farther = lesser(farther, least[k] - known->away[k][i]);
        may &= farther <= 0.0f;
    }
    return may;
}

// Removes from the list those of the sixteen entries from `place` to `next` that are not needed.
void keep(child_list *list, uint place, uint next, int16 needed)
{
    int need[16];
    vstore16(needed, 0, need);
    for (uint lane = 0; place < next; ++place) {
        const uint mask = list->masks[place], own = mask >> list->child & 1;
        const uint drop = own & (uint)(need[lane & 15] + 1);
        list->masks[place] = (uchar)(mask ^ drop << list->child);
        list->count += own ^ drop;
        lane += own;
    }
}

// Removes the triangles from the list that are nowhere nearest in the child.
NOINLINE void prune(child_list *list, const child_corners *c, const rivals *known, float edge)
{
    if (!known->many)
        return;
    list->count = 0;
    for (uint j = from(list, list->begin), next; j < list->end; j = next) {
        uint slots[16];
        next = next_sixteen(list, j, slots);
        const narrow_triangles n = sixteen_narrow(&list->scene, slots, c->centre, edge);
        float16 distances[8];
        for (uint k = 0; k < 8; ++k) {
            narrow_ways way;
            int16 feature;
            distances[k] =
                sqrt(narrow_squares(&n, c->at[0][k], c->at[1][k], c->at[2][k], &way, &feature));
        }
        keep(list, j, next, may_be_nearest(known, distances, n.doubt));
    }
}
