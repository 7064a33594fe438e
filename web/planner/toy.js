/**
 * The toy: two wheels on extensible legs, in the vertical slice of the map along its heading.
 *
 * Reads a `World` and the toy's physics (munk/munk.js); gives what a policy observes, where the toy
 * is, and whether it has fallen. Mirrors fgtutor/robots/toy.py, one toy for a batch of them, and
 * `patches` and `steer` of fgtutor/robots/base.py. Numbers agree with Python's: see
 * tests/test_site_planner.py.
 */

import { heightAt, PatchGrid, samplePatches } from "../js/heights.js";

/** How far a cut reaches behind and ahead of where it was made, m. */
const SLICE = [1.5, 3.5];
/** A cut serves until the robot comes this close to one of its ends, m. */
const ROOM = 0.8;
/** Where ground segments lie that no cut needs, m. */
const PARKED = -1000;
/** Neighbouring cells that differ by more than this meet in a vertical edge, m. */
export const CLIFF = 0.09;
/** Change of yaw after which the map is cut anew, rad. */
const RECUT = 0.05;
/** A toy pitched further than this has rolled over, rad. */
const MAX_PITCH = 1.1;
/** An axle this far below the ground on both sides has dropped into a hole, m. */
const DROP = 0.28;
/** How far from an axle that ground is looked for, m. */
const HOLE = 0.45;
/** Width of the ground around a map that continues its edge, m. */
const MARGIN = 1.5;

/** The toy's body; see `ToyModel` in Python for what each number is. */
export const MODEL = {
  chassisMass: 8.0,
  chassisSize: [0.56, 0.1],
  wheelMass: 1.0,
  wheelRadius: 0.09,
  halfBase: 0.25,
  legRange: [0.1, 0.38],
  stance: 0.2,
  legStiffness: 2500.0,
  legDamping: 90.0,
  legStroke: 0.16,
  legSpeed: 2.0,
  wheelTorque: 7.0,
  wheelBoost: 1.0,
  friction: 1.0,
  dt: 0.005,
  substeps: 8,
};
/** Seconds between two actions. */
export const CONTROL_DT = MODEL.dt * MODEL.substeps;
/** The toy's patch. */
export const GRID = new PatchGrid({
  ahead: 1.2,
  behind: 0.5,
  half_width: 0.2,
  footprint: [0.3, 0.1],
});

/** A map with the margin around it that a robot may stray onto; its corner is (0, 0). */
export class World {
  /**
   * @param {import("../js/heights.js").HeightMap} ground - What the toy drives on.
   * @param {import("../js/heights.js").HeightMap} prepared - What its patches are cut from.
   */
  constructor(ground, prepared) {
    const cells = Math.round(MARGIN / ground.resolution);
    this.ground = padded(ground, cells);
    this.seen = padded(prepared, cells);
    /** What to add to a place on the map for its place in the world, m. */
    this.offset = ground.origin.map((corner) => cells * ground.resolution - corner);
  }
}

/** Return a map with `cells` more at each side, which continue its edge. */
function padded({ heights, nx, ny, resolution }, cells) {
  const wide = nx + 2 * cells;
  const high = ny + 2 * cells;
  const out = new Float32Array(wide * high);
  for (let i = 0; i < wide; i++) {
    const from = clamp(i - cells, 0, nx - 1) * ny;
    for (let j = 0; j < high; j++) out[i * high + j] = heights[from + clamp(j - cells, 0, ny - 1)];
  }
  return { heights: out, nx: wide, ny: high, resolution, origin: [0, 0] };
}

/**
 * Return the bends [s, h] of a sampled profile; an edge becomes two vertices at the same s.
 *
 * @param {ArrayLike<number>} s
 * @param {ArrayLike<number>} h
 * @returns {[number, number][]}
 */
