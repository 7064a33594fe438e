"""Killed, out of space, locked out, in each other's way: what is left behind, byte for byte.

`FGTUTOR_KILLS=20 python -m pytest tests/test_faults.py` kills each command twenty times, where the
usual run does it once or twice.
"""

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from faults import KILLED, Victim, contents, moments

from fgtutor.elevation import ElevationMap
from fgtutor.io.storage import LOCK
from fgtutor.learning.trainer import read_checkpoint
from fgtutor.specialist import load_specialist

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs POSIX processes"),
]
KILLS = int(os.environ.get("FGTUTOR_KILLS", "2"))
SOLUTIONS = Path(__file__).parent.parent / "solutions"
TRAINING = [
    *("--num-envs", "4", "--steps", "8", "--rows", "2", "--columns", "2"),
    *("--label-seconds", "0.12", "--hidden", "8", "--save-every", "2", "--iterations", "8"),
]


@pytest.fixture(scope="module")
def victim(tmp_path_factory):
    process = Victim(tmp_path_factory.mktemp("victim"))
    yield process
    process.close()


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    process = Victim(tmp_path_factory.mktemp("other"))
    yield process
    process.close()


@pytest.fixture
def cloud(tmp_path):
    """A flight of steps as a text cloud."""
    grid = np.stack(np.meshgrid(np.arange(120), np.arange(80), indexing="ij"), -1).reshape(-1, 2)
    points = np.c_[0.05 * grid + 0.025, 0.1 * (grid[:, 0] // 30)]
    np.savetxt(tmp_path / "c.xyz", points, fmt="%.3f")
    return tmp_path / "c.xyz"


@pytest.fixture
def submissions(tmp_path):
    folder = tmp_path / "submissions"
    for learner in ("ada", "bob"):
        (folder / learner).mkdir(parents=True)
        shutil.copy(SOLUTIONS / "ex01.ipynb", folder / learner / "ex01.ipynb")
    return folder


def report(folder: Path) -> dict[str, bytes]:
    """Return what an evaluation found, without how long it took."""
    return {name: (folder / name).read_bytes() for name in ("rows.json", "table.md")}


def weights(folder: Path) -> dict[str, bytes]:
    """Return the networks of a specialist's folder."""
    return {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}


def timed(victim: Victim, words: list[object]) -> float:
    """Run a command, which must succeed, and return how long it took."""
    began = time.monotonic()
    code, said = victim.run(words)
    assert code == 0, said
    return time.monotonic() - began


def test_a_killed_training_goes_on_as_if_nothing_had_been(victim, tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    words = ["train", *TRAINING, "--out"]
    seconds = timed(victim, [*words, whole])
    for moment in moments(KILLS, seconds, seed=1):
        resume = ["--resume"] if (broken / "checkpoint.pt").exists() else []
        code = victim.kill([*words, broken, *resume], moment)
        assert code in (0, KILLED)
        if (broken / "checkpoint.pt").exists():
            iteration = read_checkpoint(broken / "checkpoint.pt")["iteration"]
            load_specialist(broken / "snapshots" / str(iteration))
        if code == 0:
            assert weights(broken / "specialist") == weights(whole / "specialist")
            shutil.rmtree(broken)
    resume = ["--resume"] if (broken / "checkpoint.pt").exists() else []
    timed(victim, [*words, broken, *resume])
    assert weights(broken / "specialist") == weights(whole / "specialist")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_evaluation_goes_on_to_the_same_rows(victim, zoo, tmp_path, workers):
    words = [
        *("evaluate", "matrix", "--zoo", zoo, "--terrains", "steps", "--policies", "steps", "ours"),
        *("--protocol", "paper", "--trials", "4", "--workers", workers, "--out"),
    ]
    seconds = timed(victim, [*words, tmp_path / "whole"])
    for moment in moments(max(1, KILLS // workers), seconds, seed=workers):
        assert victim.kill([*words, tmp_path / "broken"], moment) in (0, KILLED)
    timed(victim, [*words, tmp_path / "broken"])
    assert report(tmp_path / "broken") == report(tmp_path / "whole")


def test_a_killed_sweep_goes_on_to_the_same_rows(victim, tmp_path):
    words = [
        *("sweep", "--terrains", "steps", "--seeds", "1", "2", "--trials", "2", "--workers", "1"),
        *(f"--train.{word.removeprefix('--')}" if "--" in word else word for word in TRAINING),
        "--out",
    ]
    seconds = timed(victim, [*words, tmp_path / "whole"])
    for moment in moments(KILLS, seconds, seed=3):
        assert victim.kill([*words, tmp_path / "broken"], moment) in (0, KILLED)
    timed(victim, [*words, tmp_path / "broken"])
    assert report(tmp_path / "broken") == report(tmp_path / "whole")


@pytest.mark.parametrize("suffix", [".npz", ".tif", ".png"])
def test_a_killed_map_is_the_old_one_or_the_new_one(victim, cloud, tmp_path, suffix):
    words = ["map", cloud, "--min-points", "1", "--out", tmp_path / f"m{suffix}", "--resolution"]
    heights = {}
    for resolution in ("0.1", "0.05"):
        seconds = timed(victim, [*words, resolution])
        heights[resolution] = ElevationMap.load(tmp_path / f"m{suffix}").heights
    for n, moment in enumerate(moments(KILLS, seconds, seed=4)):
        code = victim.kill([*words, ("0.1", "0.05")[n % 2]], moment)
        assert code in (0, KILLED)
        left = ElevationMap.load(tmp_path / f"m{suffix}").heights
        assert any(np.array_equal(left, known) for known in heights.values())


def test_a_killed_grading_leaves_whole_files_or_none(victim, submissions, tmp_path):
    out = tmp_path / "marks"
    out.mkdir()
    words = [
        *("grade", submissions, "--seed", "7", "--cases", "3", "--workers", "1"),
        *("--csv", out / "marks.csv", "--gradescope", out / "results.json"),
        *("--reports", out / "reports"),
    ]
    seconds = timed(victim, words)
    whole = contents(out)
    assert {"marks.csv", "results.json"} < whole.keys()
    for moment in moments(KILLS, seconds, seed=5):
        shutil.rmtree(out)
        out.mkdir()
        assert victim.kill(words, moment) in (0, KILLED)
        for name, data in contents(out).items():
            assert Path(name).name.startswith(".") or data == whole[name]
    timed(victim, words)
    assert {name: data for name, data in contents(out).items() if name in whole} == whole


@pytest.fixture
def commands(zoo, cloud, submissions, tmp_path):
    """What each command that writes is told to write into a folder that holds earlier results."""
    old, new = tmp_path / "maps", tmp_path / "out"
    old.mkdir()
    ElevationMap(np.zeros((40, 30)), 0.1).save(old / "flat.npz")
    plan = ["--robot", "toy", "--zoo", zoo, "--map", old / "flat.npz"]
    return {
        "train": ["train", *TRAINING, "--resume", "--out", new],
        "evaluate": [
            *("evaluate", "matrix", "--zoo", zoo, "--terrains", "steps", "--policies", "steps"),
            *("--trials", "2", "--workers", "1", "--out", new),
        ],
        "map": ["map", cloud, "--min-points", "1", "--out", new / "m.npz"],
        "plan": ["plan", *plan, "--start", 1, 1, "--goal", 3, 2, "--json", new / "r.json"],
        "grade": ["grade", submissions, "--cases", "3", "--workers", "1", "--csv", new / "m.csv"],
        "export": ["export", zoo / "steps", "--out", new / "p.onnx"],
    }


EARLIER = {
    "train": ["train", *TRAINING[:-1], "2", "--out"],
    "evaluate": None,
    "map": "m.npz",
    "plan": "r.json",
    "grade": "m.csv",
    "export": "p.onnx",
}
"""What the folder held before: a run, nothing, or a file of that name."""


def prepare(victim: Victim, name: str, out: Path) -> dict[str, bytes]:
    """Put into a folder what it held before the command, and return it."""
    earlier = EARLIER[name]
    if isinstance(earlier, list):
        timed(victim, [*earlier, out])
    else:
        out.mkdir()
        if earlier:
            (out / earlier).write_bytes(b"the old one")
    return contents(out)


@pytest.mark.parametrize("name", EARLIER)
def test_a_disk_that_is_full_leaves_what_was_there(victim, commands, tmp_path, name):
    before = prepare(victim, name, tmp_path / "out")
    code, said = victim.run(commands[name], largest=200)
    assert code == 2 and "cannot write" in said and "Traceback" not in said, said
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize("name", EARLIER)
def test_a_folder_that_may_not_be_written_is_left_as_it_was(victim, commands, tmp_path, name):
    before = prepare(victim, name, tmp_path / "out")
    for path in (tmp_path / "out").rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    (tmp_path / "out").chmod(0o555)
    opened = [tmp_path, *(folder for folder in tmp_path.parents if folder.stat().st_mode % 8 < 5)]
    modes = [(folder, folder.stat().st_mode) for folder in opened]
    for folder, mode in modes:
        folder.chmod(mode | 0o055)
    try:
        code, said = victim.run(commands[name], user=0 if os.geteuid() else 65534)
    finally:
        for folder, mode in modes:
            folder.chmod(mode)
    assert code == 2 and "choose a folder that you may write to" in said, said
    assert "Traceback" not in said
    assert contents(tmp_path / "out") == before


def test_two_evaluations_in_one_folder_are_one_run(victim, other, zoo, tmp_path):
    words = [
        *("evaluate", "matrix", "--zoo", zoo, "--terrains", "steps", "--policies", "steps"),
        *("--protocol", "paper", "--trials", "4", "--workers", "1", "--out"),
    ]
    timed(victim, [*words, tmp_path / "whole"])
    victim.start([*words, tmp_path / "both"])
    while not (tmp_path / "both" / LOCK).exists():
        time.sleep(0.001)
    code, said = other.run([*words, tmp_path / "both"])
    assert code == 2 and "another process" in said, said
    assert victim.end() == 0
    assert report(tmp_path / "both") == report(tmp_path / "whole")


def test_two_trainings_in_one_folder_are_one_run(victim, other, tmp_path):
    words = ["train", *TRAINING, "--out"]
    timed(victim, [*words, tmp_path / "whole"])
    victim.start([*words, tmp_path / "both"])
    while not (tmp_path / "both" / LOCK).exists():
        time.sleep(0.001)
    code, said = other.run([*words, tmp_path / "both", "--seed", "2"])
    assert code == 2 and "another process" in said, said
    assert victim.end() == 0
    assert weights(tmp_path / "both" / "specialist") == weights(tmp_path / "whole" / "specialist")
