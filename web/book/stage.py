"""Write the book's sources: the repository's notebooks, exercises and pages, fit for Sphinx.

Reads the repository; gives a folder with the same layout, so that links between pages stay as they
are, with `conf.py` and a first page beside them. Notebooks keep the outputs they were committed
with: nothing is executed, but for the frames of sliders (`frames.py`).
"""

import html
import json
import posixpath
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from book.frames import Frames
from book.pages import PAPER, api_pages, course_map, licence_page, needs

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
DOCS = ("notation", "derivations", "results", "a1", "instructor", "cluster")
"""Pages of docs/ that the book holds, in its order."""
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s]+)\)")
"""A link or a picture: mark, words, address."""
DETAILS = re.compile(
    r"^([ ]*(?:- )?)(.*?)<details><summary>(.*?)</summary>(.*?)</details>", re.M | re.S
)
LIVE = {
    "TerrainPainter(": ("planner", "Paint the ground yourself on <a href='{}'>the planner's "
                        "page</a>: feasibility and route follow the brush there."),
    "DriveA1(": ("a1", "On <a href='{}'>the A1's page</a> the robot walks in your browser."),
    "TauExplorer(": ("planner", "The sliders below have a few positions each. On <a href='{}'>the "
                     "planner's page</a> taus, f_min, costs, policies and goal move freely."),
}  # fmt: skip
"""Widgets that need more than pictures: the page that has them live, and what to say of it."""
NEEDS_TORCH = ("ex03", "ex13")
"""Exercises that cannot run in a browser."""
TRY_IT = """\
Try it in the browser: <a href="../../lite/lab/index.html?path={name}.ipynb">open this exercise in
JupyterLite</a>, with nothing to install. Or open `exercises/{name}.ipynb`"""
TOO_LARGE = """\
This exercise needs torch, which does not run in a browser: open `exercises/{name}.ipynb`"""
WRITE_HERE = """\
:::{note}
{where} in JupyterLab (`make lab`), or in one of the other
places of [where to run it](../running.md). `check` marks each answer at once, and what passes
becomes a part of your own planner.
:::
"""
Draw = Callable[[Mapping[str, Any], Path, str], dict[int, Frames]]
"""Draws the frames of a notebook: its content, where pictures go, its name."""


