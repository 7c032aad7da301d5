// The stack of a search for the nearest triangles: nodes that are still to be visited, and squared
// distances to their boxes. The includer defines BOX, the type of distances, and includes
// spatial/bvh.h.

#define STACK ((ARITY - 1) * MAX_LEVELS + 1)

// Pushes the children of a node that are nearer than `reach`, the nearest last; returns the new top.
uint push_nearest(uint node, const BOX *found, BOX reach, BOX *bounds, uint *ids, const uint base)
{
    uint top = base;
    for (uint i = 0; i < ARITY; ++i) {
        if (found[i] >= reach)
            continue;
        uint at = top++;
        for (; at > base && bounds[at - 1] < found[i]; --at) {
            bounds[at] = bounds[at - 1];
            ids[at] = ids[at - 1];
        }
        bounds[at] = found[i];
        ids[at] = ARITY * node + 1 + i;
    }
    return top;
}