export function polyline(s, h) {
  const last = s.length - 1;
  const jump = (i) => i >= 0 && i < last && Math.abs(h[i + 1] - h[i]) > CLIFF / 2;
  const vertices = [];
  for (let i = 0; i <= last; i++) {
    const curved = i === 0 || i === last || Math.abs(h[i + 1] - h[i] - (h[i] - h[i - 1])) > 1e-4;
    if (curved || jump(i - 1) || jump(i)) vertices.push([s[i], h[i]]);
    if (jump(i)) {
      const middle = (s[i] + s[i + 1]) / 2;
      vertices.push([middle, h[i]], [middle, h[i + 1]]);
    }
  }
  return vertices;
}

/**
 * Sample the ground along a ray. Gentle ground is interpolated between cell centres; where
 * neighbouring cells differ by more than `CLIFF` each keeps its height, so that the edge between
 * them stays vertical.
 *
 * @param {import("../js/heights.js").HeightMap} map
 * @param {ArrayLike<number>} s - Distances along the ray, m.
 * @returns {Float64Array}
 */
export function profile({ heights, nx, ny, resolution, origin }, [x, y], yaw, s) {
  const cos = Math.cos(yaw);
  const sin = Math.sin(yaw);
  const h = new Float64Array(s.length);
  for (let n = 0; n < s.length; n++) {
    const u = clamp((x + s[n] * cos - origin[0]) / resolution - 0.5, 0, nx - 1);
    const v = clamp((y + s[n] * sin - origin[1]) / resolution - 0.5, 0, ny - 1);
    const i = Math.min(Math.floor(u), nx - 2);
    const j = Math.min(Math.floor(v), ny - 2);
    const a = u - i;
    const b = v - j;
    const base = i * ny + j;
    const h00 = heights[base];
    const h01 = heights[base + 1];
    const h10 = heights[base + ny];
    const h11 = heights[base + ny + 1];
    if (Math.max(h00, h01, h10, h11) - Math.min(h00, h01, h10, h11) > CLIFF) {
      h[n] = heights[base + (a >= 0.5 ? ny : 0) + (b >= 0.5 ? 1 : 0)];
    } else {
      h[n] = (h00 * (1 - b) + h01 * b) * (1 - a) + (h10 * (1 - b) + h11 * b) * a;
    }
  }
  return h;
}

/** One toy in a space of its own. Places are those of the world. */
export class Toy {
  /**
   * @param {import("./munk/munk.js").Munk} munk
   * @param {World} world
   */
  constructor(munk, world) {
    this.munk = munk;
    this.world = world;
    /** The commanded velocity vx, vy and turn rate. */
    this.command = new Float32Array(3);
    /** x, y, angle, vx, vy and angular velocity of chassis, rear and front wheel. */
    this.state = new Float64Array(18);
    this.build();
  }

  /** Add a chassis, and two wheels that slide on grooves under spring and motor. */
  build() {
    const { calls } = this.munk;
    const m = MODEL;
    this.space = calls.space_new(-9.81, 12);
    const chassis = calls.box(this.space, 0, 0, m.chassisMass, ...m.chassisSize, 0.01, 0.4);
    this.bodies = [chassis];
    this.legs = [];
    this.motors = [];
    this.segments = [];
    this.laid = 0;
    for (const side of [-1, 1]) {
      const hip = side * m.halfBase;
      const size = [m.wheelMass, m.wheelRadius, m.friction];
      const wheel = calls.circle(this.space, hip, -m.stance, ...size);
      calls.groove(this.space, chassis, wheel, hip, ...m.legRange);
      const spring = [m.stance, m.legStiffness, m.legDamping];
      this.legs.push(calls.spring(this.space, chassis, wheel, hip, ...spring));
      this.motors.push(calls.motor(this.space, chassis, wheel, m.wheelTorque));
      this.bodies.push(wheel);
    }
    // The toy drives along a ray: (x, y) = start + (s - offset) (cos, sin)(yaw).
    this.ray = { start: [0, 0], offset: 0, yaw: 0 };
    this.yaw = this.yawRate = this.speed = 0;
    this.legTarget = [m.stance, m.stance];
    this.lastAction = new Float32Array(4);
    this.read();
  }

