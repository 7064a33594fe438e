"""The fuzzer's specialists, routes, shards, notebooks and checkpoints, and what is right."""

import copy
import gc
import hashlib
import io
import json
import math
import random
import struct
import tempfile
import warnings
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_damage import (
    MARKER,
    Damage,
    damage_bytes,
    damage_json,
    damage_members,
    damage_text,
    damage_zip,
    places,
    poke,
)
from fuzz_maps import Payload
from fuzzing import Case, Target

# Specialists --------------------------------------------------------------------------------------


def specialists() -> list[Case]:
    import torch
    from rsl_rl.models import MLPModel
    from rsl_rl.modules.distribution import GaussianDistribution
    from tensordict import TensorDict

    from fgtutor.feasibility import FeasibilityNet
    from fgtutor.patches import PatchGrid
    from fgtutor.policies.dreamwaq import DreamWaQModel
    from fgtutor.policies.symmetry import SymmetricMLPModel
    from fgtutor.specialist import Specialist, save_specialist

    torch.manual_seed(0)
    grid = PatchGrid(ahead=0.3, behind=0.2, half_width=0.2)
    made = []
    for kind, options in (
        (MLPModel, {}),
        (MLPModel, {"obs_normalization": True}),
        (SymmetricMLPModel, {}),
        (DreamWaQModel, {"history": 2, "latent": 4, "context_hidden": (6,)}),
    ):
        policy = kind(
            TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1]),
            *({"actor": ["policy"]}, "actor", 3),
            hidden_dims=[8, 4],
            activation="elu",
            distribution_cfg={"class_name": GaussianDistribution, "std_type": "log"},
            **options,
        )
        specialist = Specialist(
            name="steps",
            robot="toy",
            policy=policy,
            feasibility=FeasibilityNet(
                grid.num_points, hidden=(16, 8), vae_hidden=(16, 8), latent=4
            ),
            grid=grid,
            command=(0.6, 0.0, 0.0),
            label_seconds=1.0,
            quantiles={"0.5": 0.05, "0.9": 0.1, "0.95": 0.2, "0.99": 0.4},
            provenance={"terrain": "steps", "samples": 1000, "seed": 0},
        )
        with tempfile.TemporaryDirectory() as folder:
            saved = save_specialist(specialist, Path(folder) / "steps")
            made.append({path.name: path.read_bytes() for path in sorted(saved.iterdir())})
    # A class of somebody else's, with an argument that would make the marker.
    told = json.loads(made[0]["specialist.json"])
    told["policy"]["distribution"]["class_name"] = "os:mkdir"
    attack = made[0] | {"specialist.json": json.dumps(told).encode()}
    told["policy"]["num_actions"] = MARKER
    worse = made[0] | {"specialist.json": json.dumps(told).encode()}
    mend_specialist(attack)
    mend_specialist(worse)
    return [*made, *made, attack, worse]


def mend_specialist(case: Case) -> None:
    """Correct sizes and checksums wherever the description still has a place for them."""
    try:
        text = case["specialist.json"].decode()
        for file, old in json.loads(text)["files"].items():
            text = text.replace(old["sha256"], hashlib.sha256(case[file]).hexdigest())
            text = text.replace(f'"bytes": {old["bytes"]}', f'"bytes": {len(case[file])}')
        told = json.loads(text)
        stored = told.pop("checksum")
        plain = json.dumps(told, sort_keys=True, separators=(",", ":"))
        text = text.replace(stored, hashlib.sha256(plain.encode()).hexdigest())
        case["specialist.json"] = text.encode()
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return  # too damaged to be mended


def use_specialist(folder: Path) -> None:
    import torch
    from tensordict import TensorDict

    from fgtutor.specialist import load_specialist

    specialist = load_specialist(folder)
    policy, net = specialist.policy, specialist.feasibility
    widths = [policy.obs_dim] + [0] * (len(policy.obs_groups) - 1)
    groups = {k: torch.zeros(1, n) for k, n in zip(policy.obs_groups, widths, strict=True)}
    assert torch.isfinite(specialist.act(TensorDict(groups, batch_size=[1]))).all()
    patch, command = torch.zeros(1, specialist.grid.num_points), torch.tensor([specialist.command])
    with torch.no_grad():
        assert 0 <= net.feasibility(patch, command) <= 1
        assert torch.isfinite(net.reconstruction(patch)).all()
    assert repr(specialist)


