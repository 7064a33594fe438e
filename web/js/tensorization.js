/**
 * From elevation map to feasibility tensor: a window slides over the map, once per heading.
 *
 * Reads a map and specialists (net, patch grid, planning command); gives f, L_recon, strangeness,
 * w_ood and F_i = w_ood * f of every cell and heading. Mirrors fgtutor/tensorization.py, tiles.py
 * and `prepare` of patches.py (paper, Sec. III-B, Eqs. 4-5). A changed map costs only the windows
 * that see the change, and equal patches are assessed once.
 */

import { Headings } from "./directions.js";
import { groundHeight, PatchGrid, rotate } from "./heights.js";

/** Depth at which a hole counts as bottomless, m. */
const HOLE_DEPTH = 0.3;
/** How far the ground that a hole is measured against may be, m. */
const HOLE_REACH = 0.25;
/** Distinct patches that are assessed between two calls of `onProgress`. */
const PORTION = 1024;

/**
 * Return the map that patches are taken from: deep holes raised to `HOLE_DEPTH` below the grey
 * closing of the ground around. Cells of 0.1 m or coarser need no smoothing; finer ones are refused.
 *
 * @param {import("./heights.js").HeightMap} map - Without unknown heights.
 */
export function prepare(map) {
  const { heights, nx, ny, resolution } = map;
  if (resolution < 0.1 - 1e-9) throw new Error("maps here have cells of 0.1 m or more");
  const cells = roundHalfEven(HOLE_REACH / resolution);
  // Closed on a padded map, or the border would erode what it has just dilated.
  const pad = 2 * cells;
  const [wide, high] = [nx + 2 * pad, ny + 2 * pad];
  let closed = new Float32Array(wide * high);
  for (let i = 0; i < wide; i++) {
    const from = clamp(i - pad, 0, nx - 1) * ny;
    for (let j = 0; j < high; j++) closed[i * high + j] = heights[from + clamp(j - pad, 0, ny - 1)];
  }
  for (const extreme of [Math.max, Math.min]) {
    closed = filtered(closed, wide, high, high, 1, cells, extreme);
    closed = filtered(closed, high, wide, 1, high, cells, extreme);
  }
  const prepared = new Float32Array(heights.length);
  const depth = Math.fround(HOLE_DEPTH);
  for (let i = 0; i < nx; i++) {
    for (let j = 0; j < ny; j++) {
      const floor = Math.fround(closed[(i + pad) * high + j + pad] - depth);
      prepared[i * ny + j] = Math.max(heights[i * ny + j], floor);
    }
  }
  return { ...map, heights: prepared };
}

/** Filter lines of `count` numbers, `step` apart, of which there are `lines`, `next` apart. */
function filtered(values, count, lines, step, next, reach, extreme) {
  const out = new Float32Array(values.length);
  for (let line = 0; line < lines; line++) {
    for (let i = 0; i < count; i++) {
      let best = values[line * next + i * step];
      for (let n = Math.max(i - reach, 0); n <= Math.min(i + reach, count - 1); n++) {
        best = extreme(best, values[line * next + n * step]);
      }
      out[line * next + i * step] = best;
    }
  }
  return out;
}

/** What specialists say about every cell and heading of one map. */
export class Assessment {
  /**
   * @param {import("./heights.js").HeightMap & {known?: Uint8Array}} map
   * @param {import("./specialist.js").Specialist[]} specialists - All with the same patch grid.
   * @param {Headings} headings
   */
  constructor(map, specialists, headings = new Headings(8)) {
    this.map = map;
    this.known = map.known ?? new Uint8Array(map.nx * map.ny).fill(1);
    this.specialists = specialists;
    this.headings = headings;
    this.grid = new PatchGrid(specialists[0].grid);
    this.offsets = headings.yaws.map((yaw) => offsets(this.grid, yaw, map.resolution));
    this.margin = Math.max(...this.offsets.map(({ reach }) => reach));
    this.prepared = prepare(map);
    /** Where each step ends, -1 for those that there are not. */
    this.ends = headings.stepsWithin(this.known, map.nx, map.ny);
    this.size = map.nx * map.ny * headings.count;
    const blank = () => new Float32Array(this.size);
    /** For each specialist: f, L_recon and the strangeness of each cell and heading. */
    this.said = specialists.map(() => ({
      f: blank(),
      reconstruction: blank(),
      strangeness: blank(),
    }));
  }

