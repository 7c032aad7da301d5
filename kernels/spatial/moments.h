// The moments of triangles about a centre [Barill 2018].
//
// Moments about a centre are polynomials of a vector d. They are sums, over triangles with
// area vector N and points y relative to the centre, of N.d, of the integral of (y.d)(N.d), and of
// the integral of (y.d)^2 (N.d). Coefficient order: x, y, z; xx, yy, zz, yz, xz, xy; xxx, yyy, zzz,
// xxy, xxz, yyx, yyz, zzx, zzy, xyz. Only the harmonic parts affect the result, so only these are
// kept.

typedef struct {
    double one[3], two[6], three[10];
} moments;

// two += f s m
void add_two(double *two, double f, const double *s, const double *m)
{
    two[0] += f * (s[0] * m[0]);
    two[1] += f * (s[1] * m[1]);
    two[2] += f * (s[2] * m[2]);
    two[3] += f * (s[1] * m[2] + s[2] * m[1]);
    two[4] += f * (s[0] * m[2] + s[2] * m[0]);
    two[5] += f * (s[0] * m[1] + s[1] * m[0]);
}

// three += f s q
void add_three(double *three, double f, const double *s, const double *q)
{
    three[0] += f * (s[0] * q[0]);
    three[1] += f * (s[1] * q[1]);
    three[2] += f * (s[2] * q[2]);
    three[3] += f * (s[0] * q[5] + s[1] * q[0]);
    three[4] += f * (s[0] * q[4] + s[2] * q[0]);
    three[5] += f * (s[1] * q[5] + s[0] * q[1]);
    three[6] += f * (s[1] * q[3] + s[2] * q[1]);
    three[7] += f * (s[2] * q[4] + s[0] * q[2]);
    three[8] += f * (s[2] * q[3] + s[1] * q[2]);
    three[9] += f * (s[0] * q[3] + s[1] * q[4] + s[2] * q[5]);
}

// Subtracts the multiple of d.d that makes the polynomial harmonic.
void make_harmonic(moments *m)
{
    const double trace = (m->two[0] + m->two[1] + m->two[2]) / 3;
    for (uint i = 0; i < 3; ++i)
        m->two[i] -= trace;
    double *c = m->three;
    const double x = (3 * c[0] + c[5] + c[7]) / 5;
    const double y = (3 * c[1] + c[3] + c[8]) / 5;
    const double z = (3 * c[2] + c[4] + c[6]) / 5;
    c[0] -= x, c[5] -= x, c[7] -= x;
    c[1] -= y, c[3] -= y, c[8] -= y;
    c[2] -= z, c[4] -= z, c[6] -= z;
}

double length_of(const double *v)
{
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

void clear(moments *m)
{
    for (uint i = 0; i < 3; ++i)
        m->one[i] = 0;
    for (uint i = 0; i < 6; ++i)
        m->two[i] = 0;
    for (uint i = 0; i < 10; ++i)
        m->three[i] = 0;
}
