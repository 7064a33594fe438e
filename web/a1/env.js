/**
 * The Unitree A1 in MuJoCo (WebAssembly): one robot, undisturbed, 50 actions a second.
 *
 * Mirrors fgtutor/robots/a1/env.py and observation.py under evaluation's settings: no noise, no
 * delay, the true velocity. Reads `robot.json` and a ground as web/a1/export.py writes them. Values
 * are rounded to 32 bits where torch does so.
 */

import { heightAt, PatchGrid, rotate } from "../js/heights.js";

const { cos, fround, max, min, sin } = Math;

/** Bounds of what a policy is told. */
const LARGEST = 20;
/** Where the feet stand in the stance, in the yaw frame, m (fgtutor/robots/a1/footing.py). */
const FEET = [0.17, -0.155, 0.17, 0.155, -0.22, -0.155, -0.22, 0.155];
/** Gap between the feet and the ground where a robot is placed, m. */
const GAP = 0.01;

/** Return numbers that Python wrote as base64 of 32-bit floats. */
export function decodeFloats(text) {
  return new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

/** Return a map of a ground for heights.js, from what Python wrote. */
function readMap(map, values) {
  return { ...map, heights: decodeFloats(map[values]) };
}

/** Return MuJoCo's XML of the robot on a ground's boxes. */
export function worldXml(robotXml, boxes) {
  const geoms = boxes.map((box) => {
    const [centre, half, quat] = [box.slice(0, 3), box.slice(3, 6), box.slice(6)];
    const turned = quat.length ? ` quat="${quat.join(" ")}"` : "";
    const place = `pos="${centre.join(" ")}" size="${half.join(" ")}"`;
    return `<geom type="box" contype="0" conaffinity="1" ${place}${turned}/>`;
  });
  return robotXml.replace("<worldbody>", `<worldbody>${geoms.join("")}`);
}

/** One A1 on one ground. */
export class A1Env {
  /**
   * @param {object} mujoco - The module of @mujoco/mujoco.
   * @param {object} robot - `robot.json`.
   * @param {object} ground - A ground of `grounds.json`.
   */
  constructor(mujoco, robot, ground) {
    this.mujoco = mujoco;
    this.robot = robot;
    this.corner = ground.corner;
    this.map = readMap(ground.map, "heights");
    this.rims = readMap(ground.map, "rims");
    this.model = mujoco.MjModel.from_xml_string(worldXml(robot.xml, ground.boxes));
    this.data = new mujoco.MjData(this.model);
    this.grid = new PatchGrid(robot.scan.grid);
    this.turned = new Float32Array(2 * this.grid.count);
    this.stance = Float32Array.from(robot.stance);
    this.scales = Float32Array.from(robot.scales.flatMap(([n, scale]) => Array(n).fill(scale)));
    this.felt = this.scales.length;
    this.lastAction = new Float32Array(this.stance.length);
    this.observation = new Float32Array(this.felt + 3 + this.grid.count);
    /** The last frames of what a policy feels that is not told its velocity; the newest last. */
    this.frames = new Float32Array(robot.history * this.felt);
    this.clock = 0;
    this.broken = false;
  }

  /** Free the simulator's memory. */
  delete() {
    this.data.delete();
    this.model.delete();
  }

  /** Put the robot at rest in its stance on level ground at (x, y, yaw), in the terrain's frame. */
  place(x, y, yaw) {
    const { mujoco, model, data, robot, corner } = this;
    const feet = rotate(FEET, yaw);
    let under = -Infinity;
    for (let i = 0; i < feet.length; i += 2) {
      under = max(under, heightAt(this.map, x + feet[i], y + feet[i + 1]));
    }
    mujoco.mj_resetData(model, data);
    const z = under + robot.stance_height + GAP;
    const quat = [cos(yaw / 2), 0, 0, sin(yaw / 2)];
    data.qpos.set([x + corner[0], y + corner[1], z, ...quat, ...this.stance]);
    data.ctrl.set(this.stance);
    this.lastAction.fill(0);
    this.frames.fill(0);
    this.clock = 0;
    this.broken = false;
    mujoco.mj_forward(model, data);
    this.read();
  }

  /** Take over a state, as recorded elsewhere; for tests. */
  restore({ qpos, qvel, lastAction, clock, history }) {
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    this.lastAction.set(lastAction);
    this.frames.set(history);
    this.clock = fround(clock);
    this.mujoco.mj_step1(this.model, this.data);
    this.read();
  }

  /** Take the state over from the simulator, with the trunk's rotation worked out. */
  read() {
    this.q = Float32Array.from(this.data.qpos);
    this.v = Float32Array.from(this.data.qvel);
    const [w, x, y, z] = this.q.subarray(3, 7);
    // The axes of the world as the trunk sees them.
    this.east = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)];
    this.north = [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)];
    this.up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
    /** rad */
    this.yaw = fround(Math.atan2(this.north[0], this.east[0]));
    /** Where the trunk's centre is, in the terrain's frame, m. */
    this.place2d = [this.q[0] - this.corner[0], this.q[1] - this.corner[1]];
  }

  /** The trunk's speed over ground, m/s. */
  get speed() {
    return Math.hypot(this.v[0], this.v[1]);
  }

  /**
   * Return what a policy reads, group after group: `policy` is what is felt, the command and the
   * scan, `history` the last frames of felt and command without the velocity, `scan` the scan.
   *
   * @param {ArrayLike<number>} command - (vx, vy, wz)
   * @param {("policy" | "history" | "scan")[]} groups
   */
  observe(command, groups = ["policy"]) {
    const { q, v, east, north, up, observation, frames, scales, felt } = this;
    const angle = 2 * Math.PI * this.clock;
    const velocity = [0, 1, 2].map((i) => v[0] * east[i] + v[1] * north[i] + v[2] * up[i]);
    const parts = [
      velocity,
      v.subarray(3, 6),
      up.map((value) => -value),
      this.stance.map((value, i) => q[7 + i] - value),
      v.subarray(6),
      this.lastAction,
      [sin(angle), cos(angle)],
    ];
    let at = 0;
    for (const part of parts) for (const value of part) observation[at++] = value;
    for (let i = 0; i < felt; i++) {
      observation[i] = min(max(observation[i] * scales[i], -LARGEST), LARGEST);
    }
    observation.set(command, felt);
    const scan = observation.subarray(felt + 3);
    this.scan(scan);
    if (frames.length) frames.set(observation.subarray(3, felt + 3), frames.length - felt);
    const all = { policy: observation, history: frames, scan };
    const read = groups.map((group) => all[group]);
    const seen = new Float32Array(read.reduce((sum, { length }) => sum + length, 0));
    at = 0;
    for (const numbers of read) {
      seen.set(numbers, at);
      at += numbers.length;
    }
    return seen;
  }

  /** Write heights around the robot relative to its trunk, centred and scaled. */
  scan(out) {
    const { limit, scale } = this.robot.scan;
    const trunk = this.q[2];
    rotate(this.grid.points, this.yaw, this.turned);
    const [x, y] = this.place2d;
    for (let i = 0; i < out.length; i++) {
      const height = heightAt(this.map, x + this.turned[2 * i], y + this.turned[2 * i + 1]) - trunk;
      out[i] = scale * (min(max(height, -limit), limit) + this.robot.stance_height);
    }
  }

  /** Set the joint targets and simulate one control step. */
  step(action) {
    const { mujoco, model, data, robot, stance } = this;
    this.broken ||= !action.every(Number.isFinite);
    if (this.broken) action = new Float32Array(action.length);
    this.lastAction.set(action);
    this.frames.copyWithin(0, this.felt);
    const target = stance.map((value, i) => value + fround(robot.action_scale * action[i]));
    data.ctrl.set(target);
    // mj_step in two halves: what depends on positions and velocities is current at the end.
    for (let i = 0; i < robot.substeps; i++) {
      mujoco.mj_step2(model, data);
      mujoco.mj_step1(model, data);
    }
    this.clock = fround(fround(this.clock + robot.gait_frequency * robot.control_dt) % 1);
    this.read();
    this.broken ||= !this.q.every(Number.isFinite) || !this.v.every(Number.isFinite);
  }

  /**
   * Change the trunk's velocity at once, as a shove does; the legs move along.
   *
   * @param {number} speed - m/s
   * @param {number} direction - In the yaw frame, rad; 0 pushes it ahead, a quarter turn left.
   */
  shove(speed, direction) {
    this.data.qvel[0] += speed * cos(this.yaw + direction);
    this.data.qvel[1] += speed * sin(this.yaw + direction);
    this.mujoco.mj_step1(this.model, this.data);
    this.read();
  }

  /** Tell whether it lies, touches the ground with its trunk, fell into a hole or exploded. */
  fallen() {
    const { falls } = this.robot;
    const sensed = this.data.sensordata;
    const touching = sensed[12] > 0;
    const tipped = this.up[2] < cos(falls.tilt);
    let dropped = false;
    for (let i = 0; i < 12; i += 3) {
      const rim = this.rimAt(sensed[i] - this.corner[0], sensed[i + 1] - this.corner[1]);
      dropped ||= sensed[i + 2] - falls.foot_radius < rim - falls.drop;
    }
    return touching || tipped || dropped || this.v[2] < -falls.speed || this.broken;
  }

  /** Return the ground with its holes closed, in the cell that a point lies in. */
  rimAt(x, y) {
    const { heights, nx, ny, resolution, origin } = this.rims;
    const i = min(max(Math.trunc((x - origin[0]) / resolution), 0), nx - 1);
    const j = min(max(Math.trunc((y - origin[1]) / resolution), 0), ny - 1);
    return heights[i * ny + j];
  }
}
