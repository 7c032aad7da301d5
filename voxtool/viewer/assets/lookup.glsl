uniform highp sampler3D voxels;
uniform highp usampler3D cells, offsets, bounds;
uniform uint depth; // the attribute

// Bit i of the ten lowest moves to bit 3 i.
uint spread(uint v)
{
    v &= 1023u;
    v = (v | v << 16) & 0x030000FFu;
    v = (v | v << 8) & 0x0300F00Fu;
    v = (v | v << 4) & 0x030C30C3u;
    return (v | v << 2) & 0x09249249u;
}

uint morton(uvec3 c)
{
    return spread(c.x) | spread(c.y) << 1 | spread(c.z) << 2;
}

// The low and the high word of the identifier of a cell.
uvec2 identifier_of(uint level, uvec3 cell)
{
    uint low = morton(cell), high = morton(cell >> 10), bit = 3u * level;
    uvec2 code = uvec2(low | high << 30, high >> 2);
    return bit < 32u ? uvec2(code.x | 1u << bit, code.y) : uvec2(code.x, code.y | 1u << (bit - 32u));
}

// Whether a cell is stored, and then the place of its block.
bool find_block(uint level, uvec3 cell, out uvec3 block)
{
    uint m = uint(textureSize(cells, 0).x), r = uint(textureSize(offsets, 0).x);
    uvec3 key = cell + (1u << level);
    uvec4 offset = texelFetch(offsets, ivec3(key % r), 0);
#ifdef HAS_W
    key %= offset.w;
#endif
    uvec4 texel = texelFetch(cells, ivec3((key + offset.xyz) % m), 0);
    uvec2 identifier = identifier_of(level, cell);
#ifdef WIDE
    bool stored = texel.xy == identifier;
    uint pointer = texel.z;
#else
    bool stored = texel.x == identifier.x;
    uint pointer = texel.y;
#endif
    block = uvec3(pointer, pointer >> 10, pointer >> 20) & 1023u;
    return stored;
}

// The level of the deepest stored cell at a point p, in units of 2^-32 sides, and its block.
uint find_deepest(uvec3 p, out uvec3 block)
{
    uint level = 0u;
    uvec3 found;
    find_block(0u, uvec3(0u), block);
    while (level + 1u < depth && find_block(level + 1u, p >> (31u - level), found)) {
        block = found;
        ++level;
    }
    return level;
}

// The distance at a point, in sides.
float distance_at(uvec3 p)
{
    uvec3 block;
    uint level = find_deepest(p, block);
    ivec3 v = ivec3(3u * block + (p >> (31u - level) & 1u)), w = v + 1;
    vec3 t = vec3(p << (level + 1u) >> 8) * (1.0 / 16777216.0);
    vec4 left = vec4(texelFetch(voxels, v, 0).r, texelFetch(voxels, ivec3(v.x, w.y, v.z), 0).r,
                     texelFetch(voxels, ivec3(v.xy, w.z), 0).r, texelFetch(voxels, ivec3(v.x, w.yz), 0).r);
    vec4 right = vec4(texelFetch(voxels, ivec3(w.x, v.yz), 0).r, texelFetch(voxels, ivec3(w.xy, v.z), 0).r,
                      texelFetch(voxels, ivec3(w.x, v.y, w.z), 0).r, texelFetch(voxels, w, 0).r);
    vec4 x = left + t.x * (right - left);
    vec2 y = x.xz + t.y * (x.yw - x.xz);
    return y.x + t.z * (y.y - y.x);
}

// The code of the error bound at a point.
uint bound_at(uvec3 p)
{
    uvec3 block;
    uint level = find_deepest(p, block);
    return texelFetch(bounds, ivec3(2u * block + (p >> (31u - level) & 1u)), 0).r;
}
