// Rays from cell to cell where extinction is steep: by edge functions of float64, without differences of
// depths. Host side: voxtool/tets/pictures/walk.py.
//
// In q = (X - x Z, Y - y Z) of a corner, as view.cl projects it, the ray of the pixel (x, y) is the origin.
// The signs of q_a x q_b along the six edges of a tetrahedron say by which faces the ray enters and leaves,
// and the values weigh the corners of a face where the ray meets it. Let the face by which it enters be
// opposite corner i, that by which it leaves opposite j, and k and l the other two. With V the volume in
// these coordinates and D the sum of the three products of a face, depth increases in the cell by
//     6 V (q_k x q_l) / (D_i D_j),
// in which nothing cancels however thin the cell is.
// Options:
//   PERSPECTIVE
//   CONSTANT   cells have one scalar each
//   SURFACES   isosurfaces that rays meet, with the options of surfaces.h
//   LANES, 1

#include "tets/volume/cells.h"
#include "tets/pictures/ray.h"
#include "tets/pictures/raycast.h"
#include "tets/pictures/transfer.h"
#ifdef SURFACES
#include "tets/pictures/surfaces.h"
#endif

#ifdef PERSPECTIVE
#define EYE_DEPTH(middle) (-(middle))
#else
#define EYE_DEPTH(middle) ((double)-FARTHEST)
#endif

// --- a ray in a cell -----------------------------------------------------------------------------

#define NOISE 1e-11 // of the largest product: less is rounding
#define SAME 1e-15  // difference of scalars that is rounding

typedef struct {
    double begin, end; // depths at which the ray enters and leaves
    double from, to;   // scalars there
    double growth;     // of depth, exact where `end - begin` is not
    int leaves;        // the face by which it leaves, or -1
} Chord;

#define LEAST_MARGIN 1e-300 // of a ray through an edge that belongs to the face

// The side of the ray on which an edge passes it, -1 or 1, by the rule of `enters` in view.cl; 0 for an edge
// without length.
int side_of(const double turn, const double dx, const double dy)
{
    if (turn != 0)
        return turn < 0 ? -1 : 1;
    return dy != 0 ? (dy < 0 ? -1 : 1) : dx != 0 ? (dx < 0 ? -1 : 1) : 0;
}

// A face that a ray passes: that opposite a corner, and the products of its edges, each opposite a corner.
typedef struct {
    int face, a, b, c;
    double of_a, of_b, of_c, sum;
    double depth, deeper, scalar, more; // at corner a, and what the others add, times `sum`
    double margin;                      // by which the ray is in the face
} Passage;

// The way of the ray of pixel (x, y) through a tetrahedron of projected corners and their scalars.
// `turned` is -1 where the picture is mirrored, else 1; `volume` is six times that of the projected cell.
// Returns false if the ray passes beside the cell.
bool chord_of(const double4 *corners, const double *scalars, const double x, const double y,
              const int turned, const double volume, Chord *chord)
{
    double qx[4], qy[4], turn[4][4], largest = 0;
#pragma unroll
    for (int i = 0; i < 4; ++i) {
        qx[i] = corners[i].x - x * corners[i].z;
        qy[i] = corners[i].y - y * corners[i].z;
    }
#pragma unroll
    for (int i = 0; i < 4; ++i)
#pragma unroll
        for (int j = 0; j < i; ++j) {
            turn[j][i] = qx[j] * qy[i] - qy[j] * qx[i];
            turn[i][j] = -turn[j][i];
            largest = fmax(largest, fabs(turn[j][i]));
        }
    Passage in = {.face = -1, .margin = -INFINITY}, out = in;
#pragma unroll
    for (int face = 0; face < 4; ++face) {
        const int a = TETRAHEDRON_FACES[3 * face], b = TETRAHEDRON_FACES[3 * face + 1];
        const int c = TETRAHEDRON_FACES[3 * face + 2];
        const double of_a = turn[b][c], of_b = turn[c][a], of_c = turn[a][b];
        const double sum = of_a + of_b + of_c, way = sum > 0 ? 1 : -1;
        if (fabs(sum) <= NOISE * largest)
            continue; // it is seen edge-on: its products are rounding
        // of a ray that rounding has beside all faces the one that it is least beside
        double margin = fmin(way * of_a, fmin(way * of_b, way * of_c));
        if (margin == 0) { // through an edge
            const int ab = side_of(of_c, qx[b] - qx[a], qy[b] - qy[a]);
            const int bc = side_of(of_a, qx[c] - qx[b], qy[c] - qy[b]);
            const int ca = side_of(of_b, qx[a] - qx[c], qy[a] - qy[c]);
            margin = ab == way && bc == way && ca == way ? LEAST_MARGIN : -LEAST_MARGIN;
        }
        const Passage own = {
            face, a, b, c, of_a, of_b, of_c, sum, corners[a].w,
            of_b * (corners[b].w - corners[a].w) + of_c * (corners[c].w - corners[a].w), scalars[a],
            of_b * (scalars[b] - scalars[a]) + of_c * (scalars[c] - scalars[a]), margin};
        if (turned * sum > 0)
            out = margin > out.margin ? own : out;
        else
            in = margin > in.margin ? own : in;
    }
    chord->leaves = out.face;
    chord->end = -FARTHEST;
    if (!(fmin(in.margin, out.margin) >= -NOISE * largest))
        return false;
    chord->begin = in.depth + in.deeper / in.sum;
    chord->end = out.depth + out.deeper / out.sum;
    chord->from = in.scalar + in.more / in.sum;
    chord->to = out.scalar + out.more / out.sum;
    // of the edge that both faces have, which is opposite corner `in.face` in the other
    const double common = in.face == out.a ? out.of_a : in.face == out.b ? out.of_b : out.of_c;
    chord->growth = fabs(volume * common / (in.sum * out.sum));
    return true;
}

