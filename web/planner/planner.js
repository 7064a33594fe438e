/**
 * The planner's page: reads the controls, asks the worker, draws its answer, and drives.
 *
 * The worker (worker.js) computes; here nothing takes longer than a frame. One request is under way
 * at a time, and the next one asks for what the controls then say.
 */

import { readBytes, readJson } from "../js/files.js";
import { cellOf, centreOf, OURS, PAPER } from "../js/planning.js";
import { loadSpecialist } from "../js/specialist.js";
import { prepare } from "../js/tensorization.js";
import { CELL, drawRoute, drawSide, GROUND_ENDS, paintMap, ramp } from "./draw.js";
import { Drive } from "./drive.js";
import { loadMunk } from "./munk/munk.js";
import { CONTROL_DT, World } from "./toy.js";

const BASE = new URL(".", import.meta.url).href;
const $ = (id) => document.getElementById(id);
const worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });

/** All that the page knows. */
const page = {
  maps: [],
  zoo: [],
  munk: null,
  map: null,
  start: [0, 0],
  goal: [0, 0],
  /** Where the brush is, by keyboard or pointer; null while it is not used. */
  brush: null,
  answer: null,
  drive: null,
};
/** What the next request must tell beside the controls, and whether one is under way. */
const asking = { map: false, heights: false, due: false, busy: true, asked: 0 };

// Controls ---------------------------------------------------------------------------------------

const number = (id) => Number($(id).value);

/** Return the settings that the controls say. */
function settings() {
  const taus = $("ood").value === "calibrated" ? "calibrated" : [number("low"), number("high")];
  return {
    taus,
    alpha: number("alpha"),
    fMin: number("fmin"),
    switchCost: number("switch"),
    leastPromise: number("promise"),
    cost: $("cost").value,
  };
}

/** Set the controls to our settings or the paper's. */
function begin({ taus, cost, fMin, switchCost, leastPromise }) {
  $("ood").value = taus === "calibrated" ? "calibrated" : "taus";
  if (taus !== "calibrated") [$("low").value, $("high").value] = taus;
  $("alpha").value = 0.03;
  $("cost").value = cost;
  $("fmin").value = fMin;
  $("switch").value = switchCost;
  $("promise").value = leastPromise;
}

/** Return the indices of the policies in the team. */
function team() {
  return [...$("team").querySelectorAll("input:checked")].map((box) => Number(box.value));
}

/** Write beside each slider what it says, and show those that count. */
function label() {
  const words = {
    by: `${number("by").toFixed(2)} m`,
    brush: `${(number("brush") / 10).toFixed(1)} m`,
    alpha: number("alpha").toFixed(3),
    low: number("low").toFixed(2),
    high: number("high").toFixed(2),
    fmin: number("fmin").toFixed(2),
    switch: number("switch").toFixed(1),
    promise: number("promise").toFixed(2),
  };
  for (const [id, text] of Object.entries(words)) $(`${id}-words`).textContent = text;
  for (const one of document.querySelectorAll("[data-for]")) {
    one.hidden = one.dataset.for !== $("ood").value;
  }
}

/** Fill the choices that depend on what was loaded. */
function fill() {
  page.maps.forEach((map, i) => $("preset").add(new Option(map.label, i)));
  const layers = [
    ["elevation", "Elevation"],
    ["best", "F: best policy, best heading"],
    ["petals", "F along each of the 8 headings"],
    ["policy", "P: which policy is best"],
    ...page.zoo.map(({ name }, i) => [`w${i}`, `w_ood of ${name}`]),
  ];
  for (const [value, text] of layers) $("layer").add(new Option(text, value));
  page.zoo.forEach(({ name, colour, specialist }, i) => {
    const row = document.createElement("label");
    const box = document.createElement("input");
    Object.assign(box, { type: "checkbox", value: i, checked: specialist });
    const text = specialist ? name : `${name} (trained on all)`;
    row.append(box, swatch(colour), ` ${text}`);
    $("team").append(row);
  });
}

