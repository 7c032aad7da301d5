// Scan conversion: visits the boxes that a triangle touches, or that separate ([voCCeL], sections 3.2 and
// A.4). The kernel that includes it defines RECEIVER, the type of what receives boxes, and
// put_box(RECEIVER *, level, ACTIVE_SET, box). Options: those of columns.h; BASE_OVERLAP, for the
// overlap test without depth intervals.

// Values that do not depend on the box (the set-up stage of [voCCeL], section 3.2).
typedef struct {
    int size;                // of a box, in units
    int3 first;              // low corner of box (0, 0, c.low.z) from v0, in units
    edge_functions xy, yz, zx; // in swizzled axes
    long nx, ny, nz;         // normal, negated if needed so that nz >= 0
    wide near, far;          // added to n . (low corner - v0) for the near and far side of a box
} scan;

scan set_up(const triangle *t, const columns *c, int kind, int level, int pad_x)
{
    scan s;
    const int3 pad = swizzle((int3)(pad_x, 0, 0), c->axis);
    const int3 u = swizzle(t->v[0], c->axis), v = swizzle(t->v[1], c->axis),
               w = swizzle(t->v[2], c->axis), a = v - u, b = w - u;
    s.size = VOXEL << level;
    s.first = (int3)(0, 0, c->low.z * s.size) - pad - u;
    const long3 n = cross_of(a, b);
    const int3 x = (int3)(u.x, v.x, w.x), y = (int3)(u.y, v.y, w.y), z = (int3)(u.z, v.z, w.z);
    s.xy = project(kind, x, y, n.z < 0 ? -1 : 1, s.size, pad.x, pad.y, c->axis != 1);
    s.yz = project(kind, y, z, n.x < 0 ? -1 : 1, s.size, pad.y, pad.z, c->axis != 0);
    s.zx = project(kind, z, x, n.y < 0 ? -1 : 1, s.size, pad.z, pad.x, c->axis != 2);
    s.nx = n.z < 0 ? -n.x : n.x;
    s.ny = n.z < 0 ? -n.y : n.y;
    s.nz = n.z < 0 ? -n.z : n.z;
    if (kind == SEPARATING) { // the centre is within half a voxel of the plane along the axis
        const int tie = c->axis == 2   ? shift_sign(s.nx, s.ny, s.nz)
                        : c->axis == 0 ? shift_sign(s.nz, s.nx, s.ny)
                                       : shift_sign(s.ny, s.nz, s.nx);
        s.far = wide_sum(wide_dot(s.nx, s.ny, s.nz, HALF, HALF, VOXEL), wide_product(tie < 0, -1));
        s.near = wide_sum(wide_dot(s.nx, s.ny, 0, HALF, HALF, 0), wide_product(tie > 0, 1));
    } else { // the plane passes between the critical points ([voCCeL], eq. 3.1)
        const int3 box = s.size + 2 * pad;
        s.far = wide_dot(max(s.nx, 0l), max(s.ny, 0l), s.nz, box.x, box.y, box.z);
        s.near = wide_dot(min(s.nx, 0l), min(s.ny, 0l), 0, box.x, box.y, 0);
    }
    return s;
}

