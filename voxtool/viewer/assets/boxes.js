// Textures of three dimensions, which only fields have.

/** A three-dimensional texture.
 * @param {WebGL2RenderingContext} gl @param {keyof FORMATS} name @param {any} array typed
 * @param {number[]} size texels along x, y and z @param {string} what for messages */
function boxTexture(gl, name, array, size, what) {
  const { internal, format, type } = FORMATS[name];
  const [width, height, depth] = size;
  const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  if (Math.max(...size) > most)
    throw new PageError(
      `This browser's textures have ${most} texels along a side, and the ${what} need ${Math.max(...size)}: ` +
        "open the page on a machine with a graphics card, or make it of a coarser file.",
    );
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_3D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texStorage3D(gl.TEXTURE_3D, 1, gl[/** @type {"R8UI"} */ (internal)], width, height, depth);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_3D, side, gl.NEAREST);
  gl.texSubImage3D(
    gl.TEXTURE_3D, 0, 0, 0, 0, width, height, depth,
    gl[/** @type {"RED"} */ (format)], gl[/** @type {"FLOAT"} */ (type)], array,
  );
  if (gl.getError() === gl.OUT_OF_MEMORY)
    throw new PageError(`The graphics memory does not hold the ${what}: make the page of a coarser file.`);
  boxes.add(texture);
  return texture;
}
