/**
 * Munk2D, the physics of pymunk, compiled to WebAssembly: one space with one toy in it.
 *
 * Reads munk.wasm (see build.py); gives its functions under their names in munk.c, and the state of
 * a body as numbers. Bodies, joints and segments are handles.
 */

/**
 * Compile munk.wasm once; every call of the answer gives a world of its own.
 *
 * @param {BufferSource} bytes - The file.
 * @returns {Promise<() => Munk>}
 */
export async function loadMunk(bytes) {
  const module = await WebAssembly.compile(bytes);
  return () => new Munk(new WebAssembly.Instance(module));
}

/** One instance: `calls` holds the functions of munk.c. */
export class Munk {
  /** @param {WebAssembly.Instance} instance */
  constructor(instance) {
    this.calls = instance.exports;
    this.calls._initialize();
    this.address = this.calls.state_address();
  }

  /** Write x, y, angle, vx, vy and the angular velocity of a body to `state` at `from`. */
  read(body, state, from) {
    this.calls.body_read(body);
    state.set(new Float64Array(this.calls.memory.buffer, this.address, 6), from);
  }
}
