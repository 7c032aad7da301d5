// With GRAINED, squared distances are compared in whole grains, so that triangles that are equally near
// up to rounding are equal, and the lowest rank counts. `grain` is the number of grains in a unit of
// local coordinates, squared. The limits between grains are not at simple fractions, at which
// distances to edges of a lattice lie.

#ifdef GRAINED
#define BETWEEN 0.6180339887498949
#define GRAINS(dd, grain) floor((dd) * (grain) + BETWEEN)
#define MOST_OF(grains, grain) (((grains) + 1) / (grain)) // exceeds squares that have this number of grains
#define DISTANCE(grains) (grains)
#else
#define GRAINS(dd, grain) (dd)
#define MOST_OF(dd, grain) (dd)
#define DISTANCE(dd) sqrt(dd)
#endif
