/**
 * A specialist: one policy with its Feasibility-Net, read from the folder that Python writes.
 *
 * Mirrors fgtutor/specialist.py, fgtutor/policies/ (kinds mlp, symmetric, dreamwaq, estimating) and
 * `FeasibilityNet` of fgtutor/feasibility.py (paper, Secs. III-A and III-B). Works in browsers and
 * in Node.
 */

import { BATCH, Mlp } from "./dense.js";
import { readBytes, readJson } from "./files.js";
import { parseSafetensors } from "./safetensors.js";

/** How many numbers an estimating policy estimates of the robot's motion. */
const VELOCITY = 3;

/**
 * @typedef {object} Specialist
 * @property {string} name
 * @property {string} robot
 * @property {number[]} command - The velocity (vx, vy, wz) that planning asks about, and at which
 *   a route is driven.
 * @property {object} grid - Where its patches are sampled; see `PatchGrid` in heights.js.
 * @property {Record<string, number>} quantiles - Of L_recon on its own terrain, by probability.
 * @property {Record<string, number>} strangeness - Quantiles of the strangeness there.
 * @property {number} history - Frames of history that its policy reads; 0 unless it estimates.
 * @property {(observation: Float32Array) => Float32Array} act - The deterministic action. What it
 *   reads are the observation groups that `groups` names, joined in that order.
 * @property {string[]} groups
 * @property {FeasibilityNet | null} net
 */

/**
 * Load a specialist's folder.
 *
 * @param {string | URL} folder - Its address, relative to the page or absolute.
 * @param {{net?: boolean}} options - Without `net`, only the policy is loaded.
 * @returns {Promise<Specialist>}
 */
export async function loadSpecialist(folder, { net = true } = {}) {
  const base = String(folder).replace(/\/?$/, "/");
  const tensors = async (file) => parseSafetensors(await readBytes(base + file));
  const description = await readJson(`${base}specialist.json`);
  const { packed = "" } = description;
  const [policy, weights] = await Promise.all([
    tensors(`policy.safetensors${packed}`),
    net ? tensors(`feasibility.safetensors${packed}`) : null,
  ]);
  const { name, robot, command, grid, quantiles, strangeness = {} } = description;
  return {
    name,
    robot,
    command,
    grid,
    quantiles,
    strangeness,
    groups: description.policy.groups,
    history: description.policy.options.history ?? 0,
    act: buildPolicy(description.policy, policy),
    net: weights && new FeasibilityNet(weights, description.feasibility),
  };
}

/** Return a policy as a function from an observation to an action. */
function buildPolicy(config, tensors) {
  if (config.obs_normalization) throw new Error("normalised observations are not read here");
  const build = (prefix, activation) =>
    tensors.has(`${prefix}observation_index`)
      ? new SymmetricMlp(tensors, prefix, activation)
      : new Mlp(tensors, prefix, activation);
  const mlp = build("mlp.", config.activation);
  if (config.kind === "mlp" || config.kind === "symmetric") {
    return (observation) => mlp.run(checked(observation, mlp.inputs)).slice(0, mlp.outputs);
  }
  if (config.kind === "dreamwaq" || config.kind === "estimating") {
    const { history, latent, seen = 0 } = config.options;
    const encoder = build("context.encoder.", "elu");
    const width = encoder.inputs / history;
    const features = new Float32Array(mlp.inputs);
    return (observation) => {
      const felt = checked(observation, encoder.inputs + seen).subarray(0, encoder.inputs);
      features.set(felt.subarray(felt.length - width));
      features.set(encoder.run(felt).subarray(0, VELOCITY + latent), width);
      features.set(observation.subarray(encoder.inputs), width + VELOCITY + latent);
      return mlp.run(features).slice(0, mlp.outputs);
    };
  }
  throw new Error(`no policy of the kind ${config.kind} here`);
}

/** Return an observation if it has the right length. */
function checked(observation, length) {
  if (observation.length === length) return observation;
  throw new Error(`the policy reads ${length} numbers, got ${observation.length}`);
}

