"""Say what this machine has, what fgtutor lacks on it, and what to do about each.

Reads package metadata, the machine and the zoo; prints one row a finding. Nothing heavy is imported
before its own check, so that a broken installation still gets a full report.
"""

import importlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import psutil
from annotated_types import Interval

from fgtutor import __version__
from fgtutor.errors import FgtutorError
from fgtutor.io.machine import usable_cores
from fgtutor.io.progress import waiting
from fgtutor.io.validation import check_fields

INSTALL = "pip install --constraint constraints.txt --editable"
"""Said in the clone of fgtutor, this installs what is missing."""
LOW_DISK, LOW_MEMORY = 2.0, 4.0
"""Below these many GB a training's checkpoints, or two trainings side by side, may not fit."""

_DRAW = """
import sys
import mujoco
from fgtutor.errors import RenderingError
from fgtutor.robots.offscreen import CURE, Renderer
scene = '<mujoco><worldbody><light/><geom size=".1" rgba="1 0 0 1"/></worldbody></mujoco>'
model = mujoco.MjModel.from_xml_string(scene)
try:
    with Renderer(model, 32, 32, patience=float(sys.argv[1])) as renderer:
        print(renderer.backend)
except RenderingError as error:
    sys.exit(str(error).removesuffix(f": {CURE}"))
"""


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Check the installation; the exit code is 1 if something essential is broken."""

    zoo: Path = Path(__file__).parents[1] / "zoo"
    """Folder of the zoo: <robot>/<specialist>."""
    gl: bool = True
    """Whether to try drawing with MuJoCo, in a process of its own."""
    gl_seconds: Annotated[float, Interval(gt=0, le=3600)] = 60.0
    """How long one drawing backend may take, s."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Finding:
    """One row of the report."""

    what: str
    """What was looked at."""
    value: str
    """What was found."""
    state: Literal["ok", "note", "broken"] = "ok"
    """"note" limits something; "broken" is essential."""
    fix: str = ""
    """What to do, where something can be done."""


def run(config: DoctorConfig) -> int:
    """Print the report; return 1 if something essential is broken, else 0."""
    with waiting("looking at this machine"):
        findings = list(examine(config))
    print(report(findings))
    return int(any(finding.state == "broken" for finding in findings))


def examine(config: DoctorConfig) -> Iterator[Finding]:
    """Look at everything, one finding at a time."""
    yield Finding("fgtutor", __version__)
    yield Finding("python", f"{platform.python_version()} on {platform.platform()}")
    yield from _packages()
    yield from _torch()
    yield from _machine()
    if config.gl:
        yield _gl(config.gl_seconds)
    yield from _zoo(config.zoo)


def report(findings: list[Finding]) -> str:
    """Return the findings as a table, followed by what to do."""
    width = max(len(finding.what) for finding in findings)
    marks = {"ok": "ok    ", "note": "note  ", "broken": "BROKEN"}
    lines = [f"{marks[f.state]}  {f.what:<{width}}  {f.value}" for f in findings]
    fixes = [f"- {f.what}: {f.fix}" for f in findings if f.fix]
    return "\n".join([*lines, "", "What to do:" if fixes else "Nothing to do.", *fixes])


def requirements() -> dict[str, list[str]]:
    """Return the packages that fgtutor needs (under ""), and those that each extra adds."""
    needs: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("fgtutor") or ():
        name, *extra = re.findall(r"^[\w.-]+|(?<=extra == .)\w+", line)
        needs.setdefault("".join(extra), []).append(name)
    return needs


def _packages() -> Iterator[Finding]:
    """Look up the versions of the packages, and of those of each extra."""
    for extra, names in requirements().items():
        what = f"extra {extra}" if extra else "packages"
        versions = {name: _version(name) for name in names}
        absent = ", ".join(name for name, version in versions.items() if not version)
        if not absent:
            found = ", ".join(f"{name} {version}" for name, version in versions.items())
            yield Finding(what, found)
        elif not extra:
            yield Finding(what, f"without {absent}", "broken", f"{INSTALL} .")
        elif extra != "dev":  # learners need none of it
            yield Finding(what, f"without {absent}", "note", f"{INSTALL} '.[{extra}]'")


def _version(package: str) -> str | None:
    """Return the version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _torch() -> Iterator[Finding]:
    """Import torch (a wheel for another processor fails only here) and look for a GPU."""
    try:
        torch = importlib.import_module("torch")
    except (ImportError, OSError) as error:
        fix = "pip install --force-reinstall -c constraints.txt torch"
        yield Finding("import torch", _last_line(str(error)), "broken", fix)
        return
    if torch.cuda.is_available():
        yield Finding("gpu", torch.cuda.get_device_name())
    else:
        yield Finding("gpu", "none; none is needed")


def _machine() -> Iterator[Finding]:
    """Look at cores, memory and disk."""
    yield Finding("cores", f"{usable_cores()} usable of {os.cpu_count()}")
    memory, disk = psutil.virtual_memory().total / 1e9, shutil.disk_usage(Path.cwd()).free / 1e9
    for what, has, least, fix in (
        ("memory", memory, LOW_MEMORY, "run one training at a time"),
        ("disk", disk, LOW_DISK, "free space before you train"),
    ):
        value = f"{has:.1f} GB{' free here' * (what == 'disk')}"
        yield Finding(what, value) if has >= least else Finding(what, value, "note", fix)


def _gl(seconds: float) -> Finding:
    """Start what draws films, from a process of its own: a bad graphics library may abort it."""
    command = [sys.executable, "-P", "-c", _DRAW, str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        backend = done.stdout.strip()
        told = os.environ.get("MUJOCO_GL") or sys.platform != "linux"
        fix = "" if told else f"without a screen: export MUJOCO_GL={backend}"
        return Finding("gl", f"MuJoCo draws with {backend}", fix=fix)
    reason = _last_line(done.stderr) or f"drawing ended with code {done.returncode}"
    fix = (
        "videos of the A1 need it (the toy needs none); on Debian or Ubuntu: apt install "
        "libosmesa6, then export MUJOCO_GL=osmesa"
    )
    return Finding("gl", reason, "note", fix)


def _zoo(folder: Path) -> Iterator[Finding]:
    """Load every specialist of the zoo."""
    try:
        load_specialist = importlib.import_module("fgtutor.specialist").load_specialist
    except (ImportError, OSError) as error:
        yield Finding("zoo", _last_line(str(error)), "broken", "mend the packages above")
        return
    # A hidden folder is what an interrupted save left; no reader looks at it.
    found = sorted(p.parent for p in folder.glob("*/[!.]*/specialist.json"))
    if not found:
        fix = "restore the folder (git checkout), or train one: fgtutor train --help"
        yield Finding("zoo", f"no specialist in {folder}", "broken", fix)
    for path in found:
        what = f"zoo {path.parent.name}/{path.name}"
        try:
            specialist = load_specialist(path)
        except FgtutorError as error:
            yield Finding(what, "corrupt", "broken", str(error))
        else:
            yield Finding(what, repr(specialist))


def _last_line(text: str) -> str:
    """Return the last line that says something: a traceback's message."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
