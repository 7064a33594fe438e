"""Reading files that may be missing, damaged or malicious: every failure is one error of ours.

Gives a file to the reader for its suffix, and the arrays of .npz files, which are checked before
memory is taken for them and never unpickled.
"""

import errno
import math
import re
import stat
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.lib import format as npy

from fgtutor.errors import FgtutorError

T = TypeVar("T")


def by_suffix(path: Path, table: Mapping[str, T], what: str, error: type[FgtutorError]) -> T:
    """Return the entry for a file's suffix; raises `error` if there is none."""
    try:
        return table[path.suffix.lower()]
    except KeyError:
        raise error(
            f"{path} has {f'the suffix {path.suffix!r}' if path.suffix else 'no suffix'}; {what}s "
            f"are {', '.join(table)} files"
        ) from None


def read_file(
    path: Path,
    readers: Mapping[str, Callable[[Path], T]],
    what: str,
    error: type[FgtutorError],
    cure: str,
) -> T:
    """Return what the reader for the file's suffix gives.

    Args:
        path: The file.
        readers: By suffix; each raises `error` for what it refuses.
        what: What the file should hold, in singular, such as "map".
        error: Whatever else the libraries raise on damaged files, which has no end, becomes this.
        cure: What to do about a damaged file.
    """
    reader = by_suffix(path, readers, what, error)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise error(f"{path} is a folder or a device, not a {what} file: check the path")
        path.open("rb").close()
    except FileNotFoundError:
        raise error(f"there is no {what} file {path}: check the path") from None
    except OSError as refusal:
        raise error(
            f"cannot read {path}: {refusal.strerror}; check the path and its permissions"
        ) from refusal
    try:
        return reader(path)
    except error as refusal:
        raise error(f"{path}: {refusal}") from refusal
    except Exception as caught:
        problem = caught
    # An invalid argument is what the offsets of a damaged archive are.
    if isinstance(problem, OSError) and problem.strerror and problem.errno != errno.EINVAL:
        raise error(f"cannot read {path}: {problem.strerror}; check the path and the disk")
    reason = re.sub(r"[^ -~]+", " ", f"{type(problem).__name__}: {problem}")[:200]
    reason = reason.replace("Out of memory", "Too much memory for")  # libtiff's way to say no
    raise error(
        f"{path} cannot be read as a {path.suffix} {what} ({reason}); the file is corrupt or of "
        f"another kind: {cure}"
    )


def read_npz(
    path: Path,
    names: Sequence[str],
    check: Callable[[str, tuple[int, ...], np.dtype], None],
    error: type[FgtutorError],
    *,
    others: bool = False,
) -> dict[str, np.ndarray]:
    """Return the arrays of a .npz file.

    Args:
        path: The file.
        names: The arrays that it must hold.
        check: Raises what it has against an array's shape or type, before any array is read.
        error: What to raise if they are not there, or cut off.
        others: Whether there may be others, which are passed over.
    """
    with path.open("rb") as raw, zipfile.ZipFile(raw) as archive:
        members = {f"{name}.npy": name for name in names}
        found = archive.namelist()
        if not members.keys() <= set(found) or (len(found) > len(names) and not others):
            held = ", ".join(map(repr, found[:8])) or "nothing"
            raise error(f"expected {', '.join(members)}, this file holds {held[:300]}")
        for member, name in members.items():
            with archive.open(member) as file:
                if (version := npy.read_magic(file)) != (1, 0):  # newer ones are for odd records
                    raise error(f"{member} is of version {version}: save it as plain numbers")
                shape, _, kind = npy.read_array_header_1_0(file)
                if kind.hasobject:
                    raise error(f"{member} holds {kind}, pickled objects: save it as numbers")
                check(name, shape, kind)
                rest = archive.getinfo(member).file_size - file.tell()
                if math.prod(shape) * kind.itemsize != rest:
                    raise error(f"{member} of shape {shape} is promised, it was cut off")
        arrays = {}
        for member, name in members.items():
            with archive.open(member) as file:
                arrays[name] = npy.read_array(file, allow_pickle=False)
                file.read(1)  # at its end the checksum is compared
        return arrays
