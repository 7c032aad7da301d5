// Octrees as the shader reads them at one drawn level: tables of cells, and blocks of 4^3 cells.

const BLOCK = 3; // size of blocks where voxels are drawn
const ONE_TABLE = 7; // bits of a place that a single table may resolve: 8 MiB
const TABLE_BITS = 3; // of each table where there are several

/** The number of tables that lead from the root to a block. @param {number} root its size
 * @param {number} level the finest that the page has, from 0 */
function tablesOf(root, level) {
  const bits = root - 1 - BLOCK - level;
  return bits <= ONE_TABLE ? 1 : Math.ceil(bits / TABLE_BITS);
}

// Numbers that the script and the shader share, each a uniform of this name.
const LAYOUT = {
  LEAVES: 32, // entries from here on: inside leaves, by size
  POINTERS: 64, // entries from here on: a table, or a block
  EMPTY_BLOCK: 0, FULL_BLOCK: 1,
};
const EIGHTH = 31; // the byte of a cell of which one voxel of eight is set

/** @param {number} v */
function popcount(v) {
  let count = 0;
  for (let rest = v; rest; rest &= rest - 1) ++count;
  return count;
}

/**
 * @typedef {{root: number, counts: number[], held: (node: number) => number,
 *     refined: (node: number) => number, child: (node: number, octant: number) => number,
 *     share: (node: number, octant: number) => number,
 *     value: (node: number, octant: number) => number}} Links
 *     Nodes by number, root first: the size of the root, 2^root voxels; how many nodes there are of
 *     each size downward; which children of a node hold a voxel, and which of these are refined; the
 *     number of a refined child, or of the brick or leaf below the last level; the share of a child
 *     that is set; the number of a held child among all of them, whose attributes are so ordered.
 */

/** Counts the links of the stored nodes. @param {number} root
 * @param {number[]} counts of nodes by level, root first @param {Uint8Array} children pairs: which
 * children hold a voxel, which of these are refined
 * @param {(leaf: number) => number} shareOf how much is set of a child of the last level
 * @returns {Links} */
function linksOf(root, counts, children, shareOf) {
  const total = children.length / 2;
  const lowest = total - counts[counts.length - 1]; // the first node of the last level
  const first = new Uint32Array(total);
  const shares = new Float32Array(total);
  const held = (/** @type {number} */ node) => children[2 * node];
  const refined = (/** @type {number} */ node) => children[2 * node + 1];
  const stored = (/** @type {number} */ node) => (node < lowest ? refined(node) : held(node));
  const values = new Uint32Array(total);
  for (let i = 0, next = counts[0], leaf = 0, value = 0; i < total; ++i) {
    values[i] = value;
    value += popcount(held(i));
    first[i] = i < lowest ? next : leaf;
    if (i < lowest) next += popcount(stored(i));
    else leaf += popcount(stored(i));
  }
  /** @param {number} node @param {number} octant */
  const child = (node, octant) => first[node] + popcount(stored(node) & ((1 << octant) - 1));
  /** @param {number} node @param {number} octant */
  const share = (node, octant) => {
    if (!((held(node) >> octant) & 1)) return 0;
    if (node >= lowest) return shareOf(child(node, octant));
    return (refined(node) >> octant) & 1 ? shares[child(node, octant)] : 1;
  };
  for (let i = total - 1; i >= 0; --i) {
    let sum = 0;
    for (let octant = 0; octant < 8; ++octant) sum += share(i, octant);
    shares[i] = sum / 8;
  }
  /** @param {number} node @param {number} octant */
  const value = (node, octant) => values[node] + popcount(held(node) & ((1 << octant) - 1));
  return { root, counts, held, refined, child, share, value };
}

/** What the shader reads where nodes of size 2^finest are drawn and cells of size 2^cell shaded.
 *
 * A table has `fan` entries along each axis: below LEAVES the size of the largest empty node around;
 * from there the size of an inside leaf; from POINTERS the number of a table one step below, or of a
 * block. Block 0 is empty and block 1 full. A block has the words of 8 octants, like bricks, of which
 * each byte is a cell: its voxels where these are drawn, else not 0 where it holds a voxel, and all
 * ones where the octant is an inside leaf; and the shares of its cells, by x, y, z, of which `whole` is
 * what the shader reads where all is set. Cells of which less than the share `least` is set are not drawn.
 * If the octree has attributes, `tints` says which values are shown, and where those of a brick's voxels
 * begin; `leaves` has the value of each entry that is an inside leaf, and `firsts` where the values of each
 * octant begin or, without bricks, the value of each cell.
 * @param {Links} links @param {number} tables from the root to a block @param {number} cell @param {Uint32Array | null} bricks where voxels are drawn
 * @param {number} least @param {Tints | null} tints */
