"""Write the exercises that need only numpy as a JupyterLite site: Python in the page, no server.

Reads the package, the exercises and what `make site` installed (JupyterLite, Pyodide, a numpy for
it); gives a static folder. Every package that the kernel loads lies in it and is named in its own
`pyodide-lock.json`, so that nothing comes from a content server.
"""

import base64
import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from book.stage import NEEDS_TORCH, links

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
MODULES = HERE.parent / "node_modules"
KERNEL = "@jupyterlite/pyodide-kernel-extension"
EXTENSION = Path(sys.prefix) / "share/jupyter/labextensions" / KERNEL
CORE = ("pyodide.js", "pyodide.mjs", "pyodide.asm.js", "pyodide.asm.wasm", "python_stdlib.zip")
"""What there is of Pyodide's own: `.mjs` is for the test in Node."""
ABSENT = ("ssl", "sqlite3", "jedi")
"""What JupyterLite's kernel asks for by name and does without: an empty wheel answers it."""
ON_DEMAND = ("networkx",)
"""What is loaded when a cell imports it: no exercise needs it."""
KERNEL_WHEELS = ("piplite", "pyodide_kernel", "ipykernel")
DROPPED = ("tests", "f2py", "_pyinstaller", "include")
"""Folders of numpy that no exercise needs."""
DROPPED_ENDS = (".a", ".h", ".pyi", ".pyx", ".pxd", ".pyc")
OLD_FONTS = ("fa-*.eot", "fa-*.svg", "fa-*.ttf", "fa-*.woff")
TOP = """\
**In the browser.** Python runs in this page, with numpy and the checks; nothing is sent anywhere.
It takes half a minute to start, longer the first time. Networkx is here too; torch, scipy and
matplotlib are not, and no time limit ends a loop that never does: *Kernel*, *Restart Kernel*. The
browser keeps your notebook and `mine.py` for this address until you clear its data: to save them
elsewhere, right-click them in the list of files, *Download*."""
OWN = """\
## Your own planner

What has passed is kept in `mine.py`, beside this notebook. The planner with your functions in place
of the library's needs torch, so it runs where fgtutor is installed: download `mine.py`, put it
beside the exercises there, and run this cell."""


def names() -> list[str]:
    """Return the exercises that run in the browser."""
    every = sorted(path.stem for path in (ROOT / "exercises").glob("ex*.ipynb"))
    return [name for name in every if name not in NEEDS_TORCH]


def missing() -> list[str]:
    """Return what the site is made of and is not installed."""
    needed = (EXTENSION, MODULES / "pyodide", MODULES / "@emscripten-forge/numpy")
    return [str(path) for path in needed if not path.is_dir()]


def export(out: Path) -> None:
    """Write the site; raises `SystemExit` if something that it is made of is not installed."""
    if missing():
        raise SystemExit(f"not there: {', '.join(missing())}; `make site` installs it")
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        write_pyodide(work / "static/pyodide")
        for name in names():
            content = json.loads((ROOT / f"exercises/{name}.ipynb").read_text(encoding="utf-8"))
            (work / f"{name}.ipynb").write_text(json.dumps(adapted(content, name)))
        _write_settings(work)
        command = [sys.executable, "-m", "jupyterlite_core", "build"]
        done = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"JupyterLite could not be built:\n{done.stdout}{done.stderr}")
        # Fonts for browsers that are older than WebAssembly.
        for pattern in OLD_FONTS:
            for path in (work / "out/build").glob(pattern):
                path.unlink()
        shutil.copytree(work / "out", out, dirs_exist_ok=True)


def _write_settings(work: Path) -> None:
    """Write what JupyterLite reads: how to build, and how its kernel starts."""
    build = {
        "apps": ["lab"],
        "contents": [f"{name}.ipynb" for name in names()],
        "federated_extensions": [str(EXTENSION)],
        "ignore_sys_prefix": True,
        "no_sourcemaps": True,
        "no_unused_shared_packages": True,
        "output_dir": "out",
    }
    lock = json.loads((work / "static/pyodide/pyodide-lock.json").read_text(encoding="utf-8"))
    # The kernel installs what is not in this list, and compares names as its wheels spell them.
    packages = [
        one["file_name"].split("-")[0]
        for name, one in lock["packages"].items()
        if name not in ON_DEMAND
    ]
    options = {"packages": packages}
    kernel = {"disablePyPIFallback": True, "loadPyodideOptions": options}
    page = {"appName": "fgtutor", "litePluginSettings": {f"{KERNEL}:kernel": kernel}}
    settings = {"jupyter-lite-schema-version": 0, "jupyter-config-data": page}
    (work / "jupyter_lite_config.json").write_text(json.dumps({"LiteBuildConfig": build}))
    (work / "jupyter-lite.json").write_text(json.dumps(settings))


