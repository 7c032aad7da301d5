#include "spatial/arctangent.h"

// The angle of each vector (x, y) from the x axis, in [-PI, PI]; 0 where y is 0, whatever x. Host
// side: voxtool/spatial/pseudonormals.py.
double4 angle_of(double4 y, double4 x)
{
    const double4 across = y < 0.0 ? -y : y, along = x < 0.0 ? -x : x;
    const long4 steep = across > along;
    const double4 small = steep ? along : across, big = steep ? across : along;
    const long4 turned = small > TAN_EIGHTH * big;
    const double4 t = (turned ? small - big : small) /
                      (turned ? small + big : big > 0.0 ? big : 1.0);
    const double4 z = t * t;
    double4 p = z * ARCTANGENT_10 + ARCTANGENT_9;
    p = p * z + ARCTANGENT_8;
    p = p * z + ARCTANGENT_7;
    p = p * z + ARCTANGENT_6;
    p = p * z + ARCTANGENT_5;
    p = p * z + ARCTANGENT_4;
    p = p * z + ARCTANGENT_3;
    p = p * z + ARCTANGENT_2;
    p = p * z + ARCTANGENT_1;
    p = p * z + ARCTANGENT_0;
    double4 angle = t + t * z * p;
    angle = turned ? PI / 4 + angle : angle;
    angle = steep ? PI / 2 - angle : angle;
    angle = x < 0.0 ? PI - angle : angle;
    angle = y < 0.0 ? -angle : angle;
    return y == 0.0 ? 0.0 : angle;
}