function blocksOf({ root, counts, held, refined, child, share, value }, tables, cell, bricks, least, tints) {
  const { LEAVES, POINTERS, FULL_BLOCK } = LAYOUT;
  const size = cell + 2; // of blocks
  const inner = root > size && refined(0) & 1; // the root stands in a node of twice its size
  const top = inner ? root - 1 : root;
  const bits = Math.max(Math.ceil((top - size) / tables), 1);
  const fan = 1 << bits;
  const most = counts[root - size] + 2;
  const words = new Uint32Array(16 * most);
  const cells = bricks ? new Uint8Array(64 * most) : new Float32Array(64 * most);
  const full = bricks ? 8 * EIGHTH : 1;
  words.fill(0xffffffff, 16 * FULL_BLOCK, 16 * (FULL_BLOCK + 1));
  cells.fill(full, 64 * FULL_BLOCK, 64 * (FULL_BLOCK + 1));
  let entries = new Uint32Array(fan ** 3);
  let leaves = new Uint32Array(tints ? fan ** 3 : 0);
  const firsts = new Uint32Array(tints ? (bricks ? 8 : 64) * most : 0);
  /** @param {number} node @param {number} octant */
  const isShown = (node, octant) => !tints || tints.shown(value(node, octant));
  let [used, block] = [1, FULL_BLOCK + 1];

  /** @param {number} octant @param {number} at the cell of it @param {number} octet
   * @param {number} set the share of the cell */
  const setCell = (octant, at, octet, set) => {
    if (set >= least) words[16 * block + 2 * octant + (at >> 2)] |= octet << (8 * (at & 3));
    const [x, y, z] = [0, 1, 2].map((a) => 2 * ((octant >> a) & 1) + ((at >> a) & 1));
    cells[64 * block + x + 4 * (y + 4 * z)] = full * set;
  };
  /** @param {number} node of the size of a block @param {number} octant that holds a voxel */
  const setOctant = (node, octant) => {
    const below = child(node, octant);
    if (bricks && tints) firsts[8 * block + octant] = tints.first(below);
    for (let at = 0; at < 8; ++at) {
      const isRefined = !bricks && (refined(node) >> octant) & 1;
      if (tints && !bricks) {
        if (isRefined ? !((held(below) >> at) & 1) || !isShown(below, at) : !isShown(node, octant)) continue;
        firsts[64 * block + 8 * octant + at] = isRefined ? value(below, at) : value(node, octant);
      }
      if (bricks) {
        const octet = (bricks[2 * below + (at >> 2)] >>> (8 * (at & 3))) & 0xff;
        setCell(octant, at, octet, popcount(octet) / 8);
      } else if (!isRefined) setCell(octant, at, 0xff, 1);
      else if ((held(below) >> at) & 1) setCell(octant, at, 1, share(below, at));
    }
  };
  /** The entry of a refined node, in a table whose cells are as large or larger.
   * @param {number} node @param {number} side its size @param {number} unit size of the cells */
  const pointerTo = (node, side, unit) => {
    if (unit > size) {
      const table = used++;
      if (entries.length < used * fan ** 3) {
        const longer = new Uint32Array(2 * entries.length);
        longer.set(entries);
        entries = longer;
        if (tints) {
          const more = new Uint32Array(entries.length);
          more.set(leaves);
          leaves = more;
        }
      }
      enter(node, side, table, unit - bits);
      return POINTERS + table;
    }
    for (let octant = 0; octant < 8; ++octant) if ((held(node) >> octant) & 1) setOctant(node, octant);
    return POINTERS + block++;
  };
  /** Enters a node into a table whose cells are smaller. @param {number} node @param {number} side
   * its size @param {number[]} low cells of the table @param {number} table @param {number} unit size
   * of its cells */
  const visit = (node, side, low, table, unit) => {
    const below = side - 1;
    const span = 1 << (below - unit);
    for (let octant = 0; octant < 8; ++octant) {
      const at = low.map((v, a) => v + span * ((octant >> a) & 1));
      const isHeld = (held(node) >> octant) & 1;
      const isRefined = (refined(node) >> octant) & 1;
      if (isRefined && below > unit) {
        visit(child(node, octant), below, at, table, unit);
        continue;
      }
      const isLeaf = isHeld && !isRefined && isShown(node, octant);
      const entry = isRefined ? pointerTo(child(node, octant), below, unit) : isLeaf ? LEAVES + below : below;
      for (let z = at[2]; z < at[2] + span; ++z)
        for (let y = at[1]; y < at[1] + span; ++y) {
          const row = table * fan ** 3 + fan * (y + fan * z);
          entries.fill(entry, row + at[0], row + at[0] + span);
          if (tints && isLeaf) leaves.fill(value(node, octant), row + at[0], row + at[0] + span);
        }
    }
  };
  /** Enters a refined node into a table of its own. @param {number} node @param {number} side its size
   * @param {number} table @param {number} unit size of its cells */
  const enter = (node, side, table, unit) => {
    if (side > unit) {
      visit(node, side, [0, 0, 0], table, unit);
      return;
    }
    const entry = pointerTo(node, side, unit); // may replace `entries`
    entries[table * fan ** 3] = entry;
  };
  enter(inner ? child(0, 0) : 0, top, 0, size + bits * (tables - 1));
  const count = used * fan ** 3;
  return { entries: entries.subarray(0, count), leaves: leaves.subarray(0, count), firsts, words, cells, whole: bricks ? full / 255 : 1, fan, cover: 2 ** (size + bits * tables) };
}