function swatch(colour) {
  const box = document.createElement("span");
  box.className = "swatch";
  box.style.background = colour;
  return box;
}

/** Say what the colours of the layer mean. */
function drawKey() {
  const layer = $("layer").value;
  const key = $("key");
  key.replaceChildren();
  const add = (...parts) => {
    const item = document.createElement("span");
    item.append(...parts);
    key.append(item);
  };
  const scale = (palette, [low, high]) => {
    const bar = document.createElement("span");
    bar.className = "ramp";
    bar.style.background = ramp(palette);
    add(`${low} `, bar, ` ${high}`);
  };
  if (layer === "elevation") scale("ground", GROUND_ENDS);
  else if (layer !== "policy") scale("F", ["0", "1"]);
  if (layer.startsWith("w")) add("best of 8 headings");
  for (const i of team()) add(swatch(page.zoo[i].colour), `${page.zoo[i].name}`);
  if (layer === "policy") add(swatch("rgb(120 124 130)"), "none");
}

// Asking the worker --------------------------------------------------------------------------------

/** Ask for an answer to what the controls say now, once the last one has come. */
function ask(changed = {}) {
  Object.assign(asking, changed, { due: true });
  if (asking.busy) return;
  const { map, start, goal } = page;
  const told = {
    map: asking.map ? map : undefined,
    team: team(),
    settings: settings(),
    start,
    goal,
  };
  if (!asking.map && asking.heights) told.heights = map.heights;
  Object.assign(asking, { map: false, heights: false, due: false, busy: true });
  asking.asked = performance.now();
  if (!told.team.length) {
    answered({ refusal: { reason: "no policy is in the team: choose one" }, why: [] });
  } else if (
    told.settings.taus !== "calibrated" &&
    told.settings.taus[0] >= told.settings.taus[1]
  ) {
    answered({ refusal: { reason: "tau_low must be smaller than tau_high" }, why: [] });
  } else {
    worker.postMessage(told);
  }
}

worker.onmessage = ({ data }) => {
  if (data.kind === "loaded") {
    asking.busy = false;
    if (asking.due) ask();
  } else if (data.kind === "progress") {
    $("progress").hidden = false;
    $("progress").value = data.share;
    say([`Assessing the map: ${Math.round(100 * data.share)} %`]);
  } else if (data.kind === "failed") {
    say([`Something went wrong: ${data.words}`], true);
  } else {
    answered(data);
  }
};

/** Take over an answer, show it, and ask again if the controls have moved on. */
function answered(answer) {
  page.answer = { ...page.answer, route: undefined, refusal: undefined, ...answer };
  asking.busy = false;
  $("progress").hidden = true;
  page.drive = page.drive?.reason ? null : page.drive;
  const { route, refusal, why } = page.answer;
  if (route) {
    const names = route.policies.filter((policy, i) => policy !== route.policies[i - 1]);
    say([
      `Route: ${route.length.toFixed(2)} m, cost ${route.cost.toFixed(2)}, ` +
        `${route.switches} change${route.switches === 1 ? "" : "s"} of the policy. ` +
        `Promise: it gets there with ${Math.round(100 * route.promise)} %.`,
      names.map((i) => page.zoo[i].name).join(" → ") || "Start and goal lie in one cell.",
    ]);
  } else {
    say([`No route: ${refusal.reason}.`, ...why], true);
  }
  $("drive").disabled = !route && !page.drive;
  draw();
  const passed = performance.now() - asking.asked;
  $("map").dataset.answers = Number($("map").dataset.answers ?? 0) + 1;
  $("map").dataset.milliseconds = passed.toFixed(0);
  if (answer.milliseconds) {
    const { nets, plan } = answer.milliseconds;
    $("timing").textContent =
      `Last answer: ${answer.windows} windows asked anew in ${nets.toFixed(0)} ms, weighed, fused ` +
      `and planned in ${plan.toFixed(0)} ms; ${passed.toFixed(0)} ms until it was drawn.`;
  }
  if (asking.due) ask();
}

