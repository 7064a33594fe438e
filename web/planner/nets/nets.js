/**
 * Feasibility-Nets in WebAssembly: the numbers of `FeasibilityNet` of specialist.js, faster.
 *
 * Reads nets.wasm (nets.c) and a loaded net; gives an object with the same `feasibility` and
 * `losses`. Without it the page works too, but a stroke of the brush takes a second.
 */

/** Rows that go through all layers together: their values stay in a core's cache. */
const ROWS = 64;
const ACTIVATIONS = { none: 0, elu: 1, tanh: 2 };

/** Memory and functions of nets.wasm, shared by all nets. */
export class Kernel {
  /** @param {BufferSource} bytes - nets.wasm */
  static async load(bytes) {
    const { instance } = await WebAssembly.instantiate(bytes);
    return new Kernel(instance.exports);
  }

  constructor(calls) {
    this.calls = calls;
    this.next = Math.ceil(calls.free_from() / 16) * 16;
  }

  /** Take room for so many floats; return its address. */
  room(count) {
    const at = this.next;
    this.next += Math.ceil(count / 4) * 16;
    const missing = this.next - this.calls.memory.buffer.byteLength;
    if (missing > 0) this.calls.memory.grow(Math.ceil(missing / 65536));
    return at;
  }

  /** Return the numbers at an address; until memory grows, writing to them writes there. */
  floats(at, count) {
    return new Float32Array(this.calls.memory.buffer, at, count);
  }

  /** Return a loaded net with this kernel's `feasibility` and `losses`. */
  net(net, command) {
    return net.saturation === null ? new FastNet(this, net, command) : net;
  }
}

/** A Feasibility-Net for one command. */
class FastNet {
  constructor(kernel, net, command) {
    this.kernel = kernel;
    this.points = net.points;
    this.heightScale = net.heightScale;
    this.input = kernel.room(ROWS * net.points);
    const [first, ...others] = net.head.layers;
    const head = [withCommand(first, net.points, command), ...others];
    // Of the encoder only the mean is used: the first half of its outputs.
    const encoder = net.encoder.layers.slice();
    encoder.push({ ...encoder.pop(), outputs: net.latent });
    this.head = pack(kernel, activated(head, "elu"));
    this.autoencoder = pack(kernel, [
      ...activated(encoder, "tanh"),
      ...activated(net.decoder.layers, "tanh"),
    ]);
  }

  /** As `FeasibilityNet.feasibility`, for the command that this net was made for. */
  feasibility(patches) {
    const result = new Float32Array(patches.length / this.points);
    this.batches(patches, this.head, (first, rows, scores, width) => {
      for (let r = 0; r < rows; r++) result[first + r] = 1 / (1 + Math.exp(-scores[r * width]));
    });
    return result;
  }

  /** As `FeasibilityNet.losses`. */
  losses(patches) {
    const reconstruction = new Float32Array(patches.length / this.points);
    const strangeness = new Float32Array(reconstruction.length);
    const { points, heightScale } = this;
    this.batches(patches, this.autoencoder, (first, rows, decoded, width) => {
      for (let r = 0; r < rows; r++) {
        let loss = 0;
        let size = 0;
        for (let k = 0; k < points; k++) {
          const height = heightScale * patches[(first + r) * points + k];
          loss += (decoded[r * width + k] - height) ** 2;
          size += height * height;
        }
        reconstruction[first + r] = loss;
        strangeness[first + r] = loss / (1 + size);
      }
    });
    return { reconstruction, strangeness };
  }

  /** Send patches through layers, and give the outputs of each batch of rows to `use`. */
  batches(patches, layers, use) {
    const { kernel, points, heightScale } = this;
    const count = patches.length / points;
    for (let first = 0; first < count; first += ROWS) {
      const rows = Math.min(ROWS, count - first);
      const given = kernel.floats(this.input, rows * points);
      const from = first * points;
      for (let i = 0; i < given.length; i++) given[i] = heightScale * patches[from + i];
      let x = this.input;
      const worked = Math.ceil(rows / 4) * 4;
      for (const { inputs, weights, bias, outputs, output, activation } of layers) {
        kernel.calls.dense(x, worked, inputs, weights, bias, outputs, output, activation);
        x = output;
      }
      const width = layers.at(-1).outputs;
      use(first, rows, kernel.floats(x, rows * width), width);
    }
  }
}

/** Return a layer that reads a patch alone: what it makes of the command goes into its bias. */
function withCommand({ weight, bias, inputs, outputs }, points, command) {
  const shifted = Float32Array.from(bias, (b, o) => {
    for (let k = points; k < inputs; k++) b += weight[o * inputs + k] * command[k - points];
    return b;
  });
  return { weight, bias: shifted, inputs: points, outputs, stride: inputs };
}

/** Say of each layer what activation follows it: none follows the last. */
function activated(layers, name) {
  return layers.map((layer, i) => {
    const last = i === layers.length - 1;
    return { ...layer, activation: ACTIVATIONS[last ? "none" : name] };
  });
}

/** Lay layers into the kernel's memory, outputs filled up with zeros to a multiple of 8. */
function pack(kernel, layers) {
  let { inputs } = layers[0];
  return layers.map((layer) => {
    const outputs = Math.ceil(layer.outputs / 8) * 8;
    const at = kernel.room(inputs * outputs);
    const bias = kernel.room(outputs);
    const output = kernel.room(ROWS * outputs);
    const packed = kernel.floats(at, inputs * outputs);
    const stride = layer.stride ?? layer.inputs;
    for (let o = 0; o < layer.outputs; o++) {
      for (let k = 0; k < layer.inputs; k++) {
        packed[(o - (o % 8)) * inputs + 8 * k + (o % 8)] = layer.weight[o * stride + k];
      }
    }
    kernel.floats(bias, layer.outputs).set(layer.bias.subarray(0, layer.outputs));
    const made = { weights: at, bias, output, inputs, outputs, activation: layer.activation };
    inputs = outputs;
    return made;
  });
}
