// WebGL 2: programs, textures, and the picture that is drawn off the screen.

/** @param {WebGL2RenderingContext} gl @param {number} kind @param {string} source */
function shaderOf(gl, kind, source) {
  const shader = gl.createShader(kind);
  if (!shader) throw new PageError("The browser makes no shader: reload the page.");
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  return shader;
}

/** @param {WebGL2RenderingContext} gl @param {string} vertex @param {string} fragment */
function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  const shaders = [shaderOf(gl, gl.VERTEX_SHADER, vertex), shaderOf(gl, gl.FRAGMENT_SHADER, fragment)];
  for (const shader of shaders) gl.attachShader(program, shader);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const log = shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new PageError(`The browser does not compile the shader: ${log} ${gl.getProgramInfoLog(program)}`);
  }
  return program;
}

const FORMATS = {
  u1x1: { internal: "R8UI", format: "RED_INTEGER", type: "UNSIGNED_BYTE", channels: 1 },
  u1x3: { internal: "RGB8UI", format: "RGB_INTEGER", type: "UNSIGNED_BYTE", channels: 3 },
  u1x4: { internal: "RGBA8UI", format: "RGBA_INTEGER", type: "UNSIGNED_BYTE", channels: 4 },
  u2x3: { internal: "RGB16UI", format: "RGB_INTEGER", type: "UNSIGNED_SHORT", channels: 3 },
  u2x4: { internal: "RGBA16UI", format: "RGBA_INTEGER", type: "UNSIGNED_SHORT", channels: 4 },
  n1x4: { internal: "RGBA8", format: "RGBA", type: "UNSIGNED_BYTE", channels: 4 }, // read as 0 to 1
  u4x1: { internal: "R32UI", format: "RED_INTEGER", type: "UNSIGNED_INT", channels: 1 },
  u4x3: { internal: "RGB32UI", format: "RGB_INTEGER", type: "UNSIGNED_INT", channels: 3 },
  u4x2: { internal: "RG32UI", format: "RG_INTEGER", type: "UNSIGNED_INT", channels: 2 },
  i4x4: { internal: "RGBA32I", format: "RGBA_INTEGER", type: "INT", channels: 4 },
  f4x1: { internal: "R32F", format: "RED", type: "FLOAT", channels: 1 },
  f4x2: { internal: "RG32F", format: "RG", type: "FLOAT", channels: 2 },
  f4x4: { internal: "RGBA32F", format: "RGBA", type: "FLOAT", channels: 4 },
};

/** The bits of a row of the textures that hold lists: at most 4096 texels.
 * @param {WebGL2RenderingContext} gl */
function rowBits(gl) {
  return Math.min(12, Math.floor(Math.log2(gl.getParameter(gl.MAX_TEXTURE_SIZE))));
}

/** A texture of the elements of an array, in rows.
 * @param {WebGL2RenderingContext} gl @param {keyof FORMATS} name @param {any} array typed
 * @param {string} what for messages */
function listTexture(gl, name, array, what) {
  const { internal, format, type, channels } = FORMATS[name];
  const width = 1 << rowBits(gl);
  const rows = Math.max(1, Math.ceil(array.length / channels / width));
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (rows > most)
    throw new PageError(
      `This browser's textures have ${most} rows, and the ${what} need ${rows}: ` +
        "open the page on a machine with a graphics card, or make it of a coarser file.",
    );
  const padded = new array.constructor(rows * width * channels);
  padded.set(array);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl[/** @type {"R8UI"} */ (internal)], width, rows);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  gl.texSubImage2D(
    gl.TEXTURE_2D, 0, 0, 0, width, rows,
    gl[/** @type {"RED"} */ (format)], gl[/** @type {"FLOAT"} */ (type)], padded,
  );
  if (gl.getError() === gl.OUT_OF_MEMORY)
    throw new PageError(`The graphics memory does not hold the ${what}: make the page of a coarser file.`);
  return texture;
}

