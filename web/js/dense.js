/**
 * Dense layers in plain JavaScript, for one row or for many: y = activation(W x + b).
 *
 * Rows and outputs are worked on in blocks of 2 x 4, whose sums stay in registers, and rows in
 * batches of `BATCH`, whose values stay in the cache. Nothing is allocated for a row. Mirrors
 * rsl_rl's MLP and `_mlp` of fgtutor/feasibility.py.
 */

/** Rows that go through all layers together. */
export const BATCH = 64;

/** What an activation does to the first `count` numbers of an array, in place. */
export const ACTIVATIONS = {
  elu(values, count) {
    for (let i = 0; i < count; i++) if (values[i] < 0) values[i] = Math.expm1(values[i]);
  },
  relu(values, count) {
    for (let i = 0; i < count; i++) if (values[i] < 0) values[i] = 0;
  },
  tanh(values, count) {
    for (let i = 0; i < count; i++) values[i] = 1 - 2 / (1 + Math.exp(2 * values[i]));
  },
};

/** Layers with an activation after all but the last. */
export class Mlp {
  /**
   * @param {Map<string, import("./safetensors.js").Tensor>} tensors
   * @param {string} prefix - What the names of its tensors begin with, such as "mlp.".
   * @param {keyof ACTIVATIONS} activation
   */
  constructor(tensors, prefix, activation) {
    this.activate = ACTIVATIONS[activation];
    if (!this.activate) throw new Error(`no activation ${activation} here`);
    /** @type {{weight: Float32Array, bias: Float32Array, inputs: number, outputs: number}[]} */
    this.layers = [];
    for (let i = 0; tensors.has(`${prefix}${i}.weight`); i += 2) {
      const weight = tensors.get(`${prefix}${i}.weight`);
      const bias = tensors.get(`${prefix}${i}.bias`);
      const [outputs, inputs] = weight.shape;
      this.layers.push({ weight: weight.data, bias: bias.data, inputs, outputs });
    }
    if (!this.layers.length) throw new Error(`no layers ${prefix}*.weight in this file`);
    this.inputs = this.layers[0].inputs;
    this.outputs = this.layers.at(-1).outputs;
    this.buffers = this.layers.map((layer) => new Float32Array(BATCH * layer.outputs));
  }

  /**
   * Return the outputs of up to `BATCH` rows: an array that the next call overwrites.
   *
   * @param {Float32Array} x - The rows one after another.
   * @param {number} rows
   * @returns {Float32Array}
   */
  run(x, rows = 1) {
    this.layers.forEach((layer, i) => {
      const y = this.buffers[i];
      affine(x, rows, layer, y);
      if (i < this.layers.length - 1) this.activate(y, rows * layer.outputs);
      x = y;
    });
    return x;
  }
}

/** Write W x + b of each row to y. */
function affine(x, rows, { weight, bias, inputs, outputs }, y) {
  const even = rows - (rows % 2);
  const fours = outputs - (outputs % 4);
  for (let o = 0; o < fours; o += 4) {
    const w0 = o * inputs;
    const w1 = w0 + inputs;
    const w2 = w1 + inputs;
    const w3 = w2 + inputs;
    for (let r = 0; r < even; r += 2) {
      const x0 = r * inputs;
      const x1 = x0 + inputs;
      let a0 = bias[o];
      let a1 = bias[o + 1];
      let a2 = bias[o + 2];
      let a3 = bias[o + 3];
      let b0 = a0;
      let b1 = a1;
      let b2 = a2;
      let b3 = a3;
      for (let k = 0; k < inputs; k++) {
        const p = x[x0 + k];
        const q = x[x1 + k];
        const s = weight[w0 + k];
        const t = weight[w1 + k];
        const u = weight[w2 + k];
        const v = weight[w3 + k];
        a0 += p * s;
        b0 += q * s;
        a1 += p * t;
        b1 += q * t;
        a2 += p * u;
        b2 += q * u;
        a3 += p * v;
        b3 += q * v;
      }
      const y0 = r * outputs + o;
      const y1 = y0 + outputs;
      y[y0] = a0;
      y[y0 + 1] = a1;
      y[y0 + 2] = a2;
      y[y0 + 3] = a3;
      y[y1] = b0;
      y[y1 + 1] = b1;
      y[y1 + 2] = b2;
      y[y1 + 3] = b3;
    }
    for (let r = even; r < rows; r++) {
      const x0 = r * inputs;
      let a0 = bias[o];
      let a1 = bias[o + 1];
      let a2 = bias[o + 2];
      let a3 = bias[o + 3];
      for (let k = 0; k < inputs; k++) {
        const p = x[x0 + k];
        a0 += p * weight[w0 + k];
        a1 += p * weight[w1 + k];
        a2 += p * weight[w2 + k];
        a3 += p * weight[w3 + k];
      }
      const y0 = r * outputs + o;
      y[y0] = a0;
      y[y0 + 1] = a1;
      y[y0 + 2] = a2;
      y[y0 + 3] = a3;
    }
  }
  for (let o = fours; o < outputs; o++) {
    for (let r = 0; r < rows; r++) {
      let a = bias[o];
      for (let k = 0; k < inputs; k++) a += x[r * inputs + k] * weight[o * inputs + k];
      y[r * outputs + o] = a;
    }
  }
}
