"""The command line: `fgtutor COMMAND --options`, where tyro reads each command's own dataclass.

A command is a module that offers a frozen dataclass and `run(config) -> int | None`. It is imported
only when chosen, so that `fgtutor --help` answers at once.
"""

import importlib
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any

from fgtutor import __version__
from fgtutor.errors import FgtutorError

COMMANDS = {
    "demo": ("cli.demo", "DemoConfig", "plan over a mixed terrain and drive it"),
    "train": ("learning.training", "config_of", "train a specialist with its Feasibility-Net"),
    "calibrate": (
        "learning.calibrate",
        "CalibrateConfig",
        "measure what a specialist finds familiar, on held-out terrain",
    ),
    "sweep": ("evaluation.sweep", "config_of", "train specialists side by side and compare them"),
    "plan": ("cli.plan", "PlanConfig", "plan a route over a map file"),
    "evaluate matrix": (
        "evaluation.matrix",
        "MatrixConfig",
        "drive every policy, and ours, over every terrain",
    ),
    "evaluate calibration": (
        "evaluation.calibration",
        "CalibrationConfig",
        "compare every Feasibility-Net with what its policy does on new terrain",
    ),
    "evaluate baselines": (
        "evaluation.ablation",
        "AblationConfig",
        "say what each part of the method buys, beside classical planners",
    ),
    "evaluate adaptation": (
        "evaluation.adaptation",
        "AdaptationConfig",
        "plan with early, mid and late checkpoints of one policy",
    ),
    "evaluate switching": (
        "evaluation.switching",
        "SwitchingConfig",
        "change the policy on the way, with a robot that does not quite know where it is",
    ),
    "evaluate turned": (
        "evaluation.turned",
        "TurnedConfig",
        "cross one obstacle, turned by some angles",
    ),
    "evaluate openground": (
        "evaluation.openground",
        "OpenGroundConfig",
        "plan and drive over maps with several ways across, and with tasks that have none",
    ),
    "evaluate robustness": (
        "evaluation.robustness",
        "RobustnessConfig",
        "drive under one disturbance after another, and another model of the robot",
    ),
    "evaluate newcomer": (
        "evaluation.newcomer",
        "NewcomerConfig",
        "say what one more specialist adds, and that it changes no other",
    ),
    "walk": ("cli.walk", "WalkConfig", "plan a route over a map file and drive it"),
    "map": ("cli.map", "MapConfig", "turn a point cloud into an elevation map"),
    "export": ("cli.export", "ExportConfig", "write a policy as ONNX, with what it observes"),
    "notebooks": ("course.notebooks", "NotebooksConfig", "execute the course's notebooks"),
    "exercises": ("course.exercises", "ExercisesConfig", "build the exercises from their masters"),
    "grade": ("course.grading.grade", "GradeConfig", "grade one exercise notebook or a class"),
    "doctor": ("cli.doctor", "DoctorConfig", "say what this machine has, lacks and needs"),
}
"""Command: its module, the config dataclass there (or the function that picks it), its purpose."""

USAGE, INTERRUPTED, TERMINATED, UNREAD = 2, 130, 143, 141
"""Exit codes: a mistake that the message explains; then, as shells report them, 128 + SIGINT
(Ctrl-C), 128 + SIGTERM, and 128 + SIGPIPE, when the program that read the output has ended."""


def overview() -> str:
    """Return the list of commands."""
    commands = "\n".join(f"  {name:<20} {what}" for name, (_, _, what) in COMMANDS.items())
    return (
        f"fgtutor {__version__}: feasibility-guided planning over locomotion specialists\n\n"
        f"usage: fgtutor COMMAND [--help] [--options]\n\n{commands}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a file's name may be no text
    command = next((name for name in COMMANDS if words[: len(name.split())] == name.split()), None)
    if command is not None:
        return _run(command, words[len(command.split()) :])
    if words == ["--version"]:
        print(__version__)
        return 0
    if not words or words[-1] in ("-h", "--help"):
        print(overview())
        return 0
    print(
        f"fgtutor: no command {' '.join(words[:2])!r}; the commands are {', '.join(COMMANDS)}",
        file=sys.stderr,
    )
    return USAGE


def _run(command: str, options: Sequence[str]) -> int:
    """Import a command's module, let tyro fill its dataclass, and run it."""
    module_name, config_name, _ = COMMANDS[command]
    try:
        from fgtutor.io.progress import waiting  # not at the top: `--help` must be quick
        from fgtutor.io.validation import parse_options

        with waiting(f"fgtutor {command}: loading") if sys.stderr.isatty() else nullcontext():
            module = importlib.import_module(f"fgtutor.{module_name}")
        config_class = getattr(module, config_name)
        if not isinstance(config_class, type):
            config_class = config_class(options)
        config = parse_options(config_class, options, f"fgtutor {command}")
        with _sigterm_as_exit():
            return module.run(config) or 0
    except FgtutorError as error:
        print(f"fgtutor {command}: {error}", file=sys.stderr)
        return USAGE
    except ModuleNotFoundError as error:
        print(
            f"fgtutor {command}: the package {error.name} is not installed; in the clone of "
            "fgtutor, pip install --constraint constraints.txt --editable '.[lab]' installs what "
            "the commands need",
            file=sys.stderr,
        )
        return USAGE
    except KeyboardInterrupt:
        print(f"fgtutor {command}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Python flushes stdout when it ends, and would fail once more.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD


@contextmanager
def _sigterm_as_exit() -> Iterator[None]:
    """Let SIGTERM end the block by an exception, so that files half written are removed."""

    def end(*_: Any) -> None:
        raise SystemExit(TERMINATED)

    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:  # signals arrive in the main thread only, and this is another
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
