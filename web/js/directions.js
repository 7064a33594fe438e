/**
 * The d headings: their order, yaw angles and cell steps (paper, Sec. III-B, where d is 8).
 *
 * Mirrors fgtutor/directions.py. Headings are ordered counter-clockwise from +x. Arrays over a map
 * are flat: cell (ix, iy) stands at ix * ny + iy, its heading k at (ix * ny + iy) * d + k.
 */

/** The steps of each number of headings from +x to before the diagonal. */
const EIGHTHS = {
  8: [[1, 0]],
  16: [[1, 0], [2, 1]],
  32: [[1, 0], [3, 1], [2, 1], [3, 2]],
  48: [[1, 0], [6, 1], [3, 1], [2, 1], [3, 2], [5, 4]],
};

/** The headings that a robot may leave a cell along: 8 (the paper's), 16, 32 or 48. */
export class Headings {
  /** @param {8 | 16 | 32 | 48} count */
  constructor(count = 8) {
    const eighth = EIGHTHS[count];
    if (!eighth) throw new Error(`there are no ${count} headings`);
    this.count = count;
    const mirrored = eighth.slice(1).reverse().map(([a, b]) => [b, a]);
    const quarter = [...eighth, [1, 1], ...mirrored];
    /** Cell step [dix, diy] of each heading. */
    this.steps = [
      [1, 0, 0, 1],
      [0, -1, 1, 0],
      [-1, 0, 0, -1],
      [0, 1, -1, 0],
    ].flatMap(([p, q, r, s]) => quarter.map(([a, b]) => [p * a + q * b, r * a + s * b]));
    /** Yaw of each heading, rad from 0 to 2 pi. */
    this.yaws = this.steps.map(([a, b]) => (Math.atan2(b, a) + 2 * Math.PI) % (2 * Math.PI));
    /** Length of each step in cells. */
    this.lengths = this.steps.map(([a, b]) => Math.hypot(a, b));
    /** How many of the paper's steps each step counts for: a king's moves. */
    this.moves = this.steps.map(([a, b]) => Math.max(Math.abs(a), Math.abs(b)));
    /** How each heading is named: "+x", "+2x+y", "+x+y". */
    this.names = this.steps.map(([a, b]) => part(a, "x") + part(b, "y"));
    /** The cells that each step passes through between its ends, seen from where it starts. */
    this.between = this.steps.map(passed);
  }

  /** Return the heading that points most nearly the way of a step. */
  towards([dx, dy]) {
    const along = this.steps.map(([a, b], k) => (a * dx + b * dy) / this.lengths[k]);
    return along.indexOf(Math.max(...along));
  }

  /**
   * Return where each step from each cell ends, or -1 unless it starts from, passes through and
   * ends on usable cells of the map only.
   *
   * @param {Uint8Array} usable - For each cell, 1 or 0.
   * @returns {Int32Array} At cell * d + heading.
   */
  stepsWithin(usable, nx, ny) {
    const ends = new Int32Array(nx * ny * this.count).fill(-1);
    const open = (ix, iy) => ix >= 0 && iy >= 0 && ix < nx && iy < ny && usable[ix * ny + iy];
    for (let cell = 0; cell < nx * ny; cell++) {
      if (!usable[cell]) continue;
      const [ix, iy] = [Math.floor(cell / ny), cell % ny];
      this.steps.forEach(([a, b], k) => {
        const through = this.between[k].every(([i, j]) => open(ix + i, iy + j));
        if (through && open(ix + a, iy + b)) ends[cell * this.count + k] = cell + a * ny + b;
      });
    }
    return ends;
  }
}

/** Name a step along one axis. */
function part(cells, axis) {
  if (!cells) return "";
  return (cells > 0 ? "+" : "-") + (Math.abs(cells) > 1 ? Math.abs(cells) : "") + axis;
}

/** Return the cells whose interior the straight segment of a step meets between its ends. */
function passed([a, b]) {
  const cells = [];
  for (let i = Math.min(a, 0); i <= Math.max(a, 0); i++) {
    for (let j = Math.min(b, 0); j <= Math.max(b, 0); j++) {
      const end = (i === 0 && j === 0) || (i === a && j === b);
      if (!end && 2 * Math.abs(i * b - j * a) < Math.abs(a) + Math.abs(b)) cells.push([i, j]);
    }
  }
  return cells;
}
