// The depths at which the rays of tiles of a picture begin: those of the nodes that tiles may show.

const TILE = 8; // pixels along a side
const MOST_NODES = 8192; // nodes that are drawn, besides inside leaves

/** The nodes that hold all voxels, low corner and size each: those of the least size that has at most
 * MOST_NODES of them, and the inside leaves above. @param {Links} links */
function nodeList({ root, held, refined, child, counts }) {
  const level = counts.filter((count) => count <= MOST_NODES).length - 1;
  /** @type {number[]} */
  const found = [];
  /** @param {number} node @param {number} size @param {number[]} low */
  const visit = (node, size, low) => {
    if (size === root - level) {
      found.push(...low, size);
      return;
    }
    for (let octant = 0; octant < 8; ++octant) {
      const at = low.map((v, a) => v + (((octant >> a) & 1) << (size - 1)));
      if ((refined(node) >> octant) & 1) visit(child(node, octant), size - 1, at);
      else if ((held(node) >> octant) & 1) found.push(...at, size - 1);
    }
  };
  visit(0, root, [0, 0, 0]);
  return found;
}

/** A vector whose product with an arm is its length along another, in units of that one.
 * @param {Vector} v @param {Vector} scale world units of the coordinates of v, by axis @returns {Vector} */
function dual(v, scale) {
  const world = /** @type {Vector} */ (v.map((x, a) => x * scale[a]));
  return /** @type {Vector} */ (world.map((x, a) => (x * scale[a]) / dot(world, world)));
}

/** Draws the nodes of a list into tiles. */
class Tiles {
  /** @param {WebGL2RenderingContext} gl @param {number[]} nodes */
  constructor(gl, nodes) {
    this.gl = gl;
    this.program = programOf(gl, textOf("tiles.vert"), textOf("tiles.frag"));
    this.count = nodes.length / 4;
    this.nodes = listTexture(gl, "u2x4", new Uint16Array(nodes), "nodes");
    this.frame = gl.createFramebuffer();
    this.depth = gl.createRenderbuffer();
    /** The depth of each tile as the bits of a float. @type {WebGLTexture | null} */
    this.texture = null;
    this.shape = [0, 0];
  }

  /** Makes the texture of a picture. @param {number[]} shape tiles along x and y */
  resize(shape) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    if (String(this.shape) === String(shape)) return;
    this.shape = shape;
    gl.deleteTexture(this.texture);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, shape[0], shape[1]);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT32F, shape[0], shape[1]);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
  }

  /** Finds the depths of a picture. @param {Record<string, any>} values of its uniforms
   * @param {Vector} scale of their coordinates */
  find(values, scale) {
    const gl = this.gl;
    const { size, startRight, startDown, way, wayRight } = values;
    this.resize(size.map((/** @type {number} */ n) => Math.ceil(n / TILE)));
    gl.viewport(0, 0, this.shape[0], this.shape[1]);
    gl.clearBufferuiv(gl.COLOR, 0, new Uint32Array(new Float32Array([1e30, 0, 0, 0]).buffer));
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.nodes);
    const right = dual(startRight, scale);
    const view = { right, down: dual(startDown, scale), ahead: dual(way, scale), closer: dot(right, wayRight) };
    setUniforms(gl, this.program, { ...values, ...view, nodes: 0 });
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.count);
    gl.disable(gl.DEPTH_TEST);
  }
}
