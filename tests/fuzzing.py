"""A fuzzer for every loader: makes damaged files, loads each, and tells what must not happen.

A loader may give a right value, or an `FgtutorError` with a usable message, within 10 s and 1 GB,
without a warning, without output and without running code of the file. From the repository:

    python tests/fuzzing.py npz --cases 20000            many cases for one loader, or for several
    python tests/fuzzing.py npz --first 1234 --cases 1   one case again

Cases follow from seed and number alone. Those that fail are kept in the folder `--keep`.
"""

import argparse
import multiprocessing
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzz_damage import MARKER, Damage

from fgtutor.errors import FgtutorError

Case = dict[str, bytes]
"""Files by name; a loader is given the folder that holds them."""
Outcome = tuple[str, str, str]
"""Whether it is right, refused or a fault; of which kind; and the details."""

MEMORY = 2**30
"""Most that a loader may allocate, bytes."""
BATCH = 250
"""Cases that one child process loads."""
_UNUSABLE = re.compile(
    r"https?:|Traceback|validation error|[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff]"
)
_NO_MEMORY = re.compile(r"MemoryError|nable to allocate|bad_alloc|ut of memory|memory allocation")


@dataclass(frozen=True)
class Target:
    """A loader and its files."""

    seeds: Callable[[], list[Case]]
    """Makes whole files of several shapes, and files that try to run code or to fill the memory."""
    use: Callable[[Path], None]
    """Loads the case in a folder and asserts that the value is right."""
    damages: dict[str, Sequence[Damage]]
    """What is done to a file, by suffix."""
    mend: Callable[[Case], None] | None = None
    """Corrects the checksums of a damaged case, so that what they guard is reached."""


@dataclass
class Tally:
    """What became of the cases of a loader."""

    right: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    faults: dict[str, list[tuple[int, str]]] = field(default_factory=dict)
    """Number and details of the cases that failed, by kind."""

    def add(self, number: int, outcome: Outcome) -> None:
        """Count one outcome."""
        what, kind, details = outcome
        if what == "right":
            self.right += 1
        elif what == "refused":
            self.refused[kind] += 1
        else:
            self.faults.setdefault(kind, []).append((number, details))


