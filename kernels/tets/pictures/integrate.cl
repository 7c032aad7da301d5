// The pre-integrated transfer function: the light and the opacity of a segment by its scalars at both
// ends and its length [Roettger 2000]. Host side: voxtool/tets/pictures/integrate.py.
// Option: LANES, 1

#include "tets/pictures/integrators.h"
#include "tets/pictures/transfer.h"

// One work-item an entry of the table, which has premultiplied red, green, blue, and alpha for each of
// SCALARS scalars in front, SCALARS behind, and LENGTHS lengths up to `longest`, which change fastest.
__kernel void preintegrate(__global const float *points, __global const float *rows, const int count,
                           const float longest, __global float *table)
{
    const uint entry = get_global_id(0);
    if (entry >= SCALARS * SCALARS * LENGTHS)
        return;
    const Transfer transfer = {points, rows, count};
    const float back = entry / LENGTHS % SCALARS / (SCALARS - 1.0f);
    const float length = longest * (entry % LENGTHS / (LENGTHS - 1.0f));
    float front = entry / (LENGTHS * SCALARS) / (SCALARS - 1.0f);
    const float whole = back - front;
    int interval = interval_of(&transfer, front), goes_on = 1;
    const int last = interval_of(&transfer, back);
    Light light = {0, 0, 0, 1};
    while (goes_on) {
        const Segment segment = {front, back, interval, last};
        float to;
        int own;
        goes_on = cut(&transfer, &segment, &to, &own, &interval);
        float row[ROW];
        rows_of(&transfer, own, row);
        const Sample near = sample_of(row, front), far = sample_of(row, to);
        const float share = whole != 0 ? (to - front) / whole : 1;
        add_segment(&light, &near, &far, length * share);
        front = to;
    }
    vstore4((float4)(light.r, light.g, light.b, alpha_of(&light)), entry, table);
}
