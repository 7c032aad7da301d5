// The record of a projected cell: for each face (a, b, c, side), the function a x + b y + c; the scalar on
// the ray, as in view.cl; and the depths of its nearest and farthest vertex, its columns and its rows.
// Option: FACES, of a cell: 4 or 6

#define PARTS (FACES + 2)
#define WORDS (4 * PARTS)

// The meaning of a face's function a x + b y + c:
#define LEAVES 0 // the nearness of its plane, by which rays leave
#define ENTERS 1 // the same, by which rays enter
#define BESIDE 2 // > 0 where rays are outside along their whole length
#define BESIDE_AT_0 3 // the same with >= 0: rays in the plane are on one side of it, as in view.cl
