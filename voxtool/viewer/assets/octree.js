// Octrees: the textures of their nodes, the controls, and what a pixel shows.

const PAINTS = ["light", "depth", "normal", "level"];
const TINTED = PAINTS.length; // by an attribute
const BRICK = 2; // size of a brick, 2^2 voxels

/** @param {any} facts of the page @returns {Kind} */
function octreeKind(facts) {
  // the finest level, if it is not voxels; the least share of nodes that are drawn
  const { shape, origin, pitch, finest, isovalue = 0, attributes = {} } = facts;
  const names = Object.keys(attributes); // the first one is drawn at the start
  const every = ["voxel", ...Array.from({ length: facts.depth }, (_, i) => String(i))];
  const levels = every.slice(every.indexOf(String(finest ?? "voxel")));
  const axes = ["x", "y", "z"];
  /** @param {Settings} settings */
  const sizeOf = (settings) => (settings.level === "voxel" ? 0 : Number(settings.level) + BRICK);
  /** The size of the cells of the shading: two voxels at least. @param {Settings} settings */
  const cellOf = (settings) => Math.min(Math.max(sizeOf(settings), 1), facts.root - 2);
  const tables = tablesOf(facts.root, finest ?? 0);
  /** @type {any} */
  let kept = {};

  /** Makes the colours and the voxels that are shown. @param {WebGL2RenderingContext} gl
   * @param {Settings} settings */
  const tint = (gl, settings) => {
    if (!names.length) return null;
    const by = names.includes(settings.paint) ? settings.paint : "";
    const of = `${by} ${settings.hidden || ""}`;
    if (kept.tinted === of) return kept.tints;
    kept.tints = tintsOf(kept.arrays, by, labelsIn(settings.hidden || ""));
    gl.deleteTexture(kept.textures.tints);
    kept.textures.tints = listTexture(gl, "n1x4", kept.tints.colours, "colours");
    if (kept.hidden !== settings.hidden) kept.level = null; // other voxels
    Object.assign(kept, { tinted: of, hidden: settings.hidden });
    return kept.tints;
  };

  /** Makes the textures of the level that is drawn. @param {WebGL2RenderingContext} gl
   * @param {Settings} settings */
  const upload = (gl, settings) => {
    const [size, cell] = [sizeOf(settings), cellOf(settings)];
    const share = size ? Number(settings.isovalue) : 0;
    const tints = tint(gl, settings);
    if (kept.level === settings.level && kept.share === share) return kept.told;
    const { textures, links } = kept;
    // the root is larger than the cells: either all of them are drawn, or none
    const least = size <= cell ? share : links.share(0, 0) < share ? Infinity : 0;
    const bricks = size ? null : tints ? tints.bricks : kept.bricks;
    const { entries, words, cells, leaves, firsts, ...told } = blocksOf(links, tables, cell, bricks, least, tints);
    if (tints) {
      // a node that is larger than the cells is the root, whose value comes first
      if (size > cell) for (const values of [leaves, firsts]) values.fill(0);
      for (const name of ["leafTints", "firsts"]) gl.deleteTexture(textures[name]);
      textures.leafTints = listTexture(gl, "u4x1", leaves, "nodes");
      textures.firsts = listTexture(gl, "u4x1", firsts, "nodes");
    }
    for (const name of ["entries", "bricks", "shares"]) gl.deleteTexture(textures[name]);
    textures.entries = listTexture(gl, "u4x1", entries, "nodes");
    textures.bricks = listTexture(gl, "u4x2", words, "bricks");
    textures.shares = listTexture(gl, size ? "f4x4" : "n1x4", cells, "bricks");
    Object.assign(kept, { level: settings.level, share, told });
    return told;
  };
  return {
    controls: [
      { name: "level", label: "Level (+ and −)", type: "select", options: levels, start: levels[0] },
      { name: "isovalue", label: "Least share of nodes (isovalue)", type: "range", min: 0, max: 1, step: "any", start: isovalue },
      { name: "paint", label: "Colour by", type: "select", options: [...PAINTS, ...names], start: names[0] || "light" },
      ...(attributes.label ? [labelControl(attributes.label.names, () => kept.arrays.palette)] : []),
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
      const { children, bricks } = arrays;
      const shareOf = (/** @type {number} */ i) =>
        arrays.shares ? arrays.shares[i] : (popcount(bricks[2 * i]) + popcount(bricks[2 * i + 1])) / 64;
      const links = linksOf(facts.root, facts.levels, children, shareOf);
      const tiles = new Tiles(gl, nodeList(links));
      const textures = { entries: null, bricks: null, shares: null, begins: null };
      if (names.length) Object.assign(textures, { tints: null, leafTints: null, firsts: null });
      kept = { textures, links, bricks, tiles, arrays };
      return kept.textures;
    },
    origin,
    scale: pitch,
    vertex: "spots.vert",
    define: () => `#define TABLES ${tables}${names.length ? "\n#define TINTS" : ""}`,
    before(values) {
      kept.tiles.find(values, pitch);
      kept.textures.begins = kept.tiles.texture;
    },
    uniforms(gl, settings, camera) {
      const { direction } = frameOf(camera);
      const corners = Array.from({ length: 8 }, (_, i) =>
        dot(direction, minus(facts.box[i & 1 ? 1 : 0].map(
          (/** @type {number} */ _, /** @type {number} */ a) => facts.box[(i >> a) & 1][a],
        ), camera.target)),
      );
      const longest = Math.max(...pitch);
      const side = 2 ** sizeOf(settings);
      return {
        rowBits: rowBits(gl),
        rowMask: (1 << rowBits(gl)) - 1,
        root: facts.root,
        finest: sizeOf(settings),
        shaded: cellOf(settings),
        ...upload(gl, settings),
        ...LAYOUT,
        pitch: pitch.map((/** @type {number} */ p) => p / longest),
        clipLow: axes.map((axis) => Number(settings[`${axis}-from`])),
        clipHigh: axes.map((axis, a) => {
          const to = Number(settings[`${axis}-to`]);
          return to < shape[a] ? to : Math.ceil(shape[a] / side) * side; // cubes reach beyond the grid
        }),
        extent: shape,
        paint: names.includes(settings.paint) ? TINTED : PAINTS.indexOf(String(settings.paint)),
        edges: settings.edges,
        tile: TILE,
        depths: [Math.min(...corners), Math.max(...corners)],
      };
    },
    command(settings) {
      const share = Number(settings.isovalue) ? ` --isovalue ${settings.isovalue}` : "";
      const level = settings.level === "voxel" ? "" : ` --level ${settings.level}${share}`;
      const by = names.includes(settings.paint) ? settings.paint : "none";
      const coloured = by === (names[0] || "none") ? "" : ` --colour-by ${by}`;
      const hidden = labelsIn(settings.hidden || "");
      const shown = (attributes.label?.names || []).filter((/** @type {string} */ _, /** @type {number} */ i) => !hidden.has(i));
      const only = hidden.size ? ` --only ${quoted(shown.join(","))}` : "";
      const plain = (by !== "none" || settings.paint === "light") && !settings.edges;
      const whole = axes.every(
        (axis, a) => Number(settings[`${axis}-from`]) <= 0 && Number(settings[`${axis}-to`]) >= shape[a],
      );
      return { options: `${level}${coloured}${only}`, note: plain && whole ? "" : "render has no clipping, edges or other colours" };
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