/** Write lines into the answer. */
function say(lines, refused = false) {
  $("answer").classList.toggle("refused", refused);
  $("answer").replaceChildren(
    ...lines.flatMap((line, i) => (i ? [document.createElement("br"), line] : [line])),
  );
}

// The map ------------------------------------------------------------------------------------------

/** Draw the map with its layer, the route and whatever drives. */
function draw() {
  const { map, answer, start, goal, zoo, drive, brush } = page;
  const canvas = $("map");
  const context = canvas.getContext("2d");
  const colours = zoo.map(({ colour }) => colour);
  paintMap(context, map, answer, $("layer").value, colours, number("fmin"));
  const nearest = answer?.refusal?.nearest && centre(answer.refusal.nearest);
  const shown = brush && painting() ? { at: brush, size: number("brush") } : null;
  drawRoute(context, map, { route: answer?.route, start, goal, nearest, zoo, drive, brush: shown });
}

function painting() {
  return !["goal", "start"].includes($("tool").value);
}

function centre(cell) {
  return centreOf(page.map, cell);
}

/** Choose a map: copy it, so that painting leaves the original alone. */
function choose(map) {
  page.map = { ...map, heights: Float32Array.from(map.heights), known: Uint8Array.from(map.known) };
  [page.start, page.goal] = [map.start, map.goal];
  page.answer = page.drive = page.brush = null;
  const canvas = $("map");
  canvas.width = map.nx * CELL;
  canvas.height = map.ny * CELL;
  canvas.style.setProperty("--shape", map.nx / map.ny);
  draw();
  ask({ map: true, heights: false });
}

/** Return the cell under a pointer. */
function under(event) {
  const box = $("map").getBoundingClientRect();
  const { nx, ny } = page.map;
  const share = [(event.clientX - box.left) / box.width, (box.bottom - event.clientY) / box.height];
  return share.map((value, i) =>
    Math.min(Math.max(Math.floor(value * [nx, ny][i]), 0), [nx, ny][i] - 1),
  );
}

/** Do at a cell what the tool says. */
function use(cell, shifted = false) {
  const tool = $("tool").value;
  if (tool === "goal" || tool === "start") {
    page[tool === "start" || shifted ? "start" : "goal"] = centre(cell);
  } else {
    paint(cell, tool);
    page.brush = centre(cell);
    asking.heights = true;
  }
  draw();
  ask();
}

/** Change the ground under the brush. */
function paint([cx, cy], tool) {
  const { nx, ny, heights, known } = page.map;
  const half = (number("brush") - 1) / 2;
  const by = number("by");
  for (let ix = Math.max(cx - half, 0); ix <= Math.min(cx + half, nx - 1); ix++) {
    for (let iy = Math.max(cy - half, 0); iy <= Math.min(cy + half, ny - 1); iy++) {
      const cell = ix * ny + iy;
      if (!known[cell] || page.stroke?.has(cell)) continue;
      page.stroke?.add(cell);
      const changed = { raise: heights[cell] + by, lower: heights[cell] - by, gap: -1, level: 0 };
      heights[cell] = Math.min(Math.max(changed[tool], -2), 2);
    }
  }
}

function listenToMap() {
  const canvas = $("map");
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    canvas.setPointerCapture(event.pointerId);
    // In one stroke each cell is changed once, however long the pointer stays on it.
    page.stroke = new Set();
    use(under(event), event.shiftKey);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (page.stroke) use(under(event), event.shiftKey);
    else if (painting()) {
      page.brush = centre(under(event));
      draw();
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, () => (page.stroke = null));
  }
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[
      event.key
    ];
    const { map } = page;
    if (step) {
      const name = painting()
        ? "brush"
        : event.shiftKey || $("tool").value === "start"
          ? "start"
          : "goal";
      const cell = cellOf(map, page[name] ?? page.goal).map((value, i) => value + step[i]);
      if (cell[0] < 0 || cell[1] < 0 || cell[0] >= map.nx || cell[1] >= map.ny) return;
      page[name] = centre(cell);
      draw();
      if (name !== "brush") ask();
    } else if (painting() && (event.key === " " || event.key === "Enter")) {
      use(cellOf(map, page.brush ?? page.goal));
    } else return;
    event.preventDefault();
  });
}

