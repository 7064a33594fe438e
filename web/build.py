"""Build the site: `make site` runs `python web/build.py`, and everything lands in one folder.

Reads the repository and web/node_modules; gives a static folder with a start page, the course as a
book, the planner's page, the A1's page and the exercises in JupyterLite. The site needs no network
and no server of its own: `python -m http.server --directory site` shows it. What takes minutes
(frames of sliders, grounds of the A1) is kept in web/.cache until something that goes into it
changes, and so are the packages for the browser, which come from the registry.
"""

import argparse
import contextlib
import gzip
import hashlib
import importlib
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from book import check, frames, pages, stage

WEB = Path(__file__).resolve().parent
ROOT = WEB.parent
CACHE = WEB / ".cache"
LIVE = ("planner", "a1", "lite")
"""The pages with something live in them; each has an `export.py`."""
SOURCES = (".html", ".js", ".css", ".svg")
"""What a page's folder gives the site as it is."""
PARTS = ("book", *LIVE)


def build_book(
    out: Path,
    scratch: Path,
    *,
    notebooks: list[str] | None = None,
    exercises: list[str] | None = None,
    frame_cache: Path = CACHE / "frames",
    wheels: Path | None = None,
    strict: bool = True,
) -> None:
    """Build the book, or one of some notebooks and exercises; raises `SystemExit` on faults.

    `scratch` is a folder for its sources and what Sphinx reads of them, `wheels` the one with the
    packages of the browser's Python, whose licences the book tells.
    """
    from sphinx.cmd.build import main as sphinx

    if not (WEB / "node_modules/mathjax").is_dir():
        raise SystemExit(
            "web/node_modules has no mathjax: run `make site`, or `npm install` in web/"
        )
    sources, pages_out = scratch / "sources", scratch / "html/book"
    for folder in (sources, pages_out):
        shutil.rmtree(folder, ignore_errors=True)
    stage.stage(
        sources,
        draw=lambda content, where, _: frames.frames_of(content, where, frame_cache),
        notebooks=notebooks,
        exercises=exercises,
        licences=pages.licence_rows(WEB / "node_modules", wheels),
    )
    (sources / "_static/mathjax").mkdir(exist_ok=True)
    shutil.copy2(WEB / "node_modules/mathjax/es5/tex-svg.js", sources / "_static/mathjax")
    # Everything is read anew: Sphinx does not repeat a warning about what it read before.
    options = ["-b", "html", "-q", "-E", "-d", str(scratch / "doctrees")]
    options += ["-W", "--keep-going"] if strict else []
    if sphinx([*options, str(sources), str(pages_out)]):
        raise SystemExit("Sphinx has something to say against the book: see above")
    for left_over in (".buildinfo", "objects.inv", "_modules/index.html"):
        (pages_out / left_over).unlink(missing_ok=True)
    shutil.rmtree(pages_out / "_sources", ignore_errors=True)
    # Only now: myst-nb leaves a folder of its own beside what it writes.
    shutil.copytree(pages_out, out, dirs_exist_ok=True)


def draw_frames(jobs: int) -> None:
    """Draw the frames of all notebooks, several at a time, each in a process of its own."""
    lessons = sorted((ROOT / "notebooks").glob("*.ipynb"))
    # Each process takes one notebook: torch and the drawings of one are all that it holds.
    with ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        for name, seconds in pool.map(_draw, lessons):
            if seconds > 1:
                print(f"  {name}: {seconds:.0f} s", flush=True)


def _draw(lesson: Path) -> tuple[str, float]:
    """Draw the frames of one notebook into the cache."""
    began = time.monotonic()
    content = json.loads(lesson.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as spare:
        frames.frames_of(content, Path(spare), CACHE / "frames")
    return lesson.stem, time.monotonic() - began


def export_page(name: str, out: Path) -> None:
    """Copy a live page and what its `export` writes, which is kept until its sources change."""
    for path in sorted((WEB / name).rglob("*")):
        if path.suffix in SOURCES and path.is_file():
            there = out / path.relative_to(WEB / name)
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, there)
    kept = CACHE / "exports" / f"{name}-{_sources_hash(name)}"
    if not kept.is_dir():
        fresh = kept.with_suffix(".part")
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        importlib.import_module(f"{name}.export").export(fresh)
        fresh.rename(kept)
    shutil.copytree(kept, out, dirs_exist_ok=True)


def _sources_hash(name: str) -> str:
    """Return a hash of what an export reads: the package, specialists, the page's own code."""
    digest = hashlib.sha256()
    folders = [(ROOT / "fgtutor", ".py"), (ROOT / "fgtutor/zoo", ".json"), (WEB / name, "")]
    for folder, suffix in folders:
        for path in sorted(folder.rglob(f"*{suffix}")):
            if path.is_file() and path.suffix != ".pyc":
                digest.update(path.read_bytes())
    more = [WEB / "exports.py", WEB / "package.json"]
    if name == "lite":
        more += [*sorted((ROOT / "exercises").glob("*.ipynb")), ROOT / "constraints.txt"]
        more += [ROOT / "fgtutor/course/checks/solutions.json", WEB / "book/stage.py"]
    for path in more:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def print_sizes(out: Path) -> None:
    """Print the size of each part, as it lies there and as a server sends it."""
    for part in PARTS:
        files = [path for path in (out / part).rglob("*") if path.is_file()]
        raw = sum(path.stat().st_size for path in files)
        packed = sum(len(gzip.compress(path.read_bytes(), 6)) for path in files)
        weight = f"{raw / 1e6:6.1f} MB, {packed / 1e6:6.1f} MB gzipped"
        print(f"  {part + '/':9} {weight}, {len(files)} files")


def main() -> None:
    """Build everything, check it, and say what it weighs."""
    parser = argparse.ArgumentParser(description="Build the site into one static folder.")
    parser.add_argument("--out", type=Path, default=ROOT / "site", help="the folder (%(default)s)")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--only", choices=PARTS, action="append", help="build these parts only")
    options = parser.parse_args()
    out: Path = options.out.resolve()
    parts = options.only or PARTS
    out.mkdir(parents=True, exist_ok=True)
    for part in parts:
        shutil.rmtree(out / part, ignore_errors=True)
    for name in LIVE:
        if name in parts:
            print(f"exporting {name}", flush=True)
            with contextlib.chdir(ROOT):
                export_page(name, out / name)
    if "book" in parts:
        print("drawing the frames of the sliders", flush=True)
        draw_frames(options.jobs)
        print("building the book", flush=True)
        build_book(out / "book", CACHE / "book", wheels=out / "lite/static/pyodide")
    shutil.copytree(WEB / "js", out / "js", dirs_exist_ok=True)
    for name in ("index.html", "start.css", "style.css"):
        shutil.copy2(WEB / name, out / name)
    shutil.copy2(ROOT / "docs/walk.webp", out / "walk.webp")
    faults = check.faults(out)
    for fault in faults:
        print(fault, file=sys.stderr)
    print_sizes(out)
    if faults:
        raise SystemExit(f"{len(faults)} faults in {out}")
    print(f"ready: python -m http.server --bind 127.0.0.1 --directory {os.path.relpath(out)}")


if __name__ == "__main__":
    main()
