"""Every loader meets damaged files of its kind: a right value or an error of ours, nothing else.

`fuzzing.py` says what is allowed; it runs in a process of its own, since a loader may end it. With
FGTUTOR_FUZZ_CASES=20000 in the environment each loader meets so many cases instead of 2,000.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CASES = os.environ.get("FGTUTOR_FUZZ_CASES", "2000")
CLOUDS = ("ply", "pcd", "las", "laz", "xyz", "cloud")
LOADERS = ("npz", "tif", "png", *CLOUDS, "specialist", "route", "shard", "notebook", "checkpoint")


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=HERE, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("loader", LOADERS)
def test_damaged_files_give_a_right_value_or_a_usable_error(loader, tmp_path):
    done = run("fuzzing.py", loader, "--cases", CASES, "--keep", tmp_path)
    assert done.returncode == 0, f"kept in {tmp_path}:\n{done.stdout[-5000:]}{done.stderr[-2000:]}"


def test_no_loader_of_the_fuzzer_is_left_out():
    assert f"of {', '.join(LOADERS)};" in " ".join(run("fuzzing.py", "--help").stdout.split())


MISBEHAVING = """
import os, sys, time, warnings
from pathlib import Path
from fgtutor.errors import MapError
from fuzz_damage import MARKER
from fuzzing import Target, fuzz

def use(folder):
    match (folder / "x.txt").read_text():
        case "raises": raise KeyError("x")
        case "warns": warnings.warn("careful")
        case "prints": os.write(2, b"careful")
        case "dies": os.abort()
        case "hangs": time.sleep(60)
        case "takes memory": bytearray(2 * 2**30)
        case "hides it":
            try: bytearray(2 * 2**30)
            except MemoryError as error: raise MapError("this file is corrupt: copy it") from error
        case "runs code": os.mkdir(MARKER)
        case "says nothing": raise MapError("no")
        case "says too much": raise MapError("x" * 1001)
        case "passes on": raise MapError("1 validation error for Header, see https://e.org")
        case "refuses": raise MapError("the file is corrupt: copy it again")

names = sys.argv[2:]
target = Target(lambda: [{"x.txt": name.encode()} for name in names], use, {})
tally = fuzz("x", target, first=0, cases=len(names), seed=0, seconds=2, keep=Path(sys.argv[1]))
print(tally.right, dict(tally.refused))
for kind, [(number, _)] in tally.faults.items():
    print(names[number], ":", kind)
"""


@pytest.mark.slow
def test_the_fuzzer_notices_whatever_is_not_allowed(tmp_path):
    faults = {
        "raises": "KeyError at the check",
        "warns": "warns: UserWarning",
        "prints": "prints",
        "dies": "ends the process (-6)",
        "hangs": "takes more than 2 s",
        "takes memory": "MemoryError at the check",
        "hides it": "MapError for want of memory",
        "runs code": "RUNS CODE OF THE FILE",
        "says nothing": "MapError that is too short",
        "says too much": "MapError that is too long",
        "passes on": "MapError that says 'validation error'",
    }
    done = run("-c", MISBEHAVING, tmp_path, *faults, "refuses", "is right")
    assert done.stdout.splitlines() == [
        "1 {'MapError': 1}",
        *(f"{name} : {fault}" for name, fault in faults.items()),
    ], done.stderr
    assert len(list(tmp_path.iterdir())) == len(faults)
