// Octrees: the textures of their nodes, the controls, and what a pixel shows.

const PAINTS = ["light", "depth", "normal", "level"];
const BRICK = 2; // size of a brick, 2^2 voxels

/** @param {number} v */
function popcount(v) {
  let count = 0;
  for (let rest = v; rest; rest &= rest - 1) ++count;
  return count;
}

/** The arrays of the nodes' textures; octree.frag describes them.
 * @param {number[]} counts of nodes by level, root first @param {Uint8Array} children pairs: which
 * children hold a voxel, which of these are refined
 * @param {(leaf: number) => number} shareOf how much is set of a child of the last level */
function octreeTexels(counts, children, shareOf) {
  const total = children.length / 2;
  const nodes = new Uint32Array(2 * total);
  const shares = new Float32Array(8 * total); // of the children, those at x = 0 first
  let next = counts[0]; // the first node of the level below
  let leaf = 0;
  for (let i = 0; i < total; ++i) {
    const held = children[2 * i];
    const refined = children[2 * i + 1];
    const last = i >= total - counts[counts.length - 1];
    nodes[2 * i] = last ? leaf : next;
    nodes[2 * i + 1] = held | (refined << 8);
    if (last) leaf += popcount(held);
    else next += popcount(refined);
  }
  const means = new Float32Array(total);
  for (let i = total - 1; i >= 0; --i) {
    const [first, held, refined] = [nodes[2 * i], children[2 * i], children[2 * i + 1]];
    const last = i >= total - counts[counts.length - 1];
    let sum = 0;
    for (let octant = 0, rank = 0; octant < 8; ++octant) {
      if (!((held >> octant) & 1)) continue;
      let share = 1;
      if (last) share = shareOf(first + rank++);
      else if ((refined >> octant) & 1) share = means[first + rank++];
      shares[8 * i + 4 * (octant & 1) + (octant >> 1)] = share;
      sum += share;
    }
    means[i] = sum / 8;
  }
  return { nodes, shares };
}

/** @param {any} facts of the page @returns {Kind} */
function octreeKind(facts) {
  const { shape, origin, pitch, finest } = facts; // the finest level, if it is not voxels
  const every = ["voxel", ...Array.from({ length: facts.depth }, (_, i) => String(i))];
  const levels = every.slice(every.indexOf(String(finest ?? "voxel")));
  const axes = ["x", "y", "z"];
  /** @param {Settings} settings */
  const sizeOf = (settings) => (settings.level === "voxel" ? 0 : Number(settings.level) + BRICK);
  return {
    controls: [
      { name: "level", label: "Level (+ and −)", type: "select", options: levels, start: levels[0] },
      { name: "paint", label: "Colour by", type: "select", options: PAINTS, start: "light" },
      { name: "edges", label: "Edges", type: "check", start: false },
      ...axes.flatMap((axis, a) =>
        ["from", "to"].map(
          (end) =>
            /** @type {Control} */ ({
              name: `${axis}-${end}`, label: `Clip ${axis}, ${end} voxel`, type: "range",
              min: 0, max: shape[a], step: 1, start: end === "from" ? 0 : shape[a],
            }),
        ),
      ),
    ],
    textures(gl, arrays) {
      const bricks = arrays.bricks || new Uint32Array(2);
      const shareOf = (/** @type {number} */ i) =>
        arrays.shares ? arrays.shares[i] : (popcount(bricks[2 * i]) + popcount(bricks[2 * i + 1])) / 64;
      const { nodes, shares } = octreeTexels(facts.levels, arrays.children, shareOf);
      return {
        nodes: listTexture(gl, "u4x2", nodes, "nodes"),
        bricks: listTexture(gl, "u4x2", bricks, "bricks"),
        shares: listTexture(gl, "f4x4", shares, "nodes"),
      };
    },
    origin,
    scale: pitch,
    uniforms(gl, settings, camera) {
      const { direction } = frameOf(camera);
      const corners = Array.from({ length: 8 }, (_, i) =>
        dot(direction, minus(facts.box[i & 1 ? 1 : 0].map(
          (/** @type {number} */ _, /** @type {number} */ a) => facts.box[(i >> a) & 1][a],
        ), camera.target)),
      );
      const longest = Math.max(...pitch);
      return {
        rowBits: rowBits(gl),
        root: facts.root,
        finest: sizeOf(settings),
        shaded: Math.min(Math.max(sizeOf(settings), 1), facts.root - 2),
        pitch: pitch.map((/** @type {number} */ p) => p / longest),
        clipLow: axes.map((axis) => Number(settings[`${axis}-from`])),
        clipHigh: axes.map((axis) => Number(settings[`${axis}-to`])),
        extent: shape,
        paint: PAINTS.indexOf(String(settings.paint)),
        edges: settings.edges,
        depths: [Math.min(...corners), Math.max(...corners)],
      };
    },
    command(settings) {
      const level = settings.level === "voxel" ? "" : ` --level ${settings.level}`;
      const plain = settings.paint === "light" && !settings.edges;
      const whole = axes.every(
        (axis, a) => Number(settings[`${axis}-from`]) <= 0 && Number(settings[`${axis}-to`]) >= shape[a],
      );
      return { options: level, same: plain && whole };
    },
    describe([x, y, z, size]) {
      if (!size) return "";
      const side = 2 ** (size - 1);
      const what = size === 1 ? "voxel" : `level ${Math.max(size - 1 - BRICK, 0)} node at voxel`;
      const middle = [x, y, z].map((v, a) => origin[a] + pitch[a] * (v + side / 2));
      return `${what} ${x}, ${y}, ${z}; world ${middle.map((v) => v.toPrecision(6)).join(", ")} ${facts.units}`;
    },
    keys: {
      "+": (settings) => stepLevel(settings, levels, -1),
      "=": (settings) => stepLevel(settings, levels, -1),
      "-": (settings) => stepLevel(settings, levels, 1),
    },
  };
}

/** Chooses the next finer or coarser level. @param {Settings} settings @param {string[]} levels
 * @param {number} by */
function stepLevel(settings, levels, by) {
  const at = levels.indexOf(String(settings.level)) + by;
  settings.level = levels[Math.min(Math.max(at, 0), levels.length - 1)];
}
