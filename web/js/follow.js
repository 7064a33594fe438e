/**
 * Following a route: where along it the robot is, which policy it wants there, how it is steered,
 * and when the episode is over.
 *
 * Mirrors `_Track`, `_choose` and `FollowConfig` of fgtutor/execution.py and
 * fgtutor/robots/steering.py: pure pursuit (Coulter, 1992), hysteresis, and slower turns.
 */

const { atan2, cos, hypot, max, min, sqrt, PI } = Math;

/** How a route is followed, and when an episode is over; as `FollowConfig`. */
export const FOLLOW = {
  /** Distance to the point on the route that the robot steers for, m. */
  lookahead: 0.55,
  /** The goal is reached within this distance of it, m. */
  goalRadius: 0.35,
  /** Time limit as a multiple of the route's time at its policies' speeds, plus `grace`. */
  patience: 3,
  /** Seconds added to the time limit. */
  grace: 5,
  /** A robot that has come no further for this long has run out of time too, s. */
  stuckSeconds: 10,
  /** Greatest change of the speed told along a route, m/s^2. */
  acceleration: 0.5,
  /** A policy takes over once it has been wanted for this many control steps. */
  holdSteps: 3,
};

/** Distance between the points of a track, m. */
const SPACING = 0.02;

/** A route resampled every `SPACING` metres, which remembers how far along it the robot is. */
export class Track {
  /**
   * @param {[number, number][]} xy - Points of the route, m.
   * @param {number[]} policies - Policy of each step from one point to the next.
   */
  constructor(xy, policies) {
    const at = [0];
    for (let i = 1; i < xy.length; i++) {
      at.push(at[i - 1] + hypot(xy[i][0] - xy[i - 1][0], xy[i][1] - xy[i - 1][1]));
    }
    this.length = at.at(-1);
    /** @type {[number, number][]} */
    this.points = [];
    /** @type {number[]} */
    this.policies = [];
    /** How far along the route each point is, m. */
    this.distance = [];
    const inside = Math.ceil(this.length / SPACING);
    for (let i = 0, edge = 0; i <= inside; i++) {
      const distance = i < inside ? i * SPACING : this.length;
      while (edge < xy.length - 2 && at[edge + 1] <= distance) edge++;
      const next = min(edge + 1, xy.length - 1);
      const share = next > edge ? (distance - at[edge]) / (at[next] - at[edge]) : 0;
      const [[x0, y0], [x1, y1]] = [xy[edge], xy[next]];
      this.points.push([x0 + share * (x1 - x0), y0 + share * (y1 - y0)]);
      this.policies.push(policies[edge] ?? 0);
      this.distance.push(distance);
    }
    this.nearest = 0;
    /** Steps since it last came further. */
    this.idle = 0;
  }

  /** The policy that the route names where the robot is. */
  get policy() {
    return this.policies[this.nearest];
  }

  /** Where the route ends, m. */
  get goal() {
    return this.points.at(-1);
  }

  /** Return the time that it takes at the speeds of its policies, m/s. */
  seconds(speeds) {
    let total = 0;
    for (let i = 1; i < this.points.length; i++) {
      const [[x0, y0], [x1, y1]] = [this.points[i - 1], this.points[i]];
      total += hypot(x1 - x0, y1 - y0) / speeds[this.policies[i - 1]];
    }
    return total;
  }

  /**
   * Return the speed told at each point, m/s: its policy's, but v^2 changes by at most
   * 2 * `acceleration` per metre, before a slower policy as after one.
   */
  told(speeds, acceleration) {
    const square = this.policies.map((policy) => speeds[policy] ** 2);
    const last = square.length - 1;
    const between = (i) => 2 * acceleration * (this.distance[i + 1] - this.distance[i]);
    for (let i = last - 1; i >= 0; i--) square[i] = min(square[i], square[i + 1] + between(i));
    for (let i = 0; i < last; i++) square[i + 1] = min(square[i + 1], square[i] + between(i));
    return square.map(sqrt);
  }

