"""Say what this machine has, what fgtutor lacks on it, and what to do about each.

Reads package metadata, the machine and the zoo; prints one row a finding. Nothing heavy is imported
before its own check, so that a broken installation still gets a full report.
"""

import importlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from fgtutor import __version__
from fgtutor.errors import FgtutorError
from fgtutor.io.machine import usable_cores
from fgtutor.io.progress import waiting
from fgtutor.io.validation import check_fields
from fgtutor.robots import GL_BACKENDS

ESSENTIAL = (
    "torch",
    "tensordict",
    "rsl-rl-lib",
    "pymunk",
    "mujoco",
    "numpy",
    "scipy",
    "networkx",
    "safetensors",
    "matplotlib",
    "tyro",
)
"""Packages without which the toy pipeline or the A1 does not run."""
EXTRAS = {
    "lab": (
        "the notebooks",
        ("jupyterlab", "ipywidgets", "anywidget", "ipykernel", "jupytext", "nbclient"),
    ),
    "cluster": ("evaluations and sweeps on a Ray cluster", ("ray",)),
}
"""What each extra is for, and its packages: `pip install 'fgtutor[lab]'`."""
INSTALL = "pip install --constraint constraints.txt --editable"
"""Said in the clone of fgtutor, this installs what is missing."""
LOW_DISK, LOW_MEMORY = 2.0, 4.0
"""Below these many GB a training's checkpoints, or two trainings side by side, may not fit."""

_RENDER = (
    "import mujoco\n"
    'scene = \'<mujoco><worldbody><light/><geom size=".1" rgba="1 0 0 1"/></worldbody></mujoco>\'\n'
    "model = mujoco.MjModel.from_xml_string(scene)\n"
    "data = mujoco.MjData(model)\n"
    "mujoco.mj_forward(model, data)\n"
    "with mujoco.Renderer(model, 32, 32) as renderer:\n"
    "    renderer.update_scene(data)\n"
    "    picture = renderer.render()\n"
    "if picture.max() == 0:\n"
    "    raise SystemExit('the picture came out black')\n"
)


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


@dataclass(frozen=True, kw_only=True)
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
    yield Finding(what="fgtutor", value=__version__)
    yield Finding(what="python", value=f"{platform.python_version()} on {platform.platform()}")
    yield from _packages()
    yield from _torch()
    yield _cores()
    yield _memory()
    yield _disk()
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


def _packages() -> Iterator[Finding]:
    """Look up the versions of the packages, and which of each extra are there."""
    for name in ESSENTIAL:
        if found := _version(name):
            yield Finding(what=name, value=found)
        else:
            yield Finding(what=name, value="not installed", state="broken", fix=f"{INSTALL} .")
    for extra, (use, names) in EXTRAS.items():
        what, found = f"extra {extra}", [f"{name} {v}" for name in names if (v := _version(name))]
        if len(found) == len(names):
            yield Finding(what=what, value=", ".join(found))
        else:
            absent = ", ".join(name for name in names if not _version(name))
            fix = f"for {use}: {INSTALL} '.[{extra}]'"
            yield Finding(what=what, value=f"without {absent}", state="note", fix=fix)


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
        yield Finding(
            what="import torch",
            value=_last_line(str(error)),
            state="broken",
            fix="pip install --force-reinstall -c constraints.txt torch",
        )
        return
    if torch.cuda.is_available():
        yield Finding(what="gpu", value=torch.cuda.get_device_name())
    else:
        yield Finding(what="gpu", value="none; none is needed")


def _cores() -> Finding:
    return Finding(what="cores", value=f"{usable_cores()} usable of {os.cpu_count()}")


def _memory() -> Finding:
    if not hasattr(os, "sysconf"):
        return Finding(what="memory", value="unknown on this system")
    gigabytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    value = f"{gigabytes:.1f} GB"
    if gigabytes >= LOW_MEMORY:
        return Finding(what="memory", value=value)
    return Finding(what="memory", value=value, state="note", fix="run one training at a time")


def _disk() -> Finding:
    gigabytes = shutil.disk_usage(Path.cwd()).free / 1e9
    value = f"{gigabytes:.1f} GB free here"
    if gigabytes >= LOW_DISK:
        return Finding(what="disk", value=value)
    return Finding(what="disk", value=value, state="note", fix="free space before you train")


def _gl(seconds: float) -> Finding:
    """Try the drawing backends, each in a process of its own: a bad one may abort the process."""
    wanted = os.environ.get("MUJOCO_GL")
    backends = (wanted,) if wanted else GL_BACKENDS.get(sys.platform, ())
    refusals = []
    for backend in backends:
        reason = probe_gl(backend, seconds)
        if reason is None:
            fix = (
                ""
                if wanted or sys.platform != "linux"
                else f"without a screen: export MUJOCO_GL={backend}"
            )
            return Finding(what="gl", value=f"MuJoCo draws with {backend}", fix=fix)
        refusals.append(f"{backend}: {reason}")
    return Finding(
        what="gl",
        value="; ".join(refusals) or "no backend is known for this system",
        state="note",
        fix="videos of the A1 need one (the toy needs none); on Debian or Ubuntu: "
        "apt install libosmesa6, then export MUJOCO_GL=osmesa",
    )


def probe_gl(backend: str, seconds: float) -> str | None:
    """Return why MuJoCo cannot draw with this backend, or None if it can."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _RENDER],
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no picture within {seconds:g} s"
    if done.returncode == 0:
        return None
    return _last_line(done.stderr) or f"ended with code {done.returncode}"


def _zoo(folder: Path) -> Iterator[Finding]:
    """Load every specialist of the zoo."""
    try:
        load_specialist = importlib.import_module("fgtutor.specialist").load_specialist
    except (ImportError, OSError) as error:
        yield Finding(
            what="zoo", value=_last_line(str(error)), state="broken", fix="mend the packages above"
        )
        return
    # A hidden folder is what an interrupted save left; no reader looks at it.
    found = sorted(p.parent for p in folder.glob("*/[!.]*/specialist.json"))
    if not found:
        yield Finding(
            what="zoo",
            value=f"no specialist in {folder}",
            state="broken",
            fix="restore the folder (git checkout), or train one: fgtutor train --help",
        )
    for path in found:
        what = f"zoo {path.parent.name}/{path.name}"
        try:
            specialist = load_specialist(path)
        except FgtutorError as error:
            yield Finding(what=what, value="corrupt", state="broken", fix=str(error))
        else:
            yield Finding(what=what, value=repr(specialist))


def _last_line(text: str) -> str:
    """Return the last line that says something: a traceback's message."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
