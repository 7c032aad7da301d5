// Transfer functions: control points of scalar, colour and extinction, as `render --transfer` reads.

/** @typedef {{scalar: number, color: Vector, extinction: number}} ControlPoint */

/** The control points of a setting. @param {string} text @returns {ControlPoint[]} */
function pointsOf(text) {
  const found = text.split(";").map((word) => {
    const [scalar, red, green, blue, extinction] = word.split(",").map(Number);
    return /** @type {ControlPoint} */ ({ scalar, color: [red, green, blue], extinction });
  });
  return found.filter(isPoint).sort((a, b) => a.scalar - b.scalar);
}

/** @param {any} point */
function isPoint(point) {
  const { scalar, color, extinction } = point || {};
  return (
    Number.isFinite(scalar) && extinction >= 0 && Number.isFinite(extinction) &&
    Array.isArray(color) && color.length === 3 && color.every((c) => c >= 0 && c <= 1)
  );
}

/** @param {ControlPoint[]} points */
function textOfPoints(points) {
  return points.map((p) => [p.scalar, ...p.color, p.extinction].join(",")).join(";");
}

/** The colour that #ff8000 is. @param {string} text @returns {Vector} */
const ofHex = (text) =>
  /** @type {Vector} */ ([1, 3, 5].map((i) => Number.parseInt(text.slice(i, i + 2), 16) / 255));

/** @param {ControlPoint[]} points the JSON that `render --transfer` reads */
const jsonOf = (points) => JSON.stringify({ points }, null, 1);

/** The control points of JSON, or an error that says what is wrong. @param {string} text */
function pointsOfJson(text) {
  let found;
  try {
    found = JSON.parse(text);
  } catch {
    throw new PageError("The transfer function is no JSON.");
  }
  const points = found?.points;
  if (!Array.isArray(points) || !points.length || points.length > 255 || !points.every(isPoint))
    throw new PageError("The transfer function needs 1 to 255 points of scalar, color (three from 0 to 1) and extinction.");
  if (points.some((p, i) => i > 0 && p.scalar < points[i - 1].scalar))
    throw new PageError("The points of the transfer function are not in ascending order.");
  return /** @type {ControlPoint[]} */ (points);
}

/** Colour and extinction of a scalar. @param {ControlPoint[]} points @param {number} s
 * @returns {number[]} red, green, blue, extinction */
function evaluated(points, s) {
  const after = points.findIndex((p) => p.scalar > s);
  const high = points[after < 0 ? points.length - 1 : after];
  const low = points[Math.max((after < 0 ? points.length : after) - 1, 0)];
  const w = high.scalar > low.scalar ? Math.min(Math.max((s - low.scalar) / (high.scalar - low.scalar), 0), 1) : 0;
  const [a, b] = [low, high].map((p) => [...p.color, p.extinction]);
  return a.map((v, i) => v + (b[i] - v) * w);
}

/** The rows of the shader's texture, 12 numbers for each interval of normalised scalars: the scalar
 * at its low end, 1 / width, red, green, blue, extinction there, how these change, and the width, which is
 * not 0 where float32 does not tell the points apart.
 * @param {ControlPoint[]} points @param {number[]} range of scalars
 * @param {number} scale world units a local one */
function transferRows(points, range, scale) {
  const [low, high] = range;
  const inner = points.filter((p) => p.scalar > low && p.scalar <= high);
  /** @param {number} s */
  const at = (s) => [s, ...evaluated(points, s)];
  const own = inner.map((p) => [p.scalar, ...p.color, p.extinction]);
  const found = [
    ...(points.some((p) => p.scalar <= low) ? [at(low)] : []),
    ...own,
    ...(points[points.length - 1].scalar > high && !inner.some((p) => p.scalar === high) ? [at(high)] : []),
  ];
  const shown = found.map(([s, r, g, b, e]) => [(s - low) / (high - low || 1), r, g, b, e * scale]);
  const rows = new Float32Array(12 * (shown.length + 1));
  for (let i = 0; i <= shown.length; ++i) {
    const [last, next] = [Math.max(i - 1, 0), i === 0 ? 0 : Math.min(i, shown.length - 1)];
    const width = (found[next][0] - found[last][0]) / (high - low || 1);
    const changes = shown[next].slice(1).map((v, c) => (width > 1e-30 ? v - shown[last][c + 1] : 0));
    rows.set([shown[last][0], width > 1e-30 ? 1 / width : 0, ...shown[last].slice(1), ...changes, width, 0], 12 * i);
  }
  return { rows, count: shown.length };
}
