// Distances to triangles in single precision, relative to a point nearby, with a bound on their error:
// they decide most comparisons; the others are made in double precision.
//
// Let u = 2^-24, and S = the distance of corner a from the centre plus the radius of the points. The
// vector from a to a point is off by less than 2 u S: both are rounded, and so is the difference. Its
// components along e and g in units of length are then off by less than 8 u S each, and so are the
// distances to the lines of the edges, by whose signs the feature is chosen: a feature chosen wrongly
// is as near within that error. The place that is found lies within 2 S of a, so that the vector from
// there is off by less than 10 u S more. The total, 26 u S, is less than DOUBT * S. `moved` bounds the
// change where a side or height was dropped.

#define DOUBT 0x1p-19f

// One triangle per lane, or the same triangle in every lane: the numbers of frame_triangles, with corner
// a relative to the centre of the points; `doubt` bounds the errors of distances.
typedef struct {
    float16 t[FIELDS], doubt;
} narrow_triangles;

typedef struct {
    float16 x, y, z;
} narrow_ways;

void set_centre(narrow_triangles *n, float16 moved, float3 centre, float radius)
{
    n->t[0] -= centre.x, n->t[1] -= centre.y, n->t[2] -= centre.z;
    const float16 xx = n->t[0] * n->t[0], yy = n->t[1] * n->t[1], zz = n->t[2] * n->t[2];
    n->doubt = DOUBT * (sqrt(xx + yy + zz) + radius) + moved;
}

// The triangle of a slot, in every lane, for points within `radius` of a centre.
narrow_triangles one_narrow(const scene_of_lists *scene, uint slot, float3 centre, float radius)
{
    __global const float *t = scene->narrow + (size_t)slot * NARROW;
    narrow_triangles n;
    for (uint i = 0; i < FIELDS; ++i)
        n.t[i] = t[i];
    set_centre(&n, t[FIELDS], centre, radius);
    return n;
}

// The first halves of two vectors, item by item.
float16 shuffled(float8 a, float8 b)
{
    return (float16)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3, a.s4, b.s4, a.s5, b.s5, a.s6, b.s6,
                     a.s7, b.s7);
}

// The triangles of sixteen slots, one per lane: rows become columns in four perfect shuffles.
NOINLINE narrow_triangles sixteen_narrow(const scene_of_lists *scene, const uint *slots, float3 centre,
                                float radius)
{
    float16 rows[NARROW], columns[NARROW];
    for (uint i = 0; i < NARROW; ++i)
        rows[i] = vload16(slots[i], scene->narrow);
    for (uint pass = 0; pass < 2; ++pass) {
        for (uint i = 0; i < NARROW / 2; ++i) {
            columns[2 * i] = shuffled(rows[i].lo, rows[i + NARROW / 2].lo);
            columns[2 * i + 1] = shuffled(rows[i].hi, rows[i + NARROW / 2].hi);
        }
        for (uint i = 0; i < NARROW / 2; ++i) {
            rows[2 * i] = shuffled(columns[i].lo, columns[i + NARROW / 2].lo);
            rows[2 * i + 1] = shuffled(columns[i].hi, columns[i + NARROW / 2].hi);
        }
    }
    narrow_triangles n;
    for (uint i = 0; i < FIELDS; ++i)
        n.t[i] = rows[i];
    set_centre(&n, rows[FIELDS], centre, radius);
    return n;
}

// The block's triangles from an index of the lists on, sixteen at most; the last one pads them.
narrow_triangles sixteen_at(const scene_of_lists *scene, uint place, uint end, float3 centre,
                            float radius)
{
    uint slots[16];
    for (uint i = 0; i < 16; ++i)
        slots[i] = scene->items[min(place + i, end - 1)];
    return sixteen_narrow(scene, slots, centre, radius);
}

// The vertices of a block, relative to its centre.
typedef struct {
    float3 centre;
    float x[POINTS], y[POINTS], z[POINTS];
} narrow_vertices;

narrow_vertices narrow_vertices_of(const ways *points)
{
    narrow_vertices at;
    const ways *middle = &points[MIDDLE / 8];
    at.centre = (float3)((float)middle->x.s5, (float)middle->y.s5, (float)middle->z.s5);
    for (uint k = 0; k < POINTS / 8; ++k) {
        vstore8(convert_float8(points[k].x - at.centre.x), k, at.x);
        vstore8(convert_float8(points[k].y - at.centre.y), k, at.y);
        vstore8(convert_float8(points[k].z - at.centre.z), k, at.z);
    }
    return at;
}

float16 narrow_clamped(float16 t)
{
    t = t > 0.0f ? t : 0.0f;
    return t < 1.0f ? t : 1.0f;
}

// As triangle_ways, for points relative to the centre; returns the squares of the distances.
float16 narrow_squares(const narrow_triangles *n, float16 x, float16 y, float16 z, narrow_ways *way,
                       int16 *feature)
{
    const float16 *t = n->t;
    const float16 px = x - t[0], py = y - t[1], pz = z - t[2], foot = t[9], rest = 1 - foot;
    const float16 pe = px * t[3] + py * t[4] + pz * t[5];
    const float16 pg = px * t[6] + py * t[7] + pz * t[8];
    const float16 along = pe * t[11], up = pg * t[12];
    const float16 ac = (foot * pe + pg) * t[13];
    const float16 bc = narrow_clamped((rest * (t[10] - pe) + pg) * t[14]);
    const int16 below = pg <= 0.0f;
    const int16 left = along < foot * up, beyond = left | (along > 1 - rest * up);
    const int16 on_ac = left & (ac < 1.0f);
    const float16 up_ac = narrow_clamped(ac);
    float16 u = beyond ? 1 - bc * rest : along, v = beyond ? bc : up;
    u = on_ac ? up_ac * foot : u;
    v = on_ac ? up_ac : v;
    u = below ? narrow_clamped(along) : u;
    v = below ? 0.0f : v;
    const int16 on_ab = along > 0.0f ? (along < 1.0f ? (int16)AB : (int16)B) : (int16)A;
    const int16 on_bc = bc > 0.0f ? (bc < 1.0f ? (int16)BC : (int16)C) : (int16)B;
    const int16 on_ca = ac > 0.0f ? (int16)CA : (int16)A;
    *feature = below ? on_ab : on_ac ? on_ca : beyond ? on_bc : (int16)FACE;
    way->x = px - u * t[3] - v * t[6];
    way->y = py - u * t[4] - v * t[7];
    way->z = pz - u * t[5] - v * t[8];
    return way->x * way->x + way->y * way->y + way->z * way->z;
}

float16 greater(float16 a, float16 b)
{
    return a > b ? a : b;
}

float16 lesser(float16 a, float16 b)
{
    return a < b ? a : b;
}

float highest_narrow(float16 a)
{
    const float8 b = a.lo > a.hi ? a.lo : a.hi;
    const float4 c = b.lo > b.hi ? b.lo : b.hi;
    const float2 d = c.lo > c.hi ? c.lo : c.hi;
    return d.x > d.y ? d.x : d.y;
}

float lowest_narrow(float16 a)
{
    return -highest_narrow(-a);
}
