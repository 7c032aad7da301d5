// Ray casting of an octree, as kernels/svo/raycast.cl draws it, one ray at a time.
//
// Tables, blocks and their cells are those of blocks.js: a few fetches find a voxel, or the largest
// empty node around a place. Sizes are exponents: 2^k voxels. Rays are mirrored, so that all their
// coordinates increase.
//
// SwiftShader, on a processor, runs all branches of four pixels, for none of them if need be, and shifts
// them one by one: places are floats, which hold them exactly, and little is left to branches.

uniform usampler2D entries;      // of the tables
uniform usampler2D bricks;       // of blocks, by octant
uniform sampler2D shares;        // of blocks, four cells along x
uniform int rowBits, rowMask;    // of these textures
uniform usampler2D begins;       // by tile, the bits of the depth at which its rays begin
uniform float tile;              // side of a tile, in pixels
uniform uint LEAVES, POINTERS;   // first entries of their kinds
uniform uint EMPTY_BLOCK, FULL_BLOCK;
uniform float whole;             // a full cell's share
uniform float fan, cover;        // entries of a table along an axis; voxels of all tables
uniform int root, finest, shaded; // sizes of the root, of what is drawn, of the cells of blocks
uniform vec3 pitch;              // relative to the longest
uniform vec3 clipLow, clipHigh, extent; // voxels: what is shown, and of the grid
uniform int paint;               // PAINTS of octree.js, or TINTED
uniform bool edges;              // of voxels
uniform vec2 depths;             // of the nearest and the farthest corner
#ifdef TINTS
uniform sampler2D tints;         // the colours of values
uniform usampler2D leafTints;    // of entries that are inside leaves, the value
uniform usampler2D firsts;       // of blocks, by octant the first value, or by cell the value
ivec2 entryTexel;                // of the entry that was found last
#endif

const int TINTED = 4;
const float STILL = 1e-30;   // speed along an axis below which a ray stays in its layer of voxels
const float AHEAD = 0.5;     // distance before the hit, in cells, where the coverage is sampled
const float VANISHES = 1e-6; // smaller gradients are rounding errors
const float EARLY = 4e-6;    // of the range of depths, by which rays begin before their tile says
const int MOST_STEPS = 1 << 15;
const uvec2 FULL = uvec2(0xFFFFFFFFu);

struct Ray {
    vec3 origin, speed, inverse;
    vec3 down; // 1 along the axes that are mirrored
};

float power(int k) { return intBitsToFloat((127 + k) * 8388608); }

Ray mirrored(vec3 origin, vec3 direction)
{
    Ray ray;
    bvec3 down = lessThanEqual(direction, vec3(-STILL));
    bvec3 still = lessThan(abs(direction), vec3(STILL));
    ray.speed = mix(abs(direction), vec3(STILL), still);
    ray.inverse = 1.0 / ray.speed;
    vec3 centred = mix(origin, floor(origin) + 0.5, still);
    ray.origin = mix(centred, power(root) - centred, down);
    ray.down = vec3(down);
    return ray;
}

vec3 unmirrored(vec3 v, vec3 down) { return v * (1.0 - 2.0 * down); }

// Goes to the half along each axis that holds a place in [0, 1)^3; returns its octant.
uint halve(inout vec3 place)
{
    place *= 2.0;
    vec3 upper = floor(place);
    place -= upper;
    return uint(int(dot(upper, vec3(1, 2, 4))));
}

ivec2 texel(uint i) { return ivec2(int(i) & rowMask, int(i) >> rowBits); }

// The entry of a table at a place in [0, 1)^3 of it. Leaves the place in what it points to.
uint entryOf(uint table, inout vec3 place)
{
    place *= fan;
    vec3 cell = floor(place);
    place -= cell;
    uint at = table * uint(int(fan * fan * fan)) + uint(int(cell.x + fan * (cell.y + fan * cell.z)));
#ifdef TINTS
    entryTexel = texel(at);
#endif
    return texelFetch(entries, texel(at), 0).x;
}

