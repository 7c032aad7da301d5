// The point of a box that is nearest, in squares, to planes [Ju 2002]: the vertex of a loop of
// crossings in dual contouring. Double precision; + - * / and sqrt only.

#define QEF_SWEEPS 8           // of Jacobi's method: 3 x 3 matrices converge in five
#define QEF_SHARE 0.05         // of the largest singular value: less is taken for a flat direction
#define QEF_FLAT 0x1p-20       // eigenvalue of a flat direction, of the largest
#define QEF_NEGLIGIBLE 0x1p-70 // of an element beside the diagonal

// The sum of squared distances to planes, x . A x - 2 b . x + c, and the sum of their points. A is
// xx, xy, xz, yy, yz, zz; unit normals give A a trace of the number of planes.
typedef struct {
    double a[6], b[3], c, points[3], count;
} qef;

qef empty_qef(void)
{
    const qef none = {{0, 0, 0, 0, 0, 0}, {0, 0, 0}, 0, {0, 0, 0}, 0};
    return none;
}

// Adds a point to the mean, without a plane.
void add_point(qef *q, const double3 at)
{
    q->points[0] += at.x;
    q->points[1] += at.y;
    q->points[2] += at.z;
    q->count += 1;
}

// Adds the plane through a point with a unit normal.
void add_plane(qef *q, const double3 at, const double3 normal)
{
    const double n[3] = {normal.x, normal.y, normal.z};
    const double offset = normal.x * at.x + normal.y * at.y + normal.z * at.z;
    uint k = 0;
    for (uint i = 0; i < 3; ++i) {
        for (uint j = i; j < 3; ++j)
            q->a[k++] += n[i] * n[j];
        q->b[i] += n[i] * offset;
    }
    q->c += offset * offset;
}

// The sum of squared distances from a point to the planes.
double error_of_qef(const qef *q, const double3 at)
{
    const double *a = q->a;
    const double x = a[0] * at.x + a[1] * at.y + a[2] * at.z,
                 y = a[1] * at.x + a[3] * at.y + a[4] * at.z,
                 z = a[2] * at.x + a[4] * at.y + a[5] * at.z;
    return at.x * (x - 2 * q->b[0]) + at.y * (y - 2 * q->b[1]) + at.z * (z - 2 * q->b[2]) + q->c;
}

// One rotation of Jacobi's method, which makes m[p][q] zero; the columns of v are the axes.
void rotate_axes(double m[3][3], double v[3][3], uint p, uint q)
{
    const double beside = m[p][q];
    if (fabs(beside) <= QEF_NEGLIGIBLE * (m[0][0] + m[1][1] + m[2][2]))
        return; // also keeps clear of denormals
    const double theta = (m[q][q] - m[p][p]) / (2 * beside);
    const double size = 1 / (fabs(theta) + sqrt(theta * theta + 1)), t = theta < 0 ? -size : size;
    const double cosine = 1 / sqrt(t * t + 1), sine = t * cosine;
    const uint r = 3 - p - q;
    m[p][p] -= t * beside;
    m[q][q] += t * beside;
    m[p][q] = m[q][p] = 0;
    const double at_p = m[r][p], at_q = m[r][q];
    m[r][p] = m[p][r] = cosine * at_p - sine * at_q;
    m[r][q] = m[q][r] = sine * at_p + cosine * at_q;
    for (uint i = 0; i < 3; ++i) {
        const double along_p = v[i][p], along_q = v[i][q];
        v[i][p] = cosine * along_p - sine * along_q;
        v[i][q] = sine * along_p + cosine * along_q;
    }
}

