"""Writing files so that a reader sees the old file or the new one, never half of either.

Reads nothing; gives a temporary path in the target's own folder and moves it into place with one
`os.replace`, which is atomic within a file system (POSIX rename; Windows MoveFileEx).
"""

import errno
import json
import os
import platform
import secrets
import shutil
import sys
import zlib
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
    errno.EEXIST: "there is a file of this name: choose another path",
    errno.EISDIR: "the path is a folder: give the name of a file in it",
    errno.EINVAL: "give the name of a file",
    errno.ENAMETOOLONG: "choose a shorter name",
}


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it to `path` once the block has succeeded.

    The block creates and writes the temporary file (it keeps the suffix, for writers that look at
    it). If the block or the move fails, the temporary file is removed and `path` is as it was. If
    `path` is a link, the file that it shows to is written. What a killed process left is removed.

    Raises:
        StorageError: The system refused to write (full disk, read-only or missing folder), or the
            path is a folder, a device or a pipe.
    """
    with atomic_write_all(path) as (temporary,):
        yield temporary


@contextmanager
def atomic_write_all(*paths: str | Path) -> Iterator[list[Path]]:
    """Do as `atomic_write` with files that belong together; if one move fails, none is made.

    Only a process that is killed between two moves leaves some new and some old; a reader has to
    see from their contents that these do not belong together.
    """
    temporaries: list[Path] = []
    earlier: dict[Path, Path | None] = {}
    try:
        try:
            targets = [_target(Path(path)) for path in paths]
            temporaries = [beside(target, target.suffix) for target in targets]
            yield temporaries
            for temporary in temporaries:
                # Data must reach the disk before the name, or a power cut leaves an empty file.
                with temporary.open("r+b") as file:
                    os.fsync(file.fileno())
            for target in targets[:-1]:
                earlier[target] = _copy(target)
            for temporary, target in zip(temporaries, targets, strict=True):
                os.replace(temporary, target)
        except BaseException:
            for target, copy in earlier.items():
                with suppress(OSError):
                    os.replace(copy, target) if copy else target.unlink(missing_ok=True)
            raise
        finally:
            for path in (*temporaries, *filter(None, earlier.values())):
                with suppress(OSError):
                    path.unlink(missing_ok=True)
    except OSError as error:
        raise storage_error(paths[0], error) from error


def _target(path: Path) -> Path:
    """Return the file that is to be written, links followed, beside which nothing old is left."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_dir():
        raise storage_error(path, OSError(errno.EISDIR, os.strerror(errno.EISDIR)))
    if target.exists() and not target.is_file():
        raise storage_error(path, OSError(errno.EINVAL, "it is a device or a pipe"))
    remove_leftovers(target)
    return target


def remove_leftovers(target: Path) -> None:
    """Remove the files and folders that killed processes have left beside `target` (`beside`)."""
    start = f".fgtutor-{_key(target)}-"
    for path in target.parent.glob(f"{start}*"):
        writer = path.name.removeprefix(start).split("-")[0]
        if writer.isdecimal() and int(writer) not in _processes():
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _processes() -> list[int]:
    """Return the ids of what runs on this computer; in a browser Python sees itself alone."""
    if sys.platform == "emscripten":
        return [os.getpid()]
    import psutil  # here: there is none for a browser

    return psutil.pids()


def beside(path: Path, suffix: str = "") -> Path:
    """Return a hidden, short name in the path's folder: of this process, and of this file."""
    suffix = suffix if len(os.fsencode(suffix)) <= 20 else ""
    return path.with_name(f".fgtutor-{_key(path)}-{os.getpid()}-{secrets.token_hex(4)}{suffix}")


def _key(path: Path) -> str:
    """Return eight digits for a file's name on this computer: only its processes are known here."""
    return f"{zlib.crc32(os.fsencode(f'{platform.node()}/{path.name}')):08x}"


def _copy(path: Path) -> Path | None:
    """Return a second name for a file, or a copy where the file system gives it none."""
    if not path.exists():
        return None
    copy = beside(path)
    try:
        os.link(path, copy)
    except OSError:
        shutil.copyfile(path, copy)
    return copy


def write_json(path: str | Path, data: Any) -> None:
    """Write plain values as JSON, whole or not at all; raises `StorageError` as `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1))


def check_writable(path: str | Path) -> None:
    """Raise `StorageError` now if `path` could not be written later, when the work is done."""
    try:
        probe = beside(_target(Path(path)))
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

    The system takes the lock back when the process ends, however it ends. On a file system that
    has no locks, nothing is locked.

    Raises:
        StorageError: Another process works in the folder, or the system refuses to write there.
    """
    make_folder(path)
    file = Path(path) / LOCK
    try:
        lock = file.open("a+b")
    except OSError as error:
        raise storage_error(file, error) from error
    with lock:
        holder = ""
        try:
            _lock(lock.fileno())
            # The process before may have removed it meanwhile, and another one made a new one.
            if not os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                raise BlockingIOError(errno.EAGAIN, "")
            lock.truncate(0)
            lock.write(b"%d" % os.getpid())
            lock.flush()
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EAGAIN, errno.ENOENT):
                with suppress(OSError, ValueError):
                    holder = f" ({int(file.read_text())})"
                raise StorageError(
                    f"another process{holder} works in {path}: wait for it to end, or choose "
                    "another folder"
                ) from error
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
