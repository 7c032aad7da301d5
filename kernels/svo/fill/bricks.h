// The winding number of caps at the 64 voxels of a brick at once, in single precision: good enough
// wherever it is not near a threshold. Included by svo/fill/winding.cl.

#define PER_BRICK 4     // vectors of 16 voxels in Morton order
#define SPREAD 1.5f     // voxels from the middle of a brick to the centres of its outer voxels
#define LINEAR 1.62     // over 9/8 (3 voxels)^2 6 / (4 pi); see is_linear
#define FLAT 0x1p-8     // the most that a node may deviate from a linear function in a brick
#define VAGUE 0x1p-7f   // below these, relative to `size` of triangle_vectors, an angle is not known:
#define BEHIND 0x1p-15f // near an edge, and near a triangle, where it jumps

__constant float CORNER_X[8] = {-1, 1, -1, 1, -1, 1, -1, 1};
__constant float CORNER_Y[8] = {-1, -1, 1, 1, -1, -1, 1, 1};
__constant float CORNER_Z[8] = {-1, -1, -1, -1, 1, 1, 1, 1};
__constant float VOXEL_X[16] = {0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3};
__constant float VOXEL_Y[16] = {0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1};
__constant float VOXEL_Z[16] = {0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1};

float mix_of(float a, float b, float t) { return a + t * (b - a); }

// The sums over a brick: `far` at its corners, of solid angles; `near` at its voxels, of half solid
// angles; `vague` marks voxels at which an angle is not known. `error` bounds what linear
// interpolation between the corners adds to the winding number.
typedef struct {
    float8 far;
    float16 near[PER_BRICK];
    int16 vague[PER_BRICK];
    double error;
} brick_sums;

// distant_angles of one child at the corners of a brick; m is the child's first number, p the middle
// of the brick and `spread` SPREAD in the same coordinates.
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
        const float16 off = fabs(height);
        sums->vague[g] |= (fabs(base) + off <= VAGUE * size) | ((base < 0.0f) & (off <= BEHIND * size));
        sums->near[g] += angles_of(height, base);
    }
}

// Whether a child counts at the corners of a brick alone, and is interpolated between them: all of the
// brick is beyond the child's reach, and the second derivatives of its winding number, at most
// 6 area / (4 pi r^4) in each direction at distance r, bend it by no more than FLAT. If so, adds the
// bound to sums->error. All in voxels.
bool is_linear(brick_sums *sums, double distance, double far, double radius, double area)
{
    const double half_diagonal = SPREAD * 1.7320509, gap = distance - half_diagonal - radius;
    const double bend = LINEAR * area / (gap * gap * gap * gap);
    if (!(distance > far + half_diagonal && gap > 0 && bend < FLAT))
        return false;
    sums->error += bend;
    return true;
}
