// Draws a scene (fgtutor/course/widgets/panels.py) on canvases, and tells Python what a person does with it.
//
// Pictures come as RGB bytes, one pixel per cell, upright: row 0 is the largest y. Points of the
// overlay count (right, down) in cells. Messages name cells as Python does: [ix, iy], y up.

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

function make(tag, className, parent) {
  const element = document.createElement(tag);
  element.className = className;
  parent.append(element);
  return element;
}

// One pixel per cell, off screen; the visible canvas shows it enlarged.
function cellsAsImage(view, [nx, ny]) {
  const rgb = new Uint8Array(view.buffer, view.byteOffset, view.byteLength);
  const small = document.createElement("canvas");
  [small.width, small.height] = [nx, ny];
  const context = small.getContext("2d");
  const image = context.createImageData(nx, ny);
  for (let i = 0, j = 0; j < image.data.length; i += 3, j += 4) {
    image.data[j] = rgb[i];
    image.data[j + 1] = rgb[i + 1];
    image.data[j + 2] = rgb[i + 2];
    image.data[j + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return small;
}

// About `count` round numbers between two ends: 1, 2 or 5 times a power of ten apart.
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i += 1) {
    found.push(Number((i * step).toPrecision(6)));
  }
  return found;
}

// Numbers along an edge of a picture; `side` is the style property that they are placed by.
function label(axis, low, high, count, side) {
  axis.replaceChildren();
  for (const value of ticks(low, high, count)) {
    const text = make("span", "fgtutor-tick", axis);
    text.textContent = String(value);
    text.style[side] = `${(100 * (value - low)) / (high - low)}%`;
  }
}

// Slanted lines over the cells that were never observed.
function hatch(context, boxes, scale, dots) {
  if (!boxes.length) return;
  context.save();
  context.beginPath();
  for (const [left, top, right, bottom] of boxes) {
    context.rect(left * scale, top * scale, (right - left) * scale, (bottom - top) * scale);
  }
  context.clip();
  const { width, height } = context.canvas;
  context.beginPath();
  for (let u = -height; u < width; u += 7 * dots) {
    context.moveTo(u, height);
    context.lineTo(u + height, 0);
  }
  context.lineWidth = 1.2 * dots;
  context.strokeStyle = "#5a5a5a";
  context.stroke();
  context.restore();
}

// How L_recon is spread (bars, roots of shares: much is flat and would dwarf the rest), what weight it gets (line), and the policy's own ground (bar below).
function drawChart(canvas, { colour, span, shares, weights, home }) {
  const dots = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * dots));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * dots));
  const context = canvas.getContext("2d");
  const ink = getComputedStyle(canvas).color;
  const [floor, ceiling] = [canvas.height - 24 * dots, 6 * dots];
  const across = (share) => share * canvas.width;
  const at = (log) => across((log - span[0]) / (span[1] - span[0]));
  const up = (share) => floor + share * (ceiling - floor);
  const tallest = Math.max(...shares);
  context.fillStyle = colour;
  context.globalAlpha = 0.5;
  shares.forEach((share, i) => {
    const [left, top] = [across(i / shares.length), up(Math.sqrt(share / tallest))];
    context.fillRect(left, top, canvas.width / shares.length + 0.5, floor - top);
  });
  context.globalAlpha = 1;
  if (home.length) {
    context.fillRect(0, floor + 2 * dots, at(home.at(-1)), 4 * dots);
    context.fillStyle = ink;
    for (const log of home) context.fillRect(at(log) - dots, floor, 2 * dots, 8 * dots);
  }
  context.beginPath();
  weights.forEach((weight, i) => context.lineTo(across(i / (weights.length - 1)), up(weight)));
  context.lineWidth = 2 * dots;
  context.strokeStyle = ink;
  context.stroke();
  context.fillStyle = ink;
  context.font = `${10 * dots}px sans-serif`;
  context.textAlign = "center";
  for (let power = Math.ceil(span[0]); power <= span[1]; power += 1) {
    context.fillRect(at(power), floor, dots, 4 * dots);
    context.fillText(String(10 ** power), Math.max(at(power), 12 * dots), canvas.height - 3 * dots);
  }
}

function trace(context, points, scale) {
  context.beginPath();
  for (const [u, v] of points) context.lineTo(u * scale, v * scale);
}

function mark(context, [u, v], scale, size, corners, inner) {
  context.beginPath();
  for (let i = 0; i < corners; i += 1) {
    const radius = i % 2 ? inner * size : size;
    const turn = (2 * Math.PI * i) / corners;
    context.lineTo(u * scale + radius * Math.sin(turn), v * scale - radius * Math.cos(turn));
  }
  context.closePath();
  context.fillStyle = "white";
  context.fill();
  context.lineWidth = size / 7;
  context.strokeStyle = "black";
  context.stroke();
}

