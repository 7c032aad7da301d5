// Ray casting of a distance field, as kernels/adf/raycast.cl draws it, one ray at a time: rays visit
// leaf after leaf, which the hash finds, and the first root of the cubic in one of them is the
// surface [Marmitt 2004]. Rays are mirrored, so that all their coordinates increase; they are
// followed in cells of the deepest level.

uniform sampler3D ranges; // least and greatest value in each child of a block, in sides
uniform float shown;      // distance that is drawn, in sides
uniform int planeAxis;    // of the cutting plane; -1 for none
uniform float planeAt;    // where it crosses the axis, in sides
uniform bool planeBounds; // it shows error bounds instead of distances
uniform bool leaves;      // it shows the edges of leaves
uniform float spacing;    // of isolines, in sides
uniform float reach;      // distance of the strongest colour, in sides

const float PARALLEL = 1e-12; // the least speed along an axis, of the greatest
const int HALVINGS = 20;      // of a ray's segment in a leaf
const int MOST_STEPS = 1 << 14;

uvec3 stack[24]; // by size of their cells, 2^k, the blocks around the ray

struct Ray {
    vec3 origin, speed, inverse;
    uint mirror; // one bit per axis
};

// The field along a ray in a leaf, c.x + c.y t + c.z t^2 + c.w t^3, at start + t step, in leaf edges.
struct Segment {
    vec3 start, step;
    vec4 c;
};

Ray mirrored(vec3 origin, vec3 direction)
{
    float side = float(1u << depth);
    Ray ray;
    bvec3 down = lessThan(direction, vec3(0));
    ray.speed = side * max(abs(direction), vec3(PARALLEL * largest(abs(direction))));
    ray.inverse = 1.0 / ray.speed;
    ray.origin = side * mix(origin, 1.0 - origin, down);
    ray.mirror = uint(down.x) | uint(down.y) << 1 | uint(down.z) << 2;
    return ray;
}

// 1 along the axes that are mirrored.
uvec3 turned(uint mirror) { return uvec3(mirror & 1u, mirror >> 1 & 1u, mirror >> 2); }

// The cell of a level at a mirrored place in units of such cells.
uvec3 cellAt(ivec3 place, uint level, uint mirror)
{
    ivec3 other = (1 << level) - 1 - place;
    return uvec3(place + (other - place) * ivec3(turned(mirror)));
}

// The field at the corners of a leaf, by x, then y, then z, minus what is drawn; mirrored.
void cornersOf(uvec3 block, uvec3 cell, uint mirror, out vec4 low, out vec4 high)
{
    ivec3 first = ivec3(3u * block + (cell & 1u)), m = ivec3(turned(mirror));
    ivec3 a = first + m, b = first + 1 - m;
    low = vec4(texelFetch(voxels, a, 0).r, texelFetch(voxels, ivec3(b.x, a.yz), 0).r,
               texelFetch(voxels, ivec3(a.x, b.y, a.z), 0).r, texelFetch(voxels, ivec3(b.xy, a.z), 0).r);
    high = vec4(texelFetch(voxels, ivec3(a.xy, b.z), 0).r, texelFetch(voxels, ivec3(b.x, a.y, b.z), 0).r,
                texelFetch(voxels, ivec3(a.x, b.yz), 0).r, texelFetch(voxels, b, 0).r);
    low -= shown, high -= shown;
}

// The cubic of a leaf with these corners: linear along x, then y, then z.
vec4 cubicOf(vec4 low, vec4 high, vec3 start, vec3 step)
{
    vec4 first = vec4(low.xz, high.xz), rise = vec4(low.yw, high.yw) - first;
    vec4 a = first + rise * start.x, b = rise * step.x;
    vec2 da = a.yw - a.xz, db = b.yw - b.xz;
    vec2 c0 = a.xz + da * start.y, c1 = b.xz + db * start.y + da * step.y, c2 = db * step.y;
    float d0 = c0.y - c0.x, d1 = c1.y - c1.x, d2 = c2.y - c2.x;
    return vec4(c0.x + d0 * start.z, c1.x + d1 * start.z + d0 * step.z,
                c2.x + d2 * start.z + d1 * step.z, d2 * step.z);
}

float valueAt(vec4 c, float t) { return c.x + t * (c.y + t * (c.z + t * c.w)); }

