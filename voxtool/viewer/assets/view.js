// Drawing: one frame at a time, coarser while the camera moves, and whole pictures on request.

const MOVING_TIME = 50; // milliseconds that a frame may take while the camera moves
const STILL_AFTER = 150; // milliseconds without a change after which the picture is drawn whole
const COARSEST = 0.2; // of the pixels along a side

/** A kind of content on a canvas. */
class View {
  /** @param {HTMLCanvasElement} canvas @param {WebGL2RenderingContext} gl @param {Kind} kind
   * @param {Record<string, any>} arrays @param {string[]} shaders vertex and fragment
   * @param {any} facts @param {() => State} state what is drawn next */
  constructor(canvas, gl, kind, arrays, shaders, facts, state) {
    this.state = state;
    this.canvas = canvas;
    this.gl = gl;
    this.kind = kind;
    this.colour = facts.colour;
    this.shaders = [kind.vertex ? textOf(kind.vertex) : shaders[0], shaders[1]];
    /** @type {Record<string, WebGLProgram>} */
    this.programs = {}; // by what is defined
    this.textures = kind.textures(gl, arrays);
    this.scale = 1; // of a moving picture
    this.milliseconds = 0; // of the last frame
    /** @type {Target | null} */
    this.target = null;
    this.busy = false;
    this.again = false;
    this.still = 0; // the timer after which the picture is drawn whole
    /** @type {() => void} */
    this.drawn = () => {};
  }

  /** Draws into a target. @param {Target} target @param {Camera} camera @param {Settings} settings */
  paint(target, camera, settings) {
    const { gl, kind } = this;
    const rays = localRays(raysOf(camera, target.width, target.height), kind.origin, kind.scale);
    /** @type {Record<string, any>} */
    const values = {
      ...rays,
      size: [target.width, target.height],
      colour: this.colour,
      ...kind.uniforms(gl, settings, camera),
    };
    kind.before?.(values);
    Object.entries(this.textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(texture && boxes.has(texture) ? gl.TEXTURE_3D : gl.TEXTURE_2D, texture);
      values[name] = unit;
    });
    const define = kind.define?.(settings) || "";
    const [vertex, fragment] = this.shaders;
    // what is defined comes after the version
    this.programs[define] ||= programOf(gl, vertex, fragment.replace("\n", `\n${define}\n`));
    const program = this.programs[define];
    setUniforms(gl, program, values);
    target.draw(program, values.tile || 0);
  }

  /** Draws the next frame, coarse while the camera moves and whole when it stays. */
  frame() {
    this.again = this.busy;
    if (this.busy) return;
    clearTimeout(this.still);
    this.draw(this.scale);
    if (this.scale < 1) this.still = setTimeout(() => this.whole(), STILL_AFTER);
  }

  /** Draws all pixels, as soon as the frame before is there. */
  whole() {
    if (this.busy) this.still = setTimeout(() => this.whole(), STILL_AFTER);
    else this.draw(1);
  }

  /** @param {number} scale */
  draw(scale) {
    const { gl, canvas } = this;
    const ratio = globalThis.devicePixelRatio || 1;
    const full = [canvas.clientWidth, canvas.clientHeight].map((n) => Math.max(1, Math.round(ratio * n)));
    if (canvas.width !== full[0]) canvas.width = full[0];
    if (canvas.height !== full[1]) canvas.height = full[1];
    const [width, height] = full.map((n) => Math.max(1, Math.round(scale * n)));
    if (this.target?.width !== width || this.target.height !== height) {
      this.target?.free();
      this.target = new Target(gl, width, height);
    }
    this.busy = true;
    const began = performance.now();
    const { camera, settings } = this.state();
    this.paint(this.target, camera, settings);
    this.target.show();
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const wait = () => {
      if (gl.isContextLost() || !sync) return;
      if (gl.clientWaitSync(sync, 0, 0) === gl.TIMEOUT_EXPIRED) return void setTimeout(wait, 2);
      gl.deleteSync(sync);
      this.milliseconds = performance.now() - began;
      const fitting = scale * Math.sqrt(MOVING_TIME / this.milliseconds);
      this.scale = fitting > 1 ? 1 : Math.max(COARSEST, fitting);
      this.busy = false;
      this.drawn();
      if (this.again) this.frame();
    };
    wait();
  }

  /** The id of the pixel at a place on the canvas, in CSS pixels from its upper left.
   * @param {number} x @param {number} y */
  idAt(x, y) {
    if (!this.target || this.busy) return null;
    const { width, height } = this.target;
    const column = Math.floor((x * width) / this.canvas.clientWidth);
    const row = height - 1 - Math.floor((y * height) / this.canvas.clientHeight);
    if (column < 0 || row < 0 || column >= width || row >= height) return null;
    return [...this.target.ids(column, row, 1, 1)];
  }

  /** A picture of any size: colours and ids from the bottom row up.
   * @param {Camera} camera @param {Settings} settings @param {number} width @param {number} height */
  picture(camera, settings, width, height) {
    const target = new Target(this.gl, width, height);
    this.paint(target, camera, settings);
    const found = { colours: target.colours(), ids: target.ids(0, 0, width, height) };
    target.free();
    return found;
  }
}
