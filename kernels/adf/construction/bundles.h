// Bundles of a long list: sixteen triangles each that follow one another, so that they are near each
// other, within a ball. A ball bounds their distances from below and above, sixteen bundles at once.

#include "adf/construction/lists.h"
#include "adf/construction/narrow.h"

#define SIXTEEN (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)

// The bundles of a block's list. Balls: the coordinates of the centre, relative to the block's, and the
// radius: rows of `row` numbers, of which the list has `count` from `first` on.
typedef struct {
    __global float *balls;
    uint row, first, count;
} bundles;

// The bundles of a list from begin to end, the gid-th; none of a short one.
bundles bundles_of(__global float *balls, uint row, uint gid, uint begin, uint end)
{
    const uint count = end - begin < LONG ? 0 : (end - begin + 15) / 16;
    const bundles all = {balls, row, begin / 16 + gid, count};
    return all;
}

// Sets the ball about a bundle. Rounding is less than the triangles' doubts.
void enclose(const bundles *all, uint bundle, const narrow_triangles *n)
{
    const float16 *t = n->t;
    float16 squares[3] = {0, 0, 0};
    __global float *ball = all->balls + all->first + bundle;
    for (uint axis = 0; axis < 3; ++axis, ball += all->row) {
        const float16 a = t[axis], b = a + t[3 + axis], c = a + t[9] * t[3 + axis] + t[6 + axis];
        const float low = lowest_narrow(lesser(a, lesser(b, c)));
        const float middle = 0.5f * (low + highest_narrow(greater(a, greater(b, c))));
        *ball = middle;
        squares[0] += (a - middle) * (a - middle);
        squares[1] += (b - middle) * (b - middle);
        squares[2] += (c - middle) * (c - middle);
    }
    const float farthest = highest_narrow(greater(squares[0], greater(squares[1], squares[2])));
    *ball = sqrt(farthest) + 2 * highest_narrow(n->doubt);
}

// The ways from the centres of sixteen balls, from one on, to a point, their lengths and the radii; and
// which of the sixteen exist.
typedef struct {
    narrow_ways way;
    float16 length, radius;
    int16 exist;
} ball_ways;

ball_ways ball_ways_to(const bundles *all, uint bundle, float x, float y, float z)
{
    __global const float *balls = all->balls + all->first + bundle;
    ball_ways to;
    to.way.x = x - vload16(0, balls);
    to.way.y = y - vload16(0, balls + all->row);
    to.way.z = z - vload16(0, balls + 2 * (size_t)all->row);
    to.radius = vload16(0, balls + 3 * (size_t)all->row);
    to.length = sqrt(to.way.x * to.way.x + to.way.y * to.way.y + to.way.z * to.way.z);
    to.exist = SIXTEEN < (int)(all->count - bundle);
    return to;
}
