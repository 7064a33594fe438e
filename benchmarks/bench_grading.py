"""Measure grading a class: 200 submissions of one exercise, wall clock, CPU time and memory.

Run `python benchmarks/bench_grading.py` in the repository. Nine in ten submissions are the worked
solution, the others loop forever in one function. The load of other programs shows in the wall
clock, hence CPU time too: two idle cores need half of it.
"""

import json
import resource
import tempfile
import time
from pathlib import Path

from fgtutor.course.grading.grade import GradeConfig, grade

LOOP = "def spl(success, length, reference):\n    while True: pass"


def main(learners: int = 200, exercise: str = "ex10") -> None:
    solved = json.loads((Path("solutions") / f"{exercise}.ipynb").read_text())
    loop = solved | {"cells": [*solved["cells"], {"cell_type": "code", "source": LOOP}]}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(learners):
            path = Path(folder) / f"learner{number:03}.ipynb"
            path.write_text(json.dumps(loop if number % 10 == 9 else solved))
        before = _memory(resource.RUSAGE_SELF)
        began = time.perf_counter()
        marks = grade(GradeConfig(paths=(Path(folder),), workers=2))
        wall = time.perf_counter() - began
    own, children = (resource.getrusage(who) for who in (0, resource.RUSAGE_CHILDREN))
    row = {
        "submissions": learners,
        "wall_s": round(wall, 1),
        "cpu_s": round(sum(u.ru_utime + u.ru_stime for u in (own, children)), 1),
        "grader_mb": round(_memory(resource.RUSAGE_SELF)),
        "grader_growth_mb": round(_memory(resource.RUSAGE_SELF) - before, 1),
        "largest_submission_mb": round(_memory(resource.RUSAGE_CHILDREN)),
        "full_marks": sum(mark.percent == 100 for mark in marks),
    }
    print(json.dumps(row))


def _memory(who: int) -> float:
    """Return the largest resident memory so far, MB (Linux counts in kB)."""
    return resource.getrusage(who).ru_maxrss / 1024


if __name__ == "__main__":
    main()
