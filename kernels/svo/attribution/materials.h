// Colours of triangles in linear light: of materials, textures and vertices. A texture's mean over a part
// of a triangle is exact up to rounding: what is bilinear between four texels is integrated over the
// area that the part covers of their cell. Beyond MOST_SIDE cells on a side it is the mean of samples.
// Light is in 1/LIGHT_ONE, opacity in 1/255, up to the final mean.

typedef struct {
    __global const uchar *texels;
    int width, height, wrap_u, wrap_v, nearest;
} texture;

// materials: four channels each; texture_of: the texture of a material, or -1; a face's material may be
// -1, which is white. uv and colours may be null.
#define LOOK                                                                                       \
    __global const int *material_of, __global const double *materials,                             \
        __global const int *texture_of, __global const int *textures, __global const uchar *texels, \
        __global const double *uv, __global const double *colours
#define THIS_LOOK material_of, materials, texture_of, textures, texels, uv, colours

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

uchar4 texel_at(const texture *t, long i, long j)
{
    const size_t line = (size_t)wrapped(j, t->height, t->wrap_v) * t->width;
    return vload4(line + wrapped(i, t->width, t->wrap_u), t->texels);
}

double4 light_of(uchar4 c) { return (double4)(LINEAR[c.x], LINEAR[c.y], LINEAR[c.z], c.w); }

double4 light_at(const texture *t, long i, long j) { return light_of(texel_at(t, i, j)); }

double4 share_of(double4 light) { return light / (double4)(LIGHT_ONE, LIGHT_ONE, LIGHT_ONE, 255); }

long floor_of(double x)
{
    const long whole = (long)x;
    return whole - (x < (double)whole);
}

// Bilinear interpolation between four texels, as the coefficients of 1, x, y and xy.
typedef struct { double4 d, x, y, xy; } bilinear;

bilinear cell_of(const texture *t, long i, long j)
{
    bilinear b;
    b.d = light_at(t, i, j);
    b.x = b.y = b.xy = (double4)(0);
    if (!t->nearest) {
        const double4 right = light_at(t, i + 1, j), below = light_at(t, i, j + 1),
                      both = light_at(t, i + 1, j + 1);
        b.x = right - b.d;
        b.y = below - b.d;
        b.xy = both - right - below + b.d;
    }
    return b;
}

// The texture at a place, in texels: u * width and v * height, less 1/2 if it is bilinear.
double4 sample(const texture *t, double s, double r)
{
    const long i = floor_of(s), j = floor_of(r);
    const bilinear b = cell_of(t, i, j);
    const double x = s - (double)i, y = r - (double)j;
    return b.d + b.x * x + b.y * y + b.xy * (x * y);
}

// ---- means over parts

// The mean of samples: the centres of SAMPLES^2 equal triangles in each triangle of the fan. Corners of
// the part are at (x, y).
double4 sampled(const texture *t, const part *p, const double *x, const double *y)
{
    double4 sum = (double4)(0);
    for (int k = 2; k < p->n; ++k) {
        double4 own = (double4)(0);
        for (int m = 0; m < SAMPLES; ++m)
            for (int n = 0; n < 2 * (SAMPLES - m) - 1; ++n) { // upright ones are even
                const double third = n & 1 ? 2.0 / 3 : 1.0 / 3;
                const double e = (m + third) / SAMPLES, f = (n / 2 + third) / SAMPLES;
                own += sample(t, x[0] + (x[k - 1] - x[0]) * e + (x[k] - x[0]) * f,
                              y[0] + (y[k - 1] - y[0]) * e + (y[k] - y[0]) * f);
            }
        sum += own * (fan_area(p, k) / (SAMPLES * SAMPLES));
    }
    return sum / area_of(p);
}

// The mean over a part that lies in the cell (i, j), from whose corner x and y count.
double4 mean_in_cell(const texture *t, const part *p, const double *x, const double *y, long i, long j)
{
    double one = 0, mx = 0, my = 0, mxy = 0;
    for (int k = 2; k < p->n; ++k) {
        const double a = fan_area(p, k), xs = x[0] + x[k - 1] + x[k], ys = y[0] + y[k - 1] + y[k];
        one += a;
        mx += a * xs;
        my += a * ys;
        mxy += a * (xs * ys + x[0] * y[0] + x[k - 1] * y[k - 1] + x[k] * y[k]);
    }
    const bilinear b = cell_of(t, i, j);
    return b.d + b.x * (mx / (3 * one)) + b.y * (my / (3 * one)) + b.xy * (mxy / (12 * one));
}

// Integrals over what a part covers of a cell, of 1, x, y and xy from the cell's low corner.
typedef struct { double one, x, y, xy; } moments;

