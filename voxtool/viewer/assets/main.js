// The page: its state, its buttons, and what it says.

/** @param {string} id @returns {HTMLElement} */
function element(id) {
  const found = document.getElementById(id);
  if (!found) throw new PageError(`The page is damaged: it has no ${id}.`);
  return found;
}

/** A word as a shell reads it. @param {string} word */
function quoted(word) {
  const path = word.startsWith("-") ? `./${word}` : word;
  return /^[\w@%+=:,./-]+$/.test(path) ? path : `'${path.replaceAll("'", "'\\''")}'`;
}

/** The command that draws a picture. @param {string} file @param {Camera} camera
 * @param {string} options @param {number} width @param {number} height */
function commandOf(file, camera, options, width, height) {
  /** @param {Vector} v */
  const word = (v) => v.map(String).join(",");
  const lens = camera.fov === null ? `--orthographic --height ${camera.height}` : `--fov ${camera.fov}`;
  return (
    `voxtool render ${quoted(file)} --eye=${word(camera.eye)} --target=${word(camera.target)} ` +
    `--up=${word(camera.up)} ${lens} --size ${width}x${height} --samples 1 --background none${options}`
  );
}

/** A canvas with a picture. @param {{colours: Uint8Array}} picture @param {number} width
 * @param {number} height */
function canvasOf({ colours }, width, height) {
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width, height });
  const image = new ImageData(width, height);
  for (let row = 0; row < height; ++row)
    for (let i = 0; i < 4 * width; i += 4) {
      const [from, to] = [4 * width * (height - 1 - row) + i, 4 * width * row + i];
      const alpha = colours[from + 3];
      for (let c = 0; c < 3; ++c)
        image.data[to + c] = alpha ? Math.min(255, Math.round((255 * colours[from + c]) / alpha)) : 0;
      image.data[to + 3] = alpha;
    }
  canvas.getContext("2d")?.putImageData(image, 0, 0);
  return canvas;
}

/** Offers bytes as a file. @param {Blob | null} blob @param {string} name */
function save(blob, name) {
  if (!blob) return;
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Says something on the page. @param {unknown} what */
function say(what) {
  const line = element("message");
  line.textContent = what instanceof Error ? what.message : String(what);
  line.hidden = !line.textContent;
}

/** Starts the page. @param {(facts: any) => Kind} kindOf */
async function start(kindOf) {
  const facts = JSON.parse(textOf("facts"));
  const kind = kindOf(facts);
  const canvas = /** @type {HTMLCanvasElement} */ (element("picture"));
  // preserved, because a browser that puts the page together again may find an empty picture
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
  if (!gl)
    throw new PageError(
      "This browser has no WebGL 2: use a newer one, or turn hardware acceleration on. " +
        `voxtool render ${quoted(facts.file)} draws a picture without it.`,
    );
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say("The graphics card was lost: reload the page if the picture does not come back.");
  });
  canvas.addEventListener("webglcontextrestored", () => location.reload());
  const arrays = await readArrays(facts.arrays);
  const shaders = [textOf("vertex"), textOf("fragment")];
  let state = stateOf(location.hash, facts.camera, kind.controls);
  const view = new View(canvas, gl, kind, arrays, shaders, facts, () => state);
  let written = 0;
  let at = { x: -1, y: -1 };

  const describe = () => {
    const id = view.idAt(at.x, at.y);
    if (id) element("pointed").textContent = kind.describe(id);
  };
  const changed = () => {
    clearTimeout(written);
    written = setTimeout(() => {
      history.replaceState(null, "", `#${fragmentOf(state.camera, state.settings, kind.controls)}`);
    }, 200);
    requestAnimationFrame(() => view.frame());
  };
  const showSettings = buildPanel(element("controls"), kind.controls, () => state.settings, changed);
  showSettings();
  view.drawn = () => {
    const { width, height } = view.target || canvas;
    element("figures").textContent =
      `${width} x ${height} pixels, ${view.milliseconds.toFixed(1)} ms; ${facts.size}`;
    describe();
  };
  listen(canvas, () => state.camera, changed,
    (x, y) => { at = { x, y }; describe(); },
    (key) => {
      if (key === "escape") say("");
      const act = kind.keys[key];
      if (!act) return;
      act(state.settings);
      showSettings();
      changed();
    });
  addEventListener("hashchange", (event) => {
    // location.hash may be the state before again, which changed() writes a while after a change
    state = stateOf(new URL(event.newURL).hash, facts.camera, kind.controls);
    showSettings();
    changed();
  });
  canvas.addEventListener("pointerdown", () => say(""));
  new ResizeObserver(changed).observe(canvas);

  element("reset").addEventListener("click", () => {
    state = stateOf("", facts.camera, kind.controls);
    showSettings();
    changed();
  });
  const command = () => {
    const { options, note } = kind.command(state.settings);
    const text = commandOf(facts.file, state.camera, options, canvas.width, canvas.height);
    return { text, beside: note && ` (${note})` };
  };
  element("copy").addEventListener("click", async () => {
    const { text, beside } = command();
    try {
      await navigator.clipboard.writeText(text);
      say(`Copied${beside}: ${text}`);
    } catch {
      say(`Copy this${beside}: ${text}`);
    }
  });
  element("save").addEventListener("click", () => {
    const { width, height } = canvas;
    const picture = view.picture(state.camera, state.settings, width, height);
    canvasOf(picture, width, height).toBlob((blob) => save(blob, `${facts.name}.png`));
  });
  element("frame-time").addEventListener("change", (event) => {
    element("figures").hidden = !(/** @type {HTMLInputElement} */ (event.target).checked);
  });
  Object.assign(globalThis, {
    voxtool: {
      state: () => state,
      command: () => command().text,
      picture: (/** @type {number} */ width, /** @type {number} */ height) =>
        view.picture(state.camera, state.settings, width, height),
      view,
    },
  });
  changed();
  element("picture").focus();
}

/** Starts the page, or says why it cannot. @param {(facts: any) => Kind} kindOf */
function run(kindOf) {
  addEventListener("error", (event) => say(event.error || event.message));
  start(kindOf)
    .catch(say)
    .finally(() => document.body.setAttribute("data-ready", ""));
}
