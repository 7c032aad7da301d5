// Types that the scripts share.

/**
 * @typedef {Record<string, any>} Settings values of the controls, by name
 * @typedef {{name: string, label: string, type: "select" | "range" | "check" | "text" | "color" | "custom",
 *     options?: string[], min?: number, max?: number, step?: number | "any", start: any,
 *     hint?: string, wrong?: (text: string) => string,
 *     build?: (settings: () => Settings, changed: () => void) => HTMLElement & {show: () => void}}} Control
 * @typedef {{camera: Camera, settings: Settings}} State
 * @typedef {object} Kind what the page knows of octrees, fields or volumes
 * @property {Control[]} controls
 * @property {(gl: WebGL2RenderingContext, arrays: Record<string, any>) =>
 *     Record<string, WebGLTexture | null>} textures by the names of their uniforms
 * @property {Vector} origin of the coordinates in which rays are followed, world units
 * @property {Vector} scale of these coordinates, by axis
 * @property {(gl: WebGL2RenderingContext, settings: Settings, camera: Camera) =>
 *     Record<string, any>} uniforms
 * @property {string} [vertex] the vertex shader, where it is not that of all pixels
 * @property {(settings: Settings) => string} [define] a line before the fragment shader
 * @property {(values: Record<string, any>) => void} [before] draws what the picture needs, with the
 *     values of its uniforms, before the textures are used
 * @property {(settings: Settings) => {options: string, note: string}} command the options of
 *     `voxtool render`, and what it lacks or needs for the same picture
 * @property {(id: number[]) => string} describe what a pixel with this id shows
 * @property {Record<string, (settings: Settings) => void>} keys
 */
