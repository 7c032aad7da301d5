#version 300 es
// The depth at which the rays of a tile begin.
precision highp float;
precision highp int;
flat in float begin;
out uint bits;
void main() { bits = floatBitsToUint(begin); }
