// The bits of a number moved apart, bit i to bit 3 i, and back ([voCCeL], eq. 2.2).

ulong spread_bits(uint value)
{
    ulong v = value;
    v = (v | (v << 32)) & 0x1F00000000FFFFul;
    v = (v | (v << 16)) & 0x1F0000FF0000FFul;
    v = (v | (v << 8)) & 0x100F00F00F00F00Ful;
    v = (v | (v << 4)) & 0x10C30C30C30C30C3ul;
    v = (v | (v << 2)) & 0x1249249249249249ul;
    return v;
}

uint gather_bits(ulong v)
{
    v &= 0x1249249249249249ul;
    v = (v | (v >> 2)) & 0x10C30C30C30C30C3ul;
    v = (v | (v >> 4)) & 0x100F00F00F00F00Ful;
    v = (v | (v >> 8)) & 0x1F0000FF0000FFul;
    v = (v | (v >> 16)) & 0x1F00000000FFFFul;
    v = (v | (v >> 32)) & 0x1FFFFFul;
    return (uint)v;
}
