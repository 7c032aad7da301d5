// The winding number of caps at the 64 voxels of a brick at once, in single precision: good enough
// wherever it is not near a threshold. Included by svo/fill/winding/bricks.cl.

#define PER_BRICK 4     // vectors of 16 voxels in Morton order
#define SPREAD 1.5     // voxels from the middle of a brick to the centres of its outer voxels
#define LINEAR 1.62     // over 9/8 (3 voxels)^2 6 / (4 pi); see is_linear
#define FLAT 0x1p-8     // the most that a node may deviate from a linear function in a brick
#define BEHIND 0x1p-15f // relative to `size` of triangle_vectors; nearer to 0, the sign of y is not known
#define SINGLE 0x1p-19  // winding number of an angle's error, over size / (|x| + |y|); see add_triangle
#define MOST_RATIO 0x1p15f // of size to |x| + |y|
#define ADDED 0x1p-7f   // the same of a sum's rounding, over the sum
#define FAR_ERROR 0x1p-20 // winding number of the error of angles_at_corners, over area / distance^2

__constant float CORNER_X[8] = {-1, 1, -1, 1, -1, 1, -1, 1};
__constant float CORNER_Y[8] = {-1, -1, 1, 1, -1, -1, 1, 1};
__constant float CORNER_Z[8] = {-1, -1, -1, -1, 1, 1, 1, 1};
__constant float VOXEL_X[16] = {0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3};
__constant float VOXEL_Y[16] = {0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1};
__constant float VOXEL_Z[16] = {0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1};

double mix_of(double a, double b, double t) { return a + t * (b - a); }

// The sums over a brick: `far` at its corners, of solid angles; `near` at its voxels, of half solid
// angles. SINGLE doubt bounds the error of the winding number that is due to `near`, infinite where an
// angle is not known, and `error` what is due to `far` and to its linear interpolation.
typedef struct {
    float8 far;
    float16 near[PER_BRICK], doubt[PER_BRICK];
    double far_size, error; // far_size: of area / distance^2
} brick_sums;

// distant_angles of one child at the corners of a brick; m is the child's first number, p the middle
// of the brick and `spread` SPREAD in the same coordinates. At two radii or more, the terms sum to at
// most 4.4 area / distance^2 in absolute value. With u = 2^-24, none has more than 40 roundings, so
// that the winding number is wrong by less than 40 u 4.4 / (4 pi) < 2^-20 area / distance^2.
float8 angles_at_corners(__global const double *m, double3 p, float spread)
{
    float8 x = (float)(m[0] - p.x) - vload8(0, CORNER_X) * spread;
    float8 y = (float)(m[ARITY] - p.y) - vload8(0, CORNER_Y) * spread;
    float8 z = (float)(m[2 * ARITY] - p.z) - vload8(0, CORNER_Z) * spread;
    const float8 inverse = 1.0f / sqrt(x * x + y * y + z * z);
    x *= inverse, y *= inverse, z *= inverse;
    float c[MOMENTS];
    for (uint i = 4; i < MOMENTS; ++i)
        c[i] = (float)m[i * ARITY];
    const float8 one = x * c[4] + y * c[5] + z * c[6];
    const float8 two = x * (x * c[7] + y * c[12] + z * c[11]) + y * (y * c[8] + z * c[10]) + z * z * c[9];
    const float8 three = x * (x * (x * c[13] + y * c[16] + z * c[17]) + y * (y * c[18] + z * c[22]) +
                              z * z * c[20]) +
                         y * (y * (y * c[14] + z * c[19]) + z * z * c[21]) + z * z * z * c[15];
    return inverse * inverse * (one + inverse * (7.5f * inverse * three - 3.0f * two));
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

// Whether a child counts at the corners of a brick alone, and is interpolated between them: all of the
// brick is beyond the child's reach, and the second derivatives of its winding number, at most
// 6 area / (4 pi r^4) in each direction at distance r, bend it by no more than FLAT. If so, adds the
// bound and that of rounding errors to sums->error. All in voxels.
bool is_linear(brick_sums *sums, double distance, double far, double radius, double area)
{
    const double half_diagonal = SPREAD * 1.7320509, gap = distance - half_diagonal - radius;
    const double bend = LINEAR * area / (gap * gap * gap * gap);
    if (!(distance > far + half_diagonal && gap > 0 && bend < FLAT))
        return false;
    const double part = area / (gap * gap);
    sums->far_size += part;
    sums->error += bend + FAR_ERROR * (part + sums->far_size / 32); // the last one for the addition
    return true;
}
