/**
 * One drive along a planned route: the toy, its policies and the follower, step by step.
 *
 * Reads a world, a route and specialists; gives the toy's pose, the active policy and at last the
 * outcome. Mirrors `_Drive` of fgtutor/execution.py for one robot.
 */

import { Follower, FOLLOW, Track } from "../js/follow.js";
import { CONTROL_DT, Toy } from "./toy.js";

/** Greatest turn rate of the toy, rad/s; it never slows down to turn. */
const MAX_TURN_RATE = 1.5;
/** Standard deviation of where a drive begins, m, and of its yaw, rad. */
const NOISE = 0.03;

export class Drive {
  /**
   * @param {import("./munk/munk.js").Munk} munk - A fresh one.
   * @param {import("./toy.js").World} world
   * @param {{xy: [number, number][], policies: number[]}} route
   * @param {import("../js/specialist.js").Specialist[]} zoo - What the route's policies index.
   * @param {() => number} random - Draws from a normal distribution; the start is a little off.
   */
  constructor(munk, world, route, zoo, random = normal) {
    this.zoo = zoo;
    this.offset = world.offset;
    this.toy = new Toy(munk, world);
    const track = new Track(route.xy, route.policies);
    const speeds = zoo.map(({ command }) => command[0]);
    const robot = { speeds, dt: CONTROL_DT, slowest: 1, maxTurnRate: MAX_TURN_RATE };
    this.follower = new Follower(track, robot, FOLLOW);
    const [x, y] = track.points[0].map((value) => value + NOISE * random());
    const yaw = track.bearing(track.points[0], FOLLOW.lookahead) + NOISE * random();
    this.toy.place(...[x + this.offset[0], y + this.offset[1], yaw].map(Math.fround));
    /** What became of it: null while it drives, then "reached", "fell" or "timeout". */
    this.reason = null;
    /** How it fell, in words. */
    this.fall = "";
    this.length = 0;
    /** Places on the map so far. */
    this.places = [this.place()];
  }

  /** The index of the policy that drives. */
  get policy() {
    return this.follower.active;
  }

  get seconds() {
    return this.follower.steps * CONTROL_DT;
  }

  /** Return where the toy is on the map. */
  place() {
    const [x, y] = this.toy.pose();
    return [x - this.offset[0], y - this.offset[1]];
  }

  /** Take one control step; return the reason if it was the last. */
  step() {
    if (this.reason) return this.reason;
    const { toy, follower } = this;
    toy.command.set(follower.command(this.place(), toy.pose()[3]));
    toy.advance(this.zoo[this.policy].act(toy.observe()));
    this.fall = toy.fallen();
    const place = this.place();
    const before = this.places.at(-1);
    this.length += Math.hypot(place[0] - before[0], place[1] - before[1]);
    this.places.push(place);
    this.reason = follower.outcome(place, this.fall !== "");
    return this.reason;
  }
}

/** Draw from the standard normal distribution (Box and Muller, 1958). */
function normal() {
  return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
}
