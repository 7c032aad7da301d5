// Ray casting of an octree, as kernels/svo/raycast.cl draws it, one ray at a time.
//
// A node has size 2^k voxels: k = 0 voxels, 2 bricks. `nodes` has a texel for each refined node above
// the bricks: the texel of its first refined child, or its first brick; which children hold a voxel;
// from bit 8 which of these are refined. A child that holds a voxel and is not refined is an inside leaf.
// Rays are mirrored, so that all their coordinates increase.

uniform usampler2D nodes, bricks;
uniform sampler2D shares;         // of a node's children, as octantShares, two texels a node
uniform int rowBits;             // of the textures
uniform int root, finest, shaded; // sizes of the root, of what is drawn, of the cells of the shading
uniform vec3 pitch;              // relative to the longest
uniform vec3 clipLow, clipHigh, extent; // voxels: what is shown, and of the grid
uniform int paint;               // PAINTS of octree.js
uniform bool edges;              // of voxels
uniform vec2 depths;             // of the nearest and the farthest corner

const float STILL = 1e-30;   // speed along an axis below which a ray stays in its layer of voxels
const float AHEAD = 0.5;     // distance before the hit, in cells, where the coverage is sampled
const float VANISHES = 1e-6; // smaller gradients are rounding errors
const int MOST_STEPS = 1 << 15;
const uvec2 FULL = uvec2(0xFFFFFFFFu);

struct Ray {
    vec3 origin, speed, inverse;
    uint mirror; // one bit per axis
};

uvec2 stack[20]; // by k, the nodes around the ray

uint octantAt(ivec3 place, int k, uint mirror)
{
    ivec3 bit = place >> k & 1;
    return uint(bit.x | bit.y << 1 | bit.z << 2) ^ mirror;
}

uint octantByte(uvec2 brick, uint octant)
{
    return (octant < 4u ? brick.x : brick.y) >> (8u * (octant & 3u)) & 0xFFu;
}

// The child of a node above the bricks, by its rank among those that are stored.
uvec2 childOf(uvec2 node, uint octant, int k)
{
    uint stored = k == 3 ? node.y : node.y >> 8;
    ivec2 at = texel(node.x + popcount(stored & ((1u << octant) - 1u) & 0xFFu), rowBits);
    return k == 3 ? texelFetch(bricks, at, 0).xy : texelFetch(nodes, at, 0).xy;
}

Ray mirrored(vec3 origin, vec3 direction)
{
    Ray ray;
    bvec3 down = lessThanEqual(direction, vec3(-STILL));
    bvec3 still = lessThan(abs(direction), vec3(STILL));
    ray.speed = mix(abs(direction), vec3(STILL), still);
    ray.inverse = 1.0 / ray.speed;
    vec3 centred = mix(origin, floor(origin) + 0.5, still);
    ray.origin = mix(centred, float(1 << root) - centred, down);
    ray.mirror = uint(down.x) | uint(down.y) << 1 | uint(down.z) << 2;
    return ray;
}

// The low corner of a node in axes that are not mirrored.
ivec3 unmirroredLow(ivec3 low, int k, uint mirror)
{
    ivec3 turned = (1 << root) - (1 << k) - low;
    return ivec3((mirror & 1u) != 0u ? turned.x : low.x, (mirror & 2u) != 0u ? turned.y : low.y,
                 (mirror & 4u) != 0u ? turned.z : low.z);
}

vec3 unmirrored(vec3 v, uint mirror)
{
    return v * vec3((mirror & 1u) != 0u ? -1 : 1, (mirror & 2u) != 0u ? -1 : 1,
                    (mirror & 4u) != 0u ? -1 : 1);
}

