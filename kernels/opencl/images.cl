// Probe of the device's filter. Host side: voxtool/opencl/images.py.

__constant sampler_t FILTER =
    CLK_NORMALIZED_COORDS_FALSE | CLK_ADDRESS_CLAMP_TO_EDGE | CLK_FILTER_LINEAR;

// The value in the middle between the two texels of an image.
__kernel void sample_middle(__read_only image3d_t image, __global float *middle)
{
    if (get_global_id(0) == 0)
        *middle = read_imagef(image, FILTER, (float4)(1.0f, 0.5f, 0.5f, 0)).x;
}
