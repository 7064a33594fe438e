/**
 * The A1 page: loads simulator, robot, policies and grounds, and shows one walk at a time.
 *
 * The address may choose: `?ground=3` (its place in the list), `&who=steps` (one policy for all),
 * `&pace=8` (times real time), `&start` (at once).
 */

import { readBytes, readJson } from "../js/files.js";
import { loadSpecialist } from "../js/specialist.js";
import { A1Env } from "./env.js";
import loadMujoco from "./vendor/mujoco.js";
import { poseOf, View } from "./view.js";
import { Walk } from "./walk.js";

/** Longest time that simulating may take of one picture's, ms: controls stay alive. */
const BUDGET = 40;
/** Weight of the newest control step in the speed that is shown: about half a second counts. */
const SMOOTHING = 0.06;
/** The robot's feet are this far from its centre, m: there an obstacle begins for it. */
const REACH = 0.25;
const PLANNED = "as planned";
const $ = (id) => document.getElementById(id);
const asked = new URLSearchParams(location.search);

class Page {
  /** Load what every walk needs. */
  async load() {
    const [wasmBinary, robot, list] = await Promise.all([
      readBytes("vendor/mujoco.wasm.gz"),
      readJson("robot.json"),
      readJson("grounds.json"),
    ]);
    this.robot = robot;
    this.grounds = list.grounds;
    this.colours = new Map(robot.policies.map(({ name, colour }) => [name, colour]));
    this.mujoco = await loadMujoco({ wasmBinary });
    /** @type {Map<string, import("../js/specialist.js").Specialist>} */
    this.zoo = new Map();
    this.view = new View($("view"), robot);
    this.pace = Number($("pace").value);
    this.running = asked.has("start");
    if (Number(asked.get("pace")) > 0) this.pace = Number(asked.get("pace"));
    this.fillControls();
    await this.chooseGround();
    this.listen();
    for (const fieldset of document.querySelectorAll("fieldset")) fieldset.disabled = false;
    requestAnimationFrame((now) => this.frame(now));
  }

  fillControls() {
    this.grounds.forEach(({ seed }, i) => $("ground").add(new Option(String(seed), String(i))));
    $("who").add(new Option("as planned", PLANNED));
    for (const name of this.colours.keys()) {
      const words = name === "general" ? "only general, trained on all four" : `only ${name}`;
      $("who").add(new Option(words, name));
    }
    if (this.grounds[asked.get("ground")]) $("ground").value = asked.get("ground");
    if (this.colours.has(asked.get("who"))) $("who").value = asked.get("who");
    this.sayStrength();
  }

  /** The policy that walks all of it; null: as planned. */
  get only() {
    return $("who").value === PLANNED ? null : $("who").value;
  }

  /** Load the chosen ground, and begin a walk on it. */
  async chooseGround() {
    const ground = await readJson(this.grounds[$("ground").value].file);
    await this.needPolicies(ground);
    this.ground = ground;
    this.env?.delete();
    this.env = new A1Env(this.mujoco, this.robot, ground);
    this.view.setGround(ground.scene);
    const { outcome, seconds } = ground.python;
    $("python").textContent =
      outcome === "reached"
        ? `In Python the robot reached the goal of this ground in ${seconds.toFixed(1)} s.`
        : `In Python the robot did not reach the goal of this ground (${outcome}).`;
    this.begin();
  }

  /** Let the chosen policies walk from the start. */
  async chooseWho() {
    await this.needPolicies(this.ground);
    this.begin();
  }

  /** Put the robot back to the start; whatever it needs is loaded. */
  begin() {
    this.walk = new Walk(this.env, this.ground, this.zoo, this.only);
    this.before = this.after = poseOf(this.env);
    this.due = 0;
    this.speed = 0;
    this.jump = true;
    this.showRoute();
    this.show();
  }

  /** Load the policies that walk on a ground, unless they are there. */
  async needPolicies(ground) {
    const names = this.only ? [this.only] : ground.route.names;
    const missing = names.filter((name) => !this.zoo.has(name));
    const folder = (name) => new URL(`specialists/${name}`, location.href);
    const load = (name) => loadSpecialist(folder(name), { net: false });
    const loaded = await Promise.all(missing.map(load));
    loaded.forEach((specialist, i) => this.zoo.set(missing[i], specialist));
  }

  /** Take as many control steps as are due, and draw. */
  frame(now) {
    const seconds = Math.min((now - (this.last ?? now)) / 1000, 0.1);
    this.last = now;
    const dt = this.robot.control_dt;
    if (this.running && !this.walk.outcome) {
      this.due += seconds * this.pace;
      const until = performance.now() + BUDGET;
      while (this.due >= dt && !this.walk.outcome && performance.now() < until) {
        this.step();
        this.due -= dt;
      }
      if (this.due >= dt) this.due = 0; // too slow a machine: time runs slower
      this.show();
    }
    const share = this.walk.outcome ? 1 : this.due / dt;
    this.view.draw(this.before, this.after, share, this.jump ? Infinity : seconds);
    this.jump = false;
    requestAnimationFrame((next) => this.frame(next));
  }

