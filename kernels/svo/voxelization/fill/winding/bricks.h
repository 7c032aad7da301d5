// The winding number of caps at the 64 voxels of a brick at once, in single precision: good enough
// wherever it is not near a threshold. Included by svo/voxelization/fill/winding/bricks.cl.

#define PER_BRICK 4     // vectors of 16 voxels in Morton order
#define SPREAD 1.5     // voxels from the middle of a brick to the centres of its outer voxels
#define HALF_DIAGONAL (SPREAD * 1.7320509)
#define LINEAR 1.62     // over 9/8 (3 voxels)^2 6 / (4 pi); see is_linear
#define FLAT 0x1p-8     // the most that a node may deviate from a linear function in a brick
#define BEHIND 0x1p-15f // relative to `size` of triangle_vectors; nearer to 0, the sign of y is not known
#define SINGLE 0x1p-19  // winding number of an angle's error, over size / (|x| + |y|); see add_triangle
#define MOST_RATIO 0x1p15f // of size to |x| + |y|
#define ADDED 0x1p-7f   // the same of a sum's rounding, over the sum
#define DIPOLE 0x1p-10f // the most that a triangle may deviate from a dipole in a brick
#define FLAT_DIPOLE 0x1p-10f // the most that one may deviate from a linear function there, to be taken for it
#define SIXTEEN_PI_PARTS 0.02f // over 1 / (16 pi), for rounding errors in a bound
#define FAR_ERROR 0x1p-20 // winding number of the error of distant_angles16, over area / distance^2
#define BEYOND 1.5      // over the reach of moments: from there they are summed at voxels, not triangles

__constant float CORNER_X[16] = {-1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1, 1};
__constant float VOXEL_X[16] = {0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3};
__constant float VOXEL_Y[16] = {0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1};
__constant float VOXEL_Z[16] = {0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1};

double mix_of(double a, double b, double t) { return a + t * (b - a); }

// The sums over a brick: `far` at its corners, of solid angles, of two corners in each vector and of the
// children of nodes apart; `near` at its voxels, of half solid angles. SINGLE doubt bounds the error of
// the winding number that is due to `near`, infinite where an angle is not known, and `error` what is
// due to `far` and to its linear interpolation.
typedef struct {
    float16 far[4], near[PER_BRICK], doubt[PER_BRICK];
    double far_size, error; // far_size: of area / distance^2
} brick_sums;

// Allow for what is added at the corners: its area / distance^2 and what it bends by. The last part is for
// the addition, to sums of children apart that are no larger together.
void count_far(brick_sums *sums, double part, double bend)
{
    sums->far_size += part;
    sums->error += bend + FAR_ERROR * (part + sums->far_size / 32);
}

// Solid angles of nodes by their moments c[4 ..], seen from places with centres x, y, z away from them
// [Barill 2018]. At two radii or more, the terms sum to at most 4.4 area / distance^2 in absolute
// value. With u = 2^-24, none has more than 40 roundings, so that the winding number is wrong by less
// than 40 u 4.4 / (4 pi) < 2^-20 area / distance^2.
float16 distant_angles16(float16 x, float16 y, float16 z, const float16 *c)
{
    const float16 inverse = 1.0f / sqrt(x * x + y * y + z * z);
    x *= inverse, y *= inverse, z *= inverse;
    const float16 one = x * c[4] + y * c[5] + z * c[6];
    const float16 two = x * (x * c[7] + y * c[12] + z * c[11]) + y * (y * c[8] + z * c[10]) + z * z * c[9];
    const float16 three = x * (x * (x * c[13] + y * c[16] + z * c[17]) + y * (y * c[18] + z * c[22]) +
                               z * z * c[20]) +
                          y * (y * (y * c[14] + z * c[19]) + z * z * c[21]) + z * z * z * c[15];
    return inverse * inverse * (one + inverse * (7.5f * inverse * three - 3.0f * two));
}

float16 twice(double8 v)
{
    const float8 single = convert_float8(v);
    return (float16)(single, single);
}

