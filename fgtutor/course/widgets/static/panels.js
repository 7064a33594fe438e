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
}

function render({ model, el }) {
  el.classList.add("fgtutor-scene");
  const grid = make("div", "fgtutor-rows", el);
  const legend = make("div", "fgtutor-legend", el);
  const status = make("div", "fgtutor-status", el);
  status.setAttribute("role", "status"); // read aloud when it changes
  const reading = make("pre", "fgtutor-reading", el);
  let canvases = new Map();
  let laidOut = "";
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
        const canvas = make("canvas", "fgtutor-canvas", figure);
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

  function draw() {
    scheduled = 0;
    layOut();
    const [shape, pictures, overlay] = ["shape", "pictures", "overlay"].map((k) => model.get(k));
    for (const [key, canvas] of canvases) {
      if (pictures[key] && canvas.clientWidth) drawPanel(canvas, pictures[key], shape, overlay);
    }
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
    } else {
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
      if (!step) return;
      event.preventDefault(); // the page must not scroll,
      event.stopPropagation(); // and the notebook must not move to another of its cells
      send({ kind: "move", step: [...step], shift: event.shiftKey });
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
