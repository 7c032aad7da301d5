// Quads of a dual surface, and their two triangles. A diagonal begins at corner 0 or 1 and ends at the
// opposite one.

typedef struct {
    uint vertex[4];
    long3 point[4];
} quad;

quad quad_of(uint4 vertices, __global const int *points)
{
    quad q;
    vstore4(vertices, 0, q.vertex);
    for (uint i = 0; i < 4; ++i)
        q.point[i] = convert_long3(vload3(q.vertex[i], points));
    return q;
}

bool is_flat(long3 a, long3 b, long3 c)
{
    const long3 p = b - a, q = c - a;
    return p.y * q.z == p.z * q.y && p.z * q.x == p.x * q.z && p.x * q.y == p.y * q.x;
}

long squared(long3 v) { return v.x * v.x + v.y * v.y + v.z * v.z; }

uint shorter_diagonal(const quad *q)
{
    return squared(q->point[2] - q->point[0]) <= squared(q->point[3] - q->point[1]) ? 0 : 1;
}

// True if a triangle beside the diagonal has zero area.
bool is_flat_split(const quad *q, uint first)
{
    return is_flat(q->point[first], q->point[first + 1], q->point[first + 2]) ||
           is_flat(q->point[first], q->point[first + 2], q->point[(first + 3) % 4]);
}

void store_split(const quad *q, uint first, uint index, __global uint *triangles)
{
    const uint begin = q->vertex[first], end = q->vertex[first + 2];
    vstore3((uint3)(begin, q->vertex[first + 1], end), 2 * (size_t)index, triangles);
    vstore3((uint3)(begin, end, q->vertex[(first + 3) % 4]), 2 * (size_t)index + 1, triangles);
}