// The entry at a place in [0, 1)^3 of all tables, likewise.
uint entryAt(inout vec3 place)
{
    uint found = entryOf(0u, place);
#if TABLES > 1
    for (int i = 1; i < TABLES && found >= POINTERS; ++i)
        found = entryOf(found - POINTERS, place);
#endif
    return found;
}

// The size of the largest empty node around a voxel; less than `finest` where there is something to
// draw, of this size or, in an inside leaf, of the leaf's.
int emptyAt(vec3 voxel, out int drawn)
{
    drawn = finest;
    vec3 place = voxel / cover;
    uint entry = entryAt(place);
    if (entry < LEAVES)
        return int(entry);
    if (entry < POINTERS) {
        drawn = max(int(entry - LEAVES), finest);
        return -1;
    }
    uint block = 8u * (entry - POINTERS);
    uvec2 brick = texelFetch(bricks, texel(block + halve(place)), 0).xy;
    if (finest > 0 && brick == FULL)
        drawn = max(shaded + 1, finest);
    uint at = halve(place), word = at < 4u ? brick.x : brick.y;
    uint octet = word >> (8u * (at & 3u)) & 0xFFu;
    if ((octet >> halve(place) & 1u) != 0u)
        return -1;
    return octet != 0u ? shaded - 1 : (brick.x | brick.y) != 0u ? shaded : shaded + 1;
}

// Finds the first node of the drawn size, or inside leaf, from depth t to `end`, starting in the
// voxel `p`; `low` and `k` are its corner and size.
bool follow(Ray ray, vec3 p, float end, inout float t, out vec3 low, out int k)
{
    vec3 turn = ray.down * (power(root) - 1.0);
    for (int i = 0; i < MOST_STEPS; ++i) {
        int drawn, empty = emptyAt(abs(p - turn), drawn);
        k = empty < finest ? drawn : empty;
        float size = power(k);
        low = floor(p * power(-k)) * size;
        if (empty < finest)
            return true;
        vec3 high = low + size, outs = (high - ray.origin) * ray.inverse;
        t = smallest(outs);
        if (t >= end)
            return false;
        vec3 inner = clamp(floor(ray.origin + t * ray.speed), low, high - 1.0);
        p = mix(inner, high, lessThanEqual(outs, vec3(t)));
    }
    return false;
}

// ---- shading

// Weights of four cells along an axis, and their derivatives, at f in [0, 1] between the centres of
// the two middle cells: a quadratic B-spline of the means of adjacent cells.
void spline(float f, out vec4 weights, out vec4 slopes)
{
    float first = 0.5 * (1.0 - f) * (1.0 - f), last = 0.5 * f * f;
    weights = vec4(0.5 * first, 0.5 - 0.5 * last, 0.5 - 0.5 * first, 0.5 * last);
    slopes = vec4(0.5 * f - 0.5, -0.5 * f, 0.5 - 0.5 * f, 0.5 * f);
}

// Moves four weights on by 0 to 3 cells, into the next four.
void moveOn(float by, inout vec4 here, out vec4 there)
{
    bool one = by == 1.0 || by == 3.0, two = by >= 2.0;
    there = vec4(one ? here.w : 0.0, 0, 0, 0);
    here = one ? vec4(0, here.xyz) : here;
    there = two ? vec4(here.zw, there.x, 0) : there;
    here = two ? vec4(0, 0, here.xy) : here;
}

// The block at a place in units of blocks.
uint blockAt(vec3 at)
{
    float most = cover * power(-shaded - 2);
    if (smallest(at) < 0.0 || largest(at) >= most)
        return EMPTY_BLOCK;
    vec3 place = at / most;
    uint entry = entryAt(place);
    return entry >= POINTERS ? entry - POINTERS : entry >= LEAVES ? FULL_BLOCK : EMPTY_BLOCK;
}

// Weights of the 4^3 cells around a place, by axis, and their slopes; along x those of two blocks.
struct Weights {
    vec4 x, xSlope, xThere, xSlopeThere, y, ySlope, z, zSlope;
};

