// The camera under the pointer, touches and keys.

/** @typedef {{x: number, y: number}} Finger pixels from the middle of the picture */

const CLICKS_A_TURN = 2 * Math.PI; // radians that a drag along the shorter side turns
const KEY_STEP = 0.02; // of the distance to the target, for each frame that a key is down
const WHEEL = 0.001; // of the logarithm of the distance, for a pixel of the wheel

/** Turns the eye around the target: to the side about `up`, and over it up to the poles.
 * @param {Camera} camera @param {number} aside radians @param {number} over radians */
function orbit(camera, aside, over) {
  const up = unit(camera.up);
  const arm = minus(camera.eye, camera.target);
  const { right } = frameOf(camera);
  const around = turned(arm, up, -aside);
  const side = turned(right, up, -aside);
  const height = Math.asin(Math.min(Math.max(dot(unit(around), up), -1), 1));
  const most = Math.PI / 2 - 1e-3;
  const angle = Math.min(Math.max(height + over, -most), most) - height;
  camera.eye = plus(camera.target, turned(around, side, -angle));
}

/** Moves eye and target across the view. @param {Camera} camera @param {number} x pixels
 * @param {number} y pixels @param {number} side pixels of the shorter side of the picture */
function pan(camera, x, y, side) {
  const { right, down } = frameOf(camera);
  const pixel = pixelAt(camera, side);
  move(camera, plus(times(-x * pixel, right), times(-y * pixel, down)));
}

/** @param {Camera} camera @param {Vector} by */
function move(camera, by) {
  camera.eye = plus(camera.eye, by);
  camera.target = plus(camera.target, by);
}

/** Changes the distance of the eye, or the height that parallel rays show.
 * @param {Camera} camera @param {number} factor */
function zoom(camera, factor) {
  camera.height *= factor;
  if (camera.fov !== null)
    camera.eye = plus(camera.target, times(factor, minus(camera.eye, camera.target)));
}

/** Zooms and pans so that what was under the middle of two fingers stays under it.
 * @param {Camera} camera @param {Finger[]} before @param {Finger[]} after
 * @param {number} side pixels of the shorter side of the picture */
function pinch(camera, before, after, side) {
  const [gap, wider] = [before, after].map(([a, b]) => Math.hypot(a.x - b.x, a.y - b.y));
  const factor = gap > 0 && wider > 0 ? gap / wider : 1;
  const [from, to] = [before, after].map(([a, b]) => [(a.x + b.x) / 2, (a.y + b.y) / 2]);
  pan(camera, factor * to[0] - from[0], factor * to[1] - from[1], side);
  zoom(camera, factor);
}

/** Flies by the keys that are down. @param {Camera} camera @param {Set<string>} keys
 * @returns {boolean} whether the camera moved */
function fly(camera, keys) {
  const { direction, right, down } = frameOf(camera);
  const step = KEY_STEP * norm(minus(camera.target, camera.eye));
  /** @type {Record<string, Vector>} */
  const ways = {
    w: direction, s: times(-1, direction), d: right, a: times(-1, right),
    e: times(-1, down), q: down,
  };
  const pressed = Object.keys(ways).filter((key) => keys.has(key));
  for (const key of pressed) move(camera, times(step, ways[key]));
  const [aside, over] = [
    Number(keys.has("arrowleft")) - Number(keys.has("arrowright")),
    Number(keys.has("arrowup")) - Number(keys.has("arrowdown")),
  ];
  if (aside || over) orbit(camera, -0.03 * aside, 0.03 * over);
  return pressed.length > 0 || aside !== 0 || over !== 0;
}

/** Lets pointers and keys on the canvas move the camera.
 * @param {HTMLCanvasElement} canvas @param {() => Camera} camera @param {() => void} moved
 * @param {(x: number, y: number) => void} pointed @param {(key: string) => void} pressed */
function listen(canvas, camera, moved, pointed, pressed) {
  /** @type {Map<number, Finger>} */
  const pointers = new Map();
  /** @type {Set<string>} */
  const keys = new Set();
  const side = () => Math.min(canvas.clientWidth, canvas.clientHeight);
  /** @param {PointerEvent} event @returns {Finger} */
  const fingerOf = ({ offsetX, offsetY }) =>
    ({ x: offsetX - canvas.clientWidth / 2, y: offsetY - canvas.clientHeight / 2 });
  /** @param {number} x @param {number} y */
  const turn = (x, y) => orbit(camera(), (CLICKS_A_TURN * x) / side(), (CLICKS_A_TURN * y) / side());

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, fingerOf(event));
  });
  for (const end of /** @type {const} */ (["pointerup", "pointercancel"]))
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return pointed(event.offsetX, event.offsetY);
    const now = fingerOf(event);
    const [x, y] = [now.x - before.x, now.y - before.y];
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1] || before;
      pinch(camera(), [before, other], [now, other], side());
    } else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) pan(camera(), x, y, side());
    else turn(x, y);
    pointers.set(event.pointerId, now);
    moved();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(camera(), Math.exp(WHEEL * event.deltaY));
    moved();
  }, { passive: false });
  const tick = () => {
    if (!keys.size) return;
    if (fly(camera(), keys)) moved();
    requestAnimationFrame(tick);
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    if (key.startsWith("arrow")) event.preventDefault();
    pressed(key);
    if (!keys.size) requestAnimationFrame(tick);
    keys.add(key);
  });
  canvas.addEventListener("keyup", (event) => keys.delete(event.key.toLowerCase()));
  canvas.addEventListener("blur", () => keys.clear());
}