// Finds the first node of the drawn size, or inside leaf, from depth t to `end`, starting in the
// voxel `p`; `low` and `k` are its corner and size.
bool follow(Ray ray, ivec3 p, float end, inout float t, out ivec3 low, out int k)
{
    int at = root;
    uvec2 node = texelFetch(nodes, ivec2(0), 0).xy;
    stack[root] = node;
    for (int i = 0; i < MOST_STEPS; ++i) {
        k = at - 1;
        uint octant = octantAt(p, k, ray.mirror);
        uint held = at > 2 ? node.y >> octant & 1u
                           : at == 2 ? octantByte(node, octant) : node.x >> octant & 1u;
        low = p >> k << k;
        if (held != 0u) {
            if (k == finest || (at > 3 && (node.y >> (8u + octant) & 1u) == 0u))
                return true;
            node = at == 2 ? uvec2(held, 0u) : childOf(node, octant, at);
            at = k;
            stack[at] = node;
            continue;
        }
        ivec3 high = low + (1 << k);
        vec3 outs = (vec3(high) - ray.origin) * ray.inverse;
        t = smallest(outs);
        if (t >= end)
            return false;
        ivec3 inner = clamp(ivec3(floor(ray.origin + t * ray.speed)), low, high - 1);
        ivec3 q = ivec3(outs.x <= t ? high.x : inner.x, outs.y <= t ? high.y : inner.y,
                        outs.z <= t ? high.z : inner.z);
        ivec3 changed = p ^ q;
        at = highestBit(changed.x | changed.y | changed.z) + 1;
        if (at > root)
            return false;
        node = stack[at];
        p = q;
    }
    return false;
}

// ---- shading

// Weights of four cells along an axis, and their derivatives, at f in [0, 1] between the centres of
// the two middle cells: a quadratic B-spline of the means of adjacent cells. Each vector has those of
// both cells of a node, in unmirrored order; `odd`: the first cell is the second of its node.
void spline(float f, bool odd, bool turned, out vec4 pairs[3])
{
    float first = 0.5 * (1.0 - f) * (1.0 - f), last = 0.5 * f * f;
    vec4 w = vec4(0.5 * first, 0.5 - 0.5 * last, 0.5 - 0.5 * first, 0.5 * last);
    vec4 s = vec4(0.5 * f - 0.5, -0.5 * f, 0.5 - 0.5 * f, 0.5 * f);
    pairs[0] = odd ? vec4(0, w.x, 0, s.x) : vec4(w.xy, s.xy);
    pairs[1] = odd ? vec4(w.yz, s.yz) : vec4(w.zw, s.zw);
    pairs[2] = odd ? vec4(w.w, 0, s.w, 0) : vec4(0);
    if (turned)
        for (int i = 0; i < 3; ++i)
            pairs[i] = pairs[i].yxwz;
}

// The number of bits that are set in each byte.
uint byteCounts(uint v)
{
    v = v - (v >> 1 & 0x55555555u);
    v = (v & 0x33333333u) + (v >> 2 & 0x33333333u);
    return v + (v >> 4) & 0x0F0F0F0Fu;
}

// The shares of the eight octants of a brick: those at x = 0 and at x = 1, by y, then z.
void octantShares(uvec2 brick, out vec4 even, out vec4 odd)
{
    uint low = byteCounts(brick.x), high = byteCounts(brick.y);
    even = vec4(low & 0xFFu, low >> 16 & 0xFFu, high & 0xFFu, high >> 16 & 0xFFu) / 8.0;
    odd = vec4(low >> 8 & 0xFFu, low >> 24, high >> 8 & 0xFFu, high >> 24) / 8.0;
}

// The node of size 2^k at a position in units of such nodes: 0 nothing, 1 a node, 2 inside.
int nodeAt(ivec3 place, int k, ivec3 hit, int hitSize, uint mirror, out uvec2 node)
{
    node = uvec2(0);
    if (any(lessThan(place, ivec3(0))) || any(greaterThanEqual(place, ivec3(1 << (root - k)))))
        return 0;
    ivec3 changed = place ^ (hit >> k);
    int bits = changed.x | changed.y | changed.z;
    int at = max(k + (bits == 0 ? 0 : highestBit(bits) + 1), hitSize);
    if (at == hitSize && hitSize > 2)
        return 2;
    node = stack[at];
    while (at > k) {
        uint octant = octantAt(place, at - 1 - k, mirror);
        if ((node.y >> octant & 1u) == 0u)
            return 0;
        if (at > 3 && (node.y >> (8u + octant) & 1u) == 0u)
            return 2;
        node = childOf(node, octant, at);
        --at;
    }
    return 1;
}

