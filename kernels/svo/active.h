// The set of active level-1 nodes: bits in Morton order with the number of set bits before each word,
// which gives the index of a node among the active nodes in constant time. In large grids, only
// active blocks of 8 x 8 x 8 nodes have bits; `block_words`, a set of the same form, holds these blocks.

uint set_index(__global const uint *words, __global const uint *ranks, CODE code)
{
    const uint word = (uint)(code >> 5);
    return ranks[word] + popcount(words[word] & ((1u << (uint)(code & 31)) - 1u));
}

#define ACTIVE_SET_PARAMETERS                                                                      \
    __global const uint *block_words, __global const uint *block_ranks, __global const uint *words, \
        __global const uint *ranks
#define ACTIVE_SET block_words, block_ranks, words, ranks

// The code under which the bit of a level-1 node is stored.
CODE stored_code(ACTIVE_SET_PARAMETERS, CODE code)
{
    if (!block_words)
        return code;
    return (CODE)set_index(block_words, block_ranks, code >> 9) << 9 | (code & 511);
}

// The index of an active node among the active nodes; undefined for other nodes.
uint node_index(ACTIVE_SET_PARAMETERS, CODE code)
{
    return set_index(words, ranks, stored_code(ACTIVE_SET, code));
}