// The cells of a row that a part meets. By Green's theorem, integrals over the part are those along its
// sides over y: of what lies before the side in its own cell, and of all of the cells before it.
typedef struct {
    moments in[MOST_SIDE];
    double one[MOST_SIDE], y[MOST_SIDE]; // of a side in the cell, over the cells before
    int n;
} cell_row;

void clear(cell_row *row, int n)
{
    const moments none = {0, 0, 0, 0};
    for (int i = 0; i < n; ++i) {
        row->in[i] = none;
        row->one[i] = row->y[i] = 0;
    }
    row->n = n;
}

// Add a side, or its part in the row, from (x0, y0) to (x1, y1), with x0 <= x1; `sign` turns it round.
void add_side(cell_row *row, double x0, double y0, double x1, double y1, double sign)
{
    const double slope = x1 > x0 ? (y1 - y0) / (x1 - x0) : 0;
    int i = min((int)x0, row->n - 1);
    for (double x = x0, y = y0;; ++i) {
        const bool ends = x1 <= i + 1 || i == row->n - 1;
        const double to_x = ends ? x1 : i + 1, to_y = ends ? y1 : y0 + (to_x - x0) * slope;
        const double a = x - i, b = to_x - i, height = (to_y - y) * sign;
        const double aa = a * a, ab = a * b, bb = b * b;
        moments *in = &row->in[i];
        in->one += height * (a + b) / 2;
        in->x += height * (aa + ab + bb) / 6;
        in->y += height * (y * (2 * a + b) + to_y * (a + 2 * b)) / 6;
        in->xy += height * (y * (3 * aa + 2 * ab + bb) + to_y * (aa + 2 * ab + 3 * bb)) / 24;
        row->one[i] += height;
        row->y[i] += height * (y + to_y) / 2;
        if (ends)
            return;
        x = to_x;
        y = to_y;
    }
}

// Let `row` hold the sides of a polygon between y = 0 and y = 1 of a row of cells.
void fill_row(cell_row *row, const double *x, const double *y, int corners, int j)
{
    for (int k = 0, m = corners - 1; k < corners; m = k++) {
        const bool right = x[m] <= x[k];
        const int a = right ? m : k, b = right ? k : m;
        const double low = y[a] - j, high = y[b] - j;
        const double y0 = clamp(low, 0.0, 1.0), y1 = clamp(high, 0.0, 1.0);
        if (y0 == y1)
            continue;
        const double slope = (x[b] - x[a]) / (high - low);
        const double x0 = y0 == low ? x[a] : min(x[a] + (y0 - low) * slope, x[b]);
        const double x1 = y1 == high ? x[b] : max(x[b] - (high - y1) * slope, x0);
        add_side(row, x0, y0, x1, y1, right ? 1 : -1);
    }
}

void fetch_row(const texture *t, long i, long j, int n, double4 *lights)
{
    __global const uchar *line = t->texels + 4 * (size_t)wrapped(j, t->height, t->wrap_v) * t->width;
    for (int k = 0; k < n; ++k)
        lights[k] = light_of(vload4(wrapped(i + k, t->width, t->wrap_u), line));
}

// The integral of a texture over a row of cells, whose corners are texels of two rows; adds the area.
double4 row_sum(const cell_row *row, const double4 *above, const double4 *below, int nearest,
                double *area)
{
    double4 sum = (double4)(0);
    double one = 0, y = 0; // of the sides in the cells after this one
    for (int k = row->n - 1; k >= 0; --k) {
        moments m = row->in[k];
        m.one += one;
        m.x += one / 2;
        m.y += y;
        m.xy += y / 2;
        one += row->one[k];
        y += row->y[k];
        *area += m.one;
        if (nearest)
            sum += above[k] * m.one;
        else
            sum += above[k] * (m.one - m.x - m.y + m.xy) + above[k + 1] * (m.x - m.xy) +
                   below[k] * (m.y - m.xy) + below[k + 1] * m.xy;
    }
    return sum;
}

void find_range(const double *x, int n, long *first, long *last)
{
    double low = x[0], high = x[0];
    for (int i = 1; i < n; ++i) {
        low = x[i] < low ? x[i] : low;
        high = x[i] > high ? x[i] : high;
    }
    *first = floor_of(low);
    *last = -floor_of(-high) - 1; // a cell that is only touched does not count
    *last = *last < *first ? *first : *last;
}

