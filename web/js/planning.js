/**
 * Plan a route: Dijkstra's search over cells and policies, or the reason why there is none.
 *
 * Reads F_i of every policy, F_max and P, the map, a start and a goal in metres; gives a route or a
 * refusal. Mirrors fgtutor/planning.py, graphs.py, routes.py and settings.py (paper, Sec. III-C;
 * the switching cost is ours). A state is a cell with the policy that led to it; a step with
 * another policy costs `switchCost` more, and exists only where both policies are feasible.
 */

/**
 * @typedef {object} PlanSettings
 * @property {"length" | "inverse"} cost
 * @property {number} fMin
 * @property {number} switchCost
 * @property {number} leastPromise - What a route has to promise; 0: any will do.
 */

/** Our settings: what every table uses. */
export const OURS = {
  taus: "calibrated",
  cost: "length",
  fMin: 0.1,
  switchCost: 1,
  leastPromise: 0.25,
};
/** The paper's: its thresholds on L_recon, cost 1 / F, free switching; any route will do. */
export const PAPER = {
  taus: [0.1, 2.0],
  cost: "inverse",
  fMin: 0.1,
  switchCost: 0,
  leastPromise: 0,
};

/** Walks that end per metre are exp(HAZARD - RELIEF F); fitted to drives of the A1. */
const [HAZARD, RELIEF] = [4, 20];
/** By how much the least F of a step is raised to find a route that promises more. */
const RAISE = 0.05;

/**
 * @typedef {object} Route
 * @property {[number, number][]} cells - From start to goal.
 * @property {[number, number][]} xy - Their centres, m.
 * @property {number[]} headings - Of each step.
 * @property {number[]} policies - Of each step, an index into `names`.
 * @property {number[]} feasibility - F of that policy for that step.
 * @property {number[]} costs - What each step adds, a switch before it included.
 * @property {number} cost - Their sum.
 * @property {number} length - m
 * @property {number} switches
 * @property {number} promise - How likely the route is to be driven to its end.
 *
 * @typedef {object} Refusal
 * @property {string} reason
 * @property {[number, number]} [nearest] - The reached cell nearest to the goal, or where the worst
 *   step of a route begins that promises too little.
 * @property {number} [heading] - The heading on from there.
 */

/**
 * Return the cheapest route, or a refusal: `{route}` or `{refusal}`.
 *
 * @param {object} problem
 * @param {Float32Array[]} problem.tensors - F_i of each policy of the team.
 * @param {Float32Array} problem.fused
 * @param {Uint8Array} problem.policyMap
 * @param {import("./heights.js").HeightMap} problem.map
 * @param {Uint8Array} problem.known - Which cells were observed.
 * @param {Int32Array} problem.steps - Where each step ends, -1 if nowhere; see `stepsWithin`.
 * @param {import("./directions.js").Headings} problem.headings
 * @param {[number, number]} problem.start - m
 * @param {[number, number]} problem.goal - m
 * @param {PlanSettings} problem.settings
 * @returns {{route?: Route, refusal?: Refusal}}
 */