def adapted(notebook: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an exercise as it is true in the browser; raises `ValueError` if it lacks a part."""
    cells = notebook["cells"]
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            own = source.startswith(OWN.splitlines()[0])
            pages = [f"exercises/{one}" for one in names()]
            cell["source"] = OWN if own else links(source, f"exercises/{name}", pages)
    if sum(cell["source"] == OWN for cell in cells) != 1:
        raise ValueError(f"{name} has no part {OWN.splitlines()[0]!r}, or more than one")
    cells[0]["source"] += f"\n\n{TOP}"
    notebook["metadata"]["kernelspec"] |= {"name": "python", "display_name": "Python (Pyodide)"}
    return notebook


# Packages -----------------------------------------------------------------------------------------


def fetched() -> Path:
    """Return the folder with the wheels of wheels.txt, which come from the package registry once.

    Raises `SystemExit` if they cannot be had.
    """
    wanted = HERE / "wheels.txt"
    folder = (
        HERE.parent / ".cache" / f"wheels-{hashlib.sha256(wanted.read_bytes()).hexdigest()[:16]}"
    )
    if folder.is_dir():
        return folder
    folder.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as fresh:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--only-binary", ":all:", "--platform", "any", "--python-version", "3.12"]
        command += ["--requirement", str(wanted), "--dest", f"{fresh}/wheels"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"the wheels of {wanted} could not be had:\n{done.stderr}")
        with suppress(OSError):  # another process was faster
            (Path(fresh) / "wheels").rename(folder)
    return folder


def write_pyodide(out: Path) -> None:
    """Write Python for a page: Pyodide, every wheel, and the list by which it finds them.

    Raises as `fetched`.
    """
    shutil.copytree(fetched(), out)
    for name in CORE:
        shutil.copy2(MODULES / "pyodide" / name, out)
    for name in KERNEL_WHEELS:
        (wheel,) = (EXTENSION / "static/pypi").glob(f"{name}-*.whl")
        shutil.copy2(wheel, out)
    _write_wheel(out / "fgtutor-0-py3-none-any.whl", _package())
    _write_numpy(out)
    for name in ABSENT:
        _write_wheel(out / f"{name}-0-py3-none-any.whl", {})
    about = json.loads((MODULES / "pyodide/pyodide-lock.json").read_text(encoding="utf-8"))
    packages = dict(_entry(path) for path in sorted(out.glob("*.whl")))
    (out / "pyodide-lock.json").write_text(json.dumps(about | {"packages": packages}, indent=1))


def _entry(wheel: Path) -> tuple[str, dict[str, Any]]:
    """Return what Pyodide has to know of a wheel, by the name of its package."""
    name, version = wheel.stem.split("-")[:2]
    name = name.replace("_", "-").lower()
    entry = {
        "name": name,
        "version": version,
        "file_name": wheel.name,
        "install_dir": "site",
        "sha256": hashlib.sha256(wheel.read_bytes()).hexdigest(),
        "package_type": "package",
        "imports": [name] if name in ON_DEMAND else [],
        "depends": [],
        "unvendored_tests": False,
    }
    return name, entry


def _package() -> dict[str, bytes]:
    """Return the files of fgtutor: its code and the worked solutions, without specialists."""
    package = ROOT / "fgtutor"
    paths = [*package.rglob("*.py"), package / "course/checks/solutions.json", ROOT / "LICENSE"]
    return {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in sorted(paths)}


def _write_numpy(out: Path) -> None:
    """Repack the numpy that came as a conda package, without what no exercise needs."""
    (archive,) = (MODULES / "@emscripten-forge/numpy/pkg").glob("numpy-*.tar.gz")
    version = archive.name.split("-")[1]
    files = {}
    with tarfile.open(archive) as packed:
        for member in packed.getmembers():
            _, inside, name = member.name.partition("site-packages/")
            content = packed.extractfile(member) if member.isfile() and inside else None
            dropped = set(DROPPED) & set(name.split("/")) or name.endswith(DROPPED_ENDS)
            if content and not dropped:
                files[name] = content.read()
    _write_wheel(out / f"numpy-{version}-cp312-cp312-pyodide_2024_0_wasm32.whl", files)


def _write_wheel(path: Path, files: Mapping[str, bytes]) -> None:
    """Write files as a wheel, with the records that say what it is; the same for the same files."""
    name, version, *tag = path.stem.split("-")
    folder = f"{name}-{version}.dist-info"
    about = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    kind = f"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: {'-'.join(tag)}\n"
    whole = {f"{folder}/METADATA": about.encode(), **files, f"{folder}/WHEEL": kind.encode()}
    record = f"{folder}/RECORD"
    whole.pop(record, None)
    lines = [f"{one},sha256={_digest(content)},{len(content)}" for one, content in whole.items()]
    whole[record] = "\n".join([*lines, f"{record},,", ""]).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
        for one, content in whole.items():
            packed.writestr(zipfile.ZipInfo(one), content, zipfile.ZIP_DEFLATED)


def _digest(content: bytes) -> str:
    digest = hashlib.sha256(content).digest()
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()