  step() {
    this.walk.step();
    this.before = this.after;
    this.after = poseOf(this.env);
    this.speed += SMOOTHING * (this.env.speed - this.speed);
    if (this.walk.outcome) this.running = false;
  }

  /** Show the numbers, and say how things stand. */
  show() {
    const { walk, env } = this;
    const colour = this.colours.get(walk.policy);
    this.view.setCoat(colour);
    $("policy").textContent = walk.policy;
    $("policy").style.setProperty("--policy", colour);
    $("time").textContent = walk.seconds.toFixed(1);
    $("speed").textContent = this.speed.toFixed(2);
    $("walked").textContent = walk.length.toFixed(1);
    const { nearest, points, goal } = walk.track;
    const [x, y] = env.place2d;
    $("left").textContent = Math.hypot(goal[0] - x, goal[1] - y).toFixed(1);
    $("here").style.left = `${(100 * nearest) / (points.length - 1)}%`;
    $("start").textContent = this.running ? "Pause" : walk.outcome ? "Walk again" : "Start";
    say(this.words());
  }

  words() {
    const { walk } = this;
    const after = `after ${walk.seconds.toFixed(1)} s`;
    const here = this.obstacle();
    if (walk.outcome === "reached") return `It reached the goal ${after}.`;
    if (walk.outcome === "fell") return `It fell ${after}, ${here}; policy: ${walk.policy}.`;
    if (walk.outcome === "timeout") return `It came no further and gave up ${after}, ${here}.`;
    if (this.running) return `It walks, ${here}.`;
    return walk.follower.steps ? `Paused, ${here}.` : "Ready: press Start.";
  }

  /** Say which obstacle the robot is on. */
  obstacle() {
    const [x] = this.env.place2d;
    const near = ([, from, to]) => from - REACH <= x && x <= to + REACH;
    const found = this.ground.sections.find(near);
    const words = {
      steps: "on the steps",
      gaps: "at the gaps",
      bridge: "on the bridge",
      valley: "in the valley",
    };
    return found ? words[found[0]] ?? `on ${found[0]}` : "on flat ground";
  }

  /** Show which policy walks where. */
  showRoute() {
    const { track, names } = this.walk;
    const parts = [];
    for (const policy of track.policies) {
      if (parts.at(-1)?.policy === policy) parts.at(-1).count += 1;
      else parts.push({ policy, count: 1 });
    }
    $("route").replaceChildren(
      ...parts.map(({ policy, count }) => {
        const item = document.createElement("li");
        const colour = this.colours.get(names[policy]);
        item.textContent = names[policy];
        item.style.flex = `${count} 1 0`;
        item.style.setProperty("--policy", colour);
        item.style.setProperty("--on-policy", inkOn(colour));
        return item;
      }),
    );
  }

  /** The shove's strength as an impulse, and what it does to the robot. */
  sayStrength() {
    const impulse = Number($("strength").value);
    this.shoveSpeed = impulse / this.robot.mass;
    const weight = `${impulse} N s: the robot weighs ${this.robot.mass.toFixed(1)} kg`;
    const change = `its speed changes by ${this.shoveSpeed.toFixed(2)} m/s`;
    $("strength-words").textContent = `${weight}, ${change}`;
  }

  listen() {
    $("controls").addEventListener("submit", (event) => event.preventDefault());
    $("ground").addEventListener("change", () => this.chooseGround().catch(fail));
    $("who").addEventListener("change", () => this.chooseWho().catch(fail));
    $("pace").addEventListener("change", () => {
      this.pace = Number($("pace").value);
    });
    $("start").addEventListener("click", () => {
      if (this.walk.outcome) this.begin();
      this.running = !this.running;
      this.show();
    });
    $("reset").addEventListener("click", () => {
      this.running = false;
      this.begin();
    });
    $("strength").addEventListener("input", () => this.sayStrength());
    $("shove").addEventListener("click", () => {
      this.env.shove(this.shoveSpeed, (Number($("direction").value) * Math.PI) / 180);
      this.speed = this.env.speed;
      this.show();
    });
  }
}

/** Return black or white, whichever is easier to read on a colour. */
function inkOn(colour) {
  const light = (i) => (Number.parseInt(colour.slice(i, i + 2), 16) / 255) ** 2.2;
  const [r, g, b] = [light(1), light(3), light(5)];
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.18 ? "#000" : "#fff";
}

/** Change the status only if it says something else: it is read aloud. */
function say(words) {
  if ($("status").textContent !== words) $("status").textContent = words;
}

function fail(error) {
  say(`This page could not start: ${error.message}`);
  console.error(error);
}

new Page().load().catch(fail);
