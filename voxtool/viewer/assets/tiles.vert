#version 300 es
// The tiles of a picture that a node may show in, as a rectangle at the depth of its nearest corner.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D nodes;        // low corner, size
uniform int rowBits;             // of this texture
uniform int finest;              // size of what is drawn
uniform vec2 size;               // of the picture, in pixels
uniform vec3 clipLow, clipHigh;  // voxels that are shown
uniform vec3 start;              // where the middle ray is at depth 0
uniform vec3 right, down, ahead; // with which an arm from there gives pixels and depth
uniform float closer;            // by which depths shrink pixels
uniform float nearest;           // depth at which rays begin
uniform vec2 depths;             // of the nearest and the farthest corner
uniform float tile;              // side of a tile, in pixels

flat out float begin;

const float SLACK = 0.01; // pixels by which rounding may move a corner
const float AT_EYE = 0.001; // of the distance to the target: nodes nearer than this are everywhere

void main()
{
    int number = gl_VertexID / 6, at = gl_VertexID % 6; // two triangles each: instances are slow on processors
    uvec4 node = texelFetch(nodes, ivec2(number & (1 << rowBits) - 1, number >> rowBits), 0);
    float span = float(1 << max(int(node.w), finest));
    vec3 low = floor(vec3(node.xyz) / span) * span, high = min(low + span, clipHigh);
    low = max(low, clipLow);
    vec2 first = vec2(1e30), last = vec2(-1e30);
    float least = 1e30;
    begin = 1e30;
    for (int i = 0; i < 8; ++i) {
        vec3 arm = vec3((i & 1) != 0 ? high.x : low.x, (i & 2) != 0 ? high.y : low.y, (i & 4) != 0 ? high.z : low.z) - start;
        float depth = dot(arm, ahead), scale = 1.0 + closer * depth;
        vec2 pixel = vec2(dot(arm, right), -dot(arm, down)) / scale;
        first = min(first, pixel), last = max(last, pixel);
        least = min(least, scale), begin = min(begin, depth);
    }
    vec2 tiles = ceil(size / tile);
    first = clamp(floor((first + 0.5 * size - SLACK) / tile), vec2(0), tiles);
    last = clamp(floor((last + 0.5 * size + SLACK) / tile) + 1.0, vec2(0), tiles);
    if (least < AT_EYE)
        first = vec2(0), last = tiles, begin = nearest;
    vec2 corner = vec2(at == 1 || at == 2 || at == 4 ? last.x : first.x, at == 2 || at > 3 ? last.y : first.y);
    float share = (begin - depths.x) / (depths.y - depths.x);
    gl_Position = vec4(2.0 * corner / tiles - 1.0, share / (1.0 + abs(share)), 1);
    if (any(greaterThanEqual(low, high)))
        gl_Position = vec4(2, 2, 0, 1); // clipped away
}
