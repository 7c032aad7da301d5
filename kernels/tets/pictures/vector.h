// Vectors of float64, as in voxtool/vector.py: sums and products in a fixed order.

double dot3(const double3 a, const double3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

double3 cross3(const double3 a, const double3 b)
{
    return (double3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

double length3(const double3 v)
{
    return sqrt(dot3(v, v));
}
