"""Every picture that a notebook's sliders lead to, drawn ahead for a page without a kernel.

Reads an executed notebook; gives, for each cell that shows sliders, pictures as WebP files and the
controls that choose among them (`_static/slides.js` shows them). A slider is thinned to a few
positions, its first one included, and all positions of one go with all of the others. What came
out is kept in a cache by a hash of all that goes in: the cells, the specialists and the code.
"""

import contextlib
import hashlib
import io
import itertools
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from book.cells import run
from PIL import Image

import fgtutor
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.scene_figure import scene_figure
from fgtutor.course.widgets.slides import Slides
from fgtutor.course.widgets.still import w
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.errors import FgtutorError
from fgtutor.figures.style import Picture

POSITIONS = {
    "PatchSlides": {"x": 10, "y": 3, "yaw": 8},
    "TrackingSlides": {"sigma": 5, "command": 5, "speed": 9},
    "LabelSlides": {"window": 4, "step": 31},
    "FrontierSlides": {"share": 21},
    "AdvantageSlides": {"lam": 16, "gamma": 6},
    "GateSlides": {"f_min": 27},
    "RouteSlides": {"metre": 35},
    "LidarSlides": {"count": 40},
}
"""How many positions each slider keeps; a control that is not named keeps all."""
TAU_LOW, TAU_HIGH = (0.02, 0.1, 0.3, 0.5, 0.9), (1.0, 1.5, 2.0, 3.0, 5.0)
"""The taus that the explorer's page offers, the paper's among them."""
EXPLORER = "TauExplorer"
Draw = Callable[..., Picture]


@dataclass(frozen=True)
class Control:
    """A slider or a list that a reader moves."""

    label: str
    """What it sets, with its unit."""
    values: Sequence[str]
    """Its positions, in words."""
    start: int
    """Which of them the page begins with."""
    kind: str = "range"
    """"range", a slider, or "choice", a list."""
    sets: Sequence[int] = ()
    """Another control and its position that moving this one brings about, by number."""


@dataclass(frozen=True)
class Frames:
    """The pictures of one cell, in the order of the controls' positions, the last control first."""

    controls: Sequence[Control]
    files: Sequence[str]
    """Name of the picture of each combination."""
    alts: Sequence[str]
    """What each of them shows."""
    size: tuple[int, int]
    """Width and height, pixels."""


def is_slide(source: str) -> str:
    """Return the class of the sliders that a cell shows on its last line, or ""."""
    name = source.strip().splitlines()[-1].split("(")[0] if source.strip() else ""
    return name if name.endswith("Slides") or name == EXPLORER else ""


def frames_of(notebook: Mapping[str, Any], out: Path, cache: Path) -> dict[int, Frames]:
    """Draw the frames of every cell with sliders into a folder; return them by the cell's number.

    Raises `ValueError` if what the page begins with is not what the notebook's own picture shows.
    """
    code = [(i, "".join(one["source"])) for i, one in enumerate(notebook["cells"])
            if one["cell_type"] == "code"]  # fmt: skip
    shown = [(k, number) for k, (number, source) in enumerate(code) if is_slide(source)]
    sources, found = [source for _, source in code], {}
    for last, number in shown:
        what = [sources[: last + 1], notebook["metadata"].get("fgtutor"), _code_hash()]
        key = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:20]
        if not (cache / key / "frames.json").is_file():
            _draw_into(sources, last, _alt(notebook["cells"][number]), cache / key)
        for path in (cache / key).glob("*.webp"):
            out.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, out / path.name)
        known = json.loads((cache / key / "frames.json").read_text(encoding="utf-8"))
        known["controls"] = [Control(**one) for one in known["controls"]]
        found[number] = Frames(**known)
    return found


def _alt(cell: Mapping[str, Any]) -> str:
    """Return the words of the picture that a cell committed."""
    metadata = [one.get("metadata", {}) for one in cell["outputs"]]
    return next(one["image/png"]["alt"] for one in metadata if "image/png" in one)