// The row of cells along x at y and z, weighted along x: mean, and change.
vec2 rowOf(Weights w, ivec4 row)
{
    vec4 cells = texelFetch(shares, row.xy, 0), others = texelFetch(shares, row.zw, 0);
    return vec2(dot(cells, w.x) + dot(others, w.xThere), dot(cells, w.xSlope) + dot(others, w.xSlopeThere));
}

// The slice of cells at z, weighted along x and y: changes along x and y, and mean. `here` and `next`:
// the first texels at z of the two blocks along x, and of those beyond y; `y`: that of the first cell.
vec3 sliceOf(Weights w, ivec4 here, ivec4 next, int y)
{
    ivec4 step = ivec4(1, 0, 1, 0);
    here += y * step, next += (y - 4) * step;
    vec2 a = rowOf(w, here), b = rowOf(w, (y < 3 ? here : next) + step);
    vec2 c = rowOf(w, (y < 2 ? here : next) + 2 * step), d = rowOf(w, (y < 1 ? here : next) + 3 * step);
    vec4 means = vec4(a.x, b.x, c.x, d.x), changes = vec4(a.y, b.y, c.y, d.y);
    return vec3(dot(changes, w.y), dot(means, w.ySlope), dot(means, w.y));
}

// The first texels of the block at a place in units of blocks, and of the next along x.
ivec4 pairAt(vec3 at)
{
    return ivec4(texel(16u * blockAt(at)), texel(16u * blockAt(at + vec3(1, 0, 0))));
}

// The gradient of the coverage of the cells, at a place in such cells.
vec3 coverageGradient(vec3 place)
{
    vec3 before = floor(place - 0.5), f = place - 0.5 - before, first = before - 1.0;
    vec3 block = floor(0.25 * first), within = first - 4.0 * block;
    Weights w;
    spline(f.x, w.x, w.xSlope);
    spline(f.y, w.y, w.ySlope);
    spline(f.z, w.z, w.zSlope);
    moveOn(within.x, w.x, w.xThere);
    moveOn(within.x, w.xSlope, w.xSlopeThere);
    ivec4 here = pairAt(block), up = pairAt(block + vec3(0, 1, 0));
    ivec4 beyond = pairAt(block + vec3(0, 0, 1)), both = pairAt(block + vec3(0, 1, 1));
    vec3 gradient = vec3(0);
    int y = int(within.y), z = int(within.z);
    for (int i = 0; i < 4; ++i) {
        ivec4 at = 4 * (z & 3) * ivec4(1, 0, 1, 0);
        vec3 slice = sliceOf(w, (z < 4 ? here : beyond) + at, (z < 4 ? up : both) + at, y);
        gradient += slice * vec3(w.z.x, w.z.x, w.zSlope.x);
        w.z = w.z.yzwx, w.zSlope = w.zSlope.yzwx; // a list at a variable place is slow
        ++z;
    }
    return gradient / whole;
}

// The unit normal at a hit, towards the viewer: opposite to the gradient of the coverage. A normal
// that points away from the viewer is turned until it is perpendicular to the view. Where the
// gradient vanishes, and on clipping planes, it is the face's.
vec3 normalAt(Ray ray, vec3 direction, float t, bool clipped, vec3 low, int k, vec3 face)
{
    vec3 view = direction * pitch, into = vec3(0);
    if (!clipped) {
        vec3 hit = clamp(ray.origin + t * ray.speed, low, low + power(k));
        vec3 place = hit - AHEAD * power(shaded) * normalize(ray.speed);
        place += ray.down * (power(root) - 2.0 * place);
        into = coverageGradient(place * power(-shaded)) / pitch;
    }
    float along = dot(into, view);
    if (along < 0.0)
        into -= along / dot(view, view) * view;
    if (dot(into, into) < VANISHES * VANISHES)
        into = unmirrored(face, ray.down);
    return -normalize(into);
}

vec3 hue(float h) { return clamp(abs(mod(h * 6.0 + vec3(0, 4, 2), 6.0) - 3.0) - 1.0, 0.0, 1.0); }

