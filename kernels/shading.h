// The brightness of a surface: half Lambert's law [Mitchell 2006], which keeps the shape visible
// where the surface turns away from the light. Pages (voxtool/viewer) compile this as GLSL, too.

#define AMBIENT 0.08f

// n: the unit normal towards the viewer; light: the unit vector towards the light.
float brightness(const float nx, const float ny, const float nz, const float light_x,
                 const float light_y, const float light_z)
{
    float wrapped = 0.5f + 0.5f * (nx * light_x + ny * light_y + nz * light_z);
    return AMBIENT + (1.0f - AMBIENT) * (wrapped * wrapped);
}
