// Ray casting of a volume from cell to cell [TetVol, section 4], with the exact integral of linear
// segments and isosurfaces, as kernels/tets/raycast.cl. Rays enter by boundary faces, which a grid holds.

uniform sampler2D planes;        // of face f of cell t at FACES t + f: outward normal, offset
uniform sampler2D gradients;     // of the scalar, and its term
uniform isampler2D neighbours;   // of a cell, in NEIGHBOUR_TEXELS texels; -1 outside
uniform sampler2D corners;       // of boundary triangles, three texels each, wound outward
uniform usampler2D triangles;    // by box of the grid: triangle, cell
uniform usampler2D boxes;        // of the grid: first and end of their triangles
uniform sampler2D rows;          // of the transfer function, three texels an interval; then the surfaces
uniform int rowBits;             // of these textures
uniform int grid;                // boxes along an axis of [-1, 1]
uniform int points;              // of the transfer function
uniform int surfaces;            // in ascending order of isovalues, two texels each: isovalue; tint
uniform int eyeCell;             // that holds the eye, or -1

#ifndef FACES
#define FACES 4
#endif
const int NEIGHBOUR_TEXELS = FACES == 4 ? 1 : 2;
const float LEAST_TRANSMITTANCE = 0.0001;
const float FARTHEST = 1e30;
const float GAP = 4.0 * ON_PLANE; // between cells that are apart, as in kernels/tets/surfaces.h
const float SLACK = 1e-5; // of a triangle, by which rays beside it still enter
const int MOST_STEPS = 1 << 14;
const int MOST_STILL = 64; // steps without progress after which a ray ends

// Colour and extinction.
struct Transferred {
    vec3 colour;
    float tau;
};

vec4 listed(sampler2D list, int i) { return texelFetch(list, texel(uint(i), rowBits), 0); }

// The scalar at control point k.
float pointAt(int k) { return listed(rows, 3 * (k + 1)).x; }

// The interval that holds s: the number of control points at or below it; from that of a scalar nearby.
int intervalOf(float s, int near)
{
    while (near < points && s >= pointAt(near))
        ++near;
    while (near > 0 && s < pointAt(near - 1))
        --near;
    return near;
}

Transferred transferred(int interval, float s)
{
    vec4 first = listed(rows, 3 * interval), second = listed(rows, 3 * interval + 1);
    vec4 third = listed(rows, 3 * interval + 2);
    float w = clamp((s - first.x) * first.y, 0.0, 1.0);
    return Transferred(vec3(first.zw, second.x) + vec3(second.zw, third.x) * w, second.y + third.y * w);
}

// ---- entries

// The depth at which a ray enters by a triangle after a depth, or FARTHEST.
float entryBy(int triangle, vec3 origin, vec3 direction, float after)
{
    vec3 v = listed(corners, 3 * triangle).xyz, a = listed(corners, 3 * triangle + 1).xyz - v;
    vec3 b = listed(corners, 3 * triangle + 2).xyz - v, out_ = cross(a, b), arm = origin - v;
    float against = -dot(direction, out_);
    if (against <= 0.0)
        return FARTHEST;
    vec3 turn = cross(arm, direction);
    float u = dot(b, turn), w = -dot(a, turn);
    float slack = SLACK * against;
    if (u < -slack || w < -slack || u + w > against + slack)
        return FARTHEST;
    float t = dot(arm, out_) / against;
    return t >= after ? t : FARTHEST;
}

// The cell that a ray enters first at or after a depth, or -1.
int nextEntry(vec3 origin, vec3 direction, inout float t)
{
    vec3 way = mix(direction, vec3(1e-20), lessThan(abs(direction), vec3(1e-20)));
    vec3 inverse = 1.0 / way, low = (-1.0 - origin) * inverse, high = (1.0 - origin) * inverse;
    float begin = max(t, largest(min(low, high))), end = smallest(max(low, high));
    if (!(begin <= end))
        return -1;
    float scale = 0.5 * float(grid);
    ivec3 box = clamp(ivec3(floor((origin + begin * way + 1.0) * scale)), ivec3(0), ivec3(grid - 1));
    ivec3 stride = ivec3(sign(way));
    for (int i = 0; i < 3 * 64; ++i) {
        vec3 plane = (vec3(box) + step(0.0, way)) / scale - 1.0;
        vec3 outs = (plane - origin) * inverse;
        float leaves = smallest(outs), best = FARTHEST;
        int cell = -1;
        uvec2 range = texelFetch(boxes, texel(uint(box.x + grid * (box.y + grid * box.z)), rowBits), 0).xy;
        for (uint k = range.x; k < range.y; ++k) {
            uvec2 found = texelFetch(triangles, texel(k, rowBits), 0).xy;
            float depth = entryBy(int(found.x), origin, way, t);
            if (depth < best) {
                best = depth;
                cell = int(found.y);
            }
        }
        if (best <= leaves + SLACK) {
            t = best;
            return cell;
        }
        if (leaves >= end)
            return -1;
        box += ivec3(equal(outs, vec3(leaves))) * stride;
        if (any(lessThan(box, ivec3(0))) || any(greaterThanEqual(box, ivec3(grid))))
            return -1;
    }
    return -1;
}

