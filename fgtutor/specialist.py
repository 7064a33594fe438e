"""The specialist: one policy with its Feasibility-Net, and the folder that holds them on disk.

Reads and gives folders of `policy.safetensors`, `feasibility.safetensors` and `specialist.json`;
nothing is ever unpickled. Every later stage consumes specialists, and dropping a folder into the
zoo adds one. Source: the pairs (pi_i, F_i) of the paper, Sec. III-C.
"""

import hashlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from rsl_rl.models import MLPModel
from safetensors import SafetensorError
from tensordict import TensorDict
from torch import Tensor, nn

from fgtutor.errors import SpecialistError
from fgtutor.feasibility import FeasibilityNet
from fgtutor.patches import PatchGrid
from fgtutor.policies import PolicyConfig
from fgtutor.storage import atomic_write, storage_error

SCHEMA = 1
"""Version of `specialist.json`; a reader refuses any other."""
ZOO = Path(__file__).parent / "zoo"
"""The shipped specialists: one folder <robot>/<name> each."""
GENERAL = "general"
"""Name of the baseline trained on every terrain; it lies in the zoo but is no specialist."""
DESCRIPTION = "specialist.json"
"""The file that describes the other two and holds their checksums."""
_CURE = "restore the folder from where it came, or train the specialist again"
_TENSORS = ("policy.safetensors", "feasibility.safetensors")


@dataclass(frozen=True, kw_only=True, eq=False)
class Specialist:
    """A policy, what it finds feasible, and what a planner must know about both.

    Raises:
        SpecialistError: The parts do not fit together.
    """

    name: str
    """What routes and figures call it; in a zoo, the name of its folder."""
    robot: str
    """The robot it drives: "toy" or "a1"."""
    policy: MLPModel
    """pi_i: observations to actions."""
    feasibility: FeasibilityNet
    """F_i: patch and command to feasibility, and L_recon."""
    grid: PatchGrid
    """Where its patches are sampled."""
    command: tuple[float, float, float]
    """Velocity (vx, vy, wz) that planning asks about, in the yaw frame; m/s, m/s, rad/s."""
    label_seconds: float
    """Seconds over which r_v was averaged into the label; 0 is the paper's instantaneous r_v."""
    quantiles: Mapping[str, float]
    """Quantiles of L_recon on its own terrain, m^2, by probability ("0.95": ...)."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Where it came from: terrain, samples, seed, package versions; kept as JSON keeps it."""

    def __post_init__(self) -> None:
        if self.feasibility.num_points != self.grid.num_points:
            raise SpecialistError(
                f"{self.name}: the Feasibility-Net reads {self.feasibility.num_points} points, "
                f"the patch grid gives {self.grid.num_points}; build both from one PatchGrid"
            )
        numbers = (*self.command, self.label_seconds, *self.quantiles.values())
        if len(self.command) != 3 or not all(math.isfinite(number) for number in numbers):
            raise SpecialistError(
                f"{self.name}: expected three finite numbers as command and finite label seconds "
                f"and quantiles, got {self.command}, {self.label_seconds}, {dict(self.quantiles)}"
            )

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
    is killed between the two renames, the earlier folder is still whole under its hidden name.

    Raises:
        SpecialistError: A weight is not finite, or the provenance cannot be written as JSON.
        StorageError: The system refused to write; nothing partial is left.
    """
    folder = Path(folder).absolute()
    if folder.is_dir() and any(folder.iterdir()) and not (folder / DESCRIPTION).is_file():
        raise SpecialistError(f"{folder} holds something else: choose another folder")
    # Filled into what a reader will build: a folder that cannot be loaded is never written.
    modules = (specialist.policy, specialist.feasibility)
    twins = _build(PolicyConfig.of(specialist.policy), _numbers(specialist.feasibility))
    payloads = {}
    for file, module, twin in zip(_TENSORS, modules, twins, strict=True):
        state = {k: v.detach().cpu().contiguous() for k, v in module.state_dict().items()}
        _fill(twin, state, f"{specialist.name}'s {file}")
        payloads[file] = safetensors.torch.save(state)
    payloads[DESCRIPTION] = _describe(specialist, payloads)

    stamp = secrets.token_hex(4)
    fresh = folder.with_name(f".{folder.name}.{stamp}.new")
    previous = folder.with_name(f".{folder.name}.{stamp}.old")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh.mkdir()
        for file, payload in payloads.items():
            with atomic_write(fresh / file) as path:
                path.write_bytes(payload)
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
    payloads = {file: _read_tensors(folder / file, description) for file in _TENSORS}
    try:
        grid = dict(description["grid"])
        grid["footprint"] = tuple(grid["footprint"])
        config = PolicyConfig(**description["policy"])
        policy, feasibility = _build(config, description["feasibility"])
        vx, vy, wz = description["command"]
        specialist = Specialist(
            name=str(description["name"]),
            robot=str(description["robot"]),
            policy=policy,
            feasibility=feasibility,
            grid=PatchGrid(**grid),
            command=(float(vx), float(vy), float(wz)),
            label_seconds=float(description["label_seconds"]),
            quantiles={str(k): float(v) for k, v in description["quantiles"].items()},
            provenance=dict(description["provenance"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise SpecialistError(
            f"{path} does not follow schema {SCHEMA} ({type(error).__name__}: {error}): {_CURE}"
        ) from error
    for module, file in zip((policy, feasibility), _TENSORS, strict=True):
        _fill(module, payloads[file], str(folder / file))
        module.eval().requires_grad_(False)
    return specialist


def load_zoo(
    robot: str = "toy", folder: str | Path | None = None, *, include_general: bool = False
) -> dict[str, Specialist]:
    """Load every specialist of a robot, by name in alphabetical order; hidden folders are skipped.

    `folder` holds one folder a specialist (default: the shipped zoo). The baseline `general` is
    left out unless asked for.

    Raises:
        SpecialistError: There is no such folder, it holds no specialist, or one of them is corrupt
            or drives another robot.
    """
    home = ZOO / robot if folder is None else Path(folder)
    if not home.is_dir():
        shipped = sorted(path.name for path in ZOO.glob("*") if any(path.glob(f"*/{DESCRIPTION}")))
        raise SpecialistError(
            f"no zoo for robot {robot!r} at {home}: robots with a shipped zoo are {shipped}"
        )
    zoo = {}
    for path in sorted(home.iterdir()):
        wanted = path.is_dir() and not path.name.startswith((".", "_"))
        if not wanted or (path.name == GENERAL and not include_general):
            continue
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


def _numbers(net: FeasibilityNet) -> dict[str, Any]:
    """Return the arguments that build a Feasibility-Net of this size."""
    names = ("num_points", "command_dim", "hidden", "vae_hidden", "latent", "height_scale")
    return {name: getattr(net, name) for name in names}


def _build(config: PolicyConfig, numbers: dict[str, Any]) -> tuple[MLPModel, FeasibilityNet]:
    """Build both networks; torch's random state stays, so that a save changes no training."""
    with torch.random.fork_rng(devices=[]):
        return config.build(), FeasibilityNet(**numbers)


