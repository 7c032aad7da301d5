// Connected components: each node points towards the root of its component, the least of its nodes,
// whatever the order in which components are united.

// The root of a node; halves the path to it.
uint root_of(volatile __global uint *roots, uint i)
{
    uint above = roots[i];
    while (above != i) {
        const uint next = roots[above];
        if (next != above)
            atomic_min(&roots[i], next);
        i = above;
        above = next;
    }
    return i;
}

// Unite the components of two nodes; false if they were one.
bool unite(volatile __global uint *roots, uint a, uint b)
{
    for (;;) {
        a = root_of(roots, a);
        b = root_of(roots, b);
        if (a == b)
            return false;
        const uint low = min(a, b), high = max(a, b);
        if (atomic_cmpxchg(&roots[high], high, low) == high)
            return true;
        a = low;
        b = high;
    }
}
