/**
 * Sliders over pictures that were drawn ahead (`frames.py`): the answer of a page without a kernel.
 *
 * Reads `<figure class="slides">` with a script of JSON {controls, files, alts, size, folder} and
 * the picture that it begins with; gives each control a labelled input. Files lie in the order of
 * the controls' positions, the last control's changing first.
 */

/**
 * @typedef {{label: string, values: string[], start: number, kind: "range" | "choice", sets: number[]}} Control
 * @typedef {{controls: Control[], files: string[], alts: string[], folder: string}} Slides
 */

/**
 * Where the picture of some positions stands in the list.
 * @param {Control[]} controls
 * @param {number[]} positions
 * @returns {number}
 */
export function frameAt(controls, positions) {
  return controls.reduce((sum, control, i) => sum * control.values.length + positions[i], 0);
}

/**
 * Make the input of one control, and what calls back when it is moved.
 * @param {Control} control
 * @param {string} id
 * @param {(position: number) => void} moved
 * @returns {HTMLElement}
 */
function field(control, id, moved) {
  const row = document.createElement("div");
  const label = row.appendChild(document.createElement("label"));
  label.htmlFor = id;
  label.textContent = control.label;
  if (control.kind === "choice") {
    const list = row.appendChild(document.createElement("select"));
    list.id = id;
    control.values.forEach((words, i) => list.add(new Option(words, String(i))));
    list.selectedIndex = control.start;
    list.addEventListener("input", () => moved(list.selectedIndex));
    return row;
  }
  const slider = row.appendChild(document.createElement("input"));
  Object.assign(slider, { id, type: "range", min: 0, max: control.values.length - 1, step: 1 });
  slider.value = String(control.start);
  const shown = row.appendChild(document.createElement("output"));
  shown.htmlFor.add(id);
  const say = () => {
    shown.textContent = control.values[slider.valueAsNumber];
    slider.setAttribute("aria-valuetext", `${control.values[slider.valueAsNumber]}`);
  };
  slider.addEventListener("input", () => {
    say();
    moved(slider.valueAsNumber);
  });
  say();
  return row;
}

/**
 * Bring one figure to life.
 * @param {HTMLElement} figure
 * @param {number} number of the figure on its page
 */
function enliven(figure, number) {
  const image = /** @type {HTMLImageElement} */ (figure.querySelector("img"));
  const words = /** @type {HTMLElement} */ (figure.querySelector("figcaption"));
  const text = /** @type {HTMLElement} */ (figure.querySelector("script")).textContent;
  const slides = /** @type {Slides} */ (JSON.parse(text ?? ""));
  const positions = slides.controls.map((control) => control.start);
  const at = () => frameAt(slides.controls, positions);
  const address = (/** @type {number} */ i) => slides.folder + slides.files[i];
  const show = () => {
    words.textContent = slides.alts[at()];
    image.hidden = !slides.files[at()];
    if (image.hidden) return;
    image.src = address(at());
    image.alt = slides.alts[at()];
  };
  const board = document.createElement("div");
  board.className = "slides-controls";
  slides.controls.forEach((control, i) => {
    board.append(field(control, `slide-${number}-${i}`, (position) => {
      positions[i] = position;
      if (control.sets.length) {
        const [other, to] = control.sets;
        positions[other] = to;
        const list = board.children[other].querySelector("select");
        if (list) list.selectedIndex = to;
      }
      show();
    }));
  });
  // The neighbours of a picture are fetched once somebody comes near, so that a drag is smooth.
  board.addEventListener("pointerenter", () => fetchAll(slides), { once: true });
  board.addEventListener("focusin", () => fetchAll(slides), { once: true });
  words.setAttribute("aria-live", "polite");
  figure.prepend(board);
}

/**
 * Fetch all pictures of a figure into the browser's cache, one after the other.
 * @param {Slides} slides
 */
async function fetchAll(slides) {
  for (const file of new Set(slides.files)) {
    if (!file) continue;
    const ahead = new Image();
    ahead.src = slides.folder + file;
    await ahead.decode().catch(() => undefined);
  }
}

if (typeof document !== "undefined") {
  document.querySelectorAll("figure.slides").forEach((figure, number) => {
    enliven(/** @type {HTMLElement} */ (figure), number);
  });
}