// Driving ------------------------------------------------------------------------------------------

/** Start a drive along the route, or stop the one under way. */
function startOrStop() {
  if (page.drive && !page.drive.reason) {
    page.drive = null;
    finish("Stopped.");
    return;
  }
  const { map, answer, zoo } = page;
  const world = new World(map, prepare(map));
  page.drive = new Drive(page.munk(), world, answer.route, zoo);
  $("drive").textContent = "Stop";
  $("outcome").textContent = "Driving ...";
  $("side").hidden = false;
  $("side").scrollIntoView({ block: "nearest" });
  let before = performance.now();
  let due = 0;
  const drive = page.drive;
  const frame = (now) => {
    if (page.drive !== drive) return;
    // After a pause (another tab was shown) the drive goes on where it was.
    due += Math.min(now - before, 200) * number("pace");
    before = now;
    for (; due >= 1000 * CONTROL_DT && !drive.reason; due -= 1000 * CONTROL_DT) drive.step();
    drawSide($("side").getContext("2d"), drive, zoo[drive.policy]);
    draw();
    if (drive.reason) finish(outcome(drive));
    else requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function finish(words) {
  $("drive").textContent = "Drive";
  $("drive").disabled = !page.answer?.route;
  $("outcome").textContent = words;
  draw();
}

/** Say what became of a drive. */
function outcome({ reason, fall, seconds, length, policy }) {
  const way = `after ${seconds.toFixed(1)} s and ${length.toFixed(1)} m`;
  const { name } = page.zoo[policy];
  if (reason === "reached") return `Reached the goal ${way}.`;
  if (reason === "fell") return `Fell: it ${fall} ${way}, driven by ${name}.`;
  return `Ran out of time: it was stuck ${way}, driven by ${name}.`;
}

// The beginning ------------------------------------------------------------------------------------

function listen() {
  listenToMap();
  $("preset").addEventListener("change", () => choose(page.maps[number("preset")]));
  $("settings").addEventListener("change", () => {
    begin($("settings").value === "ours" ? OURS : PAPER);
    label();
    ask();
  });
  for (const id of ["ood", "alpha", "low", "high", "fmin", "switch", "promise", "cost"]) {
    $(id).addEventListener("input", () => {
      label();
      ask();
    });
  }
  for (const id of ["by", "brush"]) $(id).addEventListener("input", label);
  $("tool").addEventListener("change", draw);
  $("team").addEventListener("change", () => {
    drawKey();
    ask();
  });
  $("layer").addEventListener("change", () => {
    drawKey();
    draw();
  });
  $("drive").addEventListener("click", startOrStop);
  $("controls").addEventListener("submit", (event) => event.preventDefault());
}

async function open() {
  const [{ policies }, maps, munk] = await Promise.all([
    readJson(`${BASE}page.json`),
    readJson(`${BASE}maps.json`),
    readBytes(`${BASE}munk.wasm`),
  ]);
  const names = policies.map(({ name }) => name);
  worker.postMessage({ kind: "load", base: BASE, names });
  page.maps = maps;
  page.munk = await loadMunk(munk);
  const loaded = await Promise.all(
    names.map((name) => loadSpecialist(`${BASE}specialists/${name}`, { net: false })),
  );
  page.zoo = loaded.map((one, i) => ({ ...one, ...policies[i] }));
  Object.assign($("side"), { width: 1104, height: 380 });
  fill();
  begin(OURS);
  label();
  listen();
  choose(maps[0]);
  drawKey();
}

open().catch((error) => say([`The page could not be opened: ${error.message}`], true));