// A set of octants, one bit each, mirrored.
uint mirroredOctants(uint octants, uint mirror)
{
    if ((mirror & 1u) != 0u)
        octants = (octants & 0x55u) << 1 | octants >> 1 & 0x55u;
    if ((mirror & 2u) != 0u)
        octants = (octants & 0x33u) << 2 | octants >> 2 & 0x33u;
    if ((mirror & 4u) != 0u)
        octants = (octants & 0x0Fu) << 4 | octants >> 4;
    return octants;
}

// The gradient of the coverage of cells of size 2^k, at a place in such cells. The inner loop visits
// only children that hold a voxel and are within reach: rays side by side wait for each other less.
vec3 coverageGradient(vec3 place, int k, ivec3 hit, int hitSize, uint mirror)
{
    vec3 before = floor(place - 0.5), f = place - 0.5 - before;
    ivec3 first = ivec3(before) - 1, low = first >> 1, odd = first & 1, last = low + 1 + odd;
    vec4 xs[3], ys[3], zs[3];
    spline(f.x, odd.x == 1, (mirror & 1u) != 0u, xs);
    spline(f.y, odd.y == 1, (mirror & 2u) != 0u, ys);
    spline(f.z, odd.z == 1, (mirror & 4u) != 0u, zs);
    ivec3 holders = (last >> 1) - (low >> 1) + 1;
    vec3 gradient = vec3(0);
    for (int h = 0; h < holders.x * holders.y * holders.z; ++h) {
        ivec3 at = (low >> 1) + ivec3(h % holders.x, h / holders.x % holders.y,
                                      h / (holders.x * holders.y));
        uvec2 holder;
        int kind = nodeAt(at, k + 2, hit, hitSize, mirror, holder);
        if (kind == 0)
            continue;
        ivec3 begin = 2 * at - low;
        uvec3 sides = uvec3(0x55u, 0x33u, 0x0Fu) * uvec3(greaterThanEqual(begin, ivec3(0))) |
                      uvec3(0xAAu, 0xCCu, 0xF0u) * uvec3(lessThan(begin, last - low));
        uint held = kind == 2 ? 0xFFu : mirroredOctants(holder.y & 0xFFu, mirror);
        for (uint rest = held & sides.x & sides.y & sides.z; rest != 0u; rest &= rest - 1u) {
            uint i = uint(highestBit(int(rest & -rest)));
            ivec3 n = begin + ivec3(i & 1u, i >> 1 & 1u, i >> 2);
            uint octant = i ^ mirror;
            vec4 even = vec4(1), next = vec4(1);
            if (kind == 1 && k == 1)
                octantShares(childOf(holder, octant, 3), even, next);
            else if (kind == 1 && (holder.y >> (8u + octant) & 1u) != 0u) {
                uint rank = popcount(holder.y >> 8 & ((1u << octant) - 1u));
                uint node = 2u * (holder.x + rank);
                even = texelFetch(shares, texel(node, rowBits), 0);
                next = texelFetch(shares, texel(node + 1u, rowBits), 0);
            }
            vec4 x = xs[n.x], y = ys[n.y], z = zs[n.z];
            vec4 mean = even * x.x + next * x.y, change = even * x.z + next * x.w;
            vec4 wy = y.xyxy, wz = z.xxyy;
            gradient += vec3(dot(change, wy * wz), dot(mean, y.zwzw * wz), dot(mean, wy * z.zzww));
        }
    }
    return gradient;
}