// Add the children of a node that count at the corners of a brick alone; m is the node's first moment,
// p the middle of the brick and `spread` SPREAD in the same coordinates.
void add_to_corners(brick_sums *sums, __global const double *m, double3 p, float spread, long8 counts)
{
    const int8 counted = convert_int8(counts);
    const int16 both = (int16)(counted, counted);
    const float16 x = twice(vload8(0, m) - p.x) - vload16(0, CORNER_X) * spread;
    const float16 y = twice(vload8(1, m) - p.y), z = twice(vload8(2, m) - p.z);
    float16 c[MOMENTS];
    for (uint i = 4; i < MOMENTS; ++i)
        c[i] = twice(vload8(i, m));
    for (uint g = 0; g < 4; ++g) {
        const float above = g & 1 ? spread : -spread, behind = g & 2 ? spread : -spread;
        const float16 angles = distant_angles16(x, y - above, z - behind, c);
        sums->far[g] += both ? angles : 0.0f;
    }
}

// Add a child of a node, whose first moment is m, at the voxels of a brick; `first` is the centre of the
// brick's first voxel and `voxel` a voxel's side in the same coordinates.
void add_to_voxels(brick_sums *sums, __global const double *m, double3 first, float voxel)
{
    float16 c[MOMENTS];
    for (uint i = 4; i < MOMENTS; ++i)
        c[i] = (float)m[i * ARITY];
    const float16 x = (float)(m[0] - first.x) - vload16(0, VOXEL_X) * voxel;
    const float16 y = (float)(m[ARITY] - first.y) - vload16(0, VOXEL_Y) * voxel;
    const float16 z = (float)(m[2 * ARITY] - first.z) - vload16(0, VOXEL_Z) * voxel;
    for (uint g = 0; g < PER_BRICK; ++g) {
        const float16 angles = distant_angles16(x, y - (g & 1) * (2 * voxel), z - (g >> 1) * (2 * voxel), c);
        sums->near[g] += 0.5f * angles;
        sums->doubt[g] += ADDED * fabs(sums->near[g]);
    }
}

// angle_of in single precision; its error is below 2^-20.
float16 angles_of(float16 y, float16 x)
{
    const float16 across = fabs(y), along = fabs(x);
    const int16 steep = across > along;
    const float16 small = steep ? along : across, big = steep ? across : along;
    const int16 turned = small > (float)TAN_EIGHTH * big;
    const float16 t = (turned ? small - big : small) / (turned ? small + big : big > 0.0f ? big : 1.0f);
    const float16 z = t * t;
    float16 p = z * (float)ARCTANGENT_4 + (float)ARCTANGENT_3;
    p = p * z + (float)ARCTANGENT_2;
    p = p * z + (float)ARCTANGENT_1;
    p = p * z + (float)ARCTANGENT_0;
    float16 angle = t + t * z * p;
    angle = turned ? (float)(PI / 4) + angle : angle;
    angle = steep ? (float)(PI / 2) - angle : angle;
    angle = x < 0.0f ? (float)PI - angle : angle;
    return y < 0.0f ? -angle : angle;
}

// The triangles of a leaf as dipoles in their middles, seen from a brick; all in voxels. x, y, z: the
// middles from the brick's first voxel; nx, ny, nz: the area vectors. The middle takes the first order of
// the integral of n . r / r^3 over a triangle; the second derivatives of this are at most 6 area / r^4, and
// the squares of the distances from the middle average to a twelfth of their sum over the corners, so that
// the winding number is wrong by at most area sum / (16 pi r^4), `bound`. Rounding: as no voxel is nearer
// than 2 or the triangle's radius, coordinates are at most 5.6 gap. Each is off by 24 u gap at most, the
// place by 42 u gap, which changes n . r / r^3 by 84 u area / gap^2; its own roundings are
// 20 u area / gap^2 at most. Both are 9 u area / gap^2 of a winding number, less than FAR_ERROR.
typedef struct {
    float4 x, y, z, nx, ny, nz;
    float4 part, bound, bend; // part: area / distance^2; bend: see linear_children
    int4 apart, flat;         // far enough to be dipoles; that count at the corners alone
} dipoles;