  read() {
    this.bodies.forEach((body, i) => this.munk.read(body, this.state, 6 * i));
  }

  /** Set wheel rates and leg lengths, turn by the commanded rate, and simulate a control step. */
  advance(action) {
    const { calls } = this.munk;
    const m = MODEL;
    const a = Float32Array.from(action, (value) => clamp(value, -1, 1));
    this.lastAction = a;
    const most = m.legSpeed * CONTROL_DT;
    for (const i of [0, 1]) {
      const goal = clamp(m.stance + m.legStroke * a[2 + i], ...m.legRange);
      this.legTarget[i] += clamp(goal - this.legTarget[i], -most, most);
    }
    this.yawRate = this.command[2];
    this.turn(this.yawRate * CONTROL_DT);
    for (const i of [0, 1]) {
      // The motor drives the angular velocity of chassis minus wheel; forward is clockwise.
      const surface = this.command[0] + m.wheelBoost * a[i];
      calls.motor_rate(this.motors[i], surface / m.wheelRadius);
      calls.spring_rest(this.legs[i], this.legTarget[i]);
    }
    calls.space_step(this.space, m.dt, m.substeps);
    const before = this.state[0];
    this.read();
    // The mean over the control step: a hop or a jolt must not look like tracking.
    this.speed = (this.state[0] - before) / CONTROL_DT;
  }

  // Places -------------------------------------------------------------------------------------

  /** Put the toy at rest, both wheels on the ground. */
  place(x, y, yaw) {
    const m = MODEL;
    this.yaw = yaw;
    this.state.fill(0);
    const { s, h } = this.cut([x, y]);
    const under = (side) => {
      const near = h.filter((_, i) => Math.abs(s[i] - side * m.halfBase) <= m.wheelRadius);
      return Math.max(...near);
    };
    const rear = under(-1);
    const front = under(1);
    const pitch = Math.atan2(front - rear, 2 * m.halfBase);
    const z = (rear + front) / 2 + m.wheelRadius + m.stance + 0.01;
    const cos = Math.cos(pitch);
    const sin = Math.sin(pitch);
    [0, -1, 1].forEach((side, i) => {
      const a = side * m.halfBase;
      const b = -m.stance * Math.abs(side);
      const at = [cos * a - sin * b, z + sin * a + cos * b];
      this.munk.calls.body_set(this.space, this.bodies[i], ...at, pitch);
    });
    this.legTarget = [m.stance, m.stance];
    this.lastAction = new Float32Array(4);
    this.speed = 0;
    this.read();
  }

  /** Return the chassis' place (x, y). */
  position() {
    const { start, offset, yaw } = this.ray;
    const s = this.state[0] - offset;
    return [start[0] + s * Math.cos(yaw), start[1] + s * Math.sin(yaw)];
  }

  /** Cut the map along the yaw through `place`, lay the cut, and return it as sampled. */
  cut(place) {
    this.ray = { start: place, offset: this.state[0], yaw: this.yaw };
    const step = this.world.ground.resolution / 2;
    const between = -SLICE[0] + step + SLICE[0]; // as numpy's arange counts
    const count = Math.ceil((SLICE[1] + 1e-9 + SLICE[0]) / step);
    const s = Float64Array.from({ length: count }, (_, i) => -SLICE[0] + i * between);
    const h = profile(this.world.ground, place, this.yaw, s);
    this.lay(polyline(s, h).map(([a, b]) => [a + this.ray.offset, b]));
    return { s, h };
  }

  /** Move the ground segments onto a polyline; those not needed are parked. */
  lay(vertices) {
    const { calls } = this.munk;
    const used = vertices.length - 1;
    while (this.segments.length < used) {
      this.segments.push(calls.segment(this.space, 0, PARKED, MODEL.friction));
    }
    for (let i = 0; i < Math.max(used, this.laid); i++) {
      const ends = i < used ? [...vertices[i], ...vertices[i + 1]] : [0, PARKED, 0, PARKED];
      calls.segment_move(this.space, this.segments[i], ...ends);
    }
    this.laid = used;
  }

