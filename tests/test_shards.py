import errno
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from fgtutor.errors import ConfigError, ReportError, StorageError
from fgtutor.evaluation.shards import RunConfig, collect, settings_of
from fgtutor.evaluation.tasks import Task


@dataclass(frozen=True, kw_only=True)
class SquareConfig(RunConfig):
    n: int = 4
    seed: int = 0
    pair: tuple[float, ...] = (1.0, 2.0)
    zoo: Path | None = None
    json: Path | None = None


def square(x, seed, diary):
    with Path(diary).open("a") as file:
        file.write(f"{x} ")
    return [{"x": x, "square": x * x, "seed": seed}]


@pytest.fixture
def diary(tmp_path):
    (tmp_path / "diary").touch()
    return tmp_path / "diary"


def squares(config, diary):
    """Run the whole thing in this process; `diary` notes which tasks were really done."""
    tasks = [
        Task(name=f"t{x}", function=square, arguments=(x, config.seed, str(diary)))
        for x in range(config.n)
    ]
    return collect(tasks, settings_of(config, "square"), replace(config, workers=1))


ROWS = [{"x": x, "square": x * x, "seed": 0} for x in range(4)]


def test_a_finished_task_is_not_done_again(tmp_path, diary):
    config = SquareConfig(out=tmp_path / "out")
    first = squares(config, diary)
    assert first.rows == ROWS and diary.read_text() == "0 1 2 3 "
    again = squares(config, diary)
    assert again.rows == ROWS and diary.read_text() == "0 1 2 3 "
    assert again.seconds == first.seconds  # what the tasks took, not what reading them takes
    assert len(first.machines) == 1 and first.machines[0]["versions"]["fgtutor"]


def test_an_interrupted_run_keeps_what_is_finished_and_goes_on(tmp_path, diary, monkeypatch):
    config = SquareConfig(out=tmp_path / "out")
    replaced, real = [], os.replace

    def interrupted(source, target):
        # Ctrl-C while the third shard is being moved into place.
        replaced.append(target)
        if Path(target).name == "t2.json":
            raise KeyboardInterrupt
        real(source, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "replace", interrupted)
        squares(config, diary)
    assert sorted(path.name for path in (config.out / "shards").iterdir()) == ["t0.json", "t1.json"]
    diary.write_text("")
    assert squares(config, diary).rows == ROWS and diary.read_text() == "2 3 "


def test_a_full_disk_says_so_and_keeps_the_shards_before(tmp_path, diary, monkeypatch):
    config = SquareConfig(out=tmp_path / "out")
    real = os.replace

    def full(source, target):
        if Path(target).name == "t1.json":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    with monkeypatch.context() as patch, pytest.raises(StorageError, match="free some disk space"):
        patch.setattr(os, "replace", full)
        squares(config, diary)
    assert [path.name for path in (config.out / "shards").iterdir()] == ["t0.json"]
    assert squares(config, diary).rows == ROWS


def test_a_folder_of_other_settings_is_refused(tmp_path, diary):
    squares(SquareConfig(out=tmp_path / "out"), diary)
    with pytest.raises(ReportError, match="seed was 0 and is 1"):
        squares(SquareConfig(seed=1, out=tmp_path / "out"), diary)
    again = SquareConfig(out=tmp_path / "out", zoo=tmp_path, workers=2)
    assert squares(again, diary).rows == ROWS


def test_a_shard_of_other_settings_is_refused(tmp_path, diary):
    mine, theirs = SquareConfig(out=tmp_path / "a"), SquareConfig(out=tmp_path / "b", seed=1)
    squares(mine, diary), squares(theirs, diary)
    shard = (theirs.out / "shards" / "t1.json").read_bytes()
    (mine.out / "shards" / "t1.json").write_bytes(shard)
    with pytest.raises(ReportError, match=r"t1.json comes from a run with other settings"):
        squares(mine, diary)


GOOD = {"settings": {}, "rows": [{"x": 1}], "seconds": 1.0, "machine": {}}


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b'{"rows": [', b"\xff\xfe", b"[1, 2]", b"{}", b"[" * 100_000),
        *(json.dumps({k: v for k, v in GOOD.items() if k != gone}).encode() for gone in GOOD),
        *(json.dumps(GOOD | {k: "text"}).encode() for k in [*GOOD, "more"]),
        *(json.dumps(GOOD | {"seconds": v}).encode() for v in (-1, 10**400, None, True, [])),
        *(json.dumps(GOOD | {"rows": v}).encode() for v in ({}, [[]], [1], None)),
        json.dumps(GOOD | {"seconds": float("nan")}).encode(),
        json.dumps(GOOD | {"rows": [{"x": float("nan")}]}).encode(),
        json.dumps(GOOD | {"machine": {"cores": [float("inf")]}}).encode(),
    ],
)
def test_a_shard_that_cannot_be_read_is_done_again(tmp_path, diary, content):
    config = SquareConfig(out=tmp_path / "out")
    squares(config, diary)
    (config.out / "shards" / "t1.json").write_bytes(content)
    diary.write_text("")
    assert squares(config, diary).rows == ROWS and diary.read_text() == "1 "


def test_a_folder_of_something_else_is_refused(tmp_path, diary):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    with pytest.raises(ReportError, match="not a report folder"):
        squares(SquareConfig(out=tmp_path / "photos"), diary)
    for text in ("[1]", "[" * 100_000, '{"a": ', "\udcff"):
        bad = tmp_path / "photos" / "settings.json"
        bad.write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(ReportError, match="not a report folder"):
            squares(SquareConfig(out=tmp_path / "photos"), diary)
    (tmp_path / "photos" / "settings.json").write_text(json.dumps({"\x1b[2J": "x" * 10**6}))
    with pytest.raises(ReportError, match="other settings") as caught:
        squares(SquareConfig(out=tmp_path / "photos"), diary)
    assert "\x1b" not in str(caught.value) and len(str(caught.value)) < 3000
    assert diary.read_text() == ""  # refused before the work
    (tmp_path / "empty").mkdir()
    assert squares(SquareConfig(out=tmp_path / "empty"), diary).rows == ROWS


def test_settings_are_what_the_rows_depend_on(tmp_path):
    settings = settings_of(SquareConfig(out=tmp_path, workers=3), "square", zoo={"steps": "ab"})
    assert settings.pop("fgtutor")
    assert settings == {
        "command": "square", "n": 4, "seed": 0, "pair": [1.0, 2.0], "zoo": {"steps": "ab"},
    }  # fmt: skip
    assert json.loads(json.dumps(settings)) == settings


@pytest.mark.parametrize("workers", [-1, 1.5])
def test_a_run_that_cannot_be_is_refused(workers):
    with pytest.raises(ConfigError, match="workers: "):
        RunConfig(workers=workers)
