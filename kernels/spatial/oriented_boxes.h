// Boxes of nodes whose axes follow the triangles [Gottschalk 1996]. Boxes of a patch of a surface are
// flat, so that fewer are within reach of a point. Host side: voxtool/spatial/distance.py.

// Exceeds the rounding errors of places along the axes, in single precision: 77 units of 2^-24 for a
// point within NEAR extents, 2 units for half of an extent.
#define WIDER 0x1p-17
#define LEVEL 1e-30 // the square of an area that has no direction

typedef struct {
    double3 u, v, w;
} axes;

double inner(double3 a, double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

double3 outer(double3 a, double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

double3 direction(double3 a)
{
    return a / sqrt(inner(a, a));
}

// The corners of a slot's triangle.
void corners_of(__global const double *leaves, uint slot, double3 *corners)
{
    __global const double *t = leaves + (size_t)(slot / LEAF) * (FIELDS * LEAF) + slot % LEAF;
    const double3 a = (double3)(t[0], t[LEAF], t[2 * LEAF]);
    const double3 e = (double3)(t[3 * LEAF], t[4 * LEAF], t[5 * LEAF]);
    const double3 g = (double3)(t[6 * LEAF], t[7 * LEAF], t[8 * LEAF]);
    corners[0] = a, corners[1] = a + e, corners[2] = a + t[9 * LEAF] * e + g;
}

// Axes of which the last is along the sum of the area vectors of triangles.
axes axes_of(__global const double *leaves, uint begin, uint end)
{
    double3 corners[3], area = 0;
    for (uint slot = begin; slot < end; ++slot) {
        corners_of(leaves, slot, corners);
        area += outer(corners[1] - corners[0], corners[2] - corners[0]);
    }
    axes a;
    a.w = inner(area, area) > LEVEL ? direction(area) : (double3)(0, 0, 1);
    const double3 size = a.w < 0 ? -a.w : a.w;
    const bool x = size.x <= size.y && size.x <= size.z, y = size.y <= size.z;
    a.u = direction(outer((double3)(x, !x && y, !x && !y), a.w));
    a.v = outer(a.w, a.u);
    return a;
}

// Stores the box of the slots from `begin` to `end`: centre, axes, half of the extents.
void store_oriented(__global const double *leaves, uint begin, uint end, __global float *box)
{
    const axes exact = axes_of(leaves, begin, end);
    const double3 along[3] = {convert_double3(convert_float3(exact.u)),
                              convert_double3(convert_float3(exact.v)),
                              convert_double3(convert_float3(exact.w))};
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (uint slot = begin; slot < end; ++slot) {
        double3 corners[3];
        corners_of(leaves, slot, corners);
        for (uint i = 0; i < 9; ++i) {
            const double place = inner(along[i % 3], corners[i / 3]);
            low[i % 3] = place < low[i % 3] ? place : low[i % 3];
            high[i % 3] = place > high[i % 3] ? place : high[i % 3];
        }
    }
    const double3 twice =
        (low[0] + high[0]) * exact.u + (low[1] + high[1]) * exact.v + (low[2] + high[2]) * exact.w;
    const float3 centre = convert_float3(0.5 * twice);
    vstore3(centre, 0, box);
    for (uint i = 0; i < 3; ++i) {
        const double middle = inner(along[i], convert_double3(centre));
        const double up = high[i] - middle, down = middle - low[i];
        vstore3(convert_float3(along[i]), 1 + i, box);
        box[12 + i] = (float)((up > down ? up : down) + WIDER);
    }
}

float16 outside(__global const float *along, float half_extent, float16 x, float16 y, float16 z)
{
    const float16 place = x * along[0] + y * along[1] + z * along[2];
    const float16 gap = (place < 0.0f ? -place : place) - half_extent;
    return gap > 0.0f ? gap : 0.0f;
}

// The squared distances of points to an oriented box, in single precision.
float16 squares_to(__global const float *box, float16 x, float16 y, float16 z)
{
    x -= box[0], y -= box[1], z -= box[2];
    const float16 u = outside(box + 3, box[12], x, y, z);
    const float16 v = outside(box + 6, box[13], x, y, z);
    const float16 w = outside(box + 9, box[14], x, y, z);
    return u * u + v * v + w * w;
}
