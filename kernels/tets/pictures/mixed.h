// Bits of a number that depend on all of its bits [Steele 2014].
ulong mixed(ulong bits)
{
    bits = (bits ^ bits >> 30) * 0xBF58476D1CE4E5B9ul;
    bits = (bits ^ bits >> 27) * 0x94D049BB133111EBul;
    return bits ^ bits >> 31;
}