dipoles dipoles_of(__global const double *leaf, double3 first)
{
    dipoles d = {.x = convert_float4(vload4(0, leaf) - first.x),
                 .y = convert_float4(vload4(1, leaf) - first.y),
                 .z = convert_float4(vload4(2, leaf) - first.z),
                 .nx = convert_float4(vload4(3, leaf)),
                 .ny = convert_float4(vload4(4, leaf)),
                 .nz = convert_float4(vload4(5, leaf))};
    const float4 area = convert_float4(vload4(6, leaf)), squares = convert_float4(vload4(7, leaf));
    const float4 radius = convert_float4(vload4(8, leaf));
    const float4 x = d.x - (float)SPREAD, y = d.y - (float)SPREAD, z = d.z - (float)SPREAD;
    const float4 gap = sqrt(x * x + y * y + z * z) - (float)HALF_DIAGONAL - radius, squared = gap * gap;
    d.part = area / squared;
    d.bound = (float)SIXTEEN_PI_PARTS * d.part * squares / squared;
    d.bend = (float)LINEAR * d.part / squared;
    d.apart = (gap >= 2.0f) & (gap >= radius) & (d.bound < DIPOLE);
    d.flat = d.apart & (d.bend < FLAT_DIPOLE);
    return d;
}

float16 four_times(float4 v) { return (float16)(v, v, v, v); }

float lane_of(float4 v, uint k) { return k < 2 ? k == 0 ? v.x : v.y : k == 2 ? v.z : v.w; }

// Add the flat ones of a leaf at the corners of a brick.
void add_flat(brick_sums *sums, const dipoles *d)
{
    const float16 x = four_times(d->x) - (float)SPREAD - vload16(0, CORNER_X) * (float)SPREAD;
    const float16 nx = four_times(d->nx), ny = four_times(d->ny), nz = four_times(d->nz);
    const int4 none = 0;
    const int16 counted = (int16)(d->flat, none, d->flat, none);
    for (uint g = 0; g < 4; ++g) {
        const float16 y = four_times(d->y) - (g & 1 ? 2 * (float)SPREAD : 0);
        const float16 z = four_times(d->z) - (g & 2 ? 2 * (float)SPREAD : 0);
        const float16 square = x * x + y * y + z * z;
        sums->far[g] += counted ? (nx * x + ny * y + nz * z) / (square * sqrt(square)) : 0.0f;
    }
    const float4 bends = d->flat ? d->bend + d->bound : 0.0f, parts = d->flat ? d->part : 0.0f;
    count_far(sums, (parts.x + parts.y) + (parts.z + parts.w), (bends.x + bends.y) + (bends.z + bends.w));
}

// Add triangle k at the voxels of a brick.
void add_dipole(brick_sums *sums, const dipoles *d, uint k)
{
    const float3 middle = (float3)(lane_of(d->x, k), lane_of(d->y, k), lane_of(d->z, k));
    const float3 n = (float3)(lane_of(d->nx, k), lane_of(d->ny, k), lane_of(d->nz, k));
    sums->error += lane_of(d->bound, k) + FAR_ERROR * lane_of(d->part, k);
    for (uint g = 0; g < PER_BRICK; ++g) {
        const float16 x = middle.x - vload16(0, VOXEL_X), y = middle.y - (g & 1) * 2.0f - vload16(0, VOXEL_Y),
                      z = middle.z - (g >> 1) * 2.0f - vload16(0, VOXEL_Z);
        const float16 square = x * x + y * y + z * z;
        sums->near[g] += 0.5f * (n.x * x + n.y * y + n.z * z) / (square * sqrt(square));
        sums->doubt[g] += ADDED * fabs(sums->near[g]);
    }
}

