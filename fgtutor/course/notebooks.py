"""The course's notebooks: how long their cells work, and how a source becomes a notebook.

Reads notebooks/src/NN_name.py (jupytext percent format, one way); gives notebooks/NN_name.ipynb,
executed by a real kernel, its outputs reduced to text and PNG pictures with alt text, so that a
page without a kernel teaches too and a rebuild changes as little as it can. What is committed is
executed in full: its numbers and pictures are those that the text speaks of.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Interval
from PIL import Image

from fgtutor.errors import ConfigError, NotebookError
from fgtutor.io.progress import waiting
from fgtutor.io.storage import atomic_write, make_folder
from fgtutor.io.validation import Count, NonNegative, check_arguments, check_fields
from fgtutor.robots import ROBOTS
from fgtutor.specialist import DESCRIPTION, ZOO

if TYPE_CHECKING:
    from nbformat import NotebookNode

FAST = "FGTUTOR_FAST"
"""Environment variable: 1 makes every `budget` its fast one."""
LIMIT = 600_000
"""Largest notebook, outputs included, bytes."""
COLOURS = (256, 64)
"""Colours of a picture that has to be small, and of one that has to be smaller still."""
ALT_WORDS = 3
"""Fewest words that can say what a picture shows."""
PATH = re.compile(r"(?<![\w./:<-])(?:/[\w.+-]+){2,}|\b[A-Za-z]:\\\w")
"""An absolute path, of any system: it would tell where the notebook was built."""
BAR = re.compile(r".*\d+/\d+ \[.*\]")
"""A line of a tqdm progress bar."""
WIDGET = "application/vnd.jupyter.widget-view+json"


def budget(fast: Count, full: Count, *, unit: str = "rounds", each: NonNegative = 0.0) -> int:
    """Return how much a long cell should do, and say it: `fast` if FGTUTOR_FAST is 1, else `full`.

    Args:
        fast: Enough to see the idea.
        full: Enough to trust the numbers.
        unit: What is counted, for the message.
        each: Seconds that one of them takes on two CPU cores; 0 leaves the time out.
    """
    check_arguments(budget, locals(), ConfigError)
    in_force, other = (fast, full) if os.environ.get(FAST) == "1" else (full, fast)
    how = "in full" if in_force == full else "fast"
    switch = f"without {FAST}=1" if in_force == fast else f"with {FAST}=1"
    print(f"{how}: {_amount(in_force, unit, each)}; {switch}: {_amount(other, unit, each)}")
    return in_force


def _amount(count: int, unit: str, each: float) -> str:
    seconds = count * each
    if not seconds:
        return f"{count} {unit}"
    lasts = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
    return f"{count} {unit}, about {lasts} on two CPU cores"


# From source to notebook --------------------------------------------------------------------------


def read_source(source: Path) -> NotebookNode:
    """Return the notebook that a source describes, without outputs; ids count its cells."""
    import jupytext

    notebook = jupytext.read(source, fmt="py:percent")
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"{source.stem}-{number:02}", {}
    notebook.metadata.clear()
    notebook.metadata.update(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    return notebook


def slide_of(cell: NotebookNode) -> dict[str, Any]:
    """Return what `make slides` reads in a cell: a heading begins a slide, a picture one below."""
    heading = cell.cell_type == "markdown" and cell.source.startswith("#")
    picture = any("image/png" in output.get("data", {}) for output in cell.get("outputs", ()))
    kind = "slide" if heading else "subslide" if picture else ""
    return {"slideshow": {"slide_type": kind}} if kind else {}


def build(source: Path, *, fast: bool = False, timeout: int = 900) -> NotebookNode:
    """Execute a source in an empty folder, in full or in fast mode; keep what readers should see.

    Raises:
        NotebookError: A cell fails, takes longer than `timeout` seconds or writes a warning, or the
            notebook has a fault (`find_faults`).
    """
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    notebook = read_source(source)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as settings,
    ):
        client = NotebookClient(
            notebook,
            kernel_name="python3",
            timeout=timeout,
            resources={"metadata": {"path": folder}},
            coalesce_streams=True,
            record_timing=False,
            extra_arguments=["--log-level=ERROR"],  # its sockets are this machine's own
        )
        try:
            # The reader's own IPython start-up files are no part of the course.
            client.execute(env=os.environ | {FAST: str(int(fast)), "IPYTHONDIR": settings})
        except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
            raise NotebookError(f"{source.name} does not run: {error}") from error
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = list(_kept(cell.outputs, f"{source.name}, cell {cell.id}"))
        cell.metadata = slide_of(cell)
    notebook.metadata.pop("widgets", None)
    notebook.metadata["language_info"] = {"name": "python"}  # the kernel adds its version
    notebook.metadata["fgtutor"] = {"fast": fast, "specialists": specialists_of(notebook)}
    slim(notebook)
    faults = find_faults(notebook)
    if faults:
        raise NotebookError(f"{source.name}: {'; '.join(faults)}")
    return notebook


def _kept(outputs: Sequence[Any], where: str) -> Iterator[Any]:
    """Yield the outputs worth keeping: text, and pictures as PNGs with their alt text.

    A widget lives only with its kernel and goes, unless it brings a picture of itself, or words
    with metadata that say so (`ask.ALONE`); so does a progress bar. Raises `NotebookError` for any
    other line on stderr: a lesson has no warnings.
    """
    for output in outputs:
        if output.output_type == "stream":
            lines = re.split(r"[\r\n]+", output.text.strip())
            if output.name == "stdout":
                yield output
            elif not all(BAR.fullmatch(line) or not line.strip() for line in lines):
                raise NotebookError(f"{where} writes to stderr: {output.text.strip()[-500:]}")
            continue
        data = output.data
        if "image/png" in data:
            words = output.metadata.get("image/png", {}).get("alt")
            output.data = {"image/png": recode(data["image/png"])}
            output.metadata = {"image/png": {"alt": words}} if words else {}
            yield output
            continue
        if "text/plain" in data and (WIDGET not in data or output.metadata.get("text/plain")):
            output.data, output.metadata = {"text/plain": data["text/plain"]}, {}
            yield output


def slim(notebook: NotebookNode) -> None:
    """Reduce the largest pictures to `COLOURS`, until the notebook is within `LIMIT`.

    A palette can turn a smooth colour bar into bands; as many pictures as fit keep every colour.
    """
    import nbformat

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [output.data for output in outputs if "image/png" in output.get("data", {})]
    for colours in COLOURS:
        for data in sorted(pictures, key=lambda data: len(data["image/png"]), reverse=True):
            if len(nbformat.writes(notebook).encode()) <= LIMIT:
                return
            data["image/png"] = recode(data["image/png"], colours)


def recode(png: str, colours: int | None = None) -> str:
    """Return a base64 PNG without transparency, as small as it gets, in so many colours at most."""
    with Image.open(io.BytesIO(base64.b64decode(png))) as image:
        picture = image.convert("RGB")
    if colours is not None:
        picture = picture.quantize(colours, kmeans=2, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return min(png.replace("\n", ""), base64.b64encode(buffer.getvalue()).decode(), key=len)


# Is a built notebook still good? ------------------------------------------------------------------


def find_faults(notebook: NotebookNode) -> list[str]:
    """Say what a built notebook must not hold: much data, absolute paths, widgets, other media.

    Nor may it hold a picture without alt text.
    """
    import nbformat

    faults = []
    size = len(nbformat.writes(notebook).encode())
    if size > LIMIT:
        faults.append(f"{size} bytes, more than {LIMIT}: fewer or smaller pictures")
    if "widgets" in notebook.metadata:
        faults.append("widget state in the metadata")
    for cell in notebook.cells:
        texts = [cell.source]
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            others = data.keys() - {"image/png", "text/plain"}
            if others or output.output_type == "error":
                faults.append(f"cell {cell.id} holds {', '.join(sorted(others)) or 'an error'}")
            texts += [output.get("text", ""), data.get("text/plain", "")]
            alt = output.get("metadata", {}).get("image/png", {}).get("alt", "")
            if "image/png" in data and len(alt.split()) < ALT_WORDS:
                faults.append(
                    f"cell {cell.id} has a picture without alt text: show a Picture or a Photo, "
                    "which bring it"
                )
        paths = [match[0] for text in texts for match in PATH.finditer(text)]
        if paths:
            faults.append(f"cell {cell.id} shows the absolute path {paths[0]}")
    return faults


def find_drift(folder: Path) -> dict[str, str]:
    """Return by name every notebook of a course that is not what its source gives, and why.

    Sources lie in `folder`/src. A notebook is also stale once the shipped specialists of a robot
    that it names have changed since it was executed: its numbers and pictures are theirs. And one
    that was executed in fast mode does not show what its text says.
    """
    import nbformat

    sources = {path.stem: path for path in sorted((folder / "src").glob("*.py"))}
    built = {path.stem: path for path in sorted(folder.glob("*.ipynb"))}
    drift = {name: "has no source in src" for name in built.keys() - sources.keys()}
    for name, source in sources.items():
        if name not in built:
            drift[name] = "was never built"
            continue
        notebook = nbformat.read(built[name], as_version=4)
        fresh = read_source(source)
        ours, theirs = ([(c.cell_type, c.source) for c in n.cells] for n in (notebook, fresh))
        if ours != theirs:
            same = [a == b for a, b in zip(ours, theirs, strict=False)]
            drift[name] = f"differs from its source from cell {[*same, False].index(False)} on"
        elif notebook.metadata.get("fgtutor", {}).get("specialists") != specialists_of(fresh):
            drift[name] = "was executed with other specialists than those shipped"
        elif notebook.metadata["fgtutor"].get("fast", True):
            drift[name] = "was executed in fast mode"
    return drift


def specialists_of(notebook: NotebookNode) -> dict[str, str]:
    """Return a checksum over the shipped specialists of each robot that a notebook names."""
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return {robot: _zoo_checksum(robot) for robot in ROBOTS if f'"{robot}"' in code}


def _zoo_checksum(robot: str) -> str:
    descriptions = sorted((ZOO / robot).glob(f"*/{DESCRIPTION}"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in descriptions)).hexdigest()[:16]


# The command --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class NotebooksConfig:
    """Execute the course's notebooks in full and write them with their pictures."""

    names: tuple[str, ...] = ()
    """Beginnings of names, such as 01 06; default: all."""
    folder: Path = Path("notebooks")
    """The course: sources in its src, notebooks beside it."""
    out: Path | None = None
    """Where to write; default: the folder itself."""
    timeout: Annotated[int, Interval(ge=1, le=86_400)] = 900
    """Longest time for one cell, s."""
    fast: bool = False
    """Execute in fast mode, in a minute or two each, to see that they run; FGTUTOR_FAST=1 does the
    same. Not for what is committed."""
    check: bool = False
    """Execute nothing; say which notebooks are not what their sources give, and fail if any."""

    def __post_init__(self) -> None:
        check_fields(self)