// The minimum nearest to the mean: `shift` from it. `metric` is the matrix of the error about the
// minimum, in which flat directions have a small weight, so that a box has one nearest point.
void solve_qef(const qef *q, const double *mean, double metric[3][3], double *shift)
{
    const double *a = q->a;
    double m[3][3] = {{a[0], a[1], a[2]}, {a[1], a[3], a[4]}, {a[2], a[4], a[5]}};
    double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, residual[3];
    for (uint i = 0; i < 3; ++i)
        residual[i] = q->b[i] - (m[i][0] * mean[0] + m[i][1] * mean[1] + m[i][2] * mean[2]);
    for (uint sweep = 0; sweep < QEF_SWEEPS; ++sweep) {
        rotate_axes(m, v, 0, 1);
        rotate_axes(m, v, 0, 2);
        rotate_axes(m, v, 1, 2);
    }
    const double most = fmax(fmax(m[0][0], m[1][1]), m[2][2]);
    for (uint i = 0; i < 3; ++i) {
        shift[i] = 0;
        for (uint j = 0; j < 3; ++j)
            metric[i][j] = 0;
    }
    for (uint k = 0; k < 3; ++k) {
        const bool flat = m[k][k] <= QEF_SHARE * QEF_SHARE * most;
        const double weight = flat ? QEF_FLAT * most : m[k][k];
        const double along = v[0][k] * residual[0] + v[1][k] * residual[1] + v[2][k] * residual[2];
        for (uint i = 0; i < 3; ++i) {
            shift[i] += flat ? 0 : along / weight * v[i][k];
            for (uint j = 0; j < 3; ++j)
                metric[i][j] += weight * v[i][k] * v[j][k];
        }
    }
}

double error_from(const double metric[3][3], const double *from, const double *at)
{
    double sum = 0;
    for (uint i = 0; i < 3; ++i)
        for (uint j = 0; j < 3; ++j)
            sum += (at[i] - from[i]) * metric[i][j] * (at[j] - from[j]);
    return sum;
}

// Keeps a point of the box's surface if its error is less.
void keep_less(const double metric[3][3], const double *from, const double *at, double *least,
               double *best)
{
    const double error = error_from(metric, from, at);
    if (error >= *least)
        return;
    *least = error;
    for (uint i = 0; i < 3; ++i)
        best[i] = at[i];
}

// The point of a box with the least error about a minimum outside it. It lies within a face, where
// two equations hold, or on an edge, where one does.
void nearest_in_box(const double metric[3][3], const double *from, const double *low,
                    const double *high, double *best)
{
    double least = INFINITY;
    for (uint face = 0; face < 6; ++face) {
        const uint r = face >> 1, p = (r + 1) % 3, q = (r + 2) % 3;
        double at[3];
        at[r] = face & 1 ? high[r] : low[r];
        const double off = at[r] - from[r];
        const double e = metric[p][p], f = metric[p][q], g = metric[q][q];
        const double determinant = e * g - f * f;
        at[p] = from[p] + off * (f * metric[q][r] - g * metric[p][r]) / determinant;
        at[q] = from[q] + off * (f * metric[p][r] - e * metric[q][r]) / determinant;
        if (at[p] >= low[p] && at[p] <= high[p] && at[q] >= low[q] && at[q] <= high[q])
            keep_less(metric, from, at, &least, best);
    }
    for (uint edge = 0; edge < 12; ++edge) {
        const uint r = edge >> 2, p = (r + 1) % 3, q = (r + 2) % 3;
        double at[3];
        at[p] = edge & 1 ? high[p] : low[p];
        at[q] = edge & 2 ? high[q] : low[q];
        const double along = metric[r][p] * (at[p] - from[p]) + metric[r][q] * (at[q] - from[q]);
        at[r] = fmin(fmax(from[r] - along / metric[r][r], low[r]), high[r]);
        keep_less(metric, from, at, &least, best);
    }
}

// The point of a box with the least sum of squared distances to planes and, where that leaves
// directions free, the nearest to the mean of the points; the mean itself without planes. Sets
// *inside to whether the minimum lies in the box.
double3 minimum_of_qef(const qef *q, const double3 low, const double3 high, bool *inside)
{
    const double lows[3] = {low.x, low.y, low.z}, highs[3] = {high.x, high.y, high.z};
    double mean[3], metric[3][3], at[3];
    for (uint i = 0; i < 3; ++i)
        mean[i] = fmin(fmax(q->points[i] / q->count, lows[i]), highs[i]);
    const bool planes = q->a[0] + q->a[3] + q->a[5] > 0;
    *inside = true;
    if (!planes)
        return (double3)(mean[0], mean[1], mean[2]);
    solve_qef(q, mean, metric, at);
    for (uint i = 0; i < 3; ++i) {
        at[i] += mean[i];
        *inside = *inside && at[i] >= lows[i] && at[i] <= highs[i];
    }
    if (!*inside) {
        const double from[3] = {at[0], at[1], at[2]};
        nearest_in_box(metric, from, lows, highs, at);
    }
    return (double3)(at[0], at[1], at[2]);
}
