// Colours of triangles in linear light: of materials, textures and vertices. A texture's mean over a part
// of a triangle is exact up to rounding: the part is cut along the texels, and what is bilinear between
// four of them is integrated. Beyond MOST_TEXELS texels it is the mean of samples.

typedef struct {
    uint first; // of its texels
    int width, height, wrap_u, wrap_v, nearest;
} texture;

// materials: four channels each; textures_of: the texture of a material, or -1; a face's material may be
// -1, which is white. uv and colours may be null.
#define LOOK                                                                                       \
    __global const int *material_of, __global const double *materials,                             \
        __global const int *texture_of, __global const int *textures, __global const uchar *texels, \
        __global const double *uv, __global const double *colours
#define THIS_LOOK material_of, materials, texture_of, textures, texels, uv, colours

typedef struct {
    __global const int *material_of;
    __global const double *materials;
    __global const int *texture_of, *textures;
    __global const uchar *texels;
    __global const double *uv, *colours;
} look;

// The texel of a coordinate beyond 0 to size - 1.
int wrapped(long i, int size, int wrap)
{
    if (i >= 0 && i < size)
        return (int)i;
    if (wrap == CLAMP)
        return i < 0 ? 0 : size - 1;
    const long period = wrap == MIRROR ? 2l * size : size;
    long rest = i % period;
    rest += rest < 0 ? period : 0;
    return (int)(rest < size ? rest : period - 1 - rest);
}

uchar4 texel_at(const look *l, const texture *t, long i, long j)
{
    const size_t place = (size_t)wrapped(j, t->height, t->wrap_v) * t->width +
                         wrapped(i, t->width, t->wrap_u);
    return vload4(t->first + place, l->texels);
}

double4 light_of(uchar4 c)
{
    return (double4)(LINEAR[c.x], LINEAR[c.y], LINEAR[c.z], 0) / (double)LIGHT_ONE +
           (double4)(0, 0, 0, c.w / 255.0);
}

long floor_of(double x)
{
    const long whole = (long)x;
    return whole - (x < (double)whole);
}

// Four texels around a cell, as the coefficients of 1, x, y and xy.
typedef struct { double4 d, x, y, xy; } bilinear;

bilinear cell_of(const look *l, const texture *t, long i, long j)
{
    bilinear b;
    b.d = light_of(texel_at(l, t, i, j));
    b.x = b.y = b.xy = (double4)(0);
    if (!t->nearest) {
        const double4 right = light_of(texel_at(l, t, i + 1, j)),
                      below = light_of(texel_at(l, t, i, j + 1)),
                      both = light_of(texel_at(l, t, i + 1, j + 1));
        b.x = right - b.d;
        b.y = below - b.d;
        b.xy = both - right - below + b.d;
    }
    return b;
}

// The texture at a place, in texels: u * width and v * height, less 1/2 if it is bilinear.
double4 sample(const look *l, const texture *t, double s, double r)
{
    const long i = floor_of(s), j = floor_of(r);
    const bilinear b = cell_of(l, t, i, j);
    const double x = s - (double)i, y = r - (double)j;
    return b.d + b.x * x + b.y * y + b.xy * (x * y);
}

// Add the integral over a part that lies in one cell; its twice area to *area.
double4 integral(const look *l, const texture *t, const part *p, linear s, linear r, long i, long j,
                 double *area)
{
    double whole = 0, mx = 0, my = 0, mxy = 0;
    const double x0 = at_corner(s, p, 0) - (double)i, y0 = at_corner(r, p, 0) - (double)j;
    for (int k = 2; k < p->n; ++k) {
        const double a = fan_area(p, k);
        const double x1 = at_corner(s, p, k - 1) - (double)i, x2 = at_corner(s, p, k) - (double)i,
                     y1 = at_corner(r, p, k - 1) - (double)j, y2 = at_corner(r, p, k) - (double)j;
        whole += a;
        mx += a * (x0 + x1 + x2) / 3;
        my += a * (y0 + y1 + y2) / 3;
        mxy += a * ((x0 + x1 + x2) * (y0 + y1 + y2) + x0 * y0 + x1 * y1 + x2 * y2) / 12;
    }
    *area += whole;
    if (whole == 0)
        return (double4)(0);
    const bilinear b = cell_of(l, t, i, j);
    return b.d * whole + b.x * mx + b.y * my + b.xy * mxy;
}

void find_range(const part *p, linear f, long *first, long *last)
{
    double low = at_corner(f, p, 0), high = low;
    for (int i = 1; i < p->n; ++i) {
        const double x = at_corner(f, p, i);
        low = x < low ? x : low;
        high = x > high ? x : high;
    }
    *first = floor_of(low);
    *last = -floor_of(-high) - 1; // a cell that is only touched does not count
    *last = *last < *first ? *first : *last;
}

part between(const part *p, linear f, long low)
{
    part q = *p;
    const linear above = {f.d - (double)low, f.u, f.v}, below = {(double)low + 1 - f.d, -f.u, -f.v};
    cut(&q, above);
    cut(&q, below);
    return q;
}