// Whether a hit is within a pixel of an edge of its face.
bool onEdge(Ray ray, float t, vec3 low, int k, vec3 face)
{
    vec3 within = (ray.origin + t * ray.speed - low) * power(-k);
    vec3 margin = min(within, 1.0 - within) + face;
    vec3 pixel = max(abs(startRight + t * wayRight), abs(startDown + t * wayDown)) * power(-k);
    return any(lessThan(margin, 0.75 * vec3(largest(pixel)))) && largest(pixel) < 0.2;
}

#ifdef TINTS

uint countOf(uint v)
{
    v -= v >> 1 & 0x55555555u;
    v = (v & 0x33333333u) + (v >> 2 & 0x33333333u);
    return ((v + (v >> 4) & 0x0F0F0F0Fu) * 0x01010101u) >> 24;
}

// The colour of what is drawn at a voxel, and its opacity.
vec4 tintAt(vec3 voxel)
{
    vec3 place = voxel / cover;
    uint entry = entryAt(place);
    if (entry < POINTERS)
        return texelFetch(tints, texel(texelFetch(leafTints, entryTexel, 0).x), 0);
    uint octant = 8u * (entry - POINTERS) + halve(place), at = halve(place);
    if (finest > 0)
        return texelFetch(tints, texel(texelFetch(firsts, texel(8u * octant + at), 0).x), 0);
    uvec2 brick = texelFetch(bricks, texel(octant), 0).xy;
    uint bit = 8u * (at & 3u) + halve(place), before = (1u << bit) - 1u;
    uint rank = at < 4u ? countOf(brick.x & before) : countOf(brick.x) + countOf(brick.y & before);
    return texelFetch(tints, texel(texelFetch(firsts, texel(octant), 0).x + rank), 0);
}

#endif

void main()
{
    picture = vec4(0);
    id = uvec4(0);
    vec3 origin, direction;
    rayOfPixel(origin, direction);
    Ray ray = mirrored(origin, direction);
    vec3 side = vec3(power(root));
    vec3 low = mix(clipLow, side - clipHigh, ray.down), high = mix(clipHigh, side - clipLow, ray.down);
    vec3 ins = (low - ray.origin) * ray.inverse, outs = (high - ray.origin) * ray.inverse;
    float enters = max(largest(ins), nearest), end = smallest(outs);
    if (!(enters < end))
        return;
    float begin = uintBitsToFloat(texelFetch(begins, ivec2(gl_FragCoord.xy / tile), 0).x);
    float t = max(enters, begin - EARLY * (depths.y - depths.x));
    if (!(t < end))
        return;
    vec3 p = clamp(floor(ray.origin + t * ray.speed), low, high - 1.0), node;
    int k;
    if (!follow(ray, p, end, t, node, k))
        return;
    vec3 begins = (node - ray.origin) * ray.inverse;
    vec3 cut = mix(vec3(greaterThan(clipLow, vec3(0))), vec3(lessThan(clipHigh, extent)), ray.down);
    bool clipped = t == enters && dot(vec3(equal(ins, vec3(t))), cut) > 0.0;
    vec3 planes = clipped ? ins : begins;
    float last = largest(planes);
    vec3 face = planes.x == last ? vec3(1, 0, 0) : planes.y == last ? vec3(0, 1, 0) : vec3(0, 0, 1);
    t = max(last, enters);
    vec3 n = normalAt(ray, direction, t, clipped, node, k, face);
    bool line = edges && onEdge(ray, t, node, k, face);
    float bright = brightness(n.x, n.y, n.z, light.x, light.y, light.z);
    node += ray.down * (side - power(k) - 2.0 * node);
    vec3 plain = colour;
#ifdef TINTS
    if (paint == TINTED) {
        vec4 tint = tintAt(node);
        plain = tint.a > 0.0 ? tint.rgb : colour;
    }
#endif
    vec3 shown = paint == 0 || paint == TINTED ? plain * bright
                 : paint == 1 ? vec3(1.0 - 0.9 * clamp((t - depths.x) / (depths.y - depths.x), 0.0, 1.0))
                 : paint == 2 ? 0.5 + 0.5 * n
                              : bright * mix(vec3(1), hue(float(k) * 0.13), 0.6);
    if (line)
        shown *= 0.5;
    picture = vec4(shown, 1);
    id = uvec4(uvec3(node), k + 1);
}
