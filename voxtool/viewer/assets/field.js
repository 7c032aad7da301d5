// Distance fields: their textures, the controls, and what a pixel shows.

const PLANES = ["none", "x", "y", "z"];

const MOST_LEVELS = 18; // whose identifiers a number of JavaScript holds: 3 (18 - 1) + 1 bits

/** The least and the greatest value in each child of each block, in sides, as a texture of 2 x 2 x 2
 * texels a block: rays pass children without a surface. Identifiers of cells say whose child is whose.
 * @param {Record<string, any>} arrays @param {number[]} size texels of the voxels along x, y and z
 * @param {number} levels deepest level of a leaf; where it is over MOST_LEVELS, nothing is passed */
function childRanges({ voxels, cells, channels }, size, levels) {
  const [width, height, depth] = size.map((n) => (2 * n) / 3);
  const ranges = new Float32Array(2 * width * height * depth);
  if (levels > MOST_LEVELS) {
    for (let i = 0; i < ranges.length; ++i) ranges[i] = i % 2 ? Infinity : -Infinity;
    return { ranges, size: [width, height, depth] };
  }
  /** @type {Map<number, number>} */
  const pointers = new Map();
  for (let i = 0; i < cells.length; i += channels) {
    const identifier = cells[i] + (channels === 3 ? cells[i + 1] * 2 ** 32 : 0);
    if (identifier) pointers.set(identifier, cells[i + channels - 1]);
  }
  /** @type {Map<number, number[]>} */
  const whole = new Map();
  for (const identifier of [...pointers.keys()].sort((a, b) => b - a)) {
    const pointer = pointers.get(identifier) || 0;
    const place = [pointer & 1023, (pointer >> 10) & 1023, pointer >> 20];
    let [least, most] = [Infinity, -Infinity];
    for (let octant = 0; octant < 8; ++octant) {
      const at = place.map((p, a) => 3 * p + ((octant >> a) & 1));
      let [low, high] = whole.get(8 * identifier + octant) || [Infinity, -Infinity];
      for (let corner = 0; corner < 8 && !whole.has(8 * identifier + octant); ++corner) {
        const [x, y, z] = at.map((p, a) => p + ((corner >> a) & 1));
        const value = voxels[x + size[0] * (y + size[1] * z)];
        [low, high] = [Math.min(low, value), Math.max(high, value)];
      }
      const [x, y, z] = place.map((p, a) => 2 * p + ((octant >> a) & 1));
      ranges.set([low, high], 2 * (x + width * (y + height * z)));
      [least, most] = [Math.min(least, low), Math.max(most, high)];
    }
    whole.set(identifier, [least, most]);
  }
  return { ranges, size: [width, height, depth] };
}

/** @param {any} facts of the page @returns {Kind} */
function fieldKind(facts) {
  const { origin, side, range, depth } = facts;
  const step = (range[1] - range[0]) / 1000;
  /** @param {Settings} settings the distance that is drawn, world units */
  const shown = (settings) => Number(settings.offset) || facts.least;
  return {
    controls: [
      { name: "offset", label: "Offset", type: "range", min: range[0], max: range[1], step: "any", start: 0 },
      { name: "plane", label: "Cutting plane", type: "select", options: PLANES, start: "none" },
      { name: "at", label: "Its place", type: "range", min: 0, max: 1, step: 0.001, start: 0.5 },
      { name: "shows", label: "It shows", type: "select", options: facts.bounds ? ["distance", "bound"] : ["distance"], start: "distance" },
      { name: "leaves", label: "Leaves", type: "check", start: false },
      { name: "spacing", label: "Isolines every", type: "range", min: step, max: 100 * step, step: "any", start: 20 * step },
    ],
    textures(gl, arrays) {
      const sized = (/** @type {string} */ name) =>
        boxTexture(gl, facts.textures[name].format, arrays[name], facts.textures[name].size, name);
      const channels = facts.textures.cells.format === "u4x3" ? 3 : 2;
      const { ranges, size } = childRanges({ ...arrays, channels }, facts.textures.voxels.size, depth);
      return { ranges: boxTexture(gl, "f4x2", ranges, size, "ranges"), voxels: sized("voxels"), cells: sized("cells"), offsets: sized("hash"), bounds: sized("bounds") };
    },
    origin,
    scale: [side, side, side],
    uniforms(_, settings) {
      return {
        depth,
        shown: shown(settings) / side,
        planeAxis: PLANES.indexOf(String(settings.plane)) - 1,
        planeAt: settings.at,
        planeBounds: settings.shows === "bound",
        leaves: settings.leaves,
        spacing: Number(settings.spacing) / side,
        reach: Math.max(-range[0], range[1]) / side,
      };
    },
    command(settings) {
      const offset = Number(settings.offset);
      return {
        options: offset ? ` --offset ${offset}` : "",
        note: settings.plane === "none" ? "" : "render has no cutting plane",
      };
    },
    describe([x, y, z, size]) {
      if (!size) return "";
      const cell = [x, y, z].map((v) => v / 2 ** (size - 1));
      const middle = [x, y, z].map((v, a) => origin[a] + (side * (v + 2 ** (size - 2))) / 2 ** depth);
      return (
        `leaf ${cell.join(", ")} of level ${depth - size + 1}; ` +
        `world ${middle.map((v) => v.toPrecision(6)).join(", ")} ${facts.units}`
      );
    },
    keys: {},
  };
}
