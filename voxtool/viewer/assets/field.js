// Distance fields: their textures, the controls, and what a pixel shows.

const PLANES = ["none", "x", "y", "z"];

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
      return { voxels: sized("voxels"), cells: sized("cells"), offsets: sized("hash"), bounds: sized("bounds") };
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
      return { options: offset ? ` --offset ${offset}` : "", same: settings.plane === "none" };
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