def stage(
    out: Path,
    *,
    draw: Draw,
    notebooks: Iterable[str] | None = None,
    exercises: Iterable[str] | None = None,
    licences: str = "",
) -> list[str]:
    """Write the book's sources into a folder; return the pages, as names without suffix.

    Args:
        out: The folder.
        draw: What draws the frames of a notebook's sliders.
        notebooks: Stems of the notebooks to take, for a small book; default: all.
        exercises: Stems of the exercises to take; default: all.
        licences: The page of licences, in Markdown.
    """
    lessons = list(notebooks or sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb")))
    questions = list(
        exercises or sorted(path.stem for path in (ROOT / "exercises").glob("*.ipynb"))
    )
    pages = [
        "index", "running", "about", "contributing", "licences",
        *(f"notebooks/{name}" for name in lessons),
        *(f"exercises/{name}" for name in questions),
        *(f"docs/{name}" for name in DOCS),
        *api_pages(),
    ]  # fmt: skip
    for folder in ("notebooks", "exercises", "docs", "api", "_static"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    shutil.copy2(HERE / "conf.py", out)
    shutil.copytree(HERE / "_static", out / "_static", dirs_exist_ok=True)
    for picture in (ROOT / "docs").iterdir():
        if picture.suffix in (".png", ".webp", ".gif", ".svg"):
            shutil.copy2(picture, out / "docs")
    texts = {f"docs/{name}": _read(f"docs/{name}.md") for name in DOCS}
    texts |= {"running": _read("web/book/running.md"), "contributing": _read("CONTRIBUTING.md")}
    texts |= {"about": about(), "licences": licence_page(licences), **api_pages()}
    texts["index"] = first_page(pages)
    for page, text in texts.items():
        _write(out / f"{page}.md", links(text, page, pages))
    for name in lessons:
        content = json.loads(_read(f"notebooks/{name}.ipynb"))
        frames = draw(content, out / "_static" / "slides" / name, name)
        _write(out / f"notebooks/{name}.ipynb", lesson(content, name, pages, frames))
    for name in questions:
        content = json.loads(_read(f"exercises/{name}.ipynb"))
        where = TOO_LARGE if name in NEEDS_TORCH else TRY_IT
        note = WRITE_HERE.replace("{where}", where).replace("{name}", name)
        _write(out / f"exercises/{name}.ipynb", lesson(content, name, pages, {}, note=note))
    return pages


def _read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _write(path: Path, text: str) -> None:
    """Write a file unless it holds the text already: Sphinx reads again what has changed only."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


# Links --------------------------------------------------------------------------------------------


def links(text: str, page: str, pages: Iterable[str]) -> str:
    """Rewrite the links of a page, so that each leads to a page of the book, or is words alone.

    A link whose words are the file's own name gets the title of the page instead.
    """
    known = set(pages)

    def rewrite(match: re.Match[str]) -> str:
        mark, words, address = match.groups()
        if mark or re.match(r"[a-z]+:", address) or address.startswith("#"):
            return match[0]
        path, _, anchor = address.partition("#")
        there = posixpath.normpath(posixpath.join(posixpath.dirname(page), path))
        target = PLACES.get(there, there)
        stem, suffix = posixpath.splitext(target)
        if suffix not in (".md", ".ipynb"):
            return match[0] if suffix == ".html" else words
        if stem not in known:
            return words
        back = posixpath.relpath(target, posixpath.dirname(page) or ".")
        title = "" if words.endswith((".ipynb", ".md")) else words
        return f"[{title}]({back}{'#' * bool(anchor)}{anchor})"

    pieces = re.split(r"(^ *```.*?^ *```)", text, flags=re.M | re.S)
    return "".join(one if i % 2 else LINK.sub(rewrite, one) for i, one in enumerate(pieces))


PLACES = {
    "README.md": "about.md",
    "CONTRIBUTING.md": "contributing.md",
    "fgtutor/paper.py": f"{PAPER}.md",
}
"""Where the book has what the repository has elsewhere."""


# Notebooks ----------------------------------------------------------------------------------------


def lesson(
    notebook: dict[str, Any],
    name: str,
    pages: Iterable[str],
    frames: Mapping[int, Frames],
    *,
    note: str = "",
) -> str:
    """Return a notebook for the book: links, answers to fold out, words for pictures, sliders."""
    page = f"{'exercises' if note else 'notebooks'}/{name}"
    for number, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            cell["source"] = folded(links(source, page, pages))
        elif cell["cell_type"] == "code":
            _words(cell)
            _live(cell, source)
            if number in frames:
                cell["outputs"] = [*_texts(cell), _output(figure(frames[number], name))]
    if note:
        first, rest = notebook["cells"][0]["source"].split("\n", 1)
        notebook["cells"][0]["source"] = f"{first}\n\n{note}\n{rest}"
    return json.dumps(notebook, indent=1, ensure_ascii=False)


def folded(text: str) -> str:
    """Open what a browser folds: Markdown and formulas in it are read only after an empty line."""

    def opened(match: re.Match[str]) -> str:
        lead, before, summary, answer = match.groups()
        pad = " " * (len(lead) if "-" in lead else len(lead.rstrip("\n")))
        body = "\n".join(pad + line.strip() if line.strip() else "" for line in answer.splitlines())
        start = f"{lead}{before}".rstrip()
        gap = "\n\n" if before else ""
        return (
            f"{start}{gap}{pad}<details><summary>\n\n{pad}{' '.join(summary.split())}\n\n"
            f"{pad}</summary>\n\n{body}\n\n{pad}</details>\n"
        )

    return DETAILS.sub(opened, text)


def _words(cell: dict[str, Any]) -> None:
    """Let the page take the words of a picture from the output that has them."""
    for output in cell["outputs"]:
        words = output.get("metadata", {}).get("image/png", {}).get("alt")
        if words:
            cell["metadata"]["mystnb"] = {"image": {"alt": words}}


def _live(cell: dict[str, Any], source: str) -> None:
    """Say where a widget is live that pictures cannot replace."""
    last = source.strip().splitlines()[-1] if source.strip() else ""
    for begins, (folder, words) in LIVE.items():
        if last.startswith(begins):
            said = f"<p class='live'>{words.format(f'../../{folder}/index.html')}</p>"
            cell["outputs"] = [_output(said), *cell["outputs"]]


def _texts(cell: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the outputs of a cell but its pictures, which the sliders replace."""
    return [one for one in cell["outputs"] if "image/png" not in one.get("data", {})]


def _output(page: str) -> dict[str, Any]:
    return {"output_type": "display_data", "data": {"text/html": page}, "metadata": {}}


def figure(frames: Frames, name: str) -> str:
    """Return the HTML of sliders: the picture that they begin with, and all that they lead to."""
    folder = f"../_static/slides/{name}/"
    data = {
        "controls": [vars(control) for control in frames.controls],
        "files": list(frames.files),
        "alts": list(frames.alts),
        "folder": folder,
    }
    at = 0
    for control in frames.controls:
        at = at * len(control.values) + control.start
    words = html.escape(frames.alts[at])
    width, height = frames.size
    blob = json.dumps(data, ensure_ascii=False).replace("</", "<\\/")
    return (
        f'<figure class="slides"><img src="{folder}{frames.files[at]}" alt="{words}" '
        f'width="{width}" height="{height}"><figcaption>{words}</figcaption>'
        f'<script type="application/json">{blob}</script></figure>'
    )


# Pages of the book's own --------------------------------------------------------------------------


def sections(text: str) -> dict[str, str]:
    """Return the parts of a page under its second-level headings, by heading."""
    parts = re.split(r"^## (.*)$", text, flags=re.M)
    return dict(zip(parts[1::2], (part.strip() for part in parts[2::2]), strict=True))


def about() -> str:
    """Return the README's parts that say what the library does, as a page."""
    parts = sections(_read("README.md"))
    chosen = ("What you can do with it", "Results", "What this is not")
    return "# The library\n\n" + "\n\n".join(f"## {name}\n\n{parts[name]}" for name in chosen)


def first_page(pages: Iterable[str]) -> str:
    """Return the first page: what it is, what needs what, and every page by kind."""
    course = sections(_read("README.md"))["The course"]
    table = re.search(r"^\| notebook .*?(?=\n\n)", course, re.M | re.S)
    prior = re.search(r"^\*\*What you should know:\*\*.*?(?=\n\n)", course, re.M | re.S)
    which = re.search(r"^\*\*Which needs which:\*\* (.*?) \*\*If", course, re.M | re.S)
    if not (table and prior and which):
        raise ValueError(
            "README.md, The course: the book's first page needs its table of notebooks"
        )
    # Its links count from notebooks/, those of the first page from the root.
    paths = sections(_read("notebooks/00_start_here.md"))["How much time do you have?"]
    paths = re.sub(r"\]\((?!\.\./)", "](notebooks/", paths).replace("](../", "](")
    groups = {
        kind: "\n".join(page for page in pages if page.startswith(f"{kind}/"))
        for kind in ("notebooks", "exercises")
    }
    reference = [f"docs/{name}" for name in DOCS[:4]] + ["api/index", "about", "running"]
    reference += [f"docs/{name}" for name in DOCS[4:]] + ["contributing", "licences"]
    parts = groups | {
        "reference": "\n".join(reference),
        "map": course_map(needs(which[1])),
        "needs": which[1],
        "paths": paths,
        "prior": prior[0],
        "syllabus": table[0],
    }
    text = _read("web/book/start.md")
    for name, part in parts.items():
        text = text.replace("{" + name + "}", part)
    return text
