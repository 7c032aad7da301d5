// The controls beside the picture, made from their descriptions.

/** Builds the controls into a form; `changed` is called after a setting has changed. Returns a
 * function that shows the settings again. @param {HTMLElement} form @param {Control[]} controls
 * @param {() => Settings} settings @param {() => void} changed */
function buildPanel(form, controls, settings, changed) {
  /** @type {(() => void)[]} */
  const refresh = [];
  form.addEventListener("submit", (event) => event.preventDefault()); // Enter in a field reloads no page
  for (const control of controls) {
    if (control.build) {
      const built = control.build(settings, changed);
      form.append(control.label, built);
      refresh.push(built.show);
      continue;
    }
    const label = document.createElement("label");
    const name = document.createElement("span");
    name.textContent = control.label;
    const [field, show] = fieldOf(control, settings, changed);
    field.id = `setting-${control.name}`;
    label.append(name, field);
    form.append(label);
    refresh.push(show);
  }
  return () => {
    for (const show of refresh) show();
  };
}

/** The element of a control, and a function that shows its setting.
 * @param {Control} control @param {() => Settings} settings @param {() => void} changed
 * @returns {[HTMLElement, () => void]} */
function fieldOf({ name, type, options = [], min, max, step, hint = "", wrong }, settings, changed) {
  if (type === "select") {
    const select = document.createElement("select");
    select.append(...options.map((option) => new Option(option, option)));
    select.addEventListener("change", () => {
      settings()[name] = select.value;
      changed();
    });
    return [select, () => { select.value = settings()[name]; }];
  }
  const input = document.createElement("input");
  if (type === "text") {
    input.placeholder = hint;
    input.addEventListener("change", () => {
      input.setCustomValidity(wrong?.(input.value) || "");
      if (!input.reportValidity()) return;
      settings()[name] = input.value;
      changed();
    });
    return [input, () => { input.value = settings()[name]; input.setCustomValidity(""); }];
  }
  input.type = { check: "checkbox", range: "range", color: "color" }[/** @type {"check"} */ (type)];
  if (type === "range") Object.assign(input, { min, max, step });
  input.addEventListener("input", () => {
    settings()[name] = type === "check" ? input.checked : type === "color" ? input.value : input.valueAsNumber;
    input.title = input.value;
    changed();
  });
  const show = () => {
    if (type === "check") input.checked = settings()[name];
    else if (type === "color") input.value = settings()[name];
    else input.valueAsNumber = settings()[name];
  };
  return [input, show];
}
