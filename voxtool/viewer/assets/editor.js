// The editor of the transfer function: points over the histogram of the scalar, extinction on a log
// scale. Drag moves a point, a double click adds one, Delete removes the chosen one.

const EDITOR = { width: 236, height: 110, decades: 4 };

/** @param {any} facts @param {() => Settings} settings @param {() => void} changed
 * @returns {HTMLElement & {show: () => void}} */
function transferEditor(facts, settings, changed) {
  const [low, high] = facts.range;
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width: EDITOR.width, height: EDITOR.height, tabIndex: 0 });
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", "Transfer function: arrows move the chosen point, N chooses the next, Delete removes it");
  const most = Math.max(1e-30, ...facts.transfer.points.map((/** @type {ControlPoint} */ p) => p.extinction)) * 10;
  let points = pointsOf(settings().transfer);
  let chosen = 0;
  let dragging = false;

  /** @param {number} s */
  const toX = (s) => ((s - low) / (high - low || 1)) * (EDITOR.width - 8) + 4;
  /** @param {number} x */
  const ofX = (x) => low + ((x - 4) / (EDITOR.width - 8)) * (high - low);
  /** @param {number} e */
  const toY = (e) => {
    const share = e > 0 ? 1 + Math.log10(e / most) / EDITOR.decades : 0;
    return EDITOR.height - 4 - Math.max(share, 0) * (EDITOR.height - 8);
  };
  /** @param {number} y */
  const ofY = (y) => {
    const share = (EDITOR.height - 4 - y) / (EDITOR.height - 8);
    return share <= 0 ? 0 : most * 10 ** ((Math.min(share, 1) - 1) * EDITOR.decades);
  };
  const colour = Object.assign(document.createElement("input"), { type: "color", title: "Colour of the point" });
  const number = Object.assign(document.createElement("input"), { type: "number", step: "any", title: "Extinction of the point" });
  /** @param {Vector} c */
  const hex = (c) => `#${c.map((v) => Math.round(255 * v).toString(16).padStart(2, "0")).join("")}`;

  const show = () => {
    points = pointsOf(settings().transfer);
    chosen = Math.min(chosen, points.length - 1);
    const pen = canvas.getContext("2d");
    if (!pen) return;
    pen.clearRect(0, 0, EDITOR.width, EDITOR.height);
    const step = (EDITOR.width - 8) / facts.histogram.length;
    pen.fillStyle = "#8886";
    facts.histogram.forEach((/** @type {number} */ share, /** @type {number} */ i) => {
      const h = Math.sqrt(share) * (EDITOR.height - 8);
      pen.fillRect(4 + i * step, EDITOR.height - 4 - h, step, h);
    });
    pen.strokeStyle = "#888";
    pen.beginPath();
    for (const p of points) pen.lineTo(toX(p.scalar), toY(p.extinction));
    pen.stroke();
    points.forEach((p, i) => {
      pen.fillStyle = hex(p.color);
      pen.beginPath();
      pen.arc(toX(p.scalar), toY(p.extinction), i === chosen ? 6 : 4, 0, 7);
      pen.fill();
      pen.stroke();
    });
    colour.value = hex(points[chosen].color);
    number.value = String(points[chosen].extinction);
  };
  const change = () => {
    settings().transfer = textOfPoints(points);
    show();
    changed();
  };
  /** Moves the chosen point between its neighbours. @param {number} scalar @param {number} extinction */
  const place = (scalar, extinction) => {
    const [before, after] = [points[chosen - 1]?.scalar ?? -Infinity, points[chosen + 1]?.scalar ?? Infinity];
    points[chosen].scalar = Math.min(Math.max(scalar, before, low), after, high);
    points[chosen].extinction = extinction;
    change();
  };
  const remove = () => {
    if (points.length < 2) return;
    points.splice(chosen, 1);
    change();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    const gaps = points.map((p) => Math.hypot(toX(p.scalar) - event.offsetX, toY(p.extinction) - event.offsetY));
    chosen = gaps.indexOf(Math.min(...gaps));
    dragging = gaps[chosen] < 12;
    show();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (dragging) place(ofX(event.offsetX), ofY(event.offsetY));
  });
  canvas.addEventListener("pointerup", () => { dragging = false; });
  canvas.addEventListener("dblclick", (event) => {
    const scalar = Math.min(Math.max(ofX(event.offsetX), low), high);
    const [r, g, b] = evaluated(points, scalar);
    const point = { scalar, color: /** @type {Vector} */ ([r, g, b]), extinction: ofY(event.offsetY) };
    chosen = points.filter((p) => p.scalar <= scalar).length;
    points.splice(chosen, 0, point);
    change();
  });
  canvas.addEventListener("keydown", (event) => {
    const { scalar, extinction } = points[chosen];
    const by = (high - low) / 100;
    if (event.key === "Delete" || event.key === "Backspace") remove();
    else if (event.key === "n") { chosen = (chosen + 1) % points.length; show(); }
    else if (event.key === "ArrowLeft") place(scalar - by, extinction);
    else if (event.key === "ArrowRight") place(scalar + by, extinction);
    else if (event.key === "ArrowUp") place(scalar, Math.min(most, extinction * 1.1 || ofY(EDITOR.height - 5)));
    else if (event.key === "ArrowDown") place(scalar, extinction / 1.1);
    else return;
    event.preventDefault();
  });
  colour.addEventListener("input", () => {
    points[chosen].color = ofHex(colour.value);
    change();
  });
  number.addEventListener("change", () => {
    if (number.valueAsNumber >= 0) place(points[chosen].scalar, number.valueAsNumber);
  });
  const file = Object.assign(document.createElement("input"), { type: "file", accept: ".json", id: "transfer-load", title: "Load a transfer function" });
  file.addEventListener("change", async () => {
    try {
      if (file.files?.[0]) settings().transfer = textOfPoints(pointsOfJson(await file.files[0].text()));
      show();
      changed();
    } catch (error) {
      say(error);
    }
    file.value = ""; // so that the same file can be loaded again
  });
  const saving = Object.assign(document.createElement("button"), { type: "button", id: "transfer-save", textContent: "Save JSON" });
  saving.addEventListener("click", () => save(new Blob([jsonOf(points)]), `${facts.name}.transfer.json`));
  const box = document.createElement("div");
  box.append(canvas, colour, number, file, saving);
  return Object.assign(box, { show });
}
