/**
 * Pictures: the map from above with one layer and the route, and the slice that the toy drives in.
 *
 * Reads a map, the planner's answer and the toy; draws on canvases. The side view mirrors
 * fgtutor/figures/toy_film.py.
 */

import { CLIFF, MODEL, profile } from "./toy.js";

/** Pixels per cell of the map's picture. */
export const CELL = 10;
/** Heights of the darkest and the lightest ground, m. */
const [LOW, HIGH] = [-0.6, 0.8];
const INK = "#1e2328";
/** Colours of viridis, the palette of f and F, at even distances from 0 to 1. */
const VIRIDIS = [
  [68, 1, 84],
  [71, 44, 122],
  [59, 81, 139],
  [44, 113, 142],
  [33, 144, 141],
  [39, 173, 129],
  [92, 200, 99],
  [170, 220, 50],
  [253, 231, 37],
];
/** Colours of the ground from low to high. */
const GROUND = [
  [38, 44, 58],
  [92, 92, 98],
  [168, 160, 142],
  [208, 192, 158],
  [238, 228, 206],
  [255, 252, 244],
];
const CLOSED = [120, 124, 130];
const UNKNOWN = [255, 255, 255];

/** Return the colour of a palette at t from 0 to 1. */
function mixed(palette, t) {
  const at = Math.min(Math.max(t, 0), 1) * (palette.length - 1);
  const i = Math.min(Math.floor(at), palette.length - 2);
  return palette[i].map((value, c) => value + (at - i) * (palette[i + 1][c] - value));
}

/** Return a palette as a CSS gradient. */
export function ramp(name) {
  const palette = name === "ground" ? GROUND : VIRIDIS;
  return `linear-gradient(to right, ${palette.map((rgb) => `rgb(${rgb})`).join(", ")})`;
}

/** Words for the ends of the ground's palette. */
export const GROUND_ENDS = [`${LOW} m`, `${HIGH} m`];

