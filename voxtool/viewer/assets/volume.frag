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
    int f = 0;
    do {
        vec4 plane = listed(planes, FACES * cell + f);
        float along = dot(plane.xyz, direction), meets = -(dot(plane.xyz, origin) + plane.w) / along;
        if (along > 0.0 && meets < leaves) {
            leaves = meets;
            face = f;
        }
    } while (++f < FACES);
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

// Composites the way through a cell: the pieces between control points [TetVol, section 4.2]. The share of
// a piece is by the width of its interval, so points that rounding makes equal are a step with the depth
// and the colour between them.
void addCell(inout Light light, float from, float to, inout int interval, float way)
{
    float whole = abs(to - from), s = from, place = -1.0; // the last in its interval, 0 or 1; or not known
    bool up, down;
    do {
        int row = 3 * interval;
        vec4 first = listed(rows, row), second = listed(rows, row + 1), third = listed(rows, row + 2);
        float high = pointAt(interval), width = third.z;
        down = interval > 0 && to < first.x, up = interval < points && to >= high;
        float end = clamp(down ? first.x : up ? high : to, min(from, to), max(from, to));
        vec2 w = clamp((vec2(s, end) - first.x) * first.y, 0.0, 1.0);
        w = vec2(place < 0.0 || whole == 0.0 ? w.x : place, up ? 1.0 : down ? 0.0 : w.y);
        float part = width > 0.0 ? width * abs(w.y - w.x) : abs(end - s);
        float piece = way * (whole > 0.0 ? min(part / whole, 1.0) : up || down ? 0.0 : 1.0);
        if (piece > 0.0) {
            vec2 tau = piece * (second.y + third.y * w);
            vec3 colour = vec3(first.zw, second.x), change = vec3(second.zw, third.x);
            float w_f, w_b, zeta;
            segment_weights(tau.x, tau.y, w_f, w_b, zeta);
            light.colour += light.transmittance * (w_f * (colour + change * w.x) + w_b * (colour + change * w.y));
            light.alpha += light.transmittance * (w_f + w_b);
            light.transmittance *= zeta;
        }
        s = end;
        place = up ? 0.0 : 1.0;
        interval += up ? 1 : down ? -1 : 0;
    } while (up || down);
}

#ifdef SURFACES
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
#endif

// SwiftShader runs all branches, for no pixel if need be, and `for` and `while` once more than they go
// round: what is rare, entering, is outside of the loop from cell to cell.
void main()
{
    picture = vec4(0);
    id = uvec4(0);
    vec3 origin, direction;
    rayOfPixel(origin, direction);
    float speed = length(direction);
    Light light = Light(vec3(0), 1.0, 0.0);
    float t = nearest;
    int cell = eyeCell, still = 0, rank = -1, i = 0;
    do {
        float entry = t;
        int entered = nextEntry(origin, direction, entry);
        if (cell < 0) {
            rank = (entry - t) * speed > GAP ? -1 : rank;
            cell = entered, t = entry;
        }
        if (cell < 0)
            break;
        if (id.w == 0u)
            id = uvec4(cell, 0, 0, 1);
        vec4 entering = listed(gradients, cell);
        int interval = intervalOf(dot(entering.xyz, origin + t * direction) + entering.w, 0);
        do {
            int beyond;
            float leaves = exitOf(cell, origin, direction, t, beyond);
            still = leaves > t ? 0 : still + 1;
            if (leaves > t) {
                vec4 gradient = listed(gradients, cell);
                float slope = dot(gradient.xyz, direction), start = dot(gradient.xyz, origin) + gradient.w;
                float from = clamp(start + slope * t, 0.0, 1.0), to = clamp(start + slope * leaves, 0.0, 1.0);
                float length_ = (leaves - t) * speed;
#ifdef SURFACES
                addToSurfaces(light, rank, from, to, interval, length_, gradient.xyz, direction);
#endif
                addCell(light, from, to, interval, length_);
            }
            t = leaves;
            cell = beyond;
            i = light.transmittance < LEAST_TRANSMITTANCE || still > MOST_STILL ? MOST_STEPS : i + 1;
        } while (cell >= 0 && i < MOST_STEPS);
    } while (i < MOST_STEPS);
    picture = vec4(light.colour, light.transmittance < 0.5 ? 1.0 - light.transmittance : light.alpha);
}