// Whether the cubic is 0 or negative in [0, 1], and where it is monotonic around its first root.
bool bracketRoot(vec4 c, out float low, out float high)
{
    float b1 = c.x + c.y / 3.0, b2 = b1 + (c.y + c.z) / 3.0, at1 = valueAt(c, 1.0);
    low = 0.0, high = 1.0;
    if (c.x > 0.0 && b1 > 0.0 && b2 > 0.0 && at1 > 0.0)
        return false; // all Bezier control points are positive
    float cube = 3.0 * c.w, discriminant = c.z * c.z - c.y * cube;
    float root = sqrt(max(discriminant, 0.0)), q = c.z < 0.0 ? root - c.z : -root - c.z;
    float r1 = cube == 0.0 ? 0.0 : clamp(q / cube, 0.0, 1.0);
    float r2 = q == 0.0 ? 0.0 : clamp(c.y / q, 0.0, 1.0);
    float first = discriminant > 0.0 ? min(r1, r2) : 0.0;
    float second = discriminant > 0.0 ? max(r1, r2) : 0.0;
    if (c.x <= 0.0)
        high = 0.0;
    else if (valueAt(c, first) <= 0.0)
        high = first;
    else if (valueAt(c, second) <= 0.0)
        low = first, high = second;
    else {
        low = second;
        return at1 <= 0.0;
    }
    return true;
}

// Finds the first point of the surface between depths t and `end`: the leaf, its blocks on the stack,
// and the segment and bounds of the root in it.
bool follow(Ray ray, inout float t, float end, out ivec3 low, out int size, out Segment along,
            out vec2 bracket)
{
    int top = int(depth), k = top;
    stack[k] = uvec3(0); // the place of the root's block
    ivec3 p = clamp(ivec3(floor(ray.origin + t * ray.speed)), ivec3(0), ivec3((1 << top) - 1));
    float side = 0.0; // of the surface on which the ray starts
    for (int i = 0; i < MOST_STEPS; ++i) {
        size = k - 1;
        low = p >> size << size;
        uvec3 cell = cellAt(p >> size, uint(top - size), ray.mirror), found;
        vec2 range = texelFetch(ranges, ivec3(2u * stack[k] + (cell & 1u)), 0).rg - shown;
        bool passes = side > 0.0 ? range.x > 0.0 : side < 0.0 && range.y < 0.0; // without a surface
        if (!passes && size > 0 && find_block(uint(top - size), cell, found)) {
            k = size;
            stack[k] = found;
            continue;
        }
        ivec3 high = low + (1 << size);
        vec3 outs = (vec3(high) - ray.origin) * ray.inverse;
        float leaves = smallest(outs), scale = 1.0 / float(1 << size);
        if (!passes && t < leaves) {
            vec4 near, far;
            cornersOf(stack[k], cell, ray.mirror, near, far);
            along.start = clamp((ray.origin + t * ray.speed - vec3(low)) * scale, 0.0, 1.0);
            along.step = (min(leaves, end) - t) * scale * ray.speed;
            along.c = cubicOf(near, far, along.start, along.step);
            side = side != 0.0 ? side : along.c.x < 0.0 ? -1.0 : 1.0;
            along.c *= side;
            if (bracketRoot(along.c, bracket.x, bracket.y)) {
                t = mix(t, min(leaves, end), bracket.y);
                return true;
            }
        }
        t = max(t, leaves);
        if (t >= end)
            return false;
        ivec3 inner = clamp(ivec3(floor(ray.origin + t * ray.speed)), low, high - 1);
        ivec3 q = ivec3(outs.x <= t ? high.x : inner.x, outs.y <= t ? high.y : inner.y,
                        outs.z <= t ? high.z : inner.z);
        ivec3 changed = p ^ q;
        k = highestBit(changed.x | changed.y | changed.z) + 1;
        if (k > top)
            return false;
        p = q;
    }
    return false;
}

float bilinear(float a, float b, float c, float d, float s, float t)
{
    return mix(mix(a, b, s), mix(c, d, s), t);
}

// The unit normal at the root, towards the viewer, in mirrored axes.
vec3 normalAt(Ray ray, ivec3 low, int size, Segment along, vec2 bracket)
{
    for (int i = 0; i < HALVINGS; ++i) {
        float middle = 0.5 * (bracket.x + bracket.y);
        if (valueAt(along.c, middle) > 0.0)
            bracket.x = middle;
        else
            bracket.y = middle;
    }
    vec3 at = along.start + bracket.y * along.step;
    vec4 a, b;
    uvec3 cell = cellAt(low >> size, depth - uint(size), ray.mirror);
    cornersOf(stack[size + 1], cell, ray.mirror, a, b);
    vec3 gradient = vec3(bilinear(a.y - a.x, a.w - a.z, b.y - b.x, b.w - b.z, at.y, at.z),
                         bilinear(a.z - a.x, a.w - a.y, b.z - b.x, b.w - b.y, at.x, at.z),
                         bilinear(b.x - a.x, b.y - a.y, b.z - a.z, b.w - a.w, at.x, at.y));
    if (gradient == vec3(0))
        return -normalize(ray.speed);
    return normalize(dot(gradient, ray.speed) > 0.0 ? -gradient : gradient);
}

