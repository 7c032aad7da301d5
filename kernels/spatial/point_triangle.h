// Vectors from triangles to points, one pair per lane. The includer defines LANES (double4 or
// double8) and MASKS (long4 or long8).

// The feature of a triangle nearest to a point; ab is the longest edge.
enum { FACE, AB, BC, CA, A, B, C };

// The layout of frame_triangles: corner a, edge e, height g, foot of the height along e; e.e; and 1
// / e.e, 1 / g.g, and the inverse squared lengths of ac and bc.
typedef struct {
    LANES ax, ay, az, ex, ey, ez, gx, gy, gz, foot, ee, per_ee, per_gg, per_ac, per_bc;
} triangle;

typedef struct {
    LANES x, y, z;
} ways;

// Triangle i of a leaf, in every lane.
triangle one_triangle(__global const double *leaf, uint i)
{
    triangle t;
    leaf += i;
    t.ax = leaf[0 * LEAF], t.ay = leaf[1 * LEAF], t.az = leaf[2 * LEAF];
    t.ex = leaf[3 * LEAF], t.ey = leaf[4 * LEAF], t.ez = leaf[5 * LEAF];
    t.gx = leaf[6 * LEAF], t.gy = leaf[7 * LEAF], t.gz = leaf[8 * LEAF];
    t.foot = leaf[9 * LEAF], t.ee = leaf[10 * LEAF];
    t.per_ee = leaf[11 * LEAF], t.per_gg = leaf[12 * LEAF];
    t.per_ac = leaf[13 * LEAF], t.per_bc = leaf[14 * LEAF];
    return t;
}

LANES clamped(LANES t)
{
    t = t > 0.0 ? t : 0.0;
    return t < 1.0 ? t : 1.0;
}

// The vectors from the nearest points of triangles to points, and the features that contain these
// nearest points; returns the squared lengths.
//
// In the triangle's plane, with axes e and g, a is (0, 0), b is (1, 0) and c is (foot, 1). e is the
// longest edge, so the angles at a and b are acute. A point below ab is nearest to ab; a point
// beyond ac to ac, or past c to bc; a point beyond bc to bc. Slivers are safe: the vector always
// starts at a point of the triangle, and the error of the foot point across a thin triangle is less
// than its height.
LANES triangle_ways(const triangle *t, LANES x, LANES y, LANES z, ways *way, MASKS *feature)
{
    const LANES px = x - t->ax, py = y - t->ay, pz = z - t->az;
    const LANES rest = 1.0 - t->foot;
    const LANES pe = px * t->ex + py * t->ey + pz * t->ez;
    const LANES pg = px * t->gx + py * t->gy + pz * t->gz;
    const LANES along = pe * t->per_ee, up = pg * t->per_gg;
    const LANES ac = (t->foot * pe + pg) * t->per_ac;
    const LANES bc = clamped((rest * (t->ee - pe) + pg) * t->per_bc);
    const MASKS below = pg <= 0.0;
    const MASKS left = along < t->foot * up, right = along > 1.0 - rest * up;
    const MASKS beyond = left | right, on_ac = left & (ac < 1.0);
    LANES u = beyond ? 1.0 - bc * rest : along;
    LANES v = beyond ? bc : up;
    u = on_ac ? clamped(ac) * t->foot : u;
    v = on_ac ? clamped(ac) : v;
    u = below ? clamped(along) : u;
    v = below ? 0.0 : v;
    const MASKS on_ab = along > 0.0 ? (along < 1.0 ? (MASKS)AB : (MASKS)B) : (MASKS)A;
    const MASKS on_bc = bc > 0.0 ? (bc < 1.0 ? (MASKS)BC : (MASKS)C) : (MASKS)B;
    const MASKS on_ca = ac > 0.0 ? (MASKS)CA : (MASKS)A;
    *feature = below ? on_ab : on_ac ? on_ca : beyond ? on_bc : (MASKS)FACE;
    way->x = px - u * t->ex - v * t->gx;
    way->y = py - u * t->ey - v * t->gy;
    way->z = pz - u * t->ez - v * t->gz;
    return way->x * way->x + way->y * way->y + way->z * way->z;
}

// The pseudo-normal of a feature of the named triangle.
double3 normal_of(uint name, uint feature, __global const uint *features,
                  __global const double *normals)
{
    const uint turn = name % 3;
    const uint turned = feature == FACE ? FACE
                        : feature < A   ? AB + (feature - AB + turn) % 3
                                        : A + (feature - A + turn) % 3;
    return vload3(features[7 * (size_t)(name / 3) + turned], normals);
}