// The depth at which a ray leaves a cell, and the cell beyond.
float exitOf(int cell, vec3 origin, vec3 direction, float t, out int beyond)
{
    float leaves = FARTHEST;
    int face = -1;
    for (int f = 0; f < FACES; ++f) {
        vec4 plane = listed(planes, FACES * cell + f);
        float along = dot(plane.xyz, direction);
        if (along <= 0.0)
            continue;
        float meets = -(dot(plane.xyz, origin) + plane.w) / along;
        if (meets < leaves) {
            leaves = meets;
            face = f;
        }
    }
    beyond = -1;
    if (face >= 0) {
        int at = NEIGHBOUR_TEXELS * cell + face / 4;
        beyond = texelFetch(neighbours, texel(uint(at), rowBits), 0)[face & 3];
    }
    return max(face < 0 ? t : leaves, t);
}

// ---- light

struct Light {
    vec3 colour;
    float transmittance, alpha;
};

// Composites the way through a cell: the pieces between control points [TetVol, section 4.2].
void addCell(inout Light light, float from, float to, inout int interval, float way)
{
    int last = intervalOf(to, interval);
    float whole = to - from, s = from, began = from;
    for (int i = 0; i < 2 * 255; ++i) {
        float end = to;
        int own = interval;
        if (interval < last) {
            end = min(pointAt(interval), to);
            ++interval;
        } else if (interval > last) {
            end = max(pointAt(interval - 1), to);
            --interval;
        }
        bool ends = own == last;
        float piece = whole == 0.0 ? (ends ? way : 0.0) : way * abs((end - s) / whole);
        if (piece > 0.0) {
            Transferred front = transferred(own, s), back = transferred(own, end);
            float w_f, w_b, zeta;
            segment_weights(front.tau * piece, back.tau * piece, w_f, w_b, zeta);
            light.colour += light.transmittance * (w_f * front.colour + w_b * back.colour);
            light.alpha += light.transmittance * (w_f + w_b);
            light.transmittance *= zeta;
        }
        if (ends)
            return;
        s = end;
    }
}

// ---- isosurfaces, as in kernels/tets/surfaces.h

vec4 surface(int number, int texel_) { return listed(rows, 3 * (points + 1) + 2 * number + texel_); }

float isovalueAt(int number) { return surface(number, 0).x; }

// The number of isovalues at or below s; from that of a scalar nearby.
int rankOf(float s, int near)
{
    while (near < surfaces && s >= isovalueAt(near))
        ++near;
    while (near > 0 && s < isovalueAt(near - 1))
        --near;
    return near;
}

// Composites a surface, lit from both sides: its normal is the gradient, towards the viewer.
void addSurface(inout Light seen, int number, vec3 gradient, vec3 direction)
{
    vec4 tint = surface(number, 1);
    float size = length(gradient);
    vec3 n = size > 0.0 ? gradient / size : -normalize(direction);
    n = dot(n, direction) > 0.0 ? -n : n;
    float weight = tint.a * seen.transmittance;
    seen.colour += weight * brightness(n.x, n.y, n.z, light.x, light.y, light.z) * tint.rgb;
    seen.alpha += weight;
    seen.transmittance *= 1.0 - tint.a;
}

// Composites the way through a cell up to its last surface; `rank`, or -1 where it is not known, is
// carried from cell to cell, so that rounding at a face neither loses nor repeats a surface. Leaves the
// scalar and the way beyond.
void addToSurfaces(inout Light light, inout int rank, inout float from, float to, inout int interval,
                   inout float way, vec3 gradient, vec3 direction)
{
    if (rank < 0)
        rank = rankOf(from, 0);
    int last = rankOf(to, rank);
    while (rank != last) {
        int number = rank < last ? rank : rank - 1;
        float at = isovalueAt(number);
        float share = clamp((at - from) / (to != from ? to - from : 1.0), 0.0, 1.0);
        addCell(light, from, at, interval, way * share);
        addSurface(light, number, gradient, direction);
        way -= way * share;
        from = at;
        rank += rank < last ? 1 : -1;
    }
}

void main()
{
    picture = vec4(0);
    id = uvec4(0);
    vec3 origin, direction;
    rayOfPixel(origin, direction);
    float speed = length(direction);
    Light light = Light(vec3(0), 1.0, 0.0);
    float t = nearest;
    int cell = eyeCell, still = 0, interval = 0, rank = -1;
    if (cell < 0)
        cell = nextEntry(origin, direction, t);
    for (int i = 0; cell >= 0 && i < MOST_STEPS; ++i) {
        if (id.w == 0u)
            id = uvec4(cell, 0, 0, 1);
        int beyond;
        float leaves = exitOf(cell, origin, direction, t, beyond);
        still = leaves > t ? 0 : still + 1;
        if (leaves > t) {
            vec4 gradient = listed(gradients, cell);
            float slope = dot(gradient.xyz, direction), start = dot(gradient.xyz, origin) + gradient.w;
            float from = clamp(start + slope * t, 0.0, 1.0), to = clamp(start + slope * leaves, 0.0, 1.0);
            interval = intervalOf(from, interval);
            float length_ = (leaves - t) * speed;
            if (surfaces > 0)
                addToSurfaces(light, rank, from, to, interval, length_, gradient.xyz, direction);
            addCell(light, from, to, interval, length_);
        }
        t = leaves;
        if (light.transmittance < LEAST_TRANSMITTANCE || still > MOST_STILL)
            break;
        cell = beyond >= 0 ? beyond : nextEntry(origin, direction, t);
        rank = (t - leaves) * speed > GAP ? -1 : rank;
    }
    picture = vec4(light.colour, light.transmittance < 0.5 ? 1.0 - light.transmittance : light.alpha);
}