  /** Assess every window of the map. */
  assess(onProgress = () => {}) {
    return this.renew(null, onProgress);
  }

  /**
   * Take over other heights, and assess the windows that see a change of the prepared map.
   *
   * @param {Float32Array} heights
   * @returns {number[]} The windows: cell * d + heading.
   */
  reassess(heights, onProgress = () => {}) {
    const before = this.prepared.heights;
    this.map = { ...this.map, heights };
    this.prepared = prepare(this.map);
    const changed = [];
    this.prepared.heights.forEach((height, cell) => {
      if (height !== before[cell]) changed.push(cell);
    });
    return this.renew(this.seeing(changed), onProgress);
  }

  /** Return the windows that see one of these cells. */
  seeing(changed) {
    const { nx, ny } = this.map;
    const d = this.headings.count;
    const marked = new Uint8Array(this.size);
    const mark = (ix, iy, k) => {
      if (ix >= 0 && iy >= 0 && ix < nx && iy < ny) marked[(ix * ny + iy) * d + k] = 1;
    };
    for (const cell of changed) {
      const [ix, iy] = [Math.floor(cell / ny), cell % ny];
      // Beyond the border the edge cell continues: there, one cell stands for many.
      const [left, right] = [ix === 0 ? -this.margin : 0, ix === nx - 1 ? this.margin : 0];
      const [down, up] = [iy === 0 ? -this.margin : 0, iy === ny - 1 ? this.margin : 0];
      this.offsets.forEach(({ seen }, k) => {
        for (const [i, j] of seen) {
          for (let a = left; a <= right; a++) {
            for (let b = down; b <= up; b++) mark(ix + a - i, iy + b - j, k);
          }
        }
      });
    }
    const windows = [];
    marked.forEach((mark, window) => mark && windows.push(window));
    return windows;
  }

  /** Assess these windows, or all; return them. */
  renew(windows, onProgress) {
    const all = windows ?? Array.from({ length: this.size }, (_, i) => i);
    const { patches, which, count } = this.distinct(all);
    const points = this.grid.count;
    const answers = this.specialists.map(() => ({
      f: new Float32Array(count),
      reconstruction: new Float32Array(count),
      strangeness: new Float32Array(count),
    }));
    for (let first = 0; first < count; first += PORTION) {
      const last = Math.min(first + PORTION, count);
      const part = patches.subarray(first * points, last * points);
      this.specialists.forEach(({ net, command }, i) => {
        const found = { f: net.feasibility(part, command), ...net.losses(part) };
        for (const name in found) answers[i][name].set(found[name], first);
      });
      onProgress(last / count);
    }
    this.said.forEach((said, i) => {
      for (const name in said) {
        for (let n = 0; n < all.length; n++) said[name][all[n]] = answers[i][name][which[n]];
      }
    });
    return all;
  }

  /** Cut the patches of windows; return each distinct one once, and which one each window has. */
  distinct(windows) {
    const points = this.grid.count;
    const patches = new Float32Array(windows.length * points);
    const bits = new Int32Array(patches.buffer);
    const which = new Int32Array(windows.length);
    const same = new Map();
    let count = 0;
    const surface = padded(this.prepared, this.margin);
    for (let n = 0; n < windows.length; n++) {
      const from = count * points;
      this.cut(surface, windows[n], patches, from);
      let key = 0;
      for (let i = from; i < from + points; i++) key = (Math.imul(key, 31) + bits[i] * 17) | 0;
      const known = same.get(key);
      const twin = known?.find((one) => equal(bits, one * points, from, points));
      if (twin !== undefined) {
        which[n] = twin;
        continue;
      }
      if (known) known.push(count);
      else same.set(key, [count]);
      which[n] = count++;
    }
    return { patches, which, count };
  }