def damage_safetensors(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Change the header, which is JSON, and correct its length; or change a weight."""
    length = int.from_bytes(data[:8], "little")
    if not 0 < length <= len(data) - 12:
        return damage_bytes(rng, data, other)
    if rng.random() < 0.4:
        weights = (len(data) - length - 8) // 4
        return poke(rng, data, 8 + length + 4 * rng.randrange(weights), rng.choice((1, 4)))
    header = damage_json(rng, data[8 : 8 + length], other)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


# Routes, shards, notebooks ------------------------------------------------------------------------


def routes() -> list[Case]:
    from fgtutor.routes import Route

    made = []
    for n in (4, 1, 2):
        cells = np.stack([np.arange(n), np.arange(n)], axis=1)
        each = None if n == 2 else np.full((n - 1, 2), 0.5)
        route = Route(
            cells=cells,
            xy=cells * 0.1 + 0.05,
            headings=np.full(n - 1, 1),
            policies=np.arange(n - 1) % 2,
            feasibility=np.full(n - 1, 0.5),
            costs=np.full(n - 1, 0.2),
            length=math.hypot(0.1, 0.1) * (n - 1),
            names=("gaps", "steps"),
            choices=each,
            ood=each,
        )
        made.append({"route.json": json.dumps(route.to_json()).encode()})
    return made


def use_route(folder: Path) -> None:
    from fgtutor.routes import Route

    text = (folder / "route.json").read_bytes()
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        data = text  # no tree at all
    route = Route.from_json(data)
    assert repr(route) and len(route.explain()) == len(route.cells) - 1
    assert np.isfinite(route.xy).all() and np.isfinite([route.cost, route.length]).all()
    plain = json.loads(json.dumps(route.to_json(), allow_nan=False))
    assert Route.from_json(plain).to_json() == plain


SETTINGS = {"command": "square", "n": 2, "seed": 0}


def shards() -> list[Case]:
    rows = [{"x": 1, "square": 1.5, "terrain": "steps", "fell": False, "note": None}]
    machine = {"host": "a", "versions": {"fgtutor": "0.1"}}
    shard = {"settings": SETTINGS, "rows": rows, "seconds": 0.5, "machine": machine}
    return [
        {"settings.json": json.dumps(SETTINGS).encode(), "t0.json": json.dumps(s).encode()}
        for s in (shard, shard | {"rows": []})
    ]


def use_shard(folder: Path) -> None:
    from fgtutor.evaluation.shards import RunConfig, finished
    from fgtutor.evaluation.tasks import Task

    for path in folder.glob("t0.json"):
        (folder / "shards").mkdir()
        path.rename(folder / "shards" / "t0.json")
    task = Task(name="t0", function=shards)
    done = finished([task], SETTINGS, RunConfig(out=folder))
    for name, result in done.items():
        assert name == "t0" and all(isinstance(row, dict) for row in result.rows)
        assert isinstance(result.rows, list) and isinstance(result.machine, dict)
        assert isinstance(result.seconds, float | int) and 0 <= result.seconds < math.inf
        json.dumps([result.rows, result.machine], allow_nan=False)


def notebooks() -> list[Case]:
    code = {"cell_type": "code", "metadata": {}, "outputs": []}
    cells = [
        {"cell_type": "markdown", "id": "a", "metadata": {}, "source": ["# Title\n"]},
        {**code, "id": "b", "execution_count": 1, "source": ["x = 1\n", "%time x"]},
        {**code, "id": "c", "execution_count": None, "source": "def fuse():\n    pass\n"},
    ]
    named = {"fgtutor": {"exercise": "ex06"}}
    whole = {"cells": cells, "metadata": named, "nbformat": 4, "nbformat_minor": 5}
    sheet = {"cells": [{**code, "input": "x = 1", "language": "python"}]}
    old = {"worksheets": [sheet], "metadata": {"name": ""}, "nbformat": 3, "nbformat_minor": 0}
    forms = (whole, whole | {"metadata": {}}, old)
    return [{"ex06_ada.ipynb": json.dumps(form).encode()} for form in forms]


def use_notebook(folder: Path) -> None:
    from fgtutor.course.grading.submissions import exercise_of, read_submission

    path = folder / "ex06_ada.ipynb"
    content = read_submission(path)
    assert isinstance(content.cells, list) and all(isinstance(cell, str) for cell in content.cells)
    assert len(content.damage) < 300 and content.damage.isprintable()
    assert exercise_of(path, folder, content.exercise) == "ex06"


# Checkpoints --------------------------------------------------------------------------------------


@cache
def trainer() -> Any:
    """Return a training that has not begun; its folder changes from case to case."""
    import torch

    from fgtutor.learning.config import TrainConfig
    from fgtutor.learning.trainer import Trainer

    torch.set_num_threads(1)
    tiny: dict[str, Any] = {"num_envs": 2, "steps": 8, "rows": 1, "columns": 1, "hidden": (8, 4)}
    made = Trainer(TrainConfig(out=Path("run"), label_seconds=0.12, iterations=2, **tiny))
    gc.freeze()  # a trainer that begins anew collects garbage, and need not look at all of this
    return made


def checkpoints() -> list[Case]:
    import pickle

    run = trainer()
    with tempfile.TemporaryDirectory() as folder:
        run.config = replace(run.config, out=Path(folder))
        run.iterate()
        run.save()
        whole = {"checkpoint.pt": (Path(folder) / "checkpoint.pt").read_bytes()}
    attack = {"checkpoint.pt": bytes(DIGEST) + pickle.dumps({"config": Payload()}, protocol=2)}
    mend_checkpoint(attack)
    return [*[whole] * 5, attack]


DIGEST = hashlib.sha256().digest_size


def mend_checkpoint(case: Case) -> None:
    """Write the checksum of what follows it."""
    payload = case["checkpoint.pt"][DIGEST:]
    case["checkpoint.pt"] = hashlib.sha256(payload).digest() + payload


def use_checkpoint(folder: Path) -> None:
    import torch

    run = trainer()
    run.config = replace(run.config, out=folder)
    run.resume()
    assert all(torch.isfinite(p).all() for p in run.algorithm.get_policy().parameters())
    assert 0 <= run.iteration < 10**9


def behind_checksum(change: Damage) -> Damage:
    """Return a damage that leaves a checkpoint's checksum where it is."""
    return lambda rng, data, other: data[:DIGEST] + change(rng, data[DIGEST:], other[DIGEST:])


@lru_cache(4)
def parsed(data: bytes) -> Any:
    import torch

    with warnings.catch_warnings(action="ignore"):
        return torch.load(io.BytesIO(data), weights_only=True)


def damage_state(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Replace or remove a value of the state, and write it as torch does."""
    import torch

    try:
        state = copy.deepcopy(parsed(data))
    except Exception:  # damaged before
        return damage_bytes(rng, data, other)
    spots = places(state)
    node, key = rng.choice(rng.choice((spots, [spot for spot in spots if spot[0] is state])))
    value, empty = node[key], torch.zeros(0)
    odd = [None, True, -1, 0, 1.5, math.nan, 10**30, "", "x", [], {}, torch.ones(3), empty]
    odd.append(Payload())
    if isinstance(value, torch.Tensor) and value.is_floating_point():
        odd += [value * math.nan, value + math.inf, value[None], value.double(), value.to_sparse()]
    elif isinstance(value, torch.Tensor):
        odd += [-value.long(), value + 100, value.double()]
    elif isinstance(value, str):
        odd += [damage_json(rng, value.encode(), b"").decode("utf-8", "replace")] * 10
    if rng.random() < 0.15:
        del node[key]
    else:
        node[key] = rng.choice(odd)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


_JSON = (damage_json, damage_json, damage_text)
_WEIGHTS = (damage_bytes, damage_safetensors, damage_safetensors)
_CHECKPOINT = (
    damage_bytes,
    *[behind_checksum(damage_state)] * 4,
    *map(behind_checksum, (damage_bytes, damage_zip, damage_members(damage_text))),
)
TARGETS = {
    "specialist": Target(
        specialists, use_specialist, {".json": _JSON, ".safetensors": _WEIGHTS}, mend_specialist
    ),
    "route": Target(routes, use_route, {".json": _JSON}),
    "shard": Target(shards, use_shard, {".json": _JSON}),
    "notebook": Target(notebooks, use_notebook, {".ipynb": _JSON}),
    "checkpoint": Target(checkpoints, use_checkpoint, {".pt": _CHECKPOINT}, mend_checkpoint),
}
