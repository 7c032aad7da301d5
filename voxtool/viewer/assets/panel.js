// The controls beside the picture, made from their descriptions.

/** Builds the controls into a form; `changed` is called after a setting has changed. Returns a
 * function that shows the settings again. @param {HTMLElement} form @param {Control[]} controls
 * @param {() => Settings} settings @param {() => void} changed */
function buildPanel(form, controls, settings, changed) {
  /** @type {(() => void)[]} */
  const refresh = [];
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
function fieldOf({ name, type, options = [], min, max, step }, settings, changed) {
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
  input.type = type === "check" ? "checkbox" : "range";
  if (type === "range") Object.assign(input, { min, max, step });
  input.addEventListener("input", () => {
    settings()[name] = type === "check" ? input.checked : input.valueAsNumber;
    input.title = input.value;
    changed();
  });
  const show = () => {
    if (type === "check") input.checked = settings()[name];
    else input.valueAsNumber = settings()[name];
  };
  return [input, show];
}
