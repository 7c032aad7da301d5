#version 300 es
// A point of the size of a tile, for each tile in which a node may show: nothing is drawn elsewhere.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D begins; // by tile, the bits of the depth at which its rays begin
uniform vec2 size;         // of the picture, in pixels
uniform float tile;        // side of a tile, in pixels

const float NOTHING = 1e30;

void main()
{
    ivec2 tiles = ivec2(ceil(size / tile)), at = ivec2(gl_VertexID % tiles.x, gl_VertexID / tiles.x);
    bool shows = uintBitsToFloat(texelFetch(begins, at, 0).x) < NOTHING;
    gl_Position = shows ? vec4((2.0 * vec2(at) + 1.0) / vec2(tiles) - 1.0, 0, 1) : vec4(2, 2, 0, 1);
    gl_PointSize = tile;
}
