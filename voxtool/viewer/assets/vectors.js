// Vectors as arrays of three numbers, and the rays of a camera as in voxtool/camera.py.

/**
 * @typedef {[number, number, number]} Vector
 * @typedef {{eye: Vector, target: Vector, up: Vector, fov: number | null, height: number}} Camera
 *     fov: degrees of the picture's shorter side, or null for parallel rays; height: world units
 *     that the shorter side then shows.
 * @typedef {{start: Vector, startRight: Vector, startDown: Vector, way: Vector, wayRight: Vector,
 *     wayDown: Vector, nearest: number, light: Vector}} Rays
 *     Where the ray of a pixel is at depth 0, that of the target, and a step along it; world units.
 */

/** @param {Vector} a @param {Vector} b @returns {Vector} */
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @param {Vector} a @param {Vector} b @returns {Vector} */
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @param {number} s @param {Vector} a @returns {Vector} */
const times = (s, a) => [s * a[0], s * a[1], s * a[2]];
/** @param {Vector} a @param {Vector} b */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {Vector} a */
const norm = (a) => Math.hypot(...a);
/** @param {Vector} a @returns {Vector} */
const unit = (a) => times(1 / norm(a), a);
/** @param {Vector} a @param {Vector} b @returns {Vector} */
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
/** @param {Vector} a @param {Vector} b @returns {Vector} a / b, by element */
const over = (a, b) => [a[0] / b[0], a[1] / b[1], a[2] / b[2]];

/** Turns v about a unit axis. @param {Vector} v @param {Vector} axis @param {number} angle radians */
function turned(v, axis, angle) {
  const along = times(dot(v, axis), axis);
  const across = minus(v, along);
  const beside = times(Math.sin(angle), cross(axis, v));
  return plus(along, plus(times(Math.cos(angle), across), beside));
}

/** The unit directions of a camera. @param {Camera} camera */
function frameOf(camera) {
  const direction = unit(minus(camera.target, camera.eye));
  const right = unit(cross(direction, camera.up));
  return { direction, right, down: cross(direction, right) };
}

/** World units between the rays of neighbouring pixels at the target.
 * @param {Camera} camera @param {number} side pixels of the shorter side */
function pixelAt(camera, side) {
  if (camera.fov === null) return camera.height / side;
  const slope = 2 * Math.tan((camera.fov * Math.PI) / 360);
  return (slope / side) * norm(minus(camera.target, camera.eye));
}

/** The rays of a picture. @param {Camera} camera @param {number} width @param {number} height
 * @returns {Rays} */
function raysOf(camera, width, height) {
  const { direction, right, down } = frameOf(camera);
  const depth = norm(minus(camera.target, camera.eye));
  const step = pixelAt(camera, Math.min(width, height));
  const spread = camera.fov === null ? 0 : step / depth;
  const light = minus(plus(times(-0.4, right), times(-0.6, down)), direction);
  return {
    start: camera.target,
    startRight: times(step, right),
    startDown: times(step, down),
    way: direction,
    wayRight: times(spread, right),
    wayDown: times(spread, down),
    nearest: camera.fov === null ? -1e30 : -depth,
    light: unit(light),
  };
}

/** Rays in coordinates (world - origin) / scale, by axis; depths stay in world units.
 * @param {Rays} rays @param {Vector} origin @param {Vector} scale @returns {Rays} */
function localRays(rays, origin, scale) {
  return {
    ...rays,
    start: over(minus(rays.start, origin), scale),
    startRight: over(rays.startRight, scale),
    startDown: over(rays.startDown, scale),
    way: over(rays.way, scale),
    wayRight: over(rays.wayRight, scale),
    wayDown: over(rays.wayDown, scale),
  };
}