// Add a triangle, as triangle_vectors has it; `first` is the centre of the brick's first voxel.
// Errors, with u = 2^-24 and relative to `size`, to first order: coordinates have 2 u (0 within 2^16
// voxels), lengths 4.5 u, `size` itself 15.5 u. A scalar product has 7 u, times a length 12.5 u; with
// three of them and the rounding of the sum, x has 15.5 u + 37.5 u + 9 u = 62 u. The products in y sum
// to at most sqrt(2) size, with 5 u of roundings and 6 u of coordinates: 15.6 u. Both together are at
// most 64 u, a part r = 64 u sqrt(2) size / (|x| + |y|) of the vector. Where r < 1/2, the angle is wrong
// by less than 1.05 r and 2^-20 (angles_of), the winding number by (15.2 size / (|x| + |y|) + 2.6) u.
// That is less than SINGLE size / (|x| + |y|), because |x| + |y| is at most (4 + sqrt(2)) size. Where r
// may be larger, and where the angle may jump by 2 pi, it is not known. Each addition is wrong by
// u / (2 pi) times the sum, less than SINGLE ADDED.
void add_triangle(brick_sums *sums, const triangle *t, int3 first)
{
    float3 v[3];
    for (uint i = 0; i < 3; ++i)
        v[i] = convert_float3(t->v[i] - first) / (float)VOXEL;
    for (uint g = 0; g < PER_BRICK; ++g) {
        const float16 x = vload16(0, VOXEL_X), y = vload16(0, VOXEL_Y) + (g & 1) * 2.0f,
                      z = vload16(0, VOXEL_Z) + (g >> 1) * 2.0f;
        const float16 ax = v[0].x - x, ay = v[0].y - y, az = v[0].z - z;
        const float16 bx = v[1].x - x, by = v[1].y - y, bz = v[1].z - z;
        const float16 cx = v[2].x - x, cy = v[2].y - y, cz = v[2].z - z;
        const float16 a = sqrt(ax * ax + ay * ay + az * az);
        const float16 b = sqrt(bx * bx + by * by + bz * bz);
        const float16 c = sqrt(cx * cx + cy * cy + cz * cz);
        const float16 height = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
        const float16 size = a * b * c;
        const float16 base = size + (ax * bx + ay * by + az * bz) * c + (bx * cx + by * cy + bz * cz) * a +
                             (cx * ax + cy * ay + cz * az) * b;
        const float16 off = fabs(height), ratio = size / (fabs(base) + off);
        const int16 known = (ratio < MOST_RATIO) & ((base >= 0.0f) | (off > BEHIND * size));
        sums->near[g] += known ? angles_of(height, base) : 0.0f;
        sums->doubt[g] += known ? ratio + ADDED * fabs(sums->near[g]) : INFINITY;
    }
}

// The children of a node that count at the corners of a brick alone, interpolated between them: all of
// the brick is beyond the child's reach, and the second derivatives of its winding number, at most
// 6 area / (4 pi r^4) in each direction at distance r, bend it by no more than FLAT. Adds the bound and
// that of rounding errors to sums->error. All in voxels.
long8 linear_children(brick_sums *sums, double8 distance, double8 far, double8 radius, double8 area)
{
    const double8 gap = distance - HALF_DIAGONAL - radius, squared = gap * gap;
    const double8 bend = LINEAR * area / (squared * squared);
    const long8 linear = (distance > far + HALF_DIAGONAL) & (gap > 0.0) & (bend < FLAT);
    count_far(sums, total(linear ? area / squared : 0.0), total(linear ? bend : 0.0));
    return linear;
}

// The sums at the corners, of all children.
float8 sums_at_corners(brick_sums *sums)
{
    float far[8];
    for (uint i = 0; i < 8; ++i) {
        const float8 of_children = i & 1 ? sums->far[i >> 1].hi : sums->far[i >> 1].lo;
        const float4 halves = of_children.lo + of_children.hi;
        far[i] = (halves.x + halves.y) + (halves.z + halves.w);
    }
    sums->error += 3 * FAR_ERROR * sums->far_size / 32; // additions
    return vload8(0, far);
}
