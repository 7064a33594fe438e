"""atomic_write: all or nothing, and a `StorageError` that says what to do."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtutor import storage
from fgtutor.errors import StorageError
from fgtutor.storage import LOCK, atomic_write, locked_folder


def test_new_file_appears_complete(tmp_path: Path) -> None:
    target = tmp_path / "map.npz"
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".npz"
        temporary.write_bytes(b"all of it")
        assert not target.exists()
    assert target.read_bytes() == b"all of it"
    assert list(tmp_path.iterdir()) == [target]


def test_file_has_the_permissions_of_any_other_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("x")
    with atomic_write(tmp_path / "atomic") as temporary:
        temporary.write_text("x")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt, OSError])
def test_failed_block_keeps_the_old_file(tmp_path: Path, failure: type[BaseException]) -> None:
    target = tmp_path / "state"
    target.write_text("old")
    expected = StorageError if failure is OSError else failure
    with pytest.raises(expected), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        (errno.ENOSPC, "free some disk space"),
        (errno.EROFS, "read-only"),
        (errno.EACCES, "may write to"),
        (errno.EIO, "check the path and the disk"),
    ],
)
def test_failed_move_is_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, advice: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "replace", refuse)
    target = tmp_path / "state"
    with pytest.raises(StorageError, match=advice) as caught, atomic_write(target) as temporary:
        temporary.write_text("new")
    assert str(target) in str(caught.value) and os.strerror(code) in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_missing_folder(tmp_path: Path) -> None:
    with (
        pytest.raises(StorageError, match="create the folder first"),
        atomic_write(tmp_path / "no" / "file") as temporary,
    ):
        temporary.write_text("x")


def test_parent_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with (
        pytest.raises(StorageError, match="is a file, not a folder"),
        atomic_write(tmp_path / "file" / "name") as temporary,
    ):
        temporary.write_text("x")


def test_target_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageError), atomic_write(tmp_path / "folder") as temporary:
        temporary.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_block_that_wrote_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError), atomic_write(tmp_path / "file"):
        pass


_LIMITED = """
import resource, signal, sys
from fgtutor.errors import StorageError
from fgtutor.storage import atomic_write
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    with atomic_write(sys.argv[1]) as temporary:
        temporary.write_bytes(bytes(100_000))
except StorageError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_real_write_failure_leaves_nothing_partial(tmp_path: Path) -> None:
    target = tmp_path / "big"
    target.write_text("old")
    result = subprocess.run(
        [sys.executable, "-c", _LIMITED, str(target)], capture_output=True, text=True, check=True
    )
    assert "larger than this system allows" in result.stdout
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


_KILLED = """
import os, signal, sys
from fgtutor.storage import atomic_write
with atomic_write(sys.argv[1]) as temporary:
    temporary.write_bytes(bytes(100_000))
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
def test_killed_while_saving_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "state"
    target.write_text("old")
    subprocess.run([sys.executable, "-c", _KILLED, str(target)], check=False)
    assert target.read_text() == "old"


_HOLDING = """
import sys, time
from fgtutor.storage import locked_folder
with locked_folder(sys.argv[1]):
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_one_process_s_until_it_ends_however_it_ends(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    with subprocess.Popen(
        [sys.executable, "-c", _HOLDING, str(folder)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout and other.stdout.readline() == "locked\n"
        with pytest.raises(StorageError, match="another process works in"), locked_folder(folder):
            pass
        other.kill()
    with locked_folder(folder):
        assert (folder / LOCK).exists()
        with pytest.raises(StorageError, match="another process"), locked_folder(folder):
            pass
    assert not list(folder.iterdir())


def test_a_lock_that_was_removed_meanwhile_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = storage._lock

    def removed_meanwhile(file: int) -> None:
        lock(file)
        (tmp_path / LOCK).unlink()
        (tmp_path / LOCK).touch()

    monkeypatch.setattr(storage, "_lock", removed_meanwhile)
    with pytest.raises(StorageError, match="another process"), locked_folder(tmp_path):
        pass