function drawPanel(canvas, picture, shape, overlay) {
  const dots = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * dots));
  canvas.height = Math.max(1, Math.round((canvas.width * shape[1]) / shape[0]));
  const scale = canvas.width / shape[0];
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = false;
  context.drawImage(cellsAsImage(picture, shape), 0, 0, canvas.width, canvas.height);
  hatch(context, overlay.hatched || [], scale, dots);
  context.lineCap = context.lineJoin = "round";
  for (const casing of [true, false]) {
    for (const { colour, points } of overlay.lines || []) {
      trace(context, points, scale);
      context.lineWidth = (casing ? 6 : 3.2) * dots;
      context.strokeStyle = casing ? "white" : colour;
      context.stroke();
    }
  }
  if (overlay.box) {
    const [left, top, right, bottom] = overlay.box.map((edge) => edge * scale);
    for (const [colour, width] of [["white", 4], ["black", 2]]) {
      context.lineWidth = width * dots;
      context.strokeStyle = colour;
      context.strokeRect(left, top, right - left, bottom - top);
    }
  }
  const { start, goal } = overlay.marks || {};
  if (start) mark(context, start, scale, 6 * dots, 24, 1);
  if (goal) mark(context, goal, scale, 10 * dots, 10, 0.4);
  const { brush } = overlay.marks || {};
  if (brush) mark(context, brush, scale, 7 * dots, 8, 1);
}

