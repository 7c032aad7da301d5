// Volumes: their textures, the boundary by which rays enter, and what a pixel shows.

const GRID = 32; // boxes along an axis

/** The boundary as triangles: corners (xyz0 of three vertices each) and their cells; and, for each
 * box of a grid over [-1, 1], the triangles whose bounding boxes touch it.
 * @param {number[][]} faces vertices of each face of a cell @param {Record<string, any>} arrays */
function boundaryOf(faces, { vertices, cells, neighbours }) {
  const corners = faces.length === 4 ? 4 : 8;
  /** @type {number[]} */
  const places = [];
  /** @type {number[]} */
  const owners = [];
  for (let i = 0; i < neighbours.length; ++i) {
    if (neighbours[i] >= 0) continue;
    const [cell, face] = [Math.floor(i / faces.length), faces[i % faces.length]];
    for (let k = 2; k < face.length; ++k) {
      for (const corner of [face[0], face[k - 1], face[k]]) {
        const v = 4 * cells[corners * cell + corner];
        places.push(vertices[v], vertices[v + 1], vertices[v + 2], 0);
      }
      owners.push(cell);
    }
  }
  /** @param {number} x */
  const box = (x) => Math.min(Math.max(Math.floor((x + 1) * 0.5 * GRID), 0), GRID - 1);
  /** @param {number} i @param {(box: number) => void} visit */
  const visitBoxes = (i, visit) => {
    const [low, high] = [Math.min, Math.max].map((end, e) =>
      [0, 1, 2].map((a) => box(end(...[0, 4, 8].map((k) => places[12 * i + k + a])) + (e ? 1e-5 : -1e-5))));
    for (let z = low[2]; z <= high[2]; ++z)
      for (let y = low[1]; y <= high[1]; ++y)
        for (let x = low[0]; x <= high[0]; ++x) visit(x + GRID * (y + GRID * z));
  };
  const counts = new Uint32Array(GRID ** 3 + 1);
  for (let i = 0; i < owners.length; ++i) visitBoxes(i, (at) => { ++counts[at + 1]; });
  for (let i = 0; i < GRID ** 3; ++i) counts[i + 1] += counts[i];
  const boxes = new Uint32Array(2 * GRID ** 3);
  for (let i = 0; i < GRID ** 3; ++i) boxes.set([counts[i], counts[i]], 2 * i);
  const triangles = new Uint32Array(2 * counts[GRID ** 3]);
  for (let i = 0; i < owners.length; ++i)
    visitBoxes(i, (at) => triangles.set([i, owners[i]], 2 * boxes[2 * at + 1]++));
  return { corners: new Float32Array(places), triangles, boxes };
}

/** The cell that holds a point, by all its planes, or -1. @param {any} planes
 * @param {number} faces of a cell @param {Vector} point */
function cellAtPoint(planes, faces, point) {
  let [best, least] = [-1, 1e-6];
  for (let cell = 0; cell < planes.length / 4 / faces; ++cell) {
    let outside = -Infinity;
    for (let f = 0; f < faces && outside < least; ++f) {
      const p = 4 * (faces * cell + f);
      const height = planes[p] * point[0] + planes[p + 1] * point[1] + planes[p + 2] * point[2] + planes[p + 3];
      outside = Math.max(outside, height);
    }
    if (outside < least) [best, least] = [cell, outside];
  }
  return best;
}

/** @param {any} facts of the page @returns {Kind} */
function volumeKind(facts) {
  const { origin, scale, range, faces } = facts;
  const start = textOfPoints(facts.transfer.points);
  /** @type {any} */
  let kept = {};
  let uploaded = "";
  let counts = { points: 0, surfaces: 0 };
  /** @type {{place: string, cell: number}} */
  let eye = { place: "", cell: -1 };

  /** Makes the texture of the transfer function and the surfaces. Surfaces alone have the colours of
   * the function at the start, as `render` draws them.
   * @param {WebGL2RenderingContext} gl @param {Settings} settings */
  const upload = (gl, settings) => {
    const given = JSON.stringify(settings);
    if (uploaded === given) return;
    const points = pointsOf(alone(settings) ? start : settings.transfer);
    const shown = alone(settings) ? points.slice(0, 1).map((p) => ({ ...p, extinction: 0 })) : points;
    const { rows, count } = transferRows(shown, range, scale);
    const texels = surfaceTexels(settings, points, range);
    gl.deleteTexture(kept.textures.rows);
    kept.textures.rows = listTexture(gl, "f4x4", new Float32Array([...rows, ...texels]), "transfer function");
    [uploaded, counts] = [given, { points: count, surfaces: texels.length / 8 }];
  };
  return {
    controls: [
      {
        name: "transfer", label: "Transfer function", type: "custom", start,
        build: (settings, changed) => transferEditor(facts, settings, changed),
      },
      ...surfaceControls(facts),
    ],
    textures(gl, arrays) {
      const cells = arrays.gradients.length / 4;
      const planes = new Float32Array(4 * faces.length * cells); // by cell, then by face
      for (let f = 0; f < faces.length; ++f)
        for (let c = 0; c < cells; ++c)
          for (let k = 0; k < 4; ++k) planes[4 * (faces.length * c + f) + k] = arrays.normals[4 * (cells * f + c) + k];
      const beside = faces.length === 4 ? 4 : 8;
      const neighbours = new Int32Array(beside * cells).fill(-1);
      for (let i = 0; i < arrays.neighbours.length; ++i)
        neighbours[beside * Math.floor(i / faces.length) + (i % faces.length)] = arrays.neighbours[i];
      const boundary = boundaryOf(faces, arrays);
      const textures = {
        planes: listTexture(gl, "f4x4", planes, "planes of cells"),
        gradients: listTexture(gl, "f4x4", arrays.gradients, "cells"),
        neighbours: listTexture(gl, "i4x4", neighbours, "cells"),
        corners: listTexture(gl, "f4x4", boundary.corners, "boundary"),
        triangles: listTexture(gl, "u4x2", boundary.triangles, "boundary"),
        boxes: listTexture(gl, "u4x2", boundary.boxes, "boundary"),
        rows: null,
      };
      kept = { planes, textures };
      uploaded = "";
      return textures;
    },
    origin,
    scale: [scale, scale, scale],
    define: (settings) => (settings.isovalues ? "#define SURFACES" : ""),
    uniforms(gl, settings, camera) {
      upload(gl, settings);
      const place = over(minus(camera.eye, origin), [scale, scale, scale]);
      if (eye.place !== String(place)) {
        const within = camera.fov !== null && place.every((v) => Math.abs(v) <= 1);
        eye = { place: String(place), cell: within ? cellAtPoint(kept.planes, faces.length, place) : -1 };
      }
      return { rowBits: rowBits(gl), grid: GRID, ...counts, eyeCell: eye.cell };
    },
    command(settings) {
      const surfaces = surfaceOptions(settings);
      if (alone(settings)) return { options: surfaces, note: "" };
      const plain = settings.transfer === start;
      const named = surfaces ? ` --map ${facts.map}` : "";
      const file = quoted(`${facts.name}.transfer.json`);
      const transfer = plain ? named : ` --transfer ${file}`;
      return { options: surfaces + transfer, note: plain ? "" : "first save its transfer function: Save JSON" };
    },
    describe([cell, , , met]) {
      return met ? `cell ${cell} of ${facts.noun}, entered first` : "";
    },
    keys: {},
  };
}