  /**
   * Return the direction to the point `distance` metres further along, or to the end, rad;
   * `there` is the answer where the place is that point.
   */
  bearing([x, y], distance = FOLLOW.lookahead, there = 0) {
    const ahead = min(this.nearest + round(distance / SPACING), this.points.length - 1);
    const dx = this.points[ahead][0] - x;
    const dy = this.points[ahead][1] - y;
    return hypot(dx, dy) > 1e-3 ? atan2(dy, dx) : there;
  }

  /** Move to the nearest point of the route within `window` metres ahead; never back. */
  advance([x, y], window = 1) {
    const end = min(this.nearest + round(window / SPACING), this.points.length);
    let best = this.nearest;
    let least = Infinity;
    for (let i = this.nearest; i < end; i++) {
      const away = (this.points[i][0] - x) ** 2 + (this.points[i][1] - y) ** 2;
      if (away < least) [best, least] = [i, away];
    }
    this.idle = best > this.nearest ? 0 : this.idle + 1;
    this.nearest = best;
  }
}

/** A robot on its route, from the first step to its end. */
export class Follower {
  /**
   * @param {Track} track
   * @param {{speeds: number[], dt: number, slowest: number, maxTurnRate: number}} robot - Its
   *   speed with each policy, m/s, the seconds between two actions, the least share of its speed at
   *   which it turns, and its greatest turn rate, rad/s.
   * @param {typeof FOLLOW} config
   */
  constructor(track, robot, config = FOLLOW) {
    this.track = track;
    this.robot = robot;
    this.config = config;
    /** The policy that drives. */
    this.active = track.policy;
    this.waiting = 0;
    this.steps = 0;
    this.told = track.told(robot.speeds, config.acceleration);
    this.limit = config.patience * track.seconds(robot.speeds) + config.grace;
  }

  /**
   * Find the robot on its route, choose its policy and return its command (vx, vy, wz).
   *
   * @param {[number, number]} place - Where it is, in the route's frame, m.
   * @param {number} yaw - rad
   */
  command(place, yaw) {
    const { track, robot, config } = this;
    track.advance(place);
    const wanted = track.bearing(place, config.lookahead, yaw);
    this.choose(track.policy);
    const vx = this.told[track.nearest] * slowdown(wanted, yaw, robot.slowest);
    return [vx, 0, turnRate(wanted, yaw, robot.maxTurnRate)];
  }

  /** Switch the policy once another has been wanted for long enough. */
  choose(wanted) {
    this.waiting = wanted !== this.active ? this.waiting + 1 : 0;
    if (this.waiting >= this.config.holdSteps) [this.active, this.waiting] = [wanted, 0];
  }

  /**
   * Count a control step just taken; return "fell", "reached" or "timeout" if it was the last.
   *
   * @param {[number, number]} place
   * @param {boolean} fell
   * @returns {"fell" | "reached" | "timeout" | null}
   */
  outcome([x, y], fell) {
    const { track, robot, config } = this;
    this.steps += 1;
    if (fell) return "fell";
    const [gx, gy] = track.goal;
    if (hypot(x - gx, y - gy) <= config.goalRadius) return "reached";
    const late = this.steps >= this.limit / robot.dt;
    return late || track.idle >= config.stuckSeconds / robot.dt ? "timeout" : null;
  }
}

/** Return the angle from `yaw` to `wanted` the shorter way, rad in [-pi, pi). */
export function offBy(wanted, yaw) {
  const turns = (wanted - yaw + PI) / (2 * PI);
  return 2 * PI * (turns - Math.floor(turns)) - PI;
}

/**
 * Return the share of its speed at which a robot should turn to the heading wanted: it falls with
 * the square of the yaw error's cosine, to `slowest` from 90 degrees on.
 */
export function slowdown(wanted, yaw, slowest) {
  return max(max(cos(wanted - yaw), 0) ** 2, slowest);
}

/** Return the turn rate, rad/s, that closes the yaw error the shorter way, within `limit`. */
export function turnRate(wanted, yaw, limit, gain = 3) {
  return min(max(gain * offBy(wanted, yaw), -limit), limit);
}

/** Round to the nearest whole number, and halves to the even one, as Python does. */
function round(value) {
  const whole = Math.round(value);
  return Math.abs(value % 1) === 0.5 && whole % 2 ? whole - 1 : whole;
}
