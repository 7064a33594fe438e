/**
 * One walk: an A1 on a ground, following the route that Python planned, each part of it with the
 * policy that the route names, or all of it with one. Mirrors `_Drive` of fgtutor/execution.py.
 */

import { Follower, Track } from "../js/follow.js";

export class Walk {
  /**
   * @param {import("./env.js").A1Env} env
   * @param {object} ground - A ground of `grounds.json`.
   * @param {Map<string, import("../js/specialist.js").Specialist>} zoo - By name.
   * @param {string | null} only - The one policy that walks it all; null: as planned.
   */
  constructor(env, ground, zoo, only = null) {
    const { robot } = env;
    this.env = env;
    this.names = only ? [only] : ground.route.names;
    this.zoo = zoo;
    const policies = only ? ground.route.policies.map(() => 0) : ground.route.policies;
    this.track = new Track(ground.route.xy, policies);
    this.follower = new Follower(this.track, {
      speeds: this.names.map((name) => zoo.get(name).command[0]),
      dt: robot.control_dt,
      slowest: robot.slowest,
      maxTurnRate: robot.max_turn_rate,
    });
    const [[x, y], [dx, dy, dyaw]] = [this.track.points[0], ground.noise];
    env.place(x + dx, y + dy, this.track.bearing([x, y]) + dyaw);
    /** @type {"fell" | "reached" | "timeout" | null} */
    this.outcome = null;
    /** Distance walked, m. */
    this.length = 0;
  }

  /** The name of the policy that walks now. */
  get policy() {
    return this.names[this.follower.active];
  }

  /** Simulated time, s. */
  get seconds() {
    return this.follower.steps * this.env.robot.control_dt;
  }

  /** Take one control step, unless the walk is over. */
  step() {
    if (this.outcome) return;
    const { env, follower } = this;
    const [x, y] = env.place2d;
    const command = follower.command([x, y], env.yaw);
    const { act, groups } = this.zoo.get(this.policy);
    env.step(act(env.observe(command, groups)));
    this.length += Math.hypot(env.place2d[0] - x, env.place2d[1] - y);
    this.outcome = follower.outcome(env.place2d, env.fallen());
  }
}