#ifdef BASE_OVERLAP
// Store the boxes that the triangle touches in the columns from `first` to `end`. Each box of the
// bounding box is tested against the plane and the three projections ([voCCeL], eq. 3.1 and 3.2).
void scan_tile(const scan *s, const columns *c, int2 first, int2 end, RECEIVER *out, int level,
               ACTIVE_SET_PARAMETERS)
{
    const wide gap = wide_sum(s->near, wide_negative(s->far));
    for (int q = first.y; q <= end.y; ++q)
        for (int p = first.x; p <= end.x; ++p)
            for (int k = c->low.z; k <= c->high.z; ++k) {
                const long x = (long)p * s->size + s->first.x, y = (long)q * s->size + s->first.y,
                           z = (long)(k - c->low.z) * s->size + s->first.z;
                const wide far = wide_sum(s->far, wide_dot(s->nx, s->ny, s->nz, x, y, z));
                const long3 xy = s->xy.p * p + s->xy.q * q + s->xy.d,
                            yz = s->yz.p * q + s->yz.q * k + s->yz.d,
                            zx = s->zx.p * k + s->zx.q * p + s->zx.d;
                if (!is_negative(far) && !is_positive(wide_sum(far, gap)) && none_negative(xy | yz | zx)) {
                    const int3 box = (int3)(p, q, k);
                    put_box(out, level, ACTIVE_SET, as_uint3(unswizzle(box, c->axis)));
                }
            }
}
#else
// Store the boxes that the triangle touches in the columns from `first` to `end`, column by column. In
// a column, the plane meets the boxes from the first whose far side is not before it to the last whose
// near side is not behind it ([voCCeL], fig. 3.4). From one column to the next, this range moves by one
// or two boxes. The columns of a row that a convex triangle meets are contiguous, so the first column
// beyond them ends the row.
void scan_tile(const scan *s, const columns *c, int2 first, int2 end, RECEIVER *out, int level,
               ACTIVE_SET_PARAMETERS)
{
    const int last = c->high.z - c->low.z;
    const wide right = wide_product(s->nx, s->size), up = wide_product(s->nz, s->size),
               down = wide_negative(up);
    const wide gap = wide_sum(s->near, wide_negative(s->far));
    for (int q = first.y; q <= end.y; ++q) {
        long3 xy = s->xy.p * first.x + s->xy.q * q + s->xy.d;
        int p = first.x;
        for (; p <= end.x && !none_negative(xy); ++p)
            xy += s->xy.p;
        if (p > end.x)
            continue;
        // box r of the column, its edge functions, and n . (p - v0) at its far side
        wide far = wide_sum(s->far, wide_dot(s->nx, s->ny, s->nz, (long)p * s->size + s->first.x,
                                             (long)q * s->size + s->first.y, s->first.z));
        int r = first_not_before(&far, s->nz, s->size, up, last);
        long3 yz = s->yz.p * q + s->yz.q * (c->low.z + r) + s->yz.d;
        long3 zx = s->zx.p * (c->low.z + r) + s->zx.q * p + s->zx.d;
        for (; p <= end.x && none_negative(xy); ++p) {
            for (; r <= last && is_negative(far); ++r, far = wide_sum(far, up)) {
                yz += s->yz.q;
                zx += s->zx.p;
            }
            for (; r > 0 && !is_negative(wide_sum(far, down)); --r, far = wide_sum(far, down)) {
                yz -= s->yz.q;
                zx -= s->zx.p;
            }
            long3 yz_box = yz, zx_box = zx;
            wide near = wide_sum(far, gap);
            for (int k = r; k <= last && !is_positive(near); ++k, near = wide_sum(near, up)) {
                if (none_negative(yz_box | zx_box)) {
                    const int3 box = (int3)(p, q, c->low.z + k);
                    put_box(out, level, ACTIVE_SET, as_uint3(unswizzle(box, c->axis)));
                }
                yz_box += s->yz.q;
                zx_box += s->zx.p;
            }
            xy += s->xy.p;
            zx += s->zx.q;
            far = wide_sum(far, right);
        }
    }
}
#endif

void scan_convert(const scan *s, const columns *c, RECEIVER *out, int level, ACTIVE_SET_PARAMETERS)
{
    int2 first, end;
    for (first.y = c->low.y; first.y <= c->high.y; first.y = end.y + 1) {
        end.y = tile_end(first.y, c->high.y);
        for (first.x = c->low.x; first.x <= c->high.x; first.x = end.x + 1) {
            end.x = tile_end(first.x, c->high.x);
            if (meets_tile(&s->xy, first, end))
                scan_tile(s, c, first, end, out, level, ACTIVE_SET);
        }
    }
}