export function plan({ tensors, fused, policyMap, map, known, steps, headings, ...asked }) {
  const { start, goal, settings } = asked;
  const ends = [start, goal].map((point) => cellOf(map, point));
  for (const [i, role] of ["start", "goal"].entries()) {
    if (!ends[i]) return refuse(`the ${role} is off the map: move it inside`);
    if (!known[ends[i][0] * map.ny + ends[i][1]]) {
      return refuse(`the ${role} lies on a cell that was never observed: move the ${role}`);
    }
  }
  const layers = settings.switchCost > 0 ? tensors : [fused];
  const search = new Search(layers, map, steps, headings, settings);
  const [first, last] = ends.map(([ix, iy]) => ix * map.ny + iy);
  if (first === last) return { route: search.route([[0, first]], policyMap) };
  const cure = `lower f_min = ${settings.fMin}, or add a specialist for this terrain`;
  if (!search.leaves(first)) {
    const of = (k) => fused[first * headings.count + k];
    const best = headings.steps.reduce((top, _, k) => (of(k) > of(top) ? k : top), 0);
    return refuse(
      `no policy can leave the start: its best F_max is ${of(best).toPrecision(2)}, towards ` +
        `${headings.names[best]}; move the start, ${cure}`,
    );
  }
  if (!search.entered(last)) {
    return refuse(
      `no policy can enter the goal from any of its neighbours; move the goal, ${cure}`,
    );
  }
  const states = search.run(first, last);
  if (states) {
    const cheapest = search.route(states, policyMap);
    let route = cheapest;
    for (let { fMin } = settings; route.promise < settings.leastPromise; ) {
      fMin += RAISE;
      const surer = new Search(layers, map, steps, headings, { ...settings, fMin });
      const found = surer.run(first, last);
      if (!found) return doubt(cheapest, settings);
      route = surer.route(found, policyMap);
    }
    return { route };
  }
  const [cell, heading] = search.nearest(ends[1]);
  const [x, y] = centreOf(map, cell);
  return refuse(
    `start and goal can both be used, but no chain of steps with F >= ${settings.fMin} joins ` +
      `them: the place nearest to the goal that can be reached is (${x.toFixed(2)}, ` +
      `${y.toFixed(2)}) m; lower f_min, move one of them or add a specialist`,
    cell,
    heading,
  );
}

/** Refuse a route that promises too little, and say which of its steps is the worst. */
function doubt(route, { leastPromise }) {
  const F = Math.min(...route.feasibility);
  const worst = route.feasibility.indexOf(F);
  const place = route.xy[worst].map((value) => value.toFixed(2)).join(", ");
  return refuse(
    `the cheapest route, ${route.length.toFixed(2)} m long, promises ${route.promise.toFixed(2)}, ` +
      `less than ${leastPromise}, and no way round its worst steps was found: the worst, with F = ` +
      `${F.toFixed(2)}, begins at (${place}) m; move start or goal, add a specialist, or lower ` +
      "the least promise to walk it all the same",
    route.cells[worst],
    route.headings[worst],
  );
}

function refuse(reason, nearest, heading) {
  return { refusal: { reason, nearest, heading } };
}

/** Return the cell that holds a point, or null off the map. */
export function cellOf({ nx, ny, resolution, origin }, point) {
  const cell = point.map((value, i) => Math.floor((value - origin[i]) / resolution + 1e-8));
  return cell.every((n, i) => n >= 0 && n < [nx, ny][i]) ? cell : null;
}

/** Return the centre of a cell, m. */
export function centreOf({ resolution, origin }, [ix, iy]) {
  return [origin[0] + (ix + 0.5) * resolution, origin[1] + (iy + 0.5) * resolution];
}

/** Dijkstra's search over layers of feasibility: one for free switching, else one per policy. */
class Search {
  constructor(tensors, map, ends, headings, { cost, fMin, switchCost }) {
    Object.assign(this, { map, ends, headings, switchCost });
    this.cells = map.nx * map.ny;
    // F where there is an edge, 0 elsewhere.
    this.layers = tensors.map((tensor) =>
      tensor.map((f, at) => (ends[at] >= 0 && f >= fMin ? f : 0)),
    );
    this.per = headings.steps.map((_, k) =>
      cost === "inverse" ? headings.moves[k] : headings.lengths[k] * map.resolution,
    );
  }

  leaves(cell) {
    const d = this.headings.count;
    return this.layers.some((layer) => layer.subarray(cell * d, cell * d + d).some((f) => f > 0));
  }

  entered(cell) {
    return this.layers.some((layer) => layer.some((f, at) => f > 0 && this.ends[at] === cell));
  }

  /** Return the cheapest chain of [layer, cell] from one cell to another, or null. */
  run(first, last) {
    const { cells, ends, layers, per, switchCost } = this;
    const d = this.headings.count;
    const count = layers.length;
    this.distance = new Float64Array(count * cells).fill(Infinity);
    const from = new Int32Array(count * cells).fill(-1);
    const { distance } = this;
    const heap = new Heap();
    for (let layer = 0; layer < count; layer++) {
      distance[layer * cells + first] = 0;
      heap.push(0, layer * cells + first);
    }
    while (heap.size) {
      const [far, state] = heap.pop();
      if (far > distance[state]) continue;
      const old = Math.floor(state / cells);
      const cell = state - old * cells;
      if (cell === last) return chain(from, state, cells);
      for (let at = cell * d, k = 0; k < d; k++, at++) {
        if (!layers[old][at]) continue;
        for (let layer = 0; layer < count; layer++) {
          const f = layers[layer][at];
          if (!f) continue;
          const next = layer * cells + ends[at];
          const reached = far + per[k] / f + (layer === old ? 0 : switchCost);
          if (reached < distance[next]) {
            distance[next] = reached;
            from[next] = state;
            heap.push(reached, next);
          }
        }
      }
    }
    return null;
  }