def make_case(name: str, target: Target, seeds: list[Case], seed: int, number: int) -> Case:
    """Return one case of a loader; the first ones are the seeds as they are."""
    if number < len(seeds):
        return seeds[number]
    rng = random.Random(f"{seed} {name} {number}")
    case = dict(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        file = rng.choice(list(case))
        damage = rng.choice(target.damages[Path(file).suffix])
        case[file] = damage(rng, case[file], rng.choice(seeds).get(file, b""))
    if len(case) > 1 and rng.random() < 0.02:
        del case[rng.choice(list(case))]
    if target.mend and rng.random() < 0.8:
        target.mend(case)
    return case


def judge(target: Target, folder: Path) -> Outcome:
    """Load the case in a folder and say what came of it."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            target.use(folder)
            outcome = "right", "", ""
        except FgtutorError as error:
            outcome = _judge_refusal(error)
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = [
                f"{Path(f.filename).name}:{f.lineno}" for f in frames if "fgtutor" in f.filename
            ]
            where = ours[-1] if ours else "the check"
            details = "".join(traceback.format_exception(error))[-1500:]
            return "fault", f"{type(error).__name__} at {where}", details
    if heard:
        return "fault", f"warns: {heard[0].category.__name__}", str(heard[0])[:500]
    return outcome


def _judge_refusal(error: FgtutorError) -> Outcome:
    """Say whether an error of ours can be used, and came before the memory was taken."""
    text, kind = str(error), type(error).__name__
    cause: BaseException | None = error
    while cause:
        if isinstance(cause, MemoryError) or _NO_MEMORY.search(str(cause)):
            return "fault", f"{kind} for want of memory", text[:500]
        cause = cause.__cause__ or cause.__context__
    if not 20 <= len(text) <= 1000:
        return "fault", f"{kind} that is too {'short' if len(text) < 20 else 'long'}", text[:500]
    if bad := _UNUSABLE.search(text):
        return "fault", f"{kind} that says {bad[0]!r}", text[:500]
    return "refused", kind, text


def _child(connection: Any, target: Target, cases: Iterator[Case], work: Path) -> None:
    """Load cases one after the other and send each outcome; what they print goes to a file."""
    os.chdir(work)
    output = os.open("output", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    used = re.search(r"VmData:\s+(\d+) kB", Path("/proc/self/status").read_text())
    resource.setrlimit(resource.RLIMIT_DATA, (int(used[1]) * 1024 + MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for case in cases:
        shutil.rmtree("case", ignore_errors=True)
        folder = work / "case"
        folder.mkdir()
        for file, content in case.items():
            (folder / file).write_bytes(content)
        outcome = judge(target, folder)
        printed = os.pread(output, 500, 0).decode(errors="replace")
        os.ftruncate(output, 0)
        if (work / MARKER).exists():
            shutil.rmtree(work / MARKER)
            outcome = "fault", "RUNS CODE OF THE FILE", outcome[2]
        elif printed and outcome[0] != "fault":
            outcome = "fault", "prints", printed
        connection.send(outcome)
    os._exit(0)


def fuzz(
    name: str, target: Target, *, first: int, cases: int, seed: int, seconds: float, keep: Path
) -> Tally:
    """Load that many cases and tally what became of them; those that fail are written to `keep`."""
    tally, context, seeds = Tally(), multiprocessing.get_context("fork"), target.seeds()
    shared = "/dev/shm" if Path("/dev/shm").is_dir() else None
    judge(target, Path("nowhere"))  # imports what the loader imports late
    number, end = first, first + cases
    while number < end:
        batch = range(number, min(number + BATCH, end))
        made = (make_case(name, target, seeds, seed, i) for i in batch)
        with tempfile.TemporaryDirectory(dir=shared, ignore_cleanup_errors=True) as work:
            ours, theirs = context.Pipe(duplex=False)
            child = context.Process(target=_child, args=(theirs, target, made, Path(work)))
            child.start()
            theirs.close()
            alive = True
            while alive and number in batch:
                outcome = "fault", f"takes more than {seconds:g} s", ""
                try:
                    if alive := ours.poll(seconds):
                        outcome = ours.recv()
                except EOFError:
                    alive = child.join()
                    printed = (Path(work) / "output").read_text(errors="replace")
                    outcome = "fault", f"ends the process ({child.exitcode})", printed[:500]
                tally.add(number, outcome)
                if outcome[0] == "fault" and len(tally.faults[outcome[1]]) <= 3:
                    folder = keep / f"{name}-{seed}-{number}"
                    folder.mkdir(parents=True, exist_ok=True)
                    for file, content in make_case(name, target, seeds, seed, number).items():
                        (folder / file).write_bytes(content)
                number += 1
            if not alive:
                child.kill()
            child.join()
            ours.close()
    return tally


def main() -> int:
    """Fuzz loaders by name and report; 1 if a case failed, or if nothing could be loaded."""
    import fuzz_clouds
    import fuzz_maps
    import fuzz_records

    targets = fuzz_maps.TARGETS | fuzz_clouds.TARGETS | fuzz_records.TARGETS
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", help=f"of {', '.join(targets)}; default: all")
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz"))
    arguments = vars(parser.parse_args())
    failed = False
    for name in arguments.pop("targets") or targets:
        tally = fuzz(name, targets[name], **arguments)
        total = sum(map(len, tally.faults.values()))
        failed |= total > 0 or not tally.right
        refused = ", ".join(f"{n} {kind}" for kind, n in tally.refused.most_common())
        print(
            f"{name}: {tally.right} right; refused: {refused or 'none'}; {total} failed", flush=True
        )
        for kind, hits in sorted(tally.faults.items(), key=lambda item: -len(item[1])):
            numbers = ", ".join(str(number) for number, _ in hits[:8])
            print(f"  {len(hits)} x {kind} (cases {numbers}; seed {arguments['seed']})")
            print("    " + hits[0][1].strip().replace("\n", "\n    "), flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