// --- light ---------------------------------------------------------------------------------------

#define WORDS 10        // of an interval of LocalTransfer.exact: s, width, r g b τ at s, and how these change
#define MOST_DEPTH 1e30 // optical, of a piece

typedef struct {
    __global const double *rows;
    int count; // of points
} Exact;

// The scalar at control point k.
double point_at(const Exact *t, const int k) { return t->rows[WORDS * (k + 1)]; }

// Composite a way on which the scalar is linear: the pieces between control points [TetVol, section 4.2].
// The share of a piece is by the width of its interval, so points that rounding makes equal are a step with
// the depth and the colour between them.
// `near` is the interval of a scalar nearby, and then that of `to`.
void add_way(Light *light, const Exact *t, const double from, const double to, const double length,
             int *near)
{
    int interval = *near;
    while (interval < t->count && from >= point_at(t, interval))
        ++interval;
    while (interval > 0 && from < point_at(t, interval - 1))
        --interval;
    const double whole = fabs(to - from);
    double s = from, w = -1; // the place in the interval, from 0 to 1; -1: not known
    for (;;) {
        __global const double *row = t->rows + WORDS * interval;
        const bool up = interval < t->count && to >= point_at(t, interval);
        const bool down = !up && interval > 0 && to < row[0];
        const bool inner = interval > 0 && interval < t->count && row[1] > 0;
        const double end = up ? point_at(t, interval) : down ? row[0] : to;
        const double begin = !inner ? 0 : w >= 0 ? w : clamp((s - row[0]) / row[1], 0.0, 1.0);
        const double stop = !inner || down ? 0 : up ? 1 : clamp((to - row[0]) / row[1], 0.0, 1.0);
        double share = inner ? row[1] * fabs(stop - begin) : fabs(end - s);
        share = whole > 0 ? fmin(share / whole, 1.0) : up || down ? 0 : 1;
        if (share > 0 && (row[5] > 0 || row[9] > 0)) {
            const double piece = share * length;
            const Sample front = {convert_float(row[2] + row[6] * begin),
                                  convert_float(row[3] + row[7] * begin),
                                  convert_float(row[4] + row[8] * begin),
                                  convert_float(fmin((row[5] + row[9] * begin) * piece, MOST_DEPTH))};
            const Sample back = {convert_float(row[2] + row[6] * stop),
                                 convert_float(row[3] + row[7] * stop),
                                 convert_float(row[4] + row[8] * stop),
                                 convert_float(fmin((row[5] + row[9] * stop) * piece, MOST_DEPTH))};
            add_segment(light, &front, &back, 1);
        }
        *near = interval;
        if (!up && !down)
            break;
        s = end;
        w = up ? 0 : 1;
        interval += up ? 1 : -1;
    }
}

// --- rays ----------------------------------------------------------------------------------------

#ifdef SURFACES
#define SHOWN_WITHIN SURFACE_LIST
#else
#define SHOWN_WITHIN __global const float *gradients
#endif

