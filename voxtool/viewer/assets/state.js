// The camera and the settings in the fragment of the address, so that a link shows the same picture.

/** @param {string | null} text @returns {Vector | null} */
function vectorOf(text) {
  const numbers = (text || "").split(",").map(Number);
  return numbers.length === 3 && numbers.every(Number.isFinite) ? [numbers[0], numbers[1], numbers[2]] : null;
}

/** The fragment of a camera and settings. @param {Camera} camera @param {Settings} settings
 * @param {Control[]} controls */
function fragmentOf(camera, settings, controls) {
  const words = new URLSearchParams();
  for (const name of /** @type {const} */ (["eye", "target", "up"])) words.set(name, camera[name].join(","));
  if (camera.fov === null) words.set("height", String(camera.height));
  else words.set("fov", String(camera.fov));
  for (const { name, start } of controls)
    if (settings[name] !== start) words.set(name, String(settings[name]));
  return words.toString().replaceAll("%2C", ",");
}

/** Reads a fragment into a camera and settings; what it does not say, or says wrongly, has the
 * values of the start. @param {string} fragment @param {Camera} first @param {Control[]} controls
 * @returns {State} */
function stateOf(fragment, first, controls) {
  const words = new URLSearchParams(fragment.replace(/^#/, ""));
  const camera = { ...first };
  for (const name of /** @type {const} */ (["eye", "target", "up"]))
    camera[name] = vectorOf(words.get(name)) || first[name];
  const [fov, height] = [Number(words.get("fov")), Number(words.get("height"))];
  if (height > 0 && Number.isFinite(height)) Object.assign(camera, { fov: null, height });
  else if (fov >= 0.01 && fov <= 170) camera.fov = fov;
  const way = minus(camera.target, camera.eye);
  const sound = norm(cross(way, camera.up)) > 1e-9 * norm(way) * norm(camera.up);
  return { camera: sound ? camera : first, settings: settingsOf(words, controls) };
}

/** @param {URLSearchParams} words @param {Control[]} controls @returns {Settings} */
function settingsOf(words, controls) {
  /** @type {Settings} */
  const settings = {};
  for (const { name, type, options, min = 0, max = 0, start, wrong } of controls) {
    const word = words.get(name);
    settings[name] = start;
    if (word === null) continue;
    const number = Number(word);
    if (type === "check") settings[name] = word === "true";
    else if (type === "select" && options?.includes(word)) settings[name] = word;
    else if (type === "range" && number >= min && number <= max) settings[name] = number;
    else if (type === "color" && /^#[0-9a-f]{6}$/.test(word)) settings[name] = word;
    else if (type === "custom" || (type === "text" && !wrong?.(word))) settings[name] = word;
  }
  return settings;
}