/** Return the colour "#rrggbb" as numbers. */
function rgb(colour) {
  return [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
}

/**
 * Paint one layer of the map, a pixel at a time.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {object} map
 * @param {object | null} answer - The planner's.
 * @param {string} layer - "elevation", "best", "petals", "policy", or "w" and a policy's number.
 * @param {string[]} colours - Of the policies.
 * @param {number} fMin
 */
export function paintMap(context, map, answer, layer, colours, fMin) {
  const { nx, ny } = map;
  const image = context.createImageData(nx * CELL, ny * CELL);
  const pixels = new Uint32Array(image.data.buffer);
  const inks = colours.map(rgb);
  const shown = answer ? layer : "elevation";
  const colour = cellColour(map, answer, shown, inks, fMin);
  for (let ix = 0; ix < nx; ix++) {
    for (let iy = 0; iy < ny; iy++) {
      const cell = ix * ny + iy;
      const unknown = map.known && !map.known[cell];
      let packed = 0;
      for (let v = 0; v < CELL; v++) {
        const row = ((ny - 1 - iy) * CELL + v) * nx * CELL + ix * CELL;
        for (let u = 0; u < CELL; u++) {
          if (unknown) packed = pack((u + v) % 4 ? UNKNOWN : CLOSED);
          else if (shown === "petals") packed = pack(colour(cell, petal(u, v)));
          else if (u + v === 0) packed = pack(colour(cell));
          pixels[row + u] = packed;
        }
      }
    }
  }
  context.putImageData(image, 0, 0);
}

function pack([r, g, b]) {
  return (255 << 24) | (b << 16) | (g << 8) | r;
}

/** Return which of 8 headings a pixel of a cell lies along. */
function petal(u, v) {
  const angle = Math.atan2(CELL / 2 - v - 0.5, u + 0.5 - CELL / 2);
  return Math.round((angle / Math.PI) * 4 + 8) % 8;
}

/** Return the function that colours a cell (and heading) in a layer. */
function cellColour(map, answer, layer, inks, fMin) {
  const { heights, nx, ny } = map;
  const highest = (values, cell) => {
    let best = 0;
    for (let k = 1; k < 8; k++) if (values[cell * 8 + k] > values[cell * 8 + best]) best = k;
    return best;
  };
  if (layer === "petals") {
    return (cell, k) => mixed(VIRIDIS, answer.fused[cell * 8 + k]);
  }
  if (layer === "best") {
    return (cell) => mixed(VIRIDIS, answer.fused[cell * 8 + highest(answer.fused, cell)]);
  }
  if (layer === "policy") {
    return (cell) => {
      const at = cell * 8 + highest(answer.fused, cell);
      const f = answer.fused[at];
      if (f < fMin) return CLOSED;
      return inks[answer.policyMap[at]].map((value) => 255 - (255 - value) * (0.25 + 0.75 * f));
    };
  }
  if (layer.startsWith("w")) {
    const weight = answer.weights[Number(layer.slice(1))];
    return (cell) => mixed(VIRIDIS, weight[cell * 8 + highest(weight, cell)]);
  }
  const at = (ix, iy) => heights[Math.min(Math.max(ix, 0), nx - 1) * ny + Math.min(iy, ny - 1)];
  return (cell) => {
    const [ix, iy] = [Math.floor(cell / ny), cell % ny];
    const slope = heights[cell] - at(ix - 1, iy) - (at(ix, iy + 1) - heights[cell]);
    const light = 1 + Math.min(Math.max(slope, -0.3), 0.3) * 0.9;
    const ground = mixed(GROUND, (heights[cell] - LOW) / (HIGH - LOW));
    return ground.map((value) => Math.min(value * light, 255));
  };
}

/** Return the picture's pixel of a place on the map. */
function pixel({ ny, resolution, origin }, [x, y]) {
  const scale = CELL / resolution;
  return [(x - origin[0]) * scale, ny * CELL - (y - origin[1]) * scale];
}

/** Draw the route coloured by policy, its first letter at each change, start, goal and the toy. */
export function drawRoute(context, map, { route, start, goal, nearest, zoo, drive, brush }) {
  context.lineJoin = context.lineCap = "round";
  const line = (points, width, colour) => {
    context.beginPath();
    points.forEach((point, i) => context[i ? "lineTo" : "moveTo"](...pixel(map, point)));
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.stroke();
  };
  if (route) {
    line(route.xy, 8, "#ffffff");
    route.policies.forEach((policy, i) => {
      line([route.xy[i], route.xy[i + 1]], 4.5, zoo[policy].colour);
    });
  }
  if (drive) line(drive.places, 2, INK);
  if (route) {
    route.policies.forEach((policy, i) => {
      if (i && policy === route.policies[i - 1]) return;
      // Some steps on, so that the letter stands where its policy drives.
      const until = route.policies.findIndex((other, j) => j > i && other !== policy);
      const last = until < 0 ? route.policies.length : until;
      badge(
        context,
        pixel(map, route.xy[Math.min(i + 4, Math.floor((i + last) / 2))]),
        zoo[policy],
      );
    });
  }
  if (nearest) cross(context, pixel(map, nearest));
  flag(context, pixel(map, start), "start", map);
  flag(context, pixel(map, goal), "goal", map);
  if (drive) toyFromAbove(context, map, drive, zoo[drive.policy].colour);
  if (brush) {
    const [u, v] = pixel(map, brush.at);
    const half = (brush.size * CELL) / 2;
    context.lineWidth = 2;
    for (const [by, colour] of [
      [0, INK],
      [2, "#ffffff"],
    ]) {
      context.strokeStyle = colour;
      context.strokeRect(u - half - by, v - half - by, 2 * (half + by), 2 * (half + by));
    }
  }
}

/** Write a policy's first letter on its colour. */
function badge(context, [u, v], { name, colour }) {
  context.beginPath();
  context.arc(u, v, 10, 0, 2 * Math.PI);
  context.fillStyle = colour;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = "#ffffff";
  context.stroke();
  words(context, name[0].toUpperCase(), u, v, "#ffffff", "bold 13px system-ui, sans-serif");
}

function words(context, text, u, v, colour, font) {
  context.font = font;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = colour;
  context.fillText(text, u, v + 1);
}

/** Mark the start by a ring, the goal by a disc with a ring, each with its word. */
function flag(context, [u, v], name, { nx, ny }) {
  for (const [radius, colour] of [
    [9, "#ffffff"],
    [7, INK],
    [4, name === "goal" ? "#ffd60a" : "#ffffff"],
  ]) {
    context.beginPath();
    context.arc(u, v, radius, 0, 2 * Math.PI);
    context.fillStyle = colour;
    context.fill();
  }
  const font = "bold 15px system-ui, sans-serif";
  const above = v > 30 ? v - 20 : v + 20;
  const beside = Math.min(Math.max(u, 24), nx * CELL - 24);
  context.font = font;
  context.lineWidth = 4;
  context.strokeStyle = "#ffffff";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.strokeText(name, beside, Math.min(above, ny * CELL - 10) + 1);
  words(context, name, beside, Math.min(above, ny * CELL - 10), INK, font);
}

/** Mark the place nearest to the goal that can be reached. */
function cross(context, [u, v]) {
  for (const [width, colour] of [
    [8, "#ffffff"],
    [4, "#b91c1c"],
  ]) {
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.beginPath();
    context.moveTo(u - 8, v - 8);
    context.lineTo(u + 8, v + 8);
    context.moveTo(u - 8, v + 8);
    context.lineTo(u + 8, v - 8);
    context.stroke();
  }
}

/** Draw the toy on the map: as long as it is, with a bow. */
function toyFromAbove(context, map, drive, colour) {
  const [u, v] = pixel(map, drive.places.at(-1));
  const scale = CELL / map.resolution;
  context.save();
  context.translate(u, v);
  context.rotate(-drive.toy.yaw);
  const [a, b] = [0.34 * scale, 0.14 * scale];
  context.beginPath();
  for (const [x, y] of [
    [-a, -b],
    [0.6 * a, -b],
    [a, 0],
    [0.6 * a, b],
    [-a, b],
  ]) {
    context.lineTo(x, y);
  }
  context.closePath();
  context.fillStyle = colour;
  context.fill();
  context.lineWidth = 2.5;
  context.strokeStyle = "#ffffff";
  context.stroke();
  context.restore();
}

/**
 * Draw the slice of the ground along the toy's heading, with the toy in it.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {import("./drive.js").Drive} drive
 * @param {{name: string, colour: string}} policy
 */
export function drawSide(context, drive, policy) {
  const { width, height } = context.canvas;
  const { toy } = drive;
  const scale = width / 4.6;
  const behind = 1.6;
  // The camera follows the ground under the toy, slowly, so that hops are seen.
  drive.camera =
    (drive.camera ?? toy.state[1]) + 0.1 * (toy.state[1] - (drive.camera ?? toy.state[1]));
  const place = (s, z) => [(s + behind) * scale, 0.55 * height - (z - drive.camera) * scale];
  context.fillStyle = "#eaf1f6";
  context.fillRect(0, 0, width, height);
  const count = Math.ceil(width / 3);
  const s = Float64Array.from({ length: count + 2 }, (_, i) => (i * 3) / scale - behind);
  const h = profile(toy.world.ground, toy.position(), toy.yaw, s);
  context.beginPath();
  context.moveTo(0, height + 4);
  for (let i = 0; i < s.length; i++) {
    if (i && Math.abs(h[i] - h[i - 1]) > CLIFF / 2) context.lineTo(...place(s[i - 1], h[i]));
    context.lineTo(...place(s[i], h[i]));
  }
  context.lineTo(width + 4, height + 4);
  context.fillStyle = "#b7a68a";
  context.strokeStyle = "#5b4a33";
  context.lineWidth = 3;
  context.fill();
  context.stroke();
  drawToy(context, toy, place, scale, policy.colour);
  const font = `600 ${Math.round(width / 48)}px system-ui, sans-serif`;
  context.font = font;
  context.textAlign = "left";
  context.textBaseline = "top";
  context.fillStyle = INK;
  context.fillText(`${policy.name}   ${drive.seconds.toFixed(1)} s`, 12, 10);
  context.fillRect(width - 14 - scale / 2, 26, scale / 2, 3);
  context.textAlign = "center";
  context.fillText("0.5 m", width - 14 - scale / 4, 6);
}

function drawToy(context, toy, place, scale, colour) {
  const m = MODEL;
  const [centre, z, angle] = toy.state;
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const local = (a, b) => place(cos * a - sin * b, z + sin * a + cos * b);
  for (const [side, at] of [
    [-1, 6],
    [1, 12],
  ]) {
    const [s, axle, turn] = [toy.state[at] - centre, toy.state[at + 1], toy.state[at + 2]];
    const [u, v] = place(s, axle);
    context.beginPath();
    context.moveTo(...local(side * m.halfBase, 0));
    context.lineTo(u, v);
    context.lineWidth = 0.045 * scale;
    context.strokeStyle = "#6b7680";
    context.stroke();
    context.beginPath();
    context.arc(u, v, m.wheelRadius * scale, 0, 2 * Math.PI);
    context.fillStyle = "#3a4148";
    context.fill();
    const spoke = 0.8 * m.wheelRadius * scale;
    context.beginPath();
    context.moveTo(u - spoke * Math.cos(turn), v + spoke * Math.sin(turn));
    context.lineTo(u + spoke * Math.cos(turn), v - spoke * Math.sin(turn));
    context.lineWidth = 3;
    context.strokeStyle = "#ffffff";
    context.stroke();
  }
  const [length, thick] = m.chassisSize.map((size) => size / 2);
  context.beginPath();
  for (const [a, b] of [
    [-1, -1],
    [0.8, -1],
    [1, -0.2],
    [1, 0.2],
    [0.8, 1],
    [-1, 1],
  ]) {
    context.lineTo(...local(a * length, b * thick));
  }
  context.closePath();
  context.fillStyle = colour;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = INK;
  context.stroke();
}
