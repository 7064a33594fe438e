"""Pages that the book adds: the interface of the library, the map of the course, the licences.

Reads the modules' docstrings through Sphinx, README's sentence on what needs what, and what is
installed; gives Markdown by page.
"""

import email
import itertools
import json
import re
import tomllib
import zipfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

API = {
    "Maps and patches": ("elevation", "patches", "directions"),
    "What a policy knows": ("feasibility", "specialist", "tensorization"),
    "Planning": ("fusion", "settings", "planning", "routes", "baselines"),
    "Ground, robots and training": ("world.terrain", "execution", "learning.training"),
    "Faults": ("errors",),
}
"""Modules of fgtutor with the names that others build on, in the order of the method."""
PAPER = "api/paper"
"""The page with the paper's planner, line by line."""
OUR_CODE = (
    ("fgtutor", "MIT", "the library, the course, these pages"),
    ("Munk2D (Chipmunk)", "MIT", "the toy's physics, from pymunk's source, as WebAssembly"),
    (
        "numpy, as WebAssembly",
        "BSD-3-Clause",
        "for the exercises in the browser, by emscripten-forge",
    ),
    ("CPython", "PSF-2.0", "Python itself, within Pyodide"),
    ("Model of the Unitree A1", "BSD-3-Clause", "numbers of the robot, from MuJoCo Menagerie"),
)


def api_pages() -> dict[str, str]:
    """Return the pages of the library's interface, by name."""
    pages = {PAPER: _paper()}
    lines = [
        "# The library's names",
        "",
        "Every stage of the method is a function over plain values. These are the names that "
        "others build on; those of the first line of a program come from `fgtutor` itself:",
        "",
        "```python",
        "from fgtutor import ElevationMap, make_terrain, load_specialist, load_zoo",
        "from fgtutor import assess, tensorize, fuse, plan, plan_on_map, execute, train",
        "from fgtutor import PlanSettings, PAPER, errors",
        "```",
        "",
        "[The paper's planner in one file](paper.md) is the shortest way into the code.",
    ]
    for title, modules in API.items():
        lines += ["", f"## {title}", "", "```{toctree}", ":maxdepth: 1", ""]
        for module in modules:
            name = module.replace(".", "_")
            lines.append(name)
            pages[f"api/{name}"] = (
                f"# fgtutor.{module}\n\n```{{eval-rst}}\n.. automodule:: fgtutor.{module}\n```\n"
            )
        lines.append("```")
    lines += ["", "```{toctree}", ":hidden:", "", "paper", "```"]
    return {"api/index": "\n".join(lines) + "\n"} | pages


def _paper() -> str:
    code = (Path(__file__).parents[2] / "fgtutor" / "paper.py").read_text(encoding="utf-8")
    return (
        "# The paper's planner in one file\n\n`fgtutor/paper.py` is the planner as the "
        "paper writes it down, and as slow as it reads. The tests hold the fast one to it.\n\n"
        f"```python\n{code}```\n"
    )


# What needs what ----------------------------------------------------------------------------------


def needs(sentence: str) -> dict[str, list[str]]:
    """Return which notebooks each one builds on, from README's sentence on it."""
    words = re.sub(r"(\d\d) to (\d\d)", lambda m: ", ".join(_span(m[1], m[2])), sentence)
    chain = _span(*re.findall(r"\d\d", sentence)[:2])
    found = {name: [before] for before, name in itertools.pairwise(chain)}
    found |= {chain[0]: []}
    for name, before in re.findall(r"(\d\d) needs ((?:\d\d(?:, | and )?)+)", words):
        found[name] = re.findall(r"\d\d", before)
    missing = [name for name in _span("01", "13") if name not in found and name != "08"]
    if missing:
        raise ValueError(f"README.md, Which needs which: nothing on {', '.join(missing)}")
    return {"08": [chain[-1]]} | found


def _span(first: str, last: str) -> list[str]:
    return [f"{number:02}" for number in range(int(first), int(last) + 1)]


PLACE = {
    **{f"{number:02}": (number - 1, 0) for number in range(1, 9)},
    "09": (5, 1), "11": (7, 1), "10": (4, 2), "13": (6, 2), "12": (7, 2),
}  # fmt: skip
"""Column and row of each notebook on the map."""
SHORT = {
    "01": "maps", "02": "a robot", "03": "feasibility", "04": "seen it?", "05": "tensor",
    "06": "plan", "07": "drive", "08": "the A1", "09": "train", "10": "adapt", "11": "mixed",
    "12": "scan", "13": "scale out",
}  # fmt: skip