/** A network n made symmetric: f(x) = (n(x) + mirror(n(mirror(x)))) / 2, one row at a time. */
class SymmetricMlp {
  constructor(tensors, prefix, activation) {
    this.network = new Mlp(tensors, prefix, activation);
    const part = (name) => tensors.get(prefix + name).data;
    this.observation = { index: part("observation_index"), sign: part("observation_sign") };
    this.action = { index: part("action_index"), sign: part("action_sign") };
    this.inputs = this.network.inputs;
    this.outputs = this.network.outputs;
    this.image = new Float32Array(this.inputs);
    this.answer = new Float32Array(this.outputs);
  }

  run(x) {
    const { answer, image } = this;
    const seen = this.observation;
    const acted = this.action;
    answer.set(this.network.run(x).subarray(0, this.outputs));
    for (let i = 0; i < image.length; i++) image[i] = x[seen.index[i]] * seen.sign[i];
    const twin = this.network.run(image);
    for (let i = 0; i < answer.length; i++) {
      answer[i] = 0.5 * (answer[i] + twin[acted.index[i]] * acted.sign[i]);
    }
    return answer;
  }
}

/** A head for feasibility beside a variational autoencoder of patches (paper, Fig. 2). */
export class FeasibilityNet {
  constructor(tensors, { num_points, height_scale, saturation }) {
    this.points = num_points;
    this.heightScale = height_scale;
    this.saturation = saturation;
    this.head = new Mlp(tensors, "head.", "elu");
    this.encoder = new Mlp(tensors, "encoder.", "tanh");
    this.decoder = new Mlp(tensors, "decoder.", "tanh");
    this.latent = this.decoder.inputs;
    this.heights = new Float32Array(BATCH * num_points);
    this.inputs = new Float32Array(BATCH * this.head.inputs);
    this.means = new Float32Array(BATCH * this.latent);
  }

  /**
   * Predict the tracking reward r_v, in [0, 1], of one command on each patch.
   *
   * @param {Float32Array} patches - n patches one after another, m.
   * @param {ArrayLike<number>} command
   * @returns {Float32Array}
   */
  feasibility(patches, command) {
    const { points, heightScale, inputs, head } = this;
    const width = head.inputs;
    const result = new Float32Array(patches.length / points);
    for (let first = 0; first < result.length; first += BATCH) {
      const rows = Math.min(BATCH, result.length - first);
      for (let r = 0; r < rows; r++) {
        const from = (first + r) * points;
        for (let k = 0; k < points; k++) inputs[r * width + k] = heightScale * patches[from + k];
        for (let k = points; k < width; k++) inputs[r * width + k] = command[k - points];
      }
      const scores = head.run(inputs, rows);
      for (let r = 0; r < rows; r++) result[first + r] = 1 / (1 + Math.exp(-scores[r]));
    }
    return result;
  }

  /**
   * Return L_recon, the squared error of heights summed over each patch, and its strangeness
   * L_recon / (1 + sum h^2).
   *
   * @param {Float32Array} patches - n patches one after another, m.
   * @returns {{reconstruction: Float32Array, strangeness: Float32Array}}
   */
  losses(patches) {
    const { points, latent, heights, means } = this;
    const count = patches.length / points;
    const reconstruction = new Float32Array(count);
    const strangeness = new Float32Array(count);
    for (let first = 0; first < count; first += BATCH) {
      const rows = Math.min(BATCH, count - first);
      this.relief(patches, first * points, rows * points);
      const codes = this.encoder.run(heights, rows);
      for (let r = 0; r < rows; r++) {
        for (let k = 0; k < latent; k++) means[r * latent + k] = codes[r * 2 * latent + k];
      }
      const decoded = this.decoder.run(means, rows);
      for (let r = 0; r < rows; r++) {
        let loss = 0;
        let size = 0;
        for (let k = r * points; k < (r + 1) * points; k++) {
          const error = decoded[k] - heights[k];
          loss += error * error;
          size += heights[k] * heights[k];
        }
        reconstruction[first + r] = loss;
        strangeness[first + r] = loss / (1 + size);
      }
    }
    return { reconstruction, strangeness };
  }

  /** Write the heights that the autoencoder sees, in its units, to `heights`. */
  relief(patches, from, count) {
    const { heights, heightScale, saturation } = this;
    for (let i = 0; i < count; i++) heights[i] = patches[from + i];
    if (saturation !== null) {
      for (let i = 0; i < count; i++) {
        heights[i] = saturation * (1 - 2 / (1 + Math.exp((2 * heights[i]) / saturation)));
      }
    }
    for (let i = 0; i < count; i++) heights[i] *= heightScale;
  }
}
