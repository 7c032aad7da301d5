#version 300 es
// The ray of a pixel, as in voxtool/camera.py. Depths are counted from the target of the camera, which
// is near the content, so that float32 loses little.
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp sampler2D;
precision highp usampler3D;
precision highp isampler2D;
precision highp sampler3D;

uniform vec2 size;                         // of the picture, in pixels
uniform vec3 start, startRight, startDown; // where rays are at depth 0, in units of the content
uniform vec3 way, wayRight, wayDown;       // a step of depth along them
uniform float nearest;                     // depth at which rays begin
uniform vec3 light;                        // unit vector towards the light
uniform vec3 colour;                       // of a face towards the light

layout(location = 0) out vec4 picture; // premultiplied
layout(location = 1) out uvec4 id;     // what the pixel shows; 0 for nothing

const uint MASK = 31u;

void rayOfPixel(out vec3 origin, out vec3 direction)
{
    float x = gl_FragCoord.x - 0.5 * size.x, y = 0.5 * size.y - gl_FragCoord.y;
    origin = start + x * startRight + y * startDown;
    direction = way + x * wayRight + y * wayDown;
}

// Element i of an array in rows of a texture.
ivec2 texel(uint i, int rowBits)
{
    return ivec2(int(i) & ((1 << rowBits) - 1), int(i) >> rowBits);
}

// The position of the highest bit that is set in v, 0 < v < 2^24.
int highestBit(int v) { return (floatBitsToInt(float(v)) >> 23) - 127; }

float smallest(vec3 v) { return min(min(v.x, v.y), v.z); }
float largest(vec3 v) { return max(max(v.x, v.y), v.z); }
