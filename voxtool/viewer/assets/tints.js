// The colours of an octree's cells by their attributes, and which labels are shown.

/**
 * @typedef {{shown: (value: number) => boolean, first: (brick: number) => number,
 *     bricks: Uint32Array | null, colours: Uint8Array}} Tints
 *     Which values of nodes are shown; the place of the first value of a brick's voxels; the bricks
 *     without the voxels that are not; the colours of all values, red, green, blue and opacity.
 */

/** The numbers of labels in a setting. @param {string} text */
function labelsIn(text) {
  return new Set(text.split(",").filter(Boolean).map(Number));
}

/** The colours of nodes and voxels.
 * @param {Record<string, any>} arrays of the page @param {string} name of the attribute, or ""
 * @param {Set<number>} hidden labels that are not shown @returns {Tints} */
function tintsOf({ label, colour, palette, bricks }, name, hidden) {
  const all = label ? label.length : colour.length / 4;
  const voxels = bricks ? countOf(bricks) : 0;
  const nodes = all - voxels;
  const firsts = new Uint32Array(bricks ? bricks.length / 2 : 0);
  const kept = bricks && hidden.size ? new Uint32Array(bricks.length) : bricks;
  /** @type {number[] | null} */
  const order = hidden.size && bricks ? [] : null; // of the voxels that are shown
  for (let i = 0, from = nodes, to = nodes; i < firsts.length; ++i) {
    firsts[i] = to;
    for (let half = 0; half < 2; ++half) {
      const word = bricks[2 * i + half];
      if (!order) {
        to += popcount(word);
        continue;
      }
      for (let bit = 0; bit < 32; ++bit) {
        if (!((word >>> bit) & 1)) continue;
        if (!hidden.has(label[from])) {
          kept[2 * i + half] |= 1 << bit;
          order.push(from);
          ++to;
        }
        ++from;
      }
    }
  }
  const count = order ? nodes + order.length : all;
  const colours = new Uint8Array(4 * count); // of opacity 0: the colour of octrees without
  for (let i = 0; i < count && name; ++i) {
    const from = order && i >= nodes ? order[i - nodes] : i;
    for (let c = 0; c < 4; ++c)
      colours[4 * i + c] = name === "colour" ? colour[4 * from + c] : c < 3 ? palette[3 * label[from] + c] : 255;
  }
  return { shown: (value) => !hidden.size || !hidden.has(label[value]), first: (brick) => firsts[brick], bricks: kept, colours };
}

/** The voxels that are set. @param {Uint32Array} bricks */
function countOf(bricks) {
  let count = 0;
  for (const word of bricks) count += popcount(word);
  return count;
}

/** A list of labels to switch on and off, with their colours. @param {string[]} names
 * @param {() => Uint8Array} colours of the palette @returns {Control} */
function labelControl(names, colours) {
  return {
    name: "hidden", label: "Labels", type: "custom", start: "",
    build(settings, changed) {
      const list = document.createElement("div");
      list.className = "labels";
      const set = (/** @type {Iterable<number>} */ hidden) => {
        settings().hidden = [...hidden].sort((a, b) => a - b).join(",");
        show();
        changed();
      };
      const buttons = document.createElement("div");
      for (const [word, hidden] of /** @type {[string, number[]][]} */ ([["All", []], ["None", [...names.keys()]]])) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = word;
        button.addEventListener("click", () => set(hidden));
        buttons.append(button);
      }
      const boxes = names.map((name, i) => {
        const label = document.createElement("label");
        const box = document.createElement("input");
        box.type = "checkbox";
        box.addEventListener("input", () => {
          const hidden = labelsIn(settings().hidden);
          if (box.checked) hidden.delete(i);
          else hidden.add(i);
          set(hidden);
        });
        const swatch = document.createElement("span");
        swatch.className = "swatch";
        swatch.style.backgroundColor = `rgb(${colours().subarray(3 * i, 3 * i + 3).join(" ")})`;
        label.append(box, swatch, name);
        return label;
      });
      const boxList = document.createElement("div");
      boxList.append(...boxes);
      list.append(buttons, boxList);
      const show = () => {
        const hidden = labelsIn(settings().hidden);
        boxes.forEach((label, i) => { /** @type {HTMLInputElement} */ (label.firstChild).checked = !hidden.has(i); });
      };
      return Object.assign(list, { show });
    },
  };
}