// The mean of a texture over a part of a face whose texture coordinates are s and r.
double4 texture_mean(const texture *t, const part *p, linear s, linear r)
{
    if (area_of(p) == 0) {
        double u, v;
        find_centre(p, &u, &v);
        return sample(t, s.d + s.u * u + s.v * v, r.d + r.u * u + r.v * v);
    }
    double x[MOST_CORNERS], y[MOST_CORNERS];
    for (int k = 0; k < p->n; ++k) {
        x[k] = at_corner(s, p, k);
        y[k] = at_corner(r, p, k);
    }
    long top, bottom, left, right;
    find_range(x, p->n, &left, &right);
    find_range(y, p->n, &top, &bottom);
    if (bottom - top >= MOST_SIDE || right - left >= MOST_SIDE)
        return sampled(t, p, x, y);
    for (int k = 0; k < p->n; ++k) {
        x[k] -= (double)left;
        y[k] -= (double)top;
    }
    if (top == bottom && left == right)
        return mean_in_cell(t, p, x, y, left, top);
    cell_row row;
    double4 lights[2][MOST_SIDE + 1], sum = (double4)(0);
    double area = 0;
    const int n = (int)(right - left) + 1, texels = n + !t->nearest;
    for (int j = 0; j <= (int)(bottom - top); ++j) {
        double4 *above = lights[j & 1], *below = lights[(j + 1) & 1];
        if (j == 0 || t->nearest)
            fetch_row(t, left, top + j, texels, above);
        if (!t->nearest)
            fetch_row(t, left, top + j + 1, texels, below);
        clear(&row, n);
        fill_row(&row, x, y, p->n, j);
        sum += row_sum(&row, above, below, t->nearest, &area);
    }
    if (fabs(area) * SLIVER > 1)
        return sum / area;
    for (int k = 0; k < p->n; ++k) {
        x[k] += (double)left;
        y[k] += (double)top;
    }
    return sampled(t, p, x, y);
}

// ---- faces

// The appearance that all parts of a face share.
typedef struct {
    double4 material;
    bool painted, textured; // it has colours of vertices, a texture
    double4 corners[3];
    texture t;
    linear s, r; // texture coordinates in texels, less 1/2 if the texture is bilinear
} skin;

skin skin_of(LOOK, __global const int *faces, uint face)
{
    skin k;
    const int number = material_of[face];
    k.material = number < 0 ? (double4)(1) : vload4(number, materials);
    k.painted = colours != 0;
    for (int i = 0; i < 3 && k.painted; ++i)
        k.corners[i] = vload4(faces[3 * (size_t)face + i], colours);
    const int own = number < 0 || !uv ? -1 : texture_of[number];
    k.textured = own >= 0;
    if (k.textured) {
        __global const int *row = textures + 6 * (size_t)own;
        __global const double *at = uv + 6 * (size_t)face;
        const texture t = {texels + 4 * (size_t)row[0], row[1], row[2], row[3], row[4], row[5]};
        const double w = t.width, h = t.height, shift = t.nearest ? 0.0 : 0.5;
        k.t = t;
        k.s = linear_of(at[0] * w - shift, at[2] * w - shift, at[4] * w - shift);
        k.r = linear_of(at[1] * h - shift, at[3] * h - shift, at[5] * h - shift);
    }
    return k;
}

// The colour at a place of a face, without its texture.
double4 paint_at(const skin *k, double u, double v)
{
    if (!k->painted)
        return k->material;
    return k->material *
           (k->corners[0] + (k->corners[1] - k->corners[0]) * u + (k->corners[2] - k->corners[0]) * v);
}

// The colour at a place of a face.
double4 colour_at(const skin *k, double u, double v)
{
    const double4 colour = paint_at(k, u, v);
    if (!k->textured)
        return colour;
    return colour * share_of(sample(&k->t, k->s.d + k->s.u * u + k->s.v * v, k->r.d + k->r.u * u + k->r.v * v));
}

// The mean colour of a part. Colours of vertices that multiply a texture are those at the centre.
double4 mean_colour(const skin *k, const part *p)
{
    double u = 0, v = 0;
    if (k->painted)
        find_centre(p, &u, &v);
    const double4 colour = paint_at(k, u, v);
    return k->textured ? colour * share_of(texture_mean(&k->t, p, k->s, k->r)) : colour;
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

// The colour at a place of a face: that of its texel, as it is, and of its nearest corner.
uchar4 nearest_colour(const skin *k, double u, double v)
{
    const double w = 1 - u - v;
    const int corner = w >= u && w >= v ? 0 : u >= v ? 1 : 2;
    const double4 colour = k->painted ? k->material * k->corners[corner] : k->material;
    if (!k->textured)
        return levels_of(colour);
    const double shift = k->t.nearest ? 0.0 : 0.5;
    const uchar4 texel = texel_at(&k->t, floor_of(k->s.d + k->s.u * u + k->s.v * v + shift),
                                  floor_of(k->r.d + k->r.u * u + k->r.v * v + shift));
    return all(colour == (double4)(1)) ? texel : levels_of(colour * share_of(light_of(texel)));
}