/** The textures of three dimensions. @type {WeakSet<WebGLTexture>} */
const boxes = new WeakSet();

/** Sets a program's uniforms by name: a number or a boolean, or an array of 2 to 4 numbers.
 * @param {WebGL2RenderingContext} gl @param {WebGLProgram} program
 * @param {Record<string, any>} values */
function setUniforms(gl, program, values) {
  gl.useProgram(program);
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; ++i) {
    const info = gl.getActiveUniform(program, i);
    if (!info) continue;
    const name = info.name.replace("[0]", "");
    const place = gl.getUniformLocation(program, info.name);
    const value = values[name];
    if (value === undefined) throw new PageError(`The shader has no value of ${name}.`);
    if (info.type === gl.FLOAT) gl.uniform1fv(place, [value].flat());
    else if (info.type === gl.FLOAT_VEC2) gl.uniform2fv(place, value);
    else if (info.type === gl.FLOAT_VEC3) gl.uniform3fv(place, value);
    else if (info.type === gl.FLOAT_VEC4) gl.uniform4fv(place, value);
    else if (info.type === gl.INT_VEC2) gl.uniform2iv(place, value);
    else if (info.type === gl.INT_VEC3) gl.uniform3iv(place, value);
    else if (info.type === gl.UNSIGNED_INT) gl.uniform1ui(place, value);
    else gl.uniform1i(place, Number(value)); // int, bool, samplers
  }
}

/** A picture and the ids of its pixels, drawn off the screen. */
class Target {
  /** @param {WebGL2RenderingContext} gl @param {number} width @param {number} height */
  constructor(gl, width, height) {
    this.gl = gl;
    this.width = width;
    this.height = height;
    this.frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    this.buffers = [gl.RGBA8, gl.RGBA32UI].map((format, i) => {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.RENDERBUFFER, buffer);
      return buffer;
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }

  /** Frees what the graphics card holds. */
  free() {
    for (const buffer of this.buffers) this.gl.deleteRenderbuffer(buffer);
    this.gl.deleteFramebuffer(this.frame);
  }

  /** Draws a program into it: a triangle that covers it, or points of tiles that may show something.
   * @param {WebGLProgram} program @param {number} tile side of a tile in pixels, or 0 */
  draw(program, tile) {
    const gl = this.gl;
    const [width, height] = [this.width, this.height].map((n) => (tile ? tile * Math.ceil(n / tile) : n));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, width, height);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferuiv(gl.COLOR, 1, [0, 0, 0, 0]);
    gl.useProgram(program);
    if (tile) gl.drawArrays(gl.POINTS, 0, (width / tile) * (height / tile));
    else gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Binds the buffers for reading. Chromium 156 leaves out a binding that it takes to be in place,
   * though it has itself bound others since, as after a change of the canvas's size. */
  bindToRead() {
    this.gl.bindFramebuffer(this.gl.READ_FRAMEBUFFER, null);
    this.gl.bindFramebuffer(this.gl.READ_FRAMEBUFFER, this.frame);
  }

  /** Shows it on the canvas. */
  show() {
    const { gl, width, height } = this;
    this.bindToRead();
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    const { drawingBufferWidth: w, drawingBufferHeight: h } = gl;
    const filter = w === width ? gl.NEAREST : gl.LINEAR;
    gl.blitFramebuffer(0, 0, width, height, 0, 0, w, h, gl.COLOR_BUFFER_BIT, filter);
  }

  /** The colours, premultiplied, from the bottom row up. */
  colours() {
    const { gl, width, height } = this;
    const bytes = new Uint8Array(4 * width * height);
    this.bindToRead();
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }

  /** The ids of a rectangle of pixels, from the bottom row up.
   * @param {number} x @param {number} y @param {number} width @param {number} height */
  ids(x, y, width, height) {
    const gl = this.gl;
    const words = new Uint32Array(4 * width * height);
    this.bindToRead();
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    gl.readPixels(x, y, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    return words;
  }
}
