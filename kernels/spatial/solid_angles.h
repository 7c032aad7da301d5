// The solid angles of a mesh's nodes and triangles. Host side: voxtool/spatial/winding_number.py.

#include "spatial/bvh.h"
#include "spatial/winding_number.h"

// The solid angles of a node's children seen from p, by their moments; 0 for children too near for
// the expansion. *far marks the children that are far enough.
double8 distant_angles(__global const double *m, double3 p, long8 *far)
{
    const double8 x = vload8(0, m) - p.x, y = vload8(1, m) - p.y, z = vload8(2, m) - p.z;
    const double8 dd = x * x + y * y + z * z;
    *far = dd > vload8(3, m);
    const double8 s = 1.0 / (dd > 0x1p-300 ? dd : 0x1p-300);
    const double8 one = x * vload8(4, m) + y * vload8(5, m) + z * vload8(6, m);
    const double8 two = x * (x * vload8(7, m) + y * vload8(12, m) + z * vload8(11, m)) +
                        y * (y * vload8(8, m) + z * vload8(10, m)) + z * z * vload8(9, m);
    const double8 three =
        x * (x * (x * vload8(13, m) + y * vload8(16, m) + z * vload8(17, m)) +
             y * (y * vload8(18, m) + z * vload8(22, m)) + z * z * vload8(20, m)) +
        y * (y * (y * vload8(14, m) + z * vload8(19, m)) + z * z * vload8(21, m)) +
        z * z * z * vload8(15, m);
    const double8 value = s * sqrt(s) * (one + s * (7.5 * s * three - 3.0 * two));
    return *far ? value : 0.0;
}

// Each triangle of a leaf subtends twice the angle of a vector (x, y) at p [Oosterom 1983]. `size`,
// the product of the distances to its corners, is the scale of rounding errors in x and y.
void triangle_vectors(__global const double *leaf, double3 p, double4 *x, double4 *y, double4 *size)
{
    const double4 ax = vload4(0, leaf) - p.x, ay = vload4(1, leaf) - p.y, az = vload4(2, leaf) - p.z;
    const double4 ex = vload4(3, leaf), ey = vload4(4, leaf), ez = vload4(5, leaf);
    const double4 gx = vload4(6, leaf), gy = vload4(7, leaf), gz = vload4(8, leaf);
    const double4 foot = vload4(9, leaf);
    const double4 bx = ax + ex, by = ay + ey, bz = az + ez;
    const double4 cx = ax + foot * ex + gx, cy = ay + foot * ey + gy, cz = az + foot * ez + gz;
    const double4 a = sqrt(ax * ax + ay * ay + az * az);
    const double4 b = sqrt(bx * bx + by * by + bz * bz);
    const double4 c = sqrt(cx * cx + cy * cy + cz * cz);
    *y = ax * (ey * gz - ez * gy) + ay * (ez * gx - ex * gz) + az * (ex * gy - ey * gx);
    const double4 ab = ax * bx + ay * by + az * bz;
    const double4 bc = bx * cx + by * cy + bz * cz;
    const double4 ca = cx * ax + cy * ay + cz * az;
    *size = a * b * c;
    *x = *size + ab * c + bc * a + ca * b;
}