def _draw_into(sources: Sequence[str], last: int, expected: str, folder: Path) -> None:
    """Run the notebook up to a cell and draw what its sliders lead to; all files or none."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch, _elsewhere():
        widget = run(sources, last)
        controls, draw = _explored(widget) if is_slide(sources[last]) == EXPLORER else _slid(widget)
        still = widget.still()
        if (still.alt or still.described()) != expected:
            raise ValueError(
                f"the page would begin with {still.alt!r}, the notebook has {expected!r}: execute "
                "the notebook again, or see which cell before this one `cells.needed` leaves out"
            )
        known = asdict(_frames(controls, draw, Path(scratch)))
        (Path(scratch) / "frames.json").write_text(json.dumps(known), encoding="utf-8")
        shutil.copytree(scratch, folder)


@contextlib.contextmanager
def _elsewhere() -> Iterator[None]:
    """Work in an empty folder, as a notebook that is built does, and print nothing."""
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        yield


def _frames(controls: Mapping[str, tuple[Control, Sequence[Any]]], draw: Draw, out: Path) -> Frames:
    """Draw every combination; pictures that are alike are kept once."""
    files, alts, size = [], [], (0, 0)
    for values in itertools.product(*(values for _, values in controls.values())):
        try:
            picture = draw(**dict(zip(controls, values, strict=True)))
            image, words = _pixels(picture), picture.alt
        except FgtutorError as error:  # a widget shows the reason in place of a picture
            files.append("")
            alts.append(str(error))
            continue
        size = image.size
        buffer = io.BytesIO()
        image.save(buffer, format="WEBP", lossless=True, quality=60, method=3)
        name = hashlib.sha256(buffer.getvalue()).hexdigest()[:16] + ".webp"
        (out / name).write_bytes(buffer.getvalue())
        files.append(name)
        alts.append(words)
    return Frames([control for control, _ in controls.values()], files, alts, size)


def _pixels(picture: Picture) -> Image.Image:
    """Return a picture in few colours: a smooth map then takes a third of the bytes."""
    canvas = picture.canvas
    canvas.draw()  # pyright: ignore[reportAttributeAccessIssue]
    pixels = canvas.buffer_rgba()  # pyright: ignore[reportAttributeAccessIssue]
    image = Image.frombuffer("RGBA", canvas.get_width_height(), pixels).convert("RGB")
    return image.quantize(128, dither=Image.Dither.NONE).convert("RGB")


def _slid(widget: Slides) -> tuple[dict[str, tuple[Control, Sequence[Any]]], Draw]:
    """Return the controls of slides with the positions that are kept, and how one is drawn."""
    most = POSITIONS.get(type(widget).__name__, {})
    return {
        name: _control(one, most.get(name)) for name, one in widget.controls.items()
    }, widget.draw


def _control(control: w.ValueWidget, most: int | None) -> tuple[Control, Sequence[Any]]:
    """Thin a control to `most` positions, the one it stands at included."""
    label, at = control.description, control.value
    if isinstance(control, w.FloatSlider | w.IntSlider):
        low, step = control.min, control.step
        count = round((control.max - low) / step)
        here = round((at - low) / step)
        kept = np.unique(
            np.linspace(0, count, min(most or count + 1, count + 1)).round().astype(int)
        )
        kept[np.abs(kept - here).argmin()] = here
        values = [type(at)(round(low + step * k, 6)) for k in kept.tolist()]
        values[kept.tolist().index(here)] = at
        # Words are those that the widget itself shows beside its slider.
        words = [f"{value:g}" if isinstance(at, int) else f"{value:.3g}" for value in values]
        return Control(label, words, values.index(at)), values
    pairs = [one if isinstance(one, tuple) else (str(one), one) for one in control.options]
    values = [value for _, value in pairs]
    kind = "range" if isinstance(control, w.SelectionSlider) else "choice"
    return Control(label, [words for words, _ in pairs], values.index(at), kind), values


def _explored(widget: Any) -> tuple[dict[str, tuple[Control, Sequence[Any]]], Draw]:
    """Return thresholds for the tau explorer: each policy's own, or one pair for all."""
    explorer: Explorer = widget.explorer
    pictures, memory = TauPictures(explorer), {}

    def draw(rule: str, low: float, high: float) -> Picture:
        taus = "calibrated" if rule == "calibrated" else (low, high)
        if taus not in memory:
            explorer.update(taus=taus)
            memory[taus] = scene_figure(pictures.scene())
        return memory[taus]

    rules = Control(
        "thresholds", ["each policy's own (calibrated)", "one pair for all"], 0, "choice"
    )
    return {
        "rule": (rules, ("calibrated", "pair")),
        "low": (Control("tau_low", [f"{one:g}" for one in TAU_LOW], 1, sets=(0, 1)), TAU_LOW),
        "high": (Control("tau_high", [f"{one:g}" for one in TAU_HIGH], 2, sets=(0, 1)), TAU_HIGH),
    }, draw


def _code_hash() -> str:
    """Return a hash of all code that may draw."""
    digest = hashlib.sha256()
    here = Path(__file__)
    for path in (here, here.with_name("cells.py"), *_package()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _package() -> list[Path]:
    """Return the files of fgtutor; marks and exercises draw nothing."""
    package = Path(fgtutor.__file__).parent
    course = ("checks", "grading", "exercises.py")
    left_out = [package / "cli", *(package / "course" / name for name in course)]
    every = sorted(package.rglob("*.py"))
    return [path for path in every if not any(path.is_relative_to(one) for one in left_out)]