// ---- the cutting plane

// A leaf on the plane: its block, its level, its octant, and where the pixel is in it.
struct Place {
    uvec3 point, block;
    uint level;
    vec3 within;
};

Place placeAt(vec3 at)
{
    Place place = Place(uvec3(clamp(at, 0.0, 0.99999994) * 4294967296.0), uvec3(0), 1u, vec3(0));
    for (uvec3 found; place.level < depth && find_block(place.level, place.point >> (32u - place.level), found);
         ++place.level)
        place.block = found;
    place.within = vec3(place.point << place.level >> 8) / 16777216.0;
    return place;
}

vec3 heat(float h) { return clamp(1.5 - abs(4.0 * h - vec3(3, 2, 1)), 0.0, 1.0); }

// The colour of the cutting plane, and whether it is outside; `pixel`: its size there, in sides.
vec4 planeColour(Place place, float pixel)
{
    vec4 low, high;
    uvec3 cell = place.point >> (32u - place.level);
    cornersOf(place.block, cell, 0u, low, high);
    vec4 between = mix(low, high, place.within.z);
    float d = bilinear(between.x, between.y, between.z, between.w, place.within.x, place.within.y) + shown;
    vec3 found = d < 0.0 ? vec3(0.45, 0.62, 0.9) : vec3(0.95, 0.75, 0.45);
    found = mix(vec3(1), found, 0.3 + 0.7 * clamp(abs(d) / reach, 0.0, 1.0));
    if (planeBounds) {
        uint code = texelFetch(bounds, ivec3(2u * place.block + (cell & 1u)), 0).r;
        found = code == 255u ? vec3(0) : heat(clamp((float(code) - 94.0) / 160.0, 0.0, 1.0));
    }
    if (abs(d - spacing * round(d / spacing)) < 0.75 * pixel)
        found *= 0.35;
    if (leaves) {
        vec3 edge = min(place.within, 1.0 - place.within) / float(1u << place.level);
        edge[planeAxis] = 1.0;
        if (smallest(edge) < 0.75 * pixel)
            found = mix(found, vec3(0.1), 0.6);
    }
    return vec4(found, d > 0.0 ? 1.0 : 0.0);
}

void main()
{
    picture = vec4(0);
    id = uvec4(0);
    vec3 origin, direction;
    rayOfPixel(origin, direction);
    Ray ray = mirrored(origin, direction);
    vec3 side = vec3(1u << depth);
    float begin = max(largest(-ray.origin * ray.inverse), nearest);
    float end = smallest((side - ray.origin) * ray.inverse), t = begin;
    if (!(begin < end))
        return;
    float cut = 1e30;
    if (planeAxis >= 0 && direction[planeAxis] != 0.0) {
        float meets = (planeAt - origin[planeAxis]) / direction[planeAxis];
        cut = meets >= begin && meets <= end ? meets : cut;
    }
    // what is before the plane is cut away, and outside the mesh it lets half of the light through
    bool cuts = cut < 1e30;
    t = cuts ? cut : begin;
    ivec3 low;
    int size;
    Segment along;
    vec2 bracket;
    if (follow(ray, t, end, low, size, along, bracket)) {
        vec3 n = normalAt(ray, low, size, along, bracket) * (1.0 - 2.0 * vec3(turned(ray.mirror)));
        picture = vec4(colour * brightness(n.x, n.y, n.z, light.x, light.y, light.z), 1);
        id = uvec4(cellAt(low >> size, depth - uint(size), ray.mirror) << size, size + 1);
    }
    if (cuts) {
        Place place = placeAt(origin + cut * direction);
        vec4 shows = planeColour(place, length(startRight + cut * wayRight));
        picture = vec4(picture.a > 0.0 && shows.a > 0.0 ? mix(picture.rgb, shows.rgb, 0.5) : shows.rgb, 1);
        id = uvec4(place.point >> (32u - place.level) << (depth - place.level), depth - place.level + 1u);
    }
}