// The unit normal at a hit, towards the viewer: opposite to the gradient of the coverage. A normal
// that points away from the viewer is turned until it is perpendicular to the view. Where the
// gradient vanishes, and on clipping planes, it is the face's.
vec3 normalAt(Ray ray, vec3 direction, float t, bool clipped, ivec3 low, int k, vec3 face)
{
    vec3 view = direction * pitch;
    float cell = float(1 << shaded);
    vec3 hit = clamp(ray.origin + t * ray.speed, vec3(low), vec3(low + (1 << k)));
    vec3 place = (hit - AHEAD * cell * normalize(ray.speed)) / cell;
    vec3 into = vec3(0);
    if (!clipped)
        into = unmirrored(coverageGradient(place, shaded, low, k, ray.mirror), ray.mirror) / pitch;
    float along = dot(into, view);
    if (along < 0.0)
        into -= along / dot(view, view) * view;
    if (dot(into, into) < VANISHES * VANISHES)
        into = unmirrored(face, ray.mirror);
    return -normalize(into);
}

vec3 hue(float h) { return clamp(abs(mod(h * 6.0 + vec3(0, 4, 2), 6.0) - 3.0) - 1.0, 0.0, 1.0); }

// Whether a hit is within a pixel of an edge of its face.
bool onEdge(Ray ray, float t, ivec3 low, int k, vec3 face)
{
    vec3 within = (ray.origin + t * ray.speed - vec3(low)) / float(1 << k);
    vec3 margin = min(within, 1.0 - within) + face;
    vec3 pixel = max(abs(startRight + t * wayRight), abs(startDown + t * wayDown)) / float(1 << k);
    return any(lessThan(margin, 0.75 * vec3(largest(pixel)))) && largest(pixel) < 0.2;
}

void main()
{
    picture = vec4(0);
    id = uvec4(0);
    vec3 origin, direction;
    rayOfPixel(origin, direction);
    Ray ray = mirrored(origin, direction);
    vec3 down = vec3(ray.mirror & 1u, ray.mirror >> 1 & 1u, ray.mirror >> 2);
    vec3 side = vec3(1 << root);
    vec3 low = mix(clipLow, side - clipHigh, down), high = mix(clipHigh, side - clipLow, down);
    vec3 ins = (low - ray.origin) * ray.inverse, outs = (high - ray.origin) * ray.inverse;
    float enters = max(largest(ins), nearest), end = smallest(outs);
    if (!(enters < end))
        return;
    float t = enters;
    ivec3 p = clamp(ivec3(floor(ray.origin + t * ray.speed)), ivec3(low), ivec3(high) - 1), node;
    int k;
    if (!follow(ray, p, end, t, node, k))
        return;
    vec3 begins = (vec3(node) - ray.origin) * ray.inverse;
    vec3 cut = mix(vec3(greaterThan(clipLow, vec3(0))), vec3(lessThan(clipHigh, extent)), down);
    bool clipped = t == enters && dot(vec3(equal(ins, vec3(t))), cut) > 0.0;
    vec3 planes = clipped ? ins : begins;
    float last = largest(planes);
    vec3 face = planes.x == last ? vec3(1, 0, 0) : planes.y == last ? vec3(0, 1, 0) : vec3(0, 0, 1);
    t = max(last, enters);
    vec3 n = normalAt(ray, direction, t, clipped, node, k, face);
    float bright = brightness(n.x, n.y, n.z, light.x, light.y, light.z);
    vec3 shown = paint == 0 ? colour * bright
                 : paint == 1 ? vec3(1.0 - 0.9 * clamp((t - depths.x) / (depths.y - depths.x), 0.0, 1.0))
                 : paint == 2 ? 0.5 + 0.5 * n
                              : bright * mix(vec3(1), hue(float(k) * 0.13), 0.6);
    if (edges && onEdge(ray, t, node, k, face))
        shown *= 0.5;
    picture = vec4(shown, 1);
    id = uvec4(unmirroredLow(node, k, ray.mirror), k + 1);
}
