// The data of the page: blocks of base64 in it, or files beside it where it is served.

/** An error whose message is shown to the reader of the page. */
class PageError extends Error {}

/** The text of an element of the page. @param {string} id */
function textOf(id) {
  const element = document.getElementById(id);
  if (!element) throw new PageError(`The page is damaged: it has no ${id}.`);
  return element.textContent || "";
}

/** @param {string} text base64 @returns {Uint8Array<ArrayBuffer>} */
function bytesOf(text) {
  const packed = atob(text);
  const bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; ++i) bytes[i] = packed.charCodeAt(i);
  return bytes;
}

/** The bytes of a block of data. Those of each element of `planes` bytes are stored plane by plane.
 * @param {string} name @param {number} planes @returns {Promise<ArrayBuffer>} */
async function blockOf(name, planes) {
  const inPage = document.getElementById(`data-${name}`);
  const stream = inPage
    ? new Blob([bytesOf(inPage.textContent || "")]).stream()
    : (await fetch(`data/${name}`)).body;
  if (!stream) throw new PageError(`The page is damaged: it has no data of ${name}.`);
  const unpacked = stream.pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(unpacked).arrayBuffer());
  if (planes === 1) return bytes.buffer;
  const count = bytes.length / planes;
  const whole = new Uint8Array(bytes.length);
  for (let plane = 0; plane < planes; ++plane)
    for (let i = 0; i < count; ++i) whole[planes * i + plane] = bytes[plane * count + i];
  return whole.buffer;
}

/** The arrays of the content, by name.
 * @param {Record<string, {type: string}>} described
 * @returns {Promise<Record<string, any>>} typed arrays */
async function readArrays(described) {
  /** @type {Record<string, any>} */
  const found = {};
  const types = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array };
  for (const [name, { type }] of Object.entries(described)) {
    const Type = types[/** @type {keyof types} */ (type)];
    found[name] = new Type(await blockOf(name, Type.BYTES_PER_ELEMENT));
  }
  return found;
}
