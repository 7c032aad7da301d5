// The rays of a work-item's pixels, and the picture that it writes. Options:
//   LANES         pixels of a work-item, side by side: 1 or 16
//   CONSTANT      cells have one scalar each
//   PERSPECTIVE

#include "tets/pictures/ray.h"
#include "tets/pictures/transfer.h"

// A kernel's parameters for a viewpoint and its picture, of voxtool/tets/pictures/view.py.
#define PICTURE                                                                                  \
    const float middle, const float right_square, const float down_square, const int width,      \
        const int height, __global float *picture
#define THE_FRAME {middle, right_square, down_square, width, height}

typedef struct {
    float middle;                    // of the volume: depths are relative to it
    float right_square, down_square; // squares of a pixel's sides
    int width, height;
} Frame;

typedef struct {
    floats x, y;      // pixels from the middle of the picture
    floats length;    // along a ray, per unit of depth
    float middle;     // as in Frame
    int pixel[LANES]; // number in the picture, or NO_PIXEL
} Rays;

// Find the rays of pixels, given by column and row. (Structs are returned by pointer: Oclgrind 21.10
// does not know what a later compiler makes of returned ones.)
void rays_of(const int2 *pixels, const Frame *f, Rays *rays)
{
    float xs[LANES], ys[LANES];
    for (uint lane = 0; lane < LANES; ++lane) {
        const int column = pixels[lane].x, row = pixels[lane].y;
        xs[lane] = column + (0.5f - 0.5f * f->width);
        ys[lane] = row + (0.5f - 0.5f * f->height);
        rays->pixel[lane] = column < f->width && row < f->height ? row * f->width + column : NO_PIXEL;
    }
    rays->x = load(xs);
    rays->y = load(ys);
    rays->middle = f->middle;
#ifdef PERSPECTIVE
    rays->length = sqrt((rays->x * rays->x * f->right_square + rays->y * rays->y * f->down_square) + 1);
#else
    rays->length = 1;
#endif
}

// Write the colours of the rays, premultiplied, and their opacity.
void write_light(const Light *light, const Rays *rays, __global float *picture)
{
    float r[LANES], g[LANES], b[LANES], a[LANES];
    store(light->r, r);
    store(light->g, g);
    store(light->b, b);
    store(alpha_of(light), a);
    for (uint lane = 0; lane < LANES; ++lane)
        if (rays->pixel[lane] >= 0)
            vstore4((float4)(r[lane], g[lane], b[lane], a[lane]), rays->pixel[lane], picture);
}