def _describe(specialist: Specialist, payloads: Mapping[str, bytes]) -> bytes:
    """Return the bytes of `specialist.json`."""
    description = {
        "schema": SCHEMA,
        "name": specialist.name,
        "robot": specialist.robot,
        "policy": asdict(PolicyConfig.of(specialist.policy)),
        "feasibility": _numbers(specialist.feasibility),
        "grid": asdict(specialist.grid),
        "command": specialist.command,
        "label_seconds": specialist.label_seconds,
        "quantiles": dict(specialist.quantiles),
        "provenance": dict(specialist.provenance),
        "files": {
            file: {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
            for file, payload in payloads.items()
        },
    }
    try:
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


def _read_description(path: Path) -> dict[str, Any]:
    """Read `specialist.json`, verifying its schema version and its own checksum."""
    try:
        description = json.loads(path.read_bytes())
        if not isinstance(description, dict):
            raise TypeError(f"expected an object, got a {type(description).__name__}")
        schema, stored = description.get("schema"), description.get("checksum")
        computed = _checksum(description)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise SpecialistError(f"cannot read {path} ({error}): {_CURE}") from error
    if schema != SCHEMA:
        raise SpecialistError(
            f"{path} has schema {schema!r}, this fgtutor reads {SCHEMA}: install the fgtutor that "
            "wrote it, or train the specialist again"
        )
    if stored != computed:
        raise SpecialistError(f"{path} was altered, its checksum does not match: {_CURE}")
    return description


def _read_tensors(path: Path, description: Mapping[str, Any]) -> dict[str, Tensor]:
    """Read one safetensors file, verifying its size and sha256 before it is parsed."""
    try:
        payload = path.read_bytes()
        expected = description["files"][path.name]
        size, digest = expected["bytes"], expected["sha256"]
    except OSError as error:
        raise SpecialistError(f"cannot read {path} ({error}): {_CURE}") from error
    except (KeyError, TypeError) as error:
        raise SpecialistError(
            f"{path.parent / DESCRIPTION} lists no {path.name}: {_CURE}"
        ) from error
    if len(payload) != size:
        raise SpecialistError(f"{path} has {len(payload)} bytes, expected {size}: {_CURE}")
    if hashlib.sha256(payload).hexdigest() != digest:
        raise SpecialistError(f"{path} was altered, its sha256 does not match: {_CURE}")
    try:
        return safetensors.torch.load(payload)
    except (SafetensorError, ValueError, KeyError) as error:
        raise SpecialistError(f"{path} is not a safetensors file ({error}): {_CURE}") from error


def _fill(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Load tensors into a module, which they must match in names, shapes and types."""
    expected = {k: (tuple(v.shape), v.dtype) for k, v in module.state_dict().items()}
    got = {k: (tuple(v.shape), v.dtype) for k, v in tensors.items()}
    wrong = sorted(k for k in expected.keys() | got.keys() if expected.get(k) != got.get(k))
    if wrong:
        raise SpecialistError(
            f"{where}: tensor {wrong[0]!r} should be {expected.get(wrong[0], 'absent')}, is "
            f"{got.get(wrong[0], 'absent')}: the description is of another network"
        )
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise SpecialistError(
                f"{where}: tensor {name!r} holds a NaN or an infinity: the training diverged, "
                "train again with a lower learning rate"
            )
    module.load_state_dict(dict(tensors))
