// The pixels that a cell or a face may cover, by its projected corners: (X, Y, Z, depth) with x = X / Z
// and y = Y / Z.

typedef struct {
    float least, most; // in pixels from the middle
} Extent;

void extend(Extent *e, const float from, const float to)
{
    e->least = from < e->least ? from : e->least;
    e->most = to > e->most ? to : e->most;
}

// Extend by an edge from a vertex in front of the eye to one behind it: to infinity on one side, or on
// both where float32 does not decide.
void extend_by_edge(Extent *e, const float front, const float front_depth, const float behind,
                    const float behind_depth)
{
    const float a = behind * front_depth, b = front * behind_depth, crossing = a - b;
    const float doubt = 1e-5f * (fabs(a) + fabs(b));
    extend(e, crossing <= doubt ? -FARTHEST : FARTHEST, crossing >= -doubt ? FARTHEST : -FARTHEST);
}

// The first and the last of `count` pixels whose centres are in the extent; last < first if there are none.
int2 pixels_of(const Extent *e, const int count)
{
    const float middle = 0.5f * count - 0.5f;
    const float first = ceil(e->least + middle - ROUNDING), last = floor(e->most + middle + ROUNDING);
    return (int2)(first < 0 ? 0 : first > count ? count : convert_int(first),
                  last < -1 ? -1 : last > count - 1 ? count - 1 : convert_int(last));
}

// The columns and the rows of pixels that the hull of corners may cover; what is behind the eye covers
// no pixel.
void cover(const float4 *corners, const uint count, const int2 size, int2 *columns, int2 *rows)
{
    Extent across = {FARTHEST, -FARTHEST}, down = {FARTHEST, -FARTHEST};
    for (uint i = 0; i < count; ++i) {
        const float4 p = corners[i];
        if (p.z <= 0)
            continue;
        extend(&across, p.x / p.z, p.x / p.z);
        extend(&down, p.y / p.z, p.y / p.z);
#ifdef PERSPECTIVE
        for (uint j = 0; j < count; ++j)
            if (corners[j].z <= 0) {
                extend_by_edge(&across, p.x, p.z, corners[j].x, corners[j].z);
                extend_by_edge(&down, p.y, p.z, corners[j].y, corners[j].z);
            }
#endif
    }
    *columns = pixels_of(&across, size.x);
    *rows = pixels_of(&down, size.y);
}