  /** Turn by `angle`, rad; cut the map anew where the last cut no longer serves. */
  turn(angle) {
    this.yaw += angle;
    const travelled = this.state[0] - this.ray.offset;
    const turned = Math.abs(this.yaw - this.ray.yaw) > RECUT;
    if (turned || travelled < ROOM - SLICE[0] || travelled > SLICE[1] - ROOM) {
      this.cut(this.position());
    }
  }

  // What a policy and a follower ask ---------------------------------------------------------------

  /** Return the pose x, y, z, yaw, in the precision that policies see. */
  pose() {
    return Float32Array.of(...this.position(), this.state[1], this.yaw);
  }

  /** Return what the policy observes: its body, the command, and the middle line of its patch. */
  observe() {
    const [rows, columns] = GRID.shape;
    const [x, y, , yaw] = this.pose();
    const patch = samplePatches(this.world.seen, [x, y, yaw], GRID);
    const observation = new Float32Array(21 + rows);
    observation.set(this.proprioception());
    observation.set(this.command, 18);
    for (let i = 0; i < rows; i++) observation[21 + i] = 4 * patch[i * columns + (columns >> 1)];
    return observation;
  }

  /** Return pitch, speeds, height above ground, legs, wheel speeds and the last action. */
  proprioception() {
    const m = MODEL;
    const { state } = this;
    const [, z, pitch, , vz, rate] = state;
    const legs = [6, 12].map((at) => this.leg(at));
    const height = z - this.groundUnder();
    return [
      Math.sin(pitch),
      Math.cos(pitch),
      0.2 * rate,
      this.speed,
      vz,
      3 * (height - m.stance - m.wheelRadius),
      ...legs.map(([length]) => 5 * (length - m.stance)),
      ...this.legTarget.map((length) => 5 * (length - m.stance)),
      ...legs.map(([, change]) => 0.3 * change),
      -m.wheelRadius * state[11],
      -m.wheelRadius * state[17],
      ...this.lastAction,
    ];
  }

  /** Return the length of the leg to the wheel whose state begins at `at`, m, and its rate, m/s. */
  leg(at) {
    const { state } = this;
    const x = Math.sin(state[2]);
    const y = -Math.cos(state[2]);
    return [
      (state[at] - state[0]) * x + (state[at + 1] - state[1]) * y,
      (state[at + 3] - state[3]) * x + (state[at + 4] - state[4]) * y,
    ];
  }

  groundUnder() {
    const s = this.state[0] - this.ray.offset;
    return [-0.25, 0, 0.25].map((by) => this.groundAt(s + by)).sort((a, b) => a - b)[1];
  }

  /** Return the ground's height at a distance along the ray. */
  groundAt(s) {
    const { start, yaw } = this.ray;
    const [x, y] = [start[0] + s * Math.cos(yaw), start[1] + s * Math.sin(yaw)];
    return heightAt(this.world.ground, x, y);
  }

  /** Tell whether the toy has rolled over or dropped an axle into a hole: "" if neither. */
  fallen() {
    if (Math.abs(this.state[2]) > MAX_PITCH) return "rolled over";
    // In a hole the ground is higher on both sides; beside a wall it is on one.
    const dropped = [6, 12].some((at) => {
      const s = this.state[at] - this.ray.offset;
      const highest = (side) => {
        let top = -Infinity;
        for (let i = 0; i < 6; i++) {
          top = Math.max(top, this.groundAt(s + side * Math.fround((HOLE * i) / 5)));
        }
        return top;
      };
      return this.state[at + 1] < Math.min(highest(-1), highest(1)) - DROP;
    });
    return dropped ? "dropped a wheel into a hole" : "";
  }
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