// The mean of samples: the centres of SAMPLES^2 equal triangles in each triangle of the fan.
double4 sampled(const look *l, const texture *t, const part *p, linear s, linear r, double *area)
{
    double4 sum = (double4)(0);
    for (int k = 2; k < p->n; ++k) {
        const double a = fan_area(p, k);
        double4 own = (double4)(0);
        for (int m = 0; m < SAMPLES; ++m)
            for (int n = 0; n < 2 * (SAMPLES - m) - 1; ++n) { // upright ones are even
                const double third = n & 1 ? 2.0 / 3 : 1.0 / 3;
                const double e = (m + third) / SAMPLES, f = (n / 2 + third) / SAMPLES;
                const double u = p->u[0] + (p->u[k - 1] - p->u[0]) * e + (p->u[k] - p->u[0]) * f,
                             v = p->v[0] + (p->v[k - 1] - p->v[0]) * e + (p->v[k] - p->v[0]) * f;
                own += sample(l, t, s.d + s.u * u + s.v * v, r.d + r.u * u + r.v * v);
            }
        *area += a;
        sum += own * (a / (SAMPLES * SAMPLES));
    }
    return sum;
}

// The mean of a texture over a part of a face.
double4 texture_mean(const look *l, const texture *t, const part *p, linear s, linear r, double u,
                     double v)
{
    long top, bottom, left, right;
    double area = 0;
    double4 sum = (double4)(0);
    find_range(p, r, &top, &bottom);
    find_range(p, s, &left, &right);
    if ((double)(bottom - top + 1) * (double)(right - left + 1) > MOST_TEXELS) {
        sum = sampled(l, t, p, s, r, &area);
    } else {
        for (long j = top; j <= bottom; ++j) {
            part row = *p;
            if (top < bottom)
                row = between(p, r, j);
            find_range(&row, s, &left, &right);
            for (long i = left; i <= right; ++i) {
                part own = row;
                if (left < right)
                    own = between(&row, s, i);
                sum += integral(l, t, &own, s, r, i, j, &area);
            }
        }
    }
    if (area > 0)
        return sum / area;
    return sample(l, t, s.d + s.u * u + s.v * v, r.d + r.u * u + r.v * v);
}

texture texture_of_face(const look *l, uint face, bool *has)
{
    texture t;
    const int material = l->material_of[face];
    const int number = material < 0 || !l->uv ? -1 : l->texture_of[material];
    *has = number >= 0;
    if (*has) {
        __global const int *row = l->textures + 6 * (size_t)number;
        t.first = (uint)row[0];
        t.width = row[1];
        t.height = row[2];
        t.wrap_u = row[3];
        t.wrap_v = row[4];
        t.nearest = row[5];
    }
    return t;
}

// Texture coordinates in texels along an axis, less `shift`.
linear in_texels(const look *l, uint face, int axis, int size, double shift)
{
    __global const double *own = l->uv + 6 * (size_t)face + axis;
    return linear_of(own[0] * size - shift, own[2] * size - shift, own[4] * size - shift);
}

double4 material_colour(const look *l, uint face)
{
    const int material = l->material_of[face];
    return material < 0 ? (double4)(1) : vload4(material, l->materials);
}

// The mean colour of a part whose centre is (u, v). Colours of vertices that multiply a texture are
// those at the centre.
double4 mean_colour(const look *l, __global const int *faces, uint face, const part *p, double u,
                    double v)
{
    double4 colour = material_colour(l, face);
    if (l->colours) {
        const double4 a = vload4(faces[3 * (size_t)face], l->colours),
                      b = vload4(faces[3 * (size_t)face + 1], l->colours),
                      c = vload4(faces[3 * (size_t)face + 2], l->colours);
        colour = colour * (a + (b - a) * u + (c - a) * v);
    }
    bool has;
    const texture t = texture_of_face(l, face, &has);
    if (has) {
        const double shift = t.nearest ? 0.0 : 0.5;
        const linear s = in_texels(l, face, 0, t.width, shift),
                     r = in_texels(l, face, 1, t.height, shift);
        colour = colour * texture_mean(l, &t, p, s, r, u, v);
    }
    return colour;
}

// The nearest level of sRGB to linear light from 0 to 1.
uchar level_of(double light)
{
    const uint scaled = (uint)(light < 0 ? 0 : light > 1 ? (double)LIGHT_ONE : light * LIGHT_ONE);
    uint low = 0, high = 255; // levels up to `low` are not above it
    while (low < high) {
        const uint middle = (low + high + 1) / 2;
        if (BOUNDS[middle - 1] <= scaled)
            low = middle;
        else
            high = middle - 1;
    }
    return (uchar)low;
}

uchar4 levels_of(double4 light)
{
    const double alpha = light.w < 0 ? 0 : light.w > 1 ? 1 : light.w;
    return (uchar4)(level_of(light.x), level_of(light.y), level_of(light.z), (uchar)(alpha * 255 + 0.5));
}

// The colour at a point of a face: its texel, and the colour of its nearest corner, as they are.
uchar4 nearest_colour(const look *l, __global const int *faces, uint face, double u, double v)
{
    const double4 material = material_colour(l, face);
    double4 colour = material;
    if (l->colours) {
        const double w = 1 - u - v;
        const int corner = w >= u && w >= v ? 0 : u >= v ? 1 : 2;
        colour = colour * vload4(faces[3 * (size_t)face + corner], l->colours);
    }
    bool has;
    const texture t = texture_of_face(l, face, &has);
    if (!has)
        return levels_of(colour);
    const linear s = in_texels(l, face, 0, t.width, 0), r = in_texels(l, face, 1, t.height, 0);
    const uchar4 texel = texel_at(l, &t, floor_of(s.d + s.u * u + s.v * v),
                                  floor_of(r.d + r.u * u + r.v * v));
    return all(colour == (double4)(1)) ? texel : levels_of(colour * light_of(texel));
}
