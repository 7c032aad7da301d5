// Isosurfaces of volumes: their controls, what the shader knows of them, and their options of `render`.

/** The isovalues of a setting, ascending, each once. @param {string} text @returns {number[]} */
function isovaluesOf(text) {
  const found = text.split(",").filter((word) => word.trim()).map(Number);
  return [...new Set(found)].sort((a, b) => a - b);
}

/** @param {any} facts of the page @returns {Control[]} none where cells have one scalar each */
function surfaceControls(facts) {
  if (!facts.surfaces) return [];
  const [low, high] = facts.range.map((/** @type {number} */ v) => v.toPrecision(4));
  return [
    {
      name: "isovalues", label: "Isosurfaces at", type: "text", start: "", hint: `${low} to ${high}, as 1,2`,
      wrong: (text) => {
        const found = isovaluesOf(text);
        if (found.every(Number.isFinite) && found.length <= facts.surfaces) return "";
        return `Write up to ${facts.surfaces} numbers, with commas between them.`;
      },
    },
    { name: "opacity", label: "Their opacity", type: "range", min: 0.01, max: 1, step: 0.01, start: 1 },
    { name: "tinted", label: "In one colour", type: "check", start: false },
    { name: "tint", label: "This colour", type: "color", start: "#cccccc" },
    { name: "within", label: "Within the transfer function", type: "check", start: false },
  ];
}

/** Whether nothing but isosurfaces is drawn. @param {Settings} settings */
const alone = (settings) => Boolean(settings.isovalues) && !settings.within;

/** The texels of isosurfaces, two each: isovalue, normalised; red, green, blue, opacity.
 * @param {Settings} settings @param {ControlPoint[]} points whose colours they have
 * @param {number[]} range of scalars @returns {number[]} */
function surfaceTexels(settings, points, [low, high]) {
  const shown = isovaluesOf(settings.isovalues || "").filter((v) => low <= v && v <= high);
  return shown.flatMap((v) => {
    const colour = settings.tinted ? ofHex(settings.tint) : evaluated(points, v).slice(0, 3);
    return [(v - low) / (high - low || 1), 0, 0, 0, ...colour, settings.opacity];
  });
}

/** @param {Settings} settings @returns {string} options of `voxtool render` */
function surfaceOptions(settings) {
  if (!settings.isovalues) return "";
  const opacity = settings.opacity === 1 ? "" : ` --iso-opacity ${settings.opacity}`;
  const colour = settings.tinted ? ` --colour ${quoted(settings.tint)}` : "";
  return ` --isovalue=${isovaluesOf(settings.isovalues).join(",")}${opacity}${colour}`;
}
