"""Compile the planner page's two WebAssembly files with the C compiler of the wheel `ziglang`.

Reads Munk2D from pymunk's source archive, in the very version that is installed (the archive is
fetched through pip once, into `web/.cache/planner`), `munk/munk.c` and `nets/nets.c`; gives
`munk.wasm` (the toy's physics, the same double-precision code that runs in Python) and `nets.wasm`
(dense layers).
"""

import importlib.metadata
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
CACHE = HERE.parent / ".cache" / "planner"
ZIG = "0.17.1"
"""The version of the wheel `ziglang` that the files are compiled with."""
COMMON = ("-std=c99", "-DNDEBUG", "-Wl,--strip-all")
UNUSED = ("cpHastySpace.c", "cpSpaceDebug.c")
"""Files of Munk2D that need threads, or draw."""


def build_wasm(folder: Path) -> list[Path]:
    """Write `munk.wasm` and `nets.wasm` into `folder`; what is up to date is only copied.

    Raises `RuntimeError` where the compiler is missing, `CalledProcessError` where it fails.
    """
    munk = munk2d()
    sources = sorted(path for path in (munk / "src").glob("*.c") if path.name not in UNUSED)
    built = [
        _compiled(
            "munk",
            [HERE / "munk" / "munk.c", *sources],
            ("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2"),
            ("-DCP_OVERRIDE_MESSAGE", f"-I{munk / 'include'}"),
        ),
        _compiled(
            "nets",
            [HERE / "nets" / "nets.c"],
            ("-target", "wasm32-freestanding", "-msimd128", "-O3", "-nostdlib"),
            ("-Wl,--no-entry",),
        ),
    ]
    folder.mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copyfile(path, folder / path.name)) for path in built]


def ready() -> bool:
    """Say whether `build_wasm` can work: it has compiled already, or the compiler is there."""
    kept = all((CACHE / f"{name}.wasm").is_file() for name in ("munk", "nets"))
    return kept or _compiler() == ZIG


def _compiler() -> str | None:
    try:
        return importlib.metadata.version("ziglang")
    except importlib.metadata.PackageNotFoundError:
        return None


def munk2d() -> Path:
    """Return the folder of Munk2D's sources, taken from the archive of the installed pymunk."""
    version = importlib.metadata.version("pymunk")
    folder = CACHE / f"pymunk-{version}"
    if not folder.is_dir():
        CACHE.mkdir(parents=True, exist_ok=True)
        asked = ["--no-binary", ":all:", "--no-deps", "--no-build-isolation", f"pymunk=={version}"]
        _run([sys.executable, "-m", "pip", "download", "-q", "-d", str(CACHE), *asked])
        with tarfile.open(CACHE / f"pymunk-{version}.tar.gz") as archive:
            archive.extractall(CACHE, filter="data")
    return folder / "Munk2D"


def _compiled(
    name: str, sources: Sequence[Path], target: Sequence[str], more: Sequence[str]
) -> Path:
    """Compile sources to `<name>.wasm` in the cache, unless that is newer than all of them."""
    made = CACHE / f"{name}.wasm"
    newest = max(path.stat().st_mtime for path in (*sources, Path(__file__)))
    if made.is_file() and made.stat().st_mtime > newest:
        return made
    if (found := _compiler()) != ZIG:
        raise RuntimeError(f"need ziglang {ZIG}, found {found}: pip install ziglang=={ZIG}")
    fresh = CACHE / f"{name}.new.wasm"
    fresh.parent.mkdir(parents=True, exist_ok=True)
    files = [str(path) for path in sources]
    _run([sys.executable, "-m", "ziglang", "cc", *target, *COMMON, *more, *files, "-o", str(fresh)])
    os.replace(fresh, made)
    return made


def _run(command: Sequence[str]) -> None:
    environment = os.environ | {"ZIG_GLOBAL_CACHE_DIR": str(CACHE / "zig")}
    subprocess.run(command, check=True, env=environment)
