"""Writing files so that a reader sees the old file or the new one, never half of either.

Reads nothing; gives a temporary path in the target's own folder and moves it into place with one
`os.replace`, which is atomic within a file system (POSIX rename; Windows MoveFileEx).
"""

import errno
import json
import os
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fgtutor.errors import StorageError

LOCK = ".lock"
"""The file in a folder that a process works in; one that was killed leaves it behind, unlocked."""

_ADVICE = {
    errno.ENOSPC: "free some disk space and save again",
    errno.EDQUOT: "your disk quota is used up: free some space and save again",
    errno.EFBIG: "the file is larger than this system allows: save a smaller one",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "the file system is read-only: choose another folder",
    errno.ENOENT: "create the folder first",
    errno.ENOTDIR: "a part of the path is a file, not a folder: choose another path",
    errno.EISDIR: "the path is a folder: give the name of a file in it",
}


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it to `path` once the block has succeeded.

    The block creates and writes the temporary file (it keeps the suffix, for writers that look at
    it). If the block or the move fails, the temporary file is removed and `path` is as it was.

    Raises:
        StorageError: The system refused to write (full disk, read-only or missing folder).
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        try:
            yield temporary
            # Data must reach the disk before the name does, or a power cut leaves an empty file.
            with temporary.open("r+b") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise storage_error(path, error) from error


def write_json(path: str | Path, data: Any) -> None:
    """Write plain values as JSON, whole or not at all; raises `StorageError` as `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1))


def check_writable(path: str | Path) -> None:
    """Raise `StorageError` now if `path` could not be written later, when the work is done."""
    path = Path(path)
    probe = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.probe")
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise storage_error(path, error) from error


def make_folder(path: str | Path) -> None:
    """Create a folder and its parents; raises `StorageError` if the system refuses."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(path, error) from error


@contextmanager
def locked_folder(path: str | Path) -> Iterator[None]:
    """Make a folder if there is none, and keep other processes out of it for a block.

    The system takes the lock back when the process ends, however it ends. A file system without
    locks keeps nobody out.

    Raises:
        StorageError: Another process works in the folder, or the system refuses to write there.
    """
    make_folder(path)
    file = Path(path) / LOCK
    busy = f"another process works in {path}: wait for it to end, or choose another folder"
    try:
        lock = file.open("ab")
    except OSError as error:
        raise storage_error(file, error) from error
    with lock:
        try:
            _lock(lock.fileno())
            # Whoever had it before may have removed it meanwhile, and a third one made a new one.
            if not os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                raise StorageError(busy)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EAGAIN, errno.ENOENT):
                raise StorageError(busy) from error
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise storage_error(file, error) from error
        try:
            yield
        finally:
            with suppress(OSError):
                file.unlink()


def _lock(file: int) -> None:
    """Lock an open file for this process alone, or raise OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def storage_error(path: str | Path, error: OSError) -> StorageError:
    """Return a `StorageError` that names the path, the system's reason and what to do about it."""
    advice = _ADVICE.get(error.errno or 0, "check the path and the disk, then save again")
    return StorageError(
        f"cannot write {path}: {error.strerror or error}; {advice} (nothing partial was left)"
    )