  /** Return the reached cell nearest to the goal, and the heading on from it. */
  nearest([gx, gy]) {
    const { ny } = this.map;
    let best = null;
    let least = Infinity;
    for (let cell = 0; cell < this.cells; cell++) {
      if (!this.layers.some((_, i) => this.distance[i * this.cells + cell] < Infinity)) continue;
      const [ix, iy] = [Math.floor(cell / ny), cell % ny];
      const away = (ix - gx) ** 2 + (iy - gy) ** 2;
      if (away < least) [best, least] = [[ix, iy], away];
    }
    return [best, this.headings.towards([gx - best[0], gy - best[1]])];
  }

  /** Describe a chain of states. */
  route(states, policyMap) {
    const { headings, map, per, switchCost } = this;
    const cells = states.map(([, cell]) => [Math.floor(cell / map.ny), cell % map.ny]);
    const steps = states.slice(1).map(([layer], i) => {
      const [old, cell] = states[i];
      const by = [cells[i + 1][0] - cells[i][0], cells[i + 1][1] - cells[i][1]];
      const k = headings.steps.findIndex(([a, b]) => a === by[0] && b === by[1]);
      const f = this.layers[layer][cell * headings.count + k];
      const policy = switchCost > 0 ? layer : policyMap[cell * headings.count + k];
      return { k, f, policy, cost: per[k] / f + (layer === old ? 0 : switchCost) };
    });
    const metres = steps.map(({ k }) => headings.lengths[k] * map.resolution);
    const ends = steps.map(({ f }, i) => metres[i] * Math.exp(HAZARD - RELIEF * f));
    return {
      cells,
      xy: cells.map((cell) => centreOf(map, cell)),
      headings: steps.map(({ k }) => k),
      policies: steps.map(({ policy }) => policy),
      feasibility: steps.map(({ f }) => f),
      costs: steps.map(({ cost }) => cost),
      cost: sum(steps.map(({ cost }) => cost)),
      length: sum(metres),
      switches: steps.filter(({ policy }, i) => i && policy !== steps[i - 1].policy).length,
      promise: Math.exp(-sum(ends)),
    };
  }
}

/** Return the states from the first to this one, as [layer, cell]. */
function chain(from, state, cells) {
  const states = [];
  for (; state >= 0; state = from[state]) states.push([Math.floor(state / cells), state % cells]);
  return states.reverse();
}

function sum(values) {
  return values.reduce((total, value) => total + value, 0);
}

/** A binary heap of [key, value] pairs, the smallest key first. */
class Heap {
  constructor() {
    this.keys = [];
    this.values = [];
  }

  get size() {
    return this.keys.length;
  }

  push(key, value) {
    const { keys, values } = this;
    let at = keys.length;
    while (at > 0) {
      const above = (at - 1) >> 1;
      if (keys[above] <= key) break;
      keys[at] = keys[above];
      values[at] = values[above];
      at = above;
    }
    keys[at] = key;
    values[at] = value;
  }

  pop() {
    const { keys, values } = this;
    const top = [keys[0], values[0]];
    const key = keys.pop();
    const value = values.pop();
    const size = keys.length;
    if (!size) return top;
    let at = 0;
    for (;;) {
      let below = 2 * at + 1;
      if (below >= size) break;
      if (below + 1 < size && keys[below + 1] < keys[below]) below++;
      if (keys[below] >= key) break;
      keys[at] = keys[below];
      values[at] = values[below];
      at = below;
    }
    keys[at] = key;
    values[at] = value;
    return top;
  }
}
