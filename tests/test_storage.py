"""atomic_write: all or nothing, and a `StorageError` that says what to do."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtutor.errors import StorageError
from fgtutor.io import storage
from fgtutor.io.storage import LOCK, atomic_write, atomic_write_all, check_writable, locked_folder


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
from fgtutor.io.storage import atomic_write
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
from fgtutor.io.storage import atomic_write
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
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_write(tmp_path / "another") as other, atomic_write(target) as temporary:
        other.write_text("x")
        temporary.write_text("new")
    assert {file.name for file in tmp_path.iterdir()} == {"state", "another"}


def test_what_a_running_process_writes_is_left_alone(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "state") as first:
        first.write_text("first")
        with atomic_write(tmp_path / "state") as second:
            second.write_text("second")
    assert (tmp_path / "state").read_text() == "first"


def test_a_link_goes_on_showing_where_it_did(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    link, target = tmp_path / "link.json", tmp_path / "far" / "real.json"
    link.symlink_to(target)
    for text in ("new", "again"):  # at first nothing is there
        with atomic_write(link) as temporary:
            assert temporary.parent == target.parent
            temporary.write_text(text)
        assert link.is_symlink() and target.read_text() == text
    assert [file.name for file in tmp_path.iterdir() if file != link] == ["far"]


@pytest.mark.parametrize(
    "name",
    [b"x" * 255, b"x" * 251 + b".npz", b"a." + b"y" * 250, "ü".encode() * 125, b"M\xfcller.npz"],
)
def test_any_name_that_the_system_takes(tmp_path: Path, name: bytes) -> None:
    target = tmp_path / os.fsdecode(name)
    check_writable(target)
    with atomic_write(target) as temporary:
        temporary.write_text("x")
    assert os.listdir(os.fsencode(tmp_path)) == [name]


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    with (
        pytest.raises(StorageError, match="choose a shorter name"),
        atomic_write(tmp_path / ("x" * 300)) as temporary,
    ):
        temporary.write_text("x")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to a folder"])
def test_what_is_no_file_is_not_replaced(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "target"
    if kind == "folder":
        target.mkdir()
    elif kind == "pipe":
        os.mkfifo(target)
    else:
        target.symlink_to(tmp_path)
    mode = target.lstat().st_mode
    with pytest.raises(StorageError, match="name of a file"):
        check_writable(target)
    with pytest.raises(StorageError, match="name of a file"), atomic_write(target):
        raise AssertionError("nothing was to be written")
    assert target.lstat().st_mode == mode and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("linking", [True, False])
def test_files_that_belong_together_change_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: bool, linking: bool
) -> None:
    paths = [tmp_path / name for name in "abc"]
    for path in paths if old else ():
        path.write_text("old")
    move, moved = os.replace, []

    def refuse_the_third(source: Path, target: Path) -> None:
        moved.append(target)
        if len(moved) == 3:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        move(source, target)

    monkeypatch.setattr(os, "replace", refuse_the_third)
    if not linking:
        monkeypatch.setattr(os, "link", lambda *_: os.listdir(tmp_path / "none"))  # an OSError
    with pytest.raises(StorageError, match="check the path"), atomic_write_all(*paths) as parts:
        for part in parts:
            part.write_text("new")
    assert moved[:3] == paths
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == (
        dict.fromkeys("abc", "old") if old else {}
    )
    with atomic_write_all(*paths) as parts:
        for part in parts:
            part.write_text("newer")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == dict.fromkeys(
        "abc", "newer"
    )


_HOLDING = """
import sys, time
from fgtutor.io.storage import locked_folder
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
        busy = rf"another process \({other.pid}\) works in"
        with pytest.raises(StorageError, match=busy), locked_folder(folder):
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