  /** Write the patch of a window to `patches` at `from`. */
  cut(surface, window, patches, from) {
    const d = this.headings.count;
    const { ny } = this.map;
    const cell = Math.floor(window / d);
    const row = surface.high;
    const base = (Math.floor(cell / ny) + this.margin) * row + (cell % ny) + this.margin;
    const { heights } = surface;
    const { whole, part, blended } = this.offsets[window % d];
    for (let i = 0; i < this.grid.count; i++) {
      const at = base + whole[2 * i] * row + whole[2 * i + 1];
      if (!blended) {
        patches[from + i] = heights[at];
        continue;
      }
      const [a, b] = [part[2 * i], part[2 * i + 1]];
      const near = heights[at] + b * (heights[at + 1] - heights[at]);
      const far = heights[at + row] + b * (heights[at + row + 1] - heights[at + row]);
      patches[from + i] = near + a * (far - near);
    }
    const ground = groundHeight(patches, this.grid, from);
    for (let i = from; i < from + this.grid.count; i++) patches[i] -= ground;
  }

  /**
   * Return w_ood of specialist i, and F_i = w_ood * f. F of a step over several cells is the least
   * of theirs, and 0 of a step from, over or to an unknown cell or off the map.
   *
   * @param {number} i
   * @param {import("./feasibility.js").OodScore} score
   */
  weigh(i, score) {
    const { f, reconstruction, strangeness } = this.said[i];
    const weight = new Float32Array(this.size);
    const product = new Float32Array(this.size);
    for (let n = 0; n < weight.length; n++) {
      weight[n] = score.weight(reconstruction[n], strangeness[n]);
      product[n] = weight[n] * f[n];
    }
    const weighted = new Float32Array(this.size);
    const { count, between } = this.headings;
    for (let n = 0; n < weighted.length; n++) {
      if (this.ends[n] < 0) continue;
      let least = product[n];
      for (const [a, b] of between[n % count]) {
        least = Math.min(least, product[n + (a * this.map.ny + b) * count]);
      }
      weighted[n] = least;
    }
    return { weight, weighted };
  }
}

/** Return where a patch's points lie from its cell, in whole cells and parts, and what they see. */
function offsets(grid, yaw, resolution) {
  const turned = rotate(grid.points, yaw, new Float64Array(2 * grid.count));
  const whole = new Int32Array(turned.length);
  const part = new Float32Array(turned.length);
  turned.forEach((metres, i) => {
    const cells = metres / resolution;
    // The cosine of a right angle is 6e-17: such a point lies on a cell's centre, not beside it.
    const exact = Math.abs(cells - Math.round(cells)) < 1e-6 ? Math.round(cells) : cells;
    whole[i] = Math.floor(exact);
    part[i] = exact - whole[i];
  });
  const blended = part.some((one) => one > 0);
  const seen = new Map();
  for (let n = 0; n < grid.count; n++) {
    for (const a of blended ? [0, 1] : [0]) {
      for (const b of blended ? [0, 1] : [0]) {
        const cell = [whole[2 * n] + a, whole[2 * n + 1] + b];
        seen.set(cell.join(), cell);
      }
    }
  }
  const reach = Math.max(...whole.map(Math.abs)) + 1;
  return { whole, part, blended, seen: [...seen.values()], reach };
}

/** Return heights with `cells` more at each side, which continue the edge. */
function padded({ heights, nx, ny }, cells) {
  const [wide, high] = [nx + 2 * cells, ny + 2 * cells];
  const out = new Float32Array(wide * high);
  for (let i = 0; i < wide; i++) {
    const from = clamp(i - cells, 0, nx - 1) * ny;
    for (let j = 0; j < high; j++) out[i * high + j] = heights[from + clamp(j - cells, 0, ny - 1)];
  }
  return { heights: out, high };
}

function equal(bits, one, other, length) {
  for (let i = 0; i < length; i++) if (bits[one + i] !== bits[other + i]) return false;
  return true;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

/** Round as Python does: 2.5 becomes 2. */
function roundHalfEven(value) {
  const low = Math.floor(value);
  const rest = value - low;
  return rest === 0.5 ? low + (low % 2) : Math.round(value);
}