function render({ model, el }) {
  el.classList.add("fgtutor-scene");
  // Above the pictures: below them it would lie under the edge of most windows.
  const status = make("div", "fgtutor-status", el);
  status.setAttribute("role", "status"); // read aloud when it changes
  const grid = make("div", "fgtutor-rows", el);
  const charts = make("div", "fgtutor-row", el);
  const legend = make("div", "fgtutor-legend", el);
  const reading = make("pre", "fgtutor-reading", el);
  let canvases = new Map();
  let laidOut = "";
  let labelled = "";
  let scheduled = 0;
  let busy = false; // Python is still answering: what happens meanwhile is merged into `waiting`
  const waiting = [];
  let hovered = "";

  function layOut() {
    const rows = model.get("rows");
    if (JSON.stringify(rows) === laidOut) return;
    laidOut = JSON.stringify(rows);
    const focused = [...canvases].find(([, canvas]) => canvas === document.activeElement);
    canvases = new Map();
    grid.replaceChildren();
    for (const row of rows) {
      const strip = make("div", "fgtutor-row", grid);
      for (const { key, title, caption, colour } of row) {
        const figure = make("figure", "fgtutor-panel", strip);
        const heading = make("figcaption", "fgtutor-title", figure);
        heading.textContent = title;
        // Coloured text may be too pale to read: a bar beside it carries the policy's colour.
        if (colour) heading.style.borderLeft = `0.6em solid ${colour}`;
        if (colour) heading.style.paddingLeft = "0.4em";
        const body = make("div", "fgtutor-body", figure);
        make("div", "fgtutor-y", body);
        const canvas = make("canvas", "fgtutor-canvas", body);
        make("div", "fgtutor-x", body);
        canvas.tabIndex = 0;
        canvas.dataset.key = key;
        canvas.setAttribute("role", "application");
        canvas.setAttribute("aria-label", `${title}. ${caption}. Click, or use the arrow keys.`);
        make("div", "fgtutor-caption", figure).textContent = caption;
        listen(canvas);
        canvases.set(key, canvas);
        sizes.observe(canvas);
      }
    }
    if (focused) canvases.get(focused[0])?.focus();
  }

  function layOutCharts(list) {
    while (charts.childElementCount > list.length) charts.lastChild.remove();
    while (charts.childElementCount < list.length) {
      const figure = make("figure", "fgtutor-panel", charts);
      make("figcaption", "fgtutor-title", figure);
      make("canvas", "fgtutor-chart", figure).setAttribute("role", "img");
      make("div", "fgtutor-caption", figure);
    }
    list.forEach((chart, i) => {
      const [heading, canvas, caption] = charts.children[i].children;
      heading.textContent = chart.title;
      const own = "; below: half, 90 % and 99 % of its own ground";
      caption.textContent = `bars: this map, root of the share; line: w_ood${chart.home.length ? own : ""}`;
      canvas.setAttribute("aria-label", chart.title);
      if (canvas.clientWidth) drawChart(canvas, chart);
    });
  }

  function labelAxes([x0, y0, x1, y1]) {
    const asked = [laidOut, grid.clientWidth, x0, y0, x1, y1].join();
    if (asked === labelled) return; // a drag changes no axis
    labelled = asked;
    for (const axis of grid.querySelectorAll(".fgtutor-x")) {
      label(axis, x0, x1, axis.clientWidth > 300 ? 8 : 4, "left");
      make("span", "fgtutor-unit", axis).textContent = "x (m)";
    }
    for (const axis of grid.querySelectorAll(".fgtutor-y")) {
      label(axis, y0, y1, axis.clientHeight > 200 ? 6 : 3, "bottom");
      make("span", "fgtutor-unit", axis).textContent = "y (m)";
    }
  }

  function draw() {
    scheduled = 0;
    layOut();
    const [shape, pictures, overlay] = ["shape", "pictures", "overlay"].map((k) => model.get(k));
    for (const [key, canvas] of canvases) {
      if (pictures[key] && canvas.clientWidth) drawPanel(canvas, pictures[key], shape, overlay);
    }
    labelAxes(overlay.extent);
    layOutCharts(overlay.charts);
    legend.replaceChildren();
    for (const [name, colour] of Object.entries(overlay.legend || {})) {
      make("span", "fgtutor-swatch", legend).style.background = colour;
      make("span", "fgtutor-name", legend).textContent = name;
    }
    status.textContent = model.get("status");
    const frame = model.get("frame");
    // The next animation frame begins once this one is on the screen.
    requestAnimationFrame(() => {
      el.dataset.painted = String(performance.now());
      el.dataset.frame = String(frame);
    });
  }

  function schedule() {
    scheduled ||= requestAnimationFrame(draw);
  }

  function send(message) {
    const last = waiting.at(-1);
    if (!busy) {
      busy = true;
      model.send(message);
    } else if (last?.kind !== message.kind || last.shift !== message.shift) {
      waiting.push(message);
    } else if (message.cells) {
      last.cells.push(...message.cells);
    } else if (message.step) {
      last.step = last.step.map((d, axis) => d + message.step[axis]);
    }
  }

  function answered(message) {
    if (message.kind !== "done") return;
    busy = false;
    if (waiting.length) send(waiting.shift());
  }

  function cellAt(canvas, event) {
    const [nx, ny] = model.get("shape");
    const area = canvas.getBoundingClientRect();
    const ix = Math.floor(((event.clientX - area.left) / area.width) * nx);
    const iy = ny - 1 - Math.floor(((event.clientY - area.top) / area.height) * ny);
    return [Math.min(Math.max(ix, 0), nx - 1), Math.min(Math.max(iy, 0), ny - 1)];
  }

  function listen(canvas) {
    let last = "";
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      canvas.setPointerCapture(event.pointerId);
      const cell = cellAt(canvas, event);
      last = String(cell);
      send({ kind: "press", cells: [cell], shift: event.shiftKey });
    });
    canvas.addEventListener("pointermove", (event) => {
      const cell = cellAt(canvas, event);
      if (event.buttons & 1) {
        if (String(cell) !== last) send({ kind: "drag", cells: [cell], shift: event.shiftKey });
        last = String(cell);
      } else if (String(cell) !== hovered) {
        hovered = String(cell);
        model.send({ kind: "hover", cells: [cell] });
      }
    });
    canvas.addEventListener("pointerleave", () => {
      hovered = "";
      model.send({ kind: "hover", cells: [] });
    });
    canvas.addEventListener("keydown", (event) => {
      const step = ARROWS[event.key];
      const enter = event.key === " " || (event.key === "Enter" && !event.shiftKey);
      if (!step && !enter) return;
      event.preventDefault(); // the page must not scroll,
      event.stopPropagation(); // and the notebook must not move to another of its cells
      send(step ? { kind: "move", step: [...step], shift: event.shiftKey } : { kind: "enter" });
    });
  }

  function read() {
    reading.textContent = model.get("reading") || "Point at a cell to read its numbers.";
  }

  function say() {
    status.textContent = model.get("status");
  }

  const sizes = new ResizeObserver(schedule);
  model.on("change:frame", schedule);
  model.on("change:status", say);
  model.on("change:reading", read);
  model.on("msg:custom", answered);
  read();
  schedule();
  return () => {
    sizes.disconnect();
    cancelAnimationFrame(scheduled);
    model.off("change:frame", schedule);
    model.off("change:status", say);
    model.off("change:reading", read);
    model.off("msg:custom", answered);
  };
}

export default { render };