// One work-item a pixel, a work-group a tile of 8 x 8. `corners` are the projected vertices; `volumes` six
// times those of the cells, local; `squares` of the vector along a ray: of x x, y y, x y, x, y, 1;
// `per_volume` is the volume in the picture's coordinates of one in local ones, negative where the picture
// is mirrored.
__kernel void walk(__global const double *rows, const int count, __global const double *corners,
                   __global const float *vertices, SHOWN_WITHIN,
                   __global const int *cells_vertices, __global const int *neighbours,
                   __global const uchar *kept, __global const double *volumes,
                   const double per_volume, __global const double *squares, const double middle,
                   const int width, const int height, __global const uint *ends,
                   __global const uint *entries, __global const uint *eye_cells,
                   const uint eye_count, __global float *picture)
{
    const uint item = get_global_id(0), tile = item / 64, tiles = (width + 7) / 8;
    const int column = 8 * (tile % tiles) + item % 8, row = 8 * (tile / tiles) + item % 64 / 8;
    if (column >= width || row >= height)
        return;
    const uint pixel = row * width + column;
    const double x = column + (0.5 - 0.5 * width), y = row + (0.5 - 0.5 * height);
#ifdef PERSPECTIVE
    const double speed = sqrt(squares[0] * x * x + squares[1] * y * y + 2 * (squares[2] * x * y) +
                              2 * (squares[3] * x + squares[4] * y) + squares[5]);
#else
    const double speed = sqrt(squares[5]);
#endif
    const Exact transfer = {rows, count};
    Light light = {0, 0, 0, 1};
    uint eye = 0, next = pixel > 0 ? ends[pixel - 1] : 0;
    const uint end = ends[pixel];
    double depth = EYE_DEPTH(middle), scalar = 0, limit = -FARTHEST;
    int cell = NO_CELL, still = 0, interval = 0;
    bool known = false; // whether `scalar` is the ray's at its place
#ifdef SURFACES
    const Surfaces surfaces = THE_SURFACES;
    int rank = NO_RANK;
#endif
    while (light.transmittance >= LEAST_TRANSMITTANCE) {
        const bool fresh = cell == NO_CELL, at_eye = eye < eye_count && depth <= EYE_DEPTH(middle) + ON_PLANE;
        if (fresh && at_eye)
            cell = eye_cells[eye++];
        else if (fresh && next < end)
            cell = entries[2 * next++ + 1];
        else if (fresh)
            break;
        double4 own[4];
        double scalars[4];
        for (uint i = 0; i < 4; ++i) {
            const int vertex = cells_vertices[4 * (size_t)cell + i];
            own[i] = vload4(vertex, corners);
#ifdef CONSTANT
            scalars[i] = gradients[4 * (size_t)cell + 3];
#else
            scalars[i] = vertices[4 * (size_t)vertex + 3];
#endif
        }
        Chord chord;
        const bool met = chord_of(own, scalars, x, y, per_volume < 0 ? -1 : 1,
                                  volumes[cell] * per_volume, &chord);
        if (fresh && at_eye && !(met && chord.begin <= depth + NOISE && chord.end > depth)) {
            cell = NO_CELL; // the eye is beside it
            continue;
        }
        if (fresh) {
            // of cells that overlap the one entered first counts; nothing is in front of the eye
            limit = at_eye ? depth : chord.begin < depth - ON_PLANE ? depth : -FARTHEST;
            still = 0;
            known = false;
#ifdef SURFACES
            rank = chord.begin > depth + GAP ? NO_RANK : rank;
#endif
        }
        if (met) {
            double from = chord.from, share = 1;
            if (chord.begin < limit) {
                share = chord.end > limit ? (chord.end - limit) / (chord.end - chord.begin) : 0;
                from = chord.to + (from - chord.to) * share;
            }
#ifndef CONSTANT
            else if (known)
                from = scalar;
#endif
            const double to = fabs(chord.to - from) < SAME ? from : chord.to;
            double length = share * (chord.growth * speed);
#ifdef SURFACES
            rank = rank == NO_RANK ? rank_of(&surfaces, from) : rank;
            Meeting m;
            for (;;) {
                meet_surface(&surfaces, 1, rank, from, to, &m);
                if (!m.met)
                    break;
                add_way(&light, &transfer, from, m.scalar, length * m.share, &interval);
                add_surfaces(&light, &surfaces, 1, m.number, cell, x, y);
                length -= length * m.share;
                from = m.scalar;
                rank = m.rank;
            }
#endif
            if (length > 0)
                add_way(&light, &transfer, from, to, length, &interval);
            scalar = to;
            known = true;
        }
        still = chord.end > depth ? 0 : still + 1;
        depth = chord.end > depth ? chord.end : depth;
        const int beyond = chord.leaves < 0 ? NO_CELL : neighbours[4 * (size_t)cell + chord.leaves];
        cell = beyond >= 0 && kept[beyond / BLOCK] && still < MAX_STILL ? beyond : NO_CELL;
    }
    vstore4((float4)(light.r, light.g, light.b, alpha_of(&light)), pixel, picture);
}