def direct(before: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Return the needs that no other need brings along: 11 needs 08, which needs 07."""

    def all_of(name: str) -> set[str]:
        return set(before[name]).union(*(all_of(one) for one in before[name]))

    return {
        name: [one for one in some if not any(one in all_of(other) for other in some)]
        for name, some in before.items()
    }


def course_map(before: Mapping[str, list[str]]) -> str:
    """Return a drawing of what needs what; each notebook is a link."""
    wide, high, across, down = 84, 44, 100, 84
    corners = {name: (6 + across * i, 6 + down * k) for name, (i, k) in PLACE.items()}
    names = {path.stem[:2]: path.stem for path in _lessons()}
    lines, boxes = [], []
    for name, some in sorted(direct(before).items()):
        x, y = corners[name]
        for u, v in (corners[one] for one in some):
            ends = (u + wide, v + high / 2, x - 3, y + high / 2)
            if v < y:
                ends = (u + wide / 2, v + high, x + wide / 2, y - 3)
            lines.append("<line x1='{:g}' y1='{:g}' x2='{:g}' y2='{:g}'/>".format(*ends))
        middle = x + wide / 2
        boxes.append(
            f"<a href='notebooks/{names[name]}.html'>"
            f"<rect x='{x}' y='{y}' width='{wide}' height='{high}' rx='6'/>"
            f"<text x='{middle:g}' y='{y + 18}' font-weight='bold'>{name}</text>"
            f"<text x='{middle:g}' y='{y + 35}'>{SHORT[name]}</text></a>"
        )
    said = "; ".join(f"{name} needs {' and '.join(some)}" for name, some in before.items() if some)
    return (
        f"<svg class='course-map' viewBox='0 0 {8 * across} {2 * down + high + 12}' role='img' "
        f"aria-label='{said}'><defs><marker id='tip' viewBox='0 0 8 8' refX='6' refY='4' "
        "markerWidth='7' markerHeight='7' orient='auto'><path d='M0 0L8 4L0 8z' "
        "fill='currentColor'/></marker></defs><g class='arrows' marker-end='url(#tip)'>"
        f"{''.join(lines)}</g><g class='boxes'>{''.join(boxes)}</g></svg>"
    )


def _lessons() -> list[Path]:
    return sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


# Licences -----------------------------------------------------------------------------------------


def licence_page(rows: str) -> str:
    """Return the page of licences around a table of what the site was built from."""
    ours = "\n".join(f"| {name} | | {licence} | {what} |" for name, licence, what in OUR_CODE)
    return (
        "# Licences\n\nWhat these pages hold, or were made with, and under which licence. "
        "Versions are those installed when the site was built.\n\n"
        "| package | version | licence | what for |\n| --- | --- | --- | --- |\n"
        f"{ours}\n{rows}\n"
    )


def licence_rows(modules: Path, wheels: Path | None = None) -> str:
    """Return a row for each npm package and each Python package of the book, then the texts.

    Packages of the browser's Python come from the folder `wheels`.
    """
    rows = []
    for path in sorted(modules.glob("*/package.json")) + sorted(modules.glob("@*/*/package.json")):
        about = json.loads(path.read_text(encoding="utf-8"))
        rows.append(f"| {about['name']} | {about['version']} | {about.get('license', '?')} | npm |")
    for name in _book_packages():
        try:
            about = distribution(name).metadata
        except PackageNotFoundError:
            continue
        rows.append(_python_row(about, "Python, builds these pages"))
    for path in sorted(wheels.glob("*.whl") if wheels else ()):
        with zipfile.ZipFile(path) as packed:
            (name,) = (n for n in packed.namelist() if n.endswith(".dist-info/METADATA"))
            about = email.message_from_bytes(packed.read(name))
        if _licence(about):  # the package's own, and those that stand for what is absent, have none
            rows.append(_python_row(about, "Python, for the exercises in the browser"))
    texts = [
        f"\n## {path.parent.relative_to(modules)}\n\n```text\n{path.read_text('utf-8')}\n```"
        for path in sorted(modules.rglob("LICENSE*"))
    ]
    return "\n".join([*rows, *texts])


def _python_row(about: Any, what: str) -> str:
    return f"| {about['Name']} | {about['Version']} | {_licence(about)} | {what} |"


def _licence(about: Any) -> str:
    """Return the licence in the metadata of a Python package, in few words."""
    licence = str(about.get("License-Expression") or about.get("License") or "")
    kinds = [
        str(one).split(" :: ")[-1]
        for one in about.get_all("Classifier") or ()
        if "License ::" in str(one)
    ]
    return licence if licence and len(licence) < 40 else ", ".join(kinds)


def _book_packages() -> list[str]:
    """Return the packages of the extra `site`."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    return sorted(Requirement(line).name for line in extras["site"])