def run(config: NotebooksConfig) -> int:
    """Build the notebooks, or check them; raises `ConfigError` if there are none of that name."""
    import nbformat

    if config.check:
        drift = find_drift(config.folder)
        for name, reason in drift.items():
            print(f"{name} {reason}: run `fgtutor notebooks --names {name}`")
        return int(bool(drift))
    every = sorted((config.folder / "src").glob("*.py"))
    sources = [path for path in every if not config.names or path.stem.startswith(config.names)]
    if not sources:
        there = ", ".join(path.stem for path in every) or "none: run this in the repository"
        raise ConfigError(
            f"{config.folder / 'src'} has no source for {', '.join(config.names) or 'a notebook'}; "
            f"there are {there}"
        )
    out = config.out or config.folder
    make_folder(out)
    fast = config.fast or os.environ.get(FAST) == "1"
    for source in sources:
        began = time.monotonic()
        with waiting(f"executing {source.name}"):
            text = nbformat.writes(build(source, fast=fast, timeout=config.timeout)) + "\n"
        with atomic_write(out / f"{source.stem}.ipynb") as path:
            path.write_text(text, encoding="utf-8")
        seconds = time.monotonic() - began
        print(f"{source.stem}: {seconds:.0f} s, {len(text.encode()) / 1000:.0f} kB", flush=True)
    return 0
