/**
 * Heights of the ground at points, and local patches H_xy around poses (paper, Sec. III-B).
 *
 * Mirrors fgtutor/patches.py. A map is `{heights, nx, ny, resolution, origin}`, with heights as a
 * Float32Array whose first index is x; it has been prepared (filled, deep holes levelled).
 */

const { fround } = Math;

/**
 * @typedef {object} HeightMap
 * @property {Float32Array} heights - m; cell (ix, iy) stands at ix * ny + iy.
 * @property {number} nx
 * @property {number} ny
 * @property {number} resolution - Side of a cell, m.
 * @property {[number, number]} origin - Corner of the first cell, m.
 */

/** Where a patch is sampled, in the robot's yaw frame (x ahead, y left), metres. */
export class PatchGrid {
  /** @param {{ahead: number, behind: number, half_width: number, spacing?: number,
   *   footprint?: [number, number]}} fields - As in specialist.json. */
  constructor({ ahead, behind, half_width, spacing = 0.1, footprint = [0.2, 0.1] }) {
    const before = Math.round(behind / spacing);
    const beside = Math.round(half_width / spacing);
    /** Points along x and along y. */
    this.shape = [Math.round(ahead / spacing) + before + 1, 2 * beside + 1];
    const [rows, columns] = this.shape;
    this.count = rows * columns;
    /** The points one after another, x and y in turn; x varies slowest, from behind to ahead. */
    this.points = new Float32Array(2 * this.count);
    /** Which points lie under the robot. */
    this.footprint = [];
    for (let i = 0; i < this.count; i++) {
      const x = (Math.floor(i / columns) - before) * spacing;
      const y = ((i % columns) - beside) * spacing;
      this.points[2 * i] = x;
      this.points[2 * i + 1] = y;
      if (Math.abs(x) <= footprint[0] + 1e-6 && Math.abs(y) <= footprint[1] + 1e-6) {
        this.footprint.push(i);
      }
    }
  }
}

/**
 * Interpolate heights bilinearly at one point; beyond the border the edge cell continues.
 *
 * Places are rounded to 32 bits, as torch does it.
 *
 * @param {HeightMap} map
 * @returns {number}
 */
export function heightAt(map, x, y) {
  const { heights, nx, ny, resolution, origin } = map;
  const side = fround(resolution);
  const u = clamp(fround(fround(fround(fround(x) - origin[0]) / side) - 0.5), 0, nx - 1);
  const v = clamp(fround(fround(fround(fround(y) - origin[1]) / side) - 0.5), 0, ny - 1);
  const i = Math.min(Math.floor(u), Math.max(nx - 2, 0));
  const j = Math.min(Math.floor(v), Math.max(ny - 2, 0));
  const a = u - i;
  const b = v - j;
  const base = i * ny + j;
  const right = nx > 1 ? ny : 0;
  const up = ny > 1 ? 1 : 0;
  const near = heights[base] * (1 - b) + heights[base + up] * b;
  const far = heights[base + right] * (1 - b) + heights[base + right + up] * b;
  return near * (1 - a) + far * a;
}

/**
 * Interpolate heights at points x, y, x, y ...
 *
 * @param {HeightMap} map
 * @param {ArrayLike<number>} xy
 * @param {Float32Array} [out] - Where to write them.
 * @returns {Float32Array}
 */
export function sampleHeights(map, xy, out = new Float32Array(xy.length / 2)) {
  for (let i = 0; i < out.length; i++) out[i] = heightAt(map, xy[2 * i], xy[2 * i + 1]);
  return out;
}

/**
 * Turn yaw-frame points x, y, x, y ... into the world's directions.
 *
 * @param {ArrayLike<number>} points
 * @param {number} yaw - rad
 * @param {Float32Array} [out]
 * @returns {Float32Array}
 */
export function rotate(points, yaw, out = new Float32Array(points.length)) {
  const cos = Math.cos(yaw);
  const sin = Math.sin(yaw);
  for (let i = 0; i < points.length; i += 2) {
    out[i] = cos * points[i] - sin * points[i + 1];
    out[i + 1] = sin * points[i] + cos * points[i + 1];
  }
  return out;
}

/**
 * Return the median height of the points under the footprint; the lower of the two middle ones if
 * their number is even.
 *
 * @param {ArrayLike<number>} patch
 * @param {PatchGrid} grid
 * @param {number} [from] - Where the patch begins.
 */
export function groundHeight(patch, grid, from = 0) {
  const under = grid.footprint.map((i) => patch[from + i]).sort((a, b) => a - b);
  return under[(under.length - 1) >> 1];
}

/**
 * Cut the patch H_xy at each pose x, y, yaw, x, y, yaw ..., relative to the ground beneath it.
 *
 * @param {HeightMap} map
 * @param {ArrayLike<number>} poses
 * @param {PatchGrid} grid
 * @returns {Float32Array} The patches one after another.
 */
export function samplePatches(map, poses, grid) {
  const patches = new Float32Array((poses.length / 3) * grid.count);
  const offsets = new Float32Array(2 * grid.count);
  let turned = NaN;
  for (let p = 0, from = 0; p < poses.length; p += 3, from += grid.count) {
    if (poses[p + 2] !== turned) rotate(grid.points, poses[p + 2], offsets);
    turned = poses[p + 2];
    for (let i = 0; i < grid.count; i++) {
      const x = poses[p] + offsets[2 * i];
      patches[from + i] = heightAt(map, x, poses[p + 1] + offsets[2 * i + 1]);
    }
    const ground = groundHeight(patches, grid, from);
    for (let i = 0; i < grid.count; i++) patches[from + i] -= ground;
  }
  return patches;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
