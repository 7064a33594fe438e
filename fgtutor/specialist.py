"""The specialist: one policy with its Feasibility-Net, and the folder that holds them on disk.

Reads and gives folders of `policy.safetensors`, `feasibility.safetensors` and `specialist.json`;
nothing is ever unpickled, imported or called by a name from a file. Every later stage consumes
specialists, and dropping a folder into the zoo adds one. Source: the pairs (pi_i, F_i) of the
paper, Sec. III-C.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import safetensors.torch
import torch
from annotated_types import Interval
from torch import Tensor, nn

from fgtutor.errors import FgtutorError, SpecialistError
from fgtutor.feasibility import FeasibilityNet
from fgtutor.io.rsl import MLPModel, TensorDict
from fgtutor.io.storage import beside, remove_leftovers, storage_error
from fgtutor.io.tensors import CURE, Digest, check_tensors, digest, read_bytes, read_tensors
from fgtutor.io.validation import (
    LARGEST_RECORD,
    NAME,
    Name,
    arguments,
    check_fields,
    parse_record,
)
from fgtutor.patches import PatchGrid
from fgtutor.policies.description import PolicyConfig
from fgtutor.policies.symmetry import SymmetricMLP

ZOO = Path(__file__).parent / "zoo"
"""The shipped specialists: one folder <robot>/<name> each."""
GENERAL = "general"
"""Name of the baseline trained on every terrain; it lies in the zoo but is no specialist."""
SCHEMA = 1
"""Version of `specialist.json`; a reader refuses any other."""
DESCRIPTION = "specialist.json"
"""The file that describes the other two and holds their checksums."""
TENSORS = ("policy.safetensors", "feasibility.safetensors")
"""The weights of a specialist's two networks."""
Speed = Annotated[float, Interval(ge=-100, le=100)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Specialist:
    """A policy, what it finds feasible, and what a planner must know about both.

    Raises:
        SpecialistError: The parts do not fit together.
    """

    name: Name
    """What routes and figures call it; in a zoo, the name of its folder."""
    robot: Name
    """The robot it drives: "toy" or "a1"."""
    policy: MLPModel
    """pi_i: observations to actions."""
    feasibility: FeasibilityNet
    """F_i: patch and command to feasibility, and L_recon."""
    grid: PatchGrid
    """Where its patches are sampled."""
    command: tuple[Speed, Speed, Speed]
    """Velocity (vx, vy, wz) that planning asks about, and at which it drives a route, in the yaw
    frame; m/s, m/s, rad/s. It goes ahead, since patches look along the heading."""
    label_seconds: Annotated[float, Interval(ge=0, le=3600)]
    """Seconds over which r_v was averaged into the label; 0 is the paper's instantaneous r_v."""
    quantiles: Mapping[str, float] = field(default_factory=dict)
    """Quantiles of L_recon on its own held-out terrain, in the Feasibility-Net's scaled units, by
    probability ("0.95": ...); none if it was never calibrated (`fgtutor calibrate`)."""
    strangeness: Mapping[str, float] = field(default_factory=dict)
    """Quantiles of the strangeness (`FeasibilityNet.losses`) there."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Where it came from: terrain, samples, seed, package versions; kept as JSON keeps it."""

    def __post_init__(self) -> None:
        check_fields(self, SpecialistError)
        if self.feasibility.num_points != self.grid.num_points:
            raise SpecialistError(
                f"{self.name}: the Feasibility-Net reads {self.feasibility.num_points} points, "
                f"the patch grid gives {self.grid.num_points}; build both from one PatchGrid"
            )
        if self.feasibility.command_dim != len(self.command):
            raise SpecialistError(
                f"{self.name}: the Feasibility-Net reads {self.feasibility.command_dim} numbers of "
                f"a command, a command has {len(self.command)}"
            )
        if self.command[0] <= 0:
            raise SpecialistError(f"command: 0: should go ahead, got {self.command}")
        _check_quantiles(self.quantiles, "quantiles")
        _check_quantiles(self.strangeness, "strangeness")
        known = {k: v for k, v in self.provenance.items() if k in _Known.__annotations__}
        parse_record(_Known, known, SpecialistError, "provenance")

    def __repr__(self) -> str:
        """Say in one line what a person wants to know about it."""
        terrain = self.provenance.get("terrain", "unknown terrain")
        return f"Specialist({self.name!r} for {self.robot}, trained on {terrain})"

    @property
    def history(self) -> int:
        """How many frames of history its policy reads; 0 unless it is blind (`dreamwaq`)."""
        return getattr(self.policy, "history", 0)

    @torch.no_grad()
    def act(self, observations: TensorDict) -> Tensor:
        """Return the policy's deterministic actions [robots, actions].

        Raises:
            SpecialistError: An observation group is missing, or their widths do not fit.
        """
        groups = self.policy.obs_groups
        got = {k: tuple(observations[k].shape) for k in groups if k in observations}
        if (
            len(got) < len(groups)
            or sum(shape[-1] for shape in got.values()) != self.policy.obs_dim
        ):
            raise SpecialistError(
                f"{self.name} reads {self.policy.obs_dim} numbers from the observation groups "
                f"{groups}, got {got}: it drives {self.robot}, check the robot"
            )
        return self.policy(observations)


def save_specialist(specialist: Specialist, folder: str | Path) -> Path:
    """Write the specialist's folder, whole or not at all, and return its path.

    The files are written into a hidden sibling which then takes the folder's place. If the process
    is killed between the two renames, the earlier folder is still whole under its hidden name; the
    next save removes it.

    Raises:
        SpecialistError: A weight is not finite, or the provenance cannot be written as JSON.
        StorageError: The system refused to write; nothing partial is left.
    """
    folder = Path(folder).absolute()
    if folder.is_symlink():  # it goes on showing where it did
        folder = Path(os.path.realpath(folder))
    if folder.is_dir() and any(folder.iterdir()) and not (folder / DESCRIPTION).is_file():
        raise SpecialistError(f"{folder} holds something else: choose another folder")
    where = specialist.name
    # Compared with what a reader will build: a folder that cannot be loaded is never written.
    config, sizes = PolicyConfig.of(specialist.policy), sizes_of(specialist.feasibility)
    payloads = {}
    twins = _build(config, sizes, "meta", where)
    for file, module, twin in zip(TENSORS, _networks(specialist), twins, strict=True):
        state = {k: v.detach().cpu().contiguous() for k, v in module.state_dict().items()}
        check_tensors(twin, state, f"{where} {file}")
        payloads[file] = safetensors.torch.save(state)
    payloads[DESCRIPTION] = _describe(specialist, config, sizes, payloads)
    parse_record(_Description, payloads[DESCRIPTION], SpecialistError, f"{where} {DESCRIPTION}")

    fresh, previous = beside(folder, ".new"), beside(folder, ".old")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh.mkdir()
        for file, payload in payloads.items():
            with (fresh / file).open("wb") as out:
                out.write(payload)
                out.flush()
                os.fsync(out.fileno())  # data before names, or a power cut leaves empty files
        if folder.is_dir():
            os.replace(folder, previous)
        os.replace(fresh, folder)
    except BaseException as error:
        if previous.exists() and not folder.exists():
            os.replace(previous, folder)
        shutil.rmtree(fresh, ignore_errors=True)
        if isinstance(error, OSError):
            raise storage_error(folder, error) from error
        raise
    shutil.rmtree(previous, ignore_errors=True)
    remove_leftovers(folder)  # only now: one of them may be the only whole copy
    return folder


def load_specialist(folder: str | Path) -> Specialist:
    """Read a specialist's folder, checking every byte.

    Raises:
        SpecialistError: A file is missing, truncated or altered, does not follow the schema, or
            holds tensors of another shape or values that are not finite.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise SpecialistError(
            f"no specialist folder {folder}: check the path, or train one with `fgtutor train`"
        )
    path = folder / DESCRIPTION
    description = _read_description(path)
    networks = description.policy, description.feasibility
    # Built without memory first: what the description claims may be larger than any machine.
    twins = _build(*networks, "meta", str(path))
    tensors = [
        read_tensors(folder / file, description.files[file], twin)
        for file, twin in zip(TENSORS, twins, strict=True)
    ]
    policy, feasibility = _build(*networks, "cpu", str(path))
    try:
        specialist = Specialist(
            policy=policy,
            feasibility=feasibility,
            **{name: getattr(description, name) for name in _PLAIN},
        )
        for module, state in zip(_networks(specialist), tensors, strict=True):
            module.load_state_dict(state)
            module.eval().requires_grad_(False)
            for part in module.modules():
                if isinstance(part, SymmetricMLP):
                    part.find_mirror()
    except FgtutorError as error:
        raise SpecialistError(f"{path}: {error}: {CURE}") from error
    return specialist


def load_zoo(
    robot: str = "toy", folder: str | Path | None = None, *, include_general: bool = False
) -> dict[str, Specialist]:
    """Load every specialist of a robot, by name in alphabetical order; hidden folders are skipped.

    `folder` holds one folder per specialist (default: the shipped zoo). The baseline `general` is
    left out unless asked for.

    Raises:
        SpecialistError: There is no such folder, it holds no specialist, or one of them is corrupt
            or drives another robot.
    """
    home = ZOO / robot if folder is None else Path(folder)
    try:
        paths = sorted(home.iterdir()) if home.is_dir() else []
    except OSError as error:
        raise SpecialistError(f"cannot read the zoo {home}: {error.strerror}") from error
    if not home.is_dir():
        shipped = sorted(path.name for path in ZOO.glob("*") if any(path.glob(f"*/{DESCRIPTION}")))
        raise SpecialistError(
            f"no zoo for robot {robot!r} at {home}: robots with a shipped zoo are {shipped}"
        )
    zoo = {}
    for path in paths:
        wanted = path.is_dir() and not path.name.startswith((".", "_"))
        if not wanted or (path.name == GENERAL and not include_general):
            continue
        if not NAME.fullmatch(path.name):
            raise SpecialistError(
                f"a folder of the zoo {home} is called {path.name!r}: rename it with letters, "
                "digits, spaces and _ . + -, since that is what tables and routes call it"
            )
        zoo[path.name] = specialist = replace(load_specialist(path), name=path.name)
        if specialist.robot != robot:
            raise SpecialistError(
                f"{path} drives {specialist.robot!r}, not {robot!r}: move it to that robot's zoo"
            )
    if not zoo:
        raise SpecialistError(
            f"the zoo {home} holds no specialist: train one with `fgtutor train --robot {robot}`"
        )
    return zoo


@dataclass(frozen=True, kw_only=True)
class _Known:
    """The entries of a provenance that are read; any other may stand beside them."""

    terrain: Name = ""
    samples: Annotated[int, Interval(ge=0, le=10**15)] = 0


@dataclass(frozen=True, kw_only=True)
class _Description:
    """What `specialist.json` holds."""

    schema: Literal[1]
    name: Name
    robot: Name
    policy: PolicyConfig
    feasibility: dict[str, Any]
    grid: PatchGrid
    command: tuple[Speed, Speed, Speed]
    label_seconds: float
    quantiles: dict[str, float]
    provenance: dict[str, Any]
    files: dict[str, Digest]
    checksum: str
    strangeness: dict[str, float] = field(default_factory=dict)


_PLAIN = (
    *("name", "robot", "grid", "command", "label_seconds"),
    *("quantiles", "strangeness", "provenance"),
)
"""What a description holds as a specialist does."""


def _describe(
    specialist: Specialist, config: PolicyConfig, sizes: dict[str, Any], payloads: dict[str, bytes]
) -> bytes:
    """Return the bytes of `specialist.json`."""
    try:
        description = asdict(
            _Description(
                schema=SCHEMA,
                policy=config,
                feasibility=sizes,
                files={file: digest(payload) for file, payload in payloads.items()},
                checksum="",
                **{name: getattr(specialist, name) for name in _PLAIN},
            )
        )
        description["checksum"] = _checksum(description)
        return (json.dumps(description, indent=2, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise SpecialistError(
            f"{specialist.name} cannot be described as JSON ({error}): keep plain finite numbers, "
            "strings, lists and dicts in its provenance and options"
        ) from error


def _checksum(description: Mapping[str, Any]) -> str:
    """Return the sha256 of a description without its own checksum, independent of its layout."""
    content = {key: value for key, value in description.items() if key != "checksum"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_description(path: Path) -> _Description:
    """Read `specialist.json`, verifying its schema version, its own checksum and every value."""
    payload = read_bytes(path, LARGEST_RECORD)
    try:
        content = json.loads(payload)
        if not isinstance(content, dict):
            raise TypeError(f"expected an object, got a {type(content).__name__}")
        schema, stored = content.get("schema"), content.get("checksum")
        computed = _checksum(content)
    except (ValueError, TypeError, RecursionError) as error:
        raise SpecialistError(f"cannot read {path} ({error}): {CURE}") from error
    if schema != SCHEMA:
        raise SpecialistError(
            f"{path} has schema {schema!r:.60}, this fgtutor reads {SCHEMA}: install the fgtutor "
            "that wrote it, or train the specialist again"
        )
    if stored != computed:
        raise SpecialistError(f"{path} was altered, its checksum does not match: {CURE}")
    description = parse_record(_Description, payload, SpecialistError, str(path))
    if set(description.files) != set(TENSORS):
        found = str([*description.files])
        raise SpecialistError(f"{path} lists {found!r:.100}, not {TENSORS}: {CURE}")
    return description


def _networks(specialist: Specialist) -> tuple[nn.Module, nn.Module]:
    """Return both networks, in the order of `TENSORS`."""
    return specialist.policy, specialist.feasibility


def sizes_of(net: FeasibilityNet) -> dict[str, Any]:
    """Return the arguments that build a Feasibility-Net of this size."""
    return {name: getattr(net, name) for name in arguments(FeasibilityNet).__annotations__}


def _build(
    config: PolicyConfig, sizes: Mapping[str, Any], device: str, where: str
) -> tuple[MLPModel, FeasibilityNet]:
    """Build both networks; torch's random state stays, so that a save changes no training."""
    numbers = parse_record(
        arguments(FeasibilityNet), sizes, SpecialistError, f"{where}: feasibility"
    )
    try:
        with torch.random.fork_rng(devices=[]), torch.device(device):
            return config.build(), FeasibilityNet(**vars(numbers))
    except Exception as error:  # a registered class may raise anything
        raise SpecialistError(
            f"{where}: no policy can be built of this description ({str(error)!r:.300}): {CURE}"
        ) from error


def _check_quantiles(quantiles: Mapping[str, float], name: str) -> None:
    """Raise `SpecialistError` unless they are quantiles: by probability, and growing with it."""
    read = parse_record(dict[str, float], dict(quantiles), SpecialistError, name)
    try:
        pairs = [(0.0, 0.0), *sorted((float(share), value) for share, value in read.items())]
    except ValueError as error:
        raise SpecialistError(f"{name}: need probabilities, {error}") from error
    if not all(a < b < 1 and low <= high for (a, low), (b, high) in pairwise(pairs)):
        raise SpecialistError(
            f"{name}: need numbers from 0 that grow with a probability below 1, got {read}"
        )
