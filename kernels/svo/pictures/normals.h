// Normals of an octree's surface at hits of rays: from the coverage of the cells around them. Included by
// kernels/svo/pictures/raycast.cl, whose octrees and shares they read.

#define AHEAD 0.5      // distance before the hit, in cells, where the coverage is sampled
#define ALL 0xFFFFFFFFFFFFFFFFul
#define VANISHES 1e-12 // smaller gradients are rounding errors

// A ray and its hit: the node at `low` of size 2^k. All fields except `direction` are mirrored.
typedef struct {
    double3 origin, direction, speed, inverse;
    double t;
    int3 low;
    int k;
    uint mirror; // one bit per axis
} ray_state;

double3 times_at(const ray_state *ray, const int3 planes)
{
    return (convert_double3(planes) - ray->origin) * ray->inverse;
}

double largest(const double3 v)
{
    const double xy = v.x > v.y ? v.x : v.y;
    return xy > v.z ? xy : v.z;
}

double product(const double3 a, const double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

// The octant given by one bit of a position along each axis.
uint octant_at(const int3 place, const int k)
{
    const int3 bit = place >> k & 1;
    return (uint)(bit.x | bit.y << 1 | bit.z << 2);
}

// The number of low bits in which two positions differ.
int differing_bits(const int3 a, const int3 b)
{
    const int3 changed = a ^ b;
    return 32 - (int)clz(changed.x | changed.y | changed.z);
}

// The word of the node of size 2^k at a position in units of such nodes, or of a larger leaf around
// it. `above`: by k, the words of the nodes around the hit, and its own.
ulong word_at(const ray_state *ray, const ulong *above, OCTREE, const int root, const int k,
              const int3 node)
{
    if (any(node < 0) || any(node >= 1 << (root - k)))
        return 0;
    int at = max(k + differing_bits(node, ray->low >> k), ray->k);
    ulong word = above[at];
    while (at > k && word && word != INSIDE) {
        --at;
        word = child_of(THIS_OCTREE, word, at, octant_at(node, at - k) ^ ray->mirror);
    }
    return word;
}

// The shares of the children, of size 2^k, of a node and the 26 around it, by mirrored octant, found
// when they are needed; rays that meet the same node use them again.
typedef struct {
    int3 centre;      // in units of the node
    uint known, held; // the nodes whose shares were found, and those that are not empty, as bits
    float8 of[27];    // by x, then y, then z
    ulong holders[8]; // the words of the nodes that hold them, by x, then y, then z
} near_shares;

// Swaps the bytes of octants.
ulong mirrored_bytes(ulong v, const uint mirror)
{
    const ulong x = 0x00FF00FF00FF00FFul, y = 0x0000FFFF0000FFFFul;
    v = mirror & 1 ? (v & x) << 8 | (v >> 8 & x) : v;
    v = mirror & 2 ? (v & y) << 16 | (v >> 16 & y) : v;
    return mirror & 4 ? as_ulong(as_uint2(v).yx) : v; // Oclgrind has no rotation
}

float8 shares_of(OCTREE, const ulong word, const int k, const uint mirror)
{
    if (word == INSIDE && k >= BRICK)
        return 1.0f;
    if (k != 1) {
        float share[8];
        for (uint octant = 0; octant < 8; ++octant)
            share[octant] = share_of_child(THIS_OCTREE, word, k, octant ^ mirror);
        return vload8(0, share);
    }
    // a byte for each octant of a brick: the voxels in it
    ulong count = word - (word >> 1 & 0x5555555555555555ul);
    count = (count & 0x3333333333333333ul) + (count >> 2 & 0x3333333333333333ul);
    count = mirrored_bytes((count + (count >> 4)) & 0x0F0F0F0F0F0F0F0Ful, mirror);
    const ulong8 bytes = (ulong8)count >> (ulong8)(0, 8, 16, 24, 32, 40, 48, 56) & 0xFF;
    return convert_float8(convert_int8(bytes)) * 0.125f;
}

// Begins to find the shares around a node near the hit, unless it is the root: the words of the eight
// nodes that hold it and those around it.
void find_holders(near_shares *near, const int3 centre, const ray_state *ray, const ulong *above,
                  OCTREE, const int root, const int k)
{
    near->centre = centre;
    near->known = near->held = 0;
    if (k + 1 == root) {
        near->known = ~0u, near->held = 1 << 13;
        near->of[13] = shares_of(THIS_OCTREE, above[root], k, ray->mirror);
        return;
    }
    const int3 holder = (centre - 1) >> 1;
    for (int i = 0; i < 8; ++i)
        near->holders[i] = word_at(ray, above, THIS_OCTREE, root, k + 2,
                                   holder + (int3)(i & 1, i >> 1 & 1, i >> 2));
}

// Finds the shares of node i of those around the hit.
void find_share(near_shares *near, const int i, const uint mirror, OCTREE, const int k)
{
    const int3 first = near->centre - 1, node = first + (int3)(i % 3, i / 3 % 3, i / 9);
    const int3 in = (node >> 1) - (first >> 1);
    ulong word = near->holders[in.x | in.y << 1 | in.z << 2];
    if (word && word != INSIDE)
        word = child_of(THIS_OCTREE, word, k + 1, octant_at(node, 0) ^ mirror);
    else if (word && k + 1 == BRICK)
        word = ALL;
    near->known |= 1u << i;
    if (word) {
        near->of[i] = shares_of(THIS_OCTREE, word, k, mirror);
        near->held |= 1u << i;
    }
}

// The weights of four cells along an axis, and their derivatives, at f in [0, 1] between the centres
// of the two middle cells: a quadratic B-spline of the means of adjacent cells. The first is at
// `begin`, 0 or 1, of six; the others are 0.
void spline(const double f, const int begin, double *weight, double *slope)
{
    const double first = 0.5 * (1.0 - f) * (1.0 - f), last = 0.5 * f * f;
    weight[0] = slope[0] = weight[4] = slope[4] = weight[5] = slope[5] = 0.0;
    weight[begin] = 0.5 * first, slope[begin] = 0.5 * f - 0.5;
    weight[begin + 1] = 0.5 - 0.5 * last, slope[begin + 1] = -0.5 * f;
    weight[begin + 2] = 0.5 - 0.5 * first, slope[begin + 2] = 0.5 - 0.5 * f;
    weight[begin + 3] = 0.5 * last, slope[begin + 3] = 0.5 * f;
}

double sum_of(const double sum, const double4 v) { return sum + v.x + v.y + v.z + v.w; }

// The gradient of the coverage of cells at a position, in units of cells from the first of the
// nodes: smooth, and nearly constant on planes.
double3 coverage_gradient(near_shares *near, const double3 place, const uint mirror, OCTREE,
                          const int k)
{
    const double3 before = floor(place - 0.5), f = place - 0.5 - before;
    const int3 first = convert_int3(before) - 1, low = first >> 1, odd = first & 1;
    double weight[3][6], slope[3][6];
    spline(f.x, odd.x, weight[0], slope[0]);
    spline(f.y, odd.y, weight[1], slope[1]);
    spline(f.z, odd.z, weight[2], slope[2]);
    double3 gradient = 0.0;
    for (int z = 0; z < 4 + odd.z; z += 2) // nodes, of two cells along each axis
        for (int y = 0; y < 4 + odd.y; y += 2) {
            const double4 wy = vload2(0, weight[1] + y).xyxy, wz = vload2(0, weight[2] + z).xxyy;
            const double4 sy = vload2(0, slope[1] + y).xyxy, sz = vload2(0, slope[2] + z).xxyy;
            const double4 ww = wy * wz, sw = sy * wz, ws = wy * sz;
            for (int x = 0; x < 4 + odd.x; x += 2) {
                const int i = low.x + x / 2 + 3 * (low.y + y / 2) + 9 * (low.z + z / 2);
                if (!(near->known >> i & 1))
                    find_share(near, i, mirror, THIS_OCTREE, k);
                if (!(near->held >> i & 1))
                    continue;
                const double4 even = convert_double4(near->of[i].even);
                const double4 next = convert_double4(near->of[i].odd);
                const double4 mean = even * weight[0][x] + next * weight[0][x + 1];
                const double4 change = even * slope[0][x] + next * slope[0][x + 1];
                gradient.x = sum_of(gradient.x, change * ww);
                gradient.y = sum_of(gradient.y, mean * sw);
                gradient.z = sum_of(gradient.z, mean * ws);
            }
        }
    return gradient;
}

// v in the original, unmirrored axes.
double3 unmirrored(const double3 v, const uint mirror)
{
    return (double3)(mirror & 1 ? -v.x : v.x, mirror & 2 ? -v.y : v.y, mirror & 4 ? -v.z : v.z);
}

// The unit normal at the hit in world space, towards the viewer: opposite to the gradient of the
// coverage of cells of size 2^k. A normal that points away from the viewer is rotated until it is
// perpendicular to the view direction. Where the gradient vanishes, the face's normal is used.
double3 normal_at(const ray_state *ray, near_shares *near, const ulong *above, OCTREE,
                  const int root, const int k, const double3 pitch)
{
    const double3 view = ray->direction * pitch;
    const double ahead = AHEAD * (1 << k) / sqrt(product(ray->speed, ray->speed));
    const double3 hit = clamp(ray->origin + ray->t * ray->speed, convert_double3(ray->low),
                              convert_double3(ray->low + (1 << ray->k)));
    const int3 centre = convert_int3(hit) >> (k + 1);
    if (any(centre != near->centre))
        find_holders(near, centre, ray, above, THIS_OCTREE, root, k);
    const double3 place = (hit - ahead * ray->speed) * (1.0 / (1 << k));
    double3 into = coverage_gradient(near, place - convert_double3(2 * (centre - 1)), ray->mirror,
                                     THIS_OCTREE, k);
    into = unmirrored(into, ray->mirror) / pitch;
    const double along = product(into, view);
    if (along < 0.0)
        into -= along / product(view, view) * view;
    double square = product(into, into);
    if (square < VANISHES * VANISHES) {
        const double3 begins = times_at(ray, ray->low);
        const double last = largest(begins);
        into = begins.x == last   ? (double3)(1.0, 0.0, 0.0)
               : begins.y == last ? (double3)(0.0, 1.0, 0.0)
                                  : (double3)(0.0, 0.0, 1.0);
        into = unmirrored(into, ray->mirror);
        square = 1.0;
    }
    return into / -sqrt(square);
}
