"""Specialist folders: round trips, every kind of damage and attack, interrupted saves, the zoo."""

import dataclasses
import errno
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import HeteroscedasticGaussianDistribution
from tensordict import TensorDict

from fgtutor.__main__ import main
from fgtutor.errors import FgtutorError, SpecialistError, StorageError
from fgtutor.feasibility import FeasibilityNet
from fgtutor.io.storage import beside
from fgtutor.patches import PatchGrid
from fgtutor.policies.description import POLICIES, Noise, PolicyConfig, register_policy
from fgtutor.policies.dreamwaq import DreamWaQModel
from fgtutor.policies.symmetry import SymmetricMLPModel
from fgtutor.specialist import (
    SCHEMA,
    Specialist,
    _checksum,
    load_specialist,
    load_zoo,
    save_specialist,
)

FILES = ("policy.safetensors", "feasibility.safetensors", "specialist.json")


def observations(rows: int = 5) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    group = torch.randn(rows, 6, generator=generator)
    return TensorDict({"policy": group, "patch": torch.zeros(rows, 30)}, batch_size=[rows])


def same(first: Specialist, second: Specialist) -> bool:
    """Tell whether two specialists would act, judge and be described alike."""
    ours, theirs = first.policy.state_dict(), second.policy.state_dict()
    nets = first.feasibility.state_dict(), second.feasibility.state_dict()
    fields = ("robot", "grid", "command", "label_seconds", "quantiles", "provenance")
    return (
        all(torch.equal(ours[k], theirs[k]) for k in ours.keys() | theirs.keys())
        and all(torch.equal(nets[0][k], nets[1][k]) for k in nets[0].keys() | nets[1].keys())
        and all(getattr(first, name) == getattr(second, name) for name in fields)
    )


def rewrite(folder, change) -> None:
    """Change the description as a careless editor would who also mends its checksum."""
    path = folder / "specialist.json"
    description = json.loads(path.read_text())
    change(description)
    description["checksum"] = _checksum(description)
    path.write_text(json.dumps(description))


def replace_tensors(folder, file, tensors) -> None:
    """Put other tensors in a folder, with checksums that match them."""
    payload = safetensors.torch.save(tensors)
    (folder / file).write_bytes(payload)
    entry = {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    rewrite(folder, lambda description: description["files"].update({file: entry}))


@pytest.mark.parametrize("normalise", [False, True])
def test_what_is_saved_is_what_is_loaded(make_specialist, tmp_path, normalise):
    specialist = make_specialist(normalise=normalise)
    specialist.policy.update_normalization(observations(64))
    loaded = load_specialist(save_specialist(specialist, tmp_path / "steps"))
    assert same(specialist, loaded) and loaded.name == "steps"
    assert torch.equal(specialist.act(observations()), loaded.act(observations()))
    patch, command = torch.rand(7, loaded.grid.num_points), torch.zeros(7, 3)
    for net in (specialist.feasibility, loaded.feasibility):
        net.eval()
    assert torch.equal(
        specialist.feasibility.feasibility(patch, command),
        loaded.feasibility.feasibility(patch, command),
    )
    assert sorted(path.name for path in (tmp_path / "steps").iterdir()) == sorted(FILES)


def test_act_is_deterministic_and_needs_no_gradient(make_specialist):
    specialist = make_specialist()
    actions = specialist.act(observations())
    assert actions.shape == (5, 3) and not actions.requires_grad
    assert torch.equal(actions, specialist.act(observations()))
    assert torch.equal(actions, specialist.policy.mlp(observations()["policy"]).detach())


def test_saving_and_loading_leave_the_random_state_alone(make_specialist, tmp_path):
    specialist = make_specialist()
    before = torch.get_rng_state()
    load_specialist(save_specialist(specialist, tmp_path / "steps"))
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    "wrong",
    [
        TensorDict({"patch": torch.zeros(2, 6)}, batch_size=[2]),
        TensorDict({"policy": torch.zeros(2, 5)}, batch_size=[2]),
    ],
)
def test_act_says_which_observations_it_needs(make_specialist, wrong):
    with pytest.raises(SpecialistError, match=r"steps reads 6 numbers .*'policy'"):
        make_specialist().act(wrong)


@pytest.mark.parametrize("missing", FILES)
def test_a_missing_file_is_named(make_specialist, tmp_path, missing):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    (folder / missing).unlink()
    with pytest.raises(SpecialistError, match=missing):
        load_specialist(folder)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("keep", [0, 1, 100, -1])
def test_a_truncated_file_is_named(make_specialist, tmp_path, file, keep):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    payload = (folder / file).read_bytes()
    # Without its final newline the description is still whole: cut one byte more.
    (folder / file).write_bytes(payload[: keep if keep >= 0 else -2])
    with pytest.raises(SpecialistError, match=file):
        load_specialist(folder)


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(file=st.sampled_from(FILES), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_found(make_specialist, tmp_path_factory, file, place, bit):
    specialist = make_specialist()
    folder = save_specialist(specialist, tmp_path_factory.mktemp("flip") / "steps")
    payload = bytearray((folder / file).read_bytes())
    payload[int(place * len(payload))] ^= 1 << bit
    (folder / file).write_bytes(payload)
    try:
        loaded = load_specialist(folder)
    except SpecialistError as error:
        assert str(folder) in str(error)
    else:
        # Only the layout of the JSON may change unnoticed: its content is what is checked.
        assert file == "specialist.json" and same(specialist, loaded)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.update(schema=SCHEMA + 1),
        lambda d: d.pop("schema"),
        lambda d: d.pop("grid"),
        lambda d: d.pop("files"),
        lambda d: d["files"].pop("policy.safetensors"),
        lambda d: d.update(command=[0.5, 0.0]),
        lambda d: d.update(command="fast"),
        lambda d: d.update(quantiles=None),
        lambda d: d.update(quantiles={"0.5": "much"}),
        lambda d: d.update(provenance=3),
        lambda d: d["grid"].update(spacing=0.0),
        lambda d: d["grid"].update(half_width=0.4),
        lambda d: d["grid"].update(colour="red"),
        lambda d: d["feasibility"].update(hidden=[16, 9]),
        lambda d: d["feasibility"].update(latent=-4),
        lambda d: d["policy"].update(kind="os.system"),
        lambda d: d["policy"].update(hidden_dims=[8]),
        lambda d: d["policy"].update(num_actions=4),
        lambda d: d["policy"].update(groups=[]),
        lambda d: d["policy"].update(activation="sawtooth"),
        lambda d: d["policy"]["distribution"].update(std_type="scalar"),
        lambda d: d["policy"]["distribution"].update(class_name="os:system"),
        lambda d: d["policy"]["options"].update(cheese=1),
    ],
)
def test_a_description_that_does_not_fit_is_refused(make_specialist, tmp_path, change):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    rewrite(folder, change)
    with pytest.raises(SpecialistError, match="steps"):
        load_specialist(folder)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"schema": NaN}', "[" * 100_000, "\xff"])
def test_a_description_that_is_no_object_is_refused(make_specialist, tmp_path, text):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    (folder / "specialist.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(SpecialistError, match=r"specialist\.json"):
        load_specialist(folder)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("file", FILES[:2])
def test_weights_that_are_not_finite_are_refused(make_specialist, tmp_path, file, value):
    specialist = make_specialist()
    folder = save_specialist(specialist, tmp_path / "steps")
    tensors = safetensors.torch.load((folder / file).read_bytes())
    name = sorted(tensors)[0]
    tensors[name].view(-1)[0] = value
    replace_tensors(folder, file, tensors)
    with pytest.raises(SpecialistError, match=rf"{file}.*{name}.*NaN"):
        load_specialist(folder)


def test_diverged_weights_are_never_saved(make_specialist, tmp_path):
    specialist = make_specialist()
    with torch.no_grad():
        specialist.policy.mlp[0].weight[0, 0] = float("nan")
    with pytest.raises(SpecialistError, match="diverged"):
        save_specialist(specialist, tmp_path / "steps")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", FILES[:2])
def test_tensors_that_do_not_match_are_refused(make_specialist, tmp_path, file):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    tensors = safetensors.torch.load((folder / file).read_bytes())
    name, value = sorted(tensors.items())[0]
    wrong = [
        {k: v for k, v in tensors.items() if k != name},
        tensors | {"extra": torch.zeros(2)},
        tensors | {name: torch.zeros(*value.shape, 2)},
        tensors | {name: value.double()},
    ]
    for other in wrong:
        replace_tensors(folder, file, other)
        with pytest.raises(SpecialistError, match=file):
            load_specialist(folder)


def test_bytes_that_are_no_safetensors_are_refused(make_specialist, tmp_path):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    payload = b"\x80\x04pickle, perhaps"
    (folder / FILES[0]).write_bytes(payload)
    entry = {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    rewrite(folder, lambda description: description["files"].update({FILES[0]: entry}))
    with pytest.raises(SpecialistError, match=FILES[0]):
        load_specialist(folder)


def test_saving_again_replaces_the_folder(make_specialist, tmp_path):
    save_specialist(make_specialist(seed=0), tmp_path / "steps")
    second = make_specialist(seed=1)
    save_specialist(second, tmp_path / "steps")
    assert same(load_specialist(tmp_path / "steps"), second)
    assert [path.name for path in tmp_path.iterdir()] == ["steps"]


@pytest.mark.parametrize("call", range(2))
def test_a_save_that_fails_leaves_the_earlier_folder(make_specialist, tmp_path, monkeypatch, call):
    # Two renames make a second save: the old folder aside, the new one in its place.
    first = make_specialist(seed=0)
    save_specialist(first, tmp_path / "steps")
    rename, calls = os.replace, []

    def failing(source, target):
        calls.append(target)
        if len(calls) == call + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(StorageError, match="free some disk space"):
        save_specialist(make_specialist(seed=1), tmp_path / "steps")
    assert [path.name for path in tmp_path.iterdir()] == ["steps"]
    assert same(load_specialist(tmp_path / "steps"), first)


def test_a_disk_that_takes_no_more_leaves_nothing(make_specialist, tmp_path):
    # A limit on file sizes makes the system itself refuse the write, as a full disk would.
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    specialist = make_specialist()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(StorageError, match="steps"):
            save_specialist(specialist, tmp_path / "steps")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_named(make_specialist, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        save_specialist(make_specialist(), tmp_path / "file" / "steps")
    with pytest.raises(StorageError, match="file"):
        save_specialist(make_specialist(), tmp_path / "file")
    assert (tmp_path / "file").read_text() == "in the way"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_somebody_elses_folder_is_not_replaced(make_specialist, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(SpecialistError, match="holds something else"):
        save_specialist(make_specialist(), tmp_path)
    assert (tmp_path / "thesis.txt").exists()


def test_parts_that_do_not_fit_are_refused(make_specialist):
    with pytest.raises(SpecialistError, match="30 points"):
        dataclasses.replace(make_specialist(), grid=PatchGrid())
    with pytest.raises(SpecialistError, match="command: 0: should be a finite number"):
        make_specialist(command=(float("nan"), 0.0, 0.0))
    with pytest.raises(SpecialistError, match="reads 2 numbers of a command"):
        net = FeasibilityNet(30, command_dim=2, hidden=(4, 4), vae_hidden=(4, 4), latent=2)
        make_specialist(feasibility=net)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", "a|b"),
        ("name", "\x1b]0;me\x07"),
        ("name", "../../outside"),
        ("name", 3),
        ("robot", "toy\n"),
        ("command", (-0.5, 0.0, 0.0)),
        ("command", (0.0, 0.5, 0.0)),
        ("command", (1e9, 0.0, 0.0)),
        ("command", (0.5, 0.0)),
        ("label_seconds", -1.0),
        ("label_seconds", float("nan")),
        ("quantiles", {"0.5": float("inf")}),
        ("quantiles", {"0.5": -1.0}),
        ("quantiles", {"0.5": 2.0, "0.9": 1.0}),
        ("quantiles", {"1.0": 2.0}),
        ("quantiles", {"nan": 2.0}),
        ("quantiles", {"half": 2.0}),
        ("provenance", {"terrain": "a\x1b[2J"}),
        ("provenance", {"terrain": ["steps"]}),
        ("provenance", {"samples": "many"}),
        ("provenance", {"samples": -1}),
    ],
)
def test_what_a_specialist_says_of_itself_is_checked(make_specialist, field, value):
    with pytest.raises(SpecialistError, match=f"^{field}"):
        make_specialist(**{field: value}) if field != "name" else make_specialist(value)


def test_provenance_must_be_plain(make_specialist, tmp_path):
    with pytest.raises(SpecialistError, match="plain"):
        save_specialist(make_specialist(provenance={"when": object()}), tmp_path / "steps")
    assert not list(tmp_path.iterdir())


def test_the_zoo_is_sorted_named_by_folder_and_skips_what_is_no_specialist(
    make_specialist, tmp_path
):
    for name in ("steps", "general", "gaps"):
        save_specialist(make_specialist(name), tmp_path / name)
    shutil.copytree(tmp_path / "gaps", tmp_path / "another")
    shutil.copytree(tmp_path / "gaps", tmp_path / ".half-written")
    (tmp_path / "README.txt").write_text("about")
    zoo = load_zoo("toy", tmp_path)
    assert list(zoo) == ["another", "gaps", "steps"]
    assert all(name == specialist.name for name, specialist in zoo.items())
    assert list(load_zoo("toy", tmp_path, include_general=True)) == [
        "another",
        "gaps",
        "general",
        "steps",
    ]


def test_a_zoo_that_cannot_be_used_says_why(make_specialist, tmp_path):
    with pytest.raises(SpecialistError, match="no zoo for robot 'cat'"):
        load_zoo("cat")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SpecialistError, match="holds no specialist"):
        load_zoo("toy", tmp_path / "empty")
    save_specialist(make_specialist(robot="a1"), tmp_path / "mixed" / "steps")
    with pytest.raises(SpecialistError, match="drives 'a1'"):
        load_zoo("toy", tmp_path / "mixed")
    with pytest.raises(FgtutorError, match="no specialist folder"):
        load_specialist(tmp_path / "nowhere")


class ScaledPolicy(MLPModel):
    """A policy class of a user's own, with an argument of its own."""

    def __init__(self, *args, scale: float = 1.0, **kwargs):
        super().__init__(*args, **kwargs)
        self.options = {"scale": scale}

    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        return self.options["scale"] * super().forward(obs, masks, hidden_state, stochastic_output)


def test_a_registered_policy_class_comes_back_with_its_options(
    make_specialist, tmp_path, monkeypatch
):
    monkeypatch.setattr("fgtutor.policies.description.POLICIES", dict(POLICIES))
    groups = TensorDict({"policy": torch.zeros(1, 6), "patch": torch.zeros(1, 30)}, [1])
    policy = ScaledPolicy(groups, {"actor": ["policy", "patch"]}, "actor", 3, [8], scale=2.5)
    specialist = make_specialist(policy=policy)
    with pytest.raises(SpecialistError, match="register_policy"):
        save_specialist(specialist, tmp_path / "steps")
    register_policy("scaled", ScaledPolicy)
    register_policy("scaled", ScaledPolicy)
    loaded = load_specialist(save_specialist(specialist, tmp_path / "steps"))
    assert type(loaded.policy) is ScaledPolicy
    assert PolicyConfig.of(loaded.policy) == PolicyConfig.of(policy)
    assert torch.equal(specialist.act(observations()), loaded.act(observations()))
    with pytest.raises(SpecialistError, match="choose another name"):
        register_policy("scaled", MLPModel)


def test_a_distribution_that_has_no_name_is_refused(make_specialist):
    groups = TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1])
    noise = {"class_name": HeteroscedasticGaussianDistribution}
    policy = MLPModel(groups, {"actor": ["policy"]}, "actor", 3, [8], distribution_cfg=noise)
    with pytest.raises(SpecialistError, match="HeteroscedasticGaussian"):
        PolicyConfig.of(policy)


# What a hostile folder may try -------------------------------------------------------------------


def leaves(value, path=()):
    """Give the path of every value in a description, and of every group of them."""
    if path:
        yield path
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in items:
            yield from leaves(part, (*path, key))


LEAVES = [
    *(("policy", k) for k in ("kind", "groups", "obs_dim", "num_actions", "hidden_dims")),
    *(("policy", k) for k in ("activation", "obs_normalization", "distribution", "options")),
    *(
        ("policy", "groups", 0),
        ("policy", "hidden_dims", 0),
        ("policy", "distribution", "std_type"),
    ),
    *(("policy", "distribution", "std_range"), ("policy", "distribution", "std_range", 1)),
    *(("feasibility", k) for k in ("num_points", "command_dim", "hidden", "vae_hidden")),
    *(("feasibility", k) for k in ("latent", "height_scale", "saturation")),
    ("feasibility", "hidden", 1),
    ("strangeness", "0.9"),
    *(("grid", k) for k in ("ahead", "behind", "half_width", "spacing", "footprint")),
    *(("grid", "footprint", 0), ("command", 0), ("command", 2), ("quantiles", "0.9")),
    *((k,) for k in ("schema", "name", "robot", "policy", "feasibility", "grid", "command")),
    *((k,) for k in ("label_seconds", "quantiles", "strangeness", "provenance", "files")),
    *(("files", "policy.safetensors"), ("files", "policy.safetensors", "bytes")),
    *(("files", "policy.safetensors", "sha256"), ("provenance", "terrain")),
    ("provenance", "samples"),
]
VALUES = [None, -1, 0, 2**31, 1e308, "x", "os:system", [], {}, [[]], 10**400, True, 0.5, [128]]


def test_every_value_of_a_description_is_tried(make_specialist, tmp_path):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    everything = set(leaves(json.loads((folder / "specialist.json").read_text())))
    kinds = {tuple(0 if isinstance(key, int) else key for key in path) for path in everything}
    tried = {tuple(0 if isinstance(key, int) else key for key in path) for path in LEAVES}
    free = {("checksum",), ("provenance", "seed")}
    alike = {("files", "feasibility.safetensors", *path[2:]) for path in tried if len(path) > 1}
    levels = ("quantiles", "strangeness")
    missing = {path for path in kinds - tried - free - alike if path[0] not in levels}
    assert missing == {("feasibility", "vae_hidden", 0)}  # as ("feasibility", "hidden", 0)


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: ".".join(map(str, path)))
def test_a_value_of_another_kind_is_refused_or_means_the_same(make_specialist, tmp_path, path):
    specialist = make_specialist()
    folder = save_specialist(specialist, tmp_path / "steps")
    original = (folder / "specialist.json").read_text()
    for value in [*VALUES, "missing"]:
        description = json.loads(original)
        *way, last = path
        parent = description
        for key in way:
            parent = parent[key]
        before = parent[last]
        if value == "missing":
            del parent[last]
        else:
            parent[last] = value
        description["checksum"] = _checksum(description)
        (folder / "specialist.json").write_text(json.dumps(description))
        try:
            loaded = load_specialist(folder)
        except SpecialistError as error:
            assert str(folder) in str(error) and len(str(error)) < 1000
            continue
        # What loads can be used, and says what was written.
        (group,) = loaded.policy.obs_groups
        seen = TensorDict({group: torch.ones(1, 6)}, batch_size=[1])
        assert repr(loaded) and torch.isfinite(loaded.act(seen)).all()
        patch, command = torch.zeros(1, loaded.grid.num_points), torch.tensor([loaded.command])
        assert torch.isfinite(loaded.feasibility.feasibility(patch, command)).all()
        free = ("label_seconds", "quantiles", "strangeness", "provenance", "name", "robot", "grid")
        scales = ("height_scale", "saturation", "groups", 0, 1)
        assert value == before or path[0] in (*free, "command") or path[-1] in scales


def hostile(description, marker) -> None:
    """Ask for a function of Python by its name, as rsl_rl would resolve it, with a command."""
    description["policy"]["distribution"] = {"class_name": "os:system"}
    description["policy"]["num_actions"] = f"touch {marker}"


WAYS = {
    "plan": "plan --map {map} --zoo {zoo} --start 1 4 --goal 11 4",
    "matrix": "evaluate matrix --zoo {zoo} --trials 1 --workers 1 --terrains flat",
    "newcomer": "evaluate newcomer --newcomer {bad} --trials 1 --workers 1",
    "export": "export {bad} --out {out}/policy.onnx",
    "train": "train --robot toy --terrain steps --from {bad} --out {out}/run --iterations 1",
    "demo": "demo --robot toy --zoo {zoo} --out {out}/demo",
    "doctor": "doctor --zoo {zoos}",
}


@pytest.fixture
def trap(make_rolling, tmp_path):
    """A zoo of which one folder asks for a command to be run, and the file that it would make."""
    folder = save_specialist(make_rolling(), tmp_path / "zoos" / "toy" / "steps")
    return folder, tmp_path / "PWNED"


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_no_way_of_loading_a_folder_runs_what_it_names(trap, tmp_path, capsys, way):
    folder, marker = trap
    rewrite(folder, lambda description: hostile(description, marker))
    toy_map = Path(load_specialist.__globals__["ZOO"]) / "maps" / "toy_mixed.npz"
    places = {"zoo": folder.parent, "zoos": folder.parent.parent, "bad": folder, "out": tmp_path}
    code = main(WAYS[way].format(map=toy_map, **places).split())
    said = " ".join("".join(capsys.readouterr()).split())
    assert code != 0 and not marker.exists()
    assert "specialist.json: policy.num_actions: should be a valid integer" in said


@pytest.mark.parametrize(
    "change",
    [
        lambda p, run: p.update(distribution={"class_name": run}),
        lambda p, run: p["distribution"].update({"class_name": run}),
        lambda p, run: p.update(options={"distribution_cfg": {"class_name": run}}),
        lambda p, run: p.update(options={"class_name": run}),
        lambda p, run: p.update(class_name=run),
        lambda p, run: p.update(kind=run),
        lambda p, run: p.update(activation=run),
        lambda p, run: p.update(activation="ELU"),
        lambda p, run: p.update(activation="identity"),
        lambda p, run: p["distribution"].update(std_type=run),
        lambda p, run: p["distribution"].update(init_std=1.0),
        lambda p, run: p["distribution"].update(std_range=[2.0, 1.0]),
        lambda p, run: p.update(groups=["policy", "policy"]),
        lambda p, run: p.update(kind="symmetric", options={"mirror": {"class_name": run}}),
        lambda p, run: p.update(kind="dreamwaq", options={"history": run}),
        lambda p, run: p.update(
            kind="dreamwaq", options={"history": 0, "latent": 4, "context_hidden": [4]}
        ),
        lambda p, run: p.update(
            kind="dreamwaq", options={"history": 1, "latent": 4, "context_hidden": []}
        ),
    ],
)
@pytest.mark.parametrize(
    "run", ["os:system", "builtins.exec", "fgtutor.specialist:save_specialist"]
)
def test_a_file_chooses_among_our_names_only(make_specialist, tmp_path, change, run):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    rewrite(folder, lambda description: change(description["policy"], run))
    with pytest.raises(SpecialistError, match=r"specialist\.json: "):
        load_specialist(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["policy"].update(obs_dim=2**31),
        lambda d: d["policy"].update(obs_dim=100_000),
        lambda d: d["policy"].update(hidden_dims=[30_000, 30_000]),
        lambda d: d["policy"].update(hidden_dims=[100_000] * 16),
        lambda d: d["policy"].update(hidden_dims=[8] * 100_000),
        lambda d: d["policy"].update(num_actions=100_000, hidden_dims=[100_000]),
        lambda d: d["policy"].update(groups=[f"group {i}" for i in range(100_000)]),
        lambda d: d["policy"].update(kind="symmetric", obs_dim=100_000),
        lambda d: d["policy"].update(
            kind="dreamwaq",
            obs_dim=100_000,
            options={"history": 1, "latent": 100_000, "context_hidden": [100_000, 100_000]},
        ),
        lambda d: d["feasibility"].update(hidden=[30_000, 30_000]),
        lambda d: d["feasibility"].update(vae_hidden=[100_000, 100_000]),
        lambda d: d["feasibility"].update(num_points=100_000, latent=100_000),
        lambda d: d["grid"].update(spacing=1e-9),
        lambda d: d["grid"].update(spacing=1e-3, ahead=100.0, behind=100.0),
        lambda d: d["files"]["policy.safetensors"].update(bytes=10**9),
    ],
)
def test_a_claim_larger_than_the_file_takes_no_memory(make_specialist, tmp_path, change):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    with (folder / "policy.safetensors").open("r+b") as file:
        file.truncate(10**9)  # a file of a gigabyte that takes no space either
    rewrite(folder, change)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SpecialistError, match="steps"):
        load_specialist(folder)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kilobytes


@pytest.mark.parametrize(
    "header",
    [
        {"w": {"dtype": "F32", "shape": [2**40, 2**40], "data_offsets": [0, 8]}},
        {"w": {"dtype": "F32", "shape": [0, 2**62], "data_offsets": [0, 0]}},
        {"w": {"dtype": "F32", "shape": [10**30], "data_offsets": [0, 8]}},
        {"w": {"dtype": "X1", "shape": [2], "data_offsets": [0, 8]}},
        {"w": {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]}},
        {"w": {"dtype": "C64", "shape": [1], "data_offsets": [0, 8]}},
        {"__metadata__": {"class_name": "os:system"}},
        {"w": {"dtype": "\x1b[2J" + "x" * 5000, "shape": [2], "data_offsets": [0, 8]}},
        {},
        [],
    ],
)
@pytest.mark.parametrize("file", FILES[:2])
def test_an_absurd_list_of_tensors_is_refused(make_specialist, tmp_path, file, header):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    text = json.dumps(header).encode()
    for length in (len(text), 2**63, 0):
        payload = length.to_bytes(8, "little") + text + bytes(8)
        (folder / file).write_bytes(payload)
        entry = {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
        rewrite(folder, lambda d, entry=entry: d["files"].update({file: entry}))
        with pytest.raises(SpecialistError, match=file) as caught:
            load_specialist(folder)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 700


def test_a_pipe_or_a_device_is_no_file(make_specialist, tmp_path):
    for name in FILES:
        for place in ("pipe", "device"):
            folder = save_specialist(make_specialist(), tmp_path / f"{name} {place}")
            (folder / name).unlink()
            os.mkfifo(folder / name) if place == "pipe" else (folder / name).symlink_to("/dev/zero")
            with pytest.raises(SpecialistError, match=f"there is no file .*{name}"):
                load_specialist(folder)


def test_a_mirror_that_is_none_is_refused(make_specialist, tmp_path):
    groups = TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1])
    policy = SymmetricMLPModel(groups, {"actor": ["policy"]}, "actor", 3, [8])
    folder = save_specialist(make_specialist(policy=policy), tmp_path / "steps")
    assert torch.isfinite(load_specialist(folder).act(observations())).all()
    good = safetensors.torch.load((folder / FILES[0]).read_bytes())
    for name, value in [("observation_index", 99), ("action_index", -1), ("action_sign", 0.5)]:
        tensors = {k: v.clone() for k, v in good.items()}
        tensors[f"mlp.{name}"][1] = value
        replace_tensors(folder, FILES[0], tensors)
        with pytest.raises(SpecialistError, match=r"the mirrored .* must be the"):
            load_specialist(folder)


def test_a_blind_policy_comes_back_with_its_options(make_specialist, tmp_path):
    groups = TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1])
    policy = DreamWaQModel(
        groups, {"actor": ["policy"]}, "actor", 3, [8], history=2, latent=4, context_hidden=(6,)
    )
    loaded = load_specialist(save_specialist(make_specialist(policy=policy), tmp_path / "steps"))
    assert loaded.history == 2 and PolicyConfig.of(loaded.policy) == PolicyConfig.of(policy)


def test_a_weight_that_must_overflow_is_refused(make_specialist, tmp_path):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    tensors = safetensors.torch.load((folder / FILES[0]).read_bytes())
    tensors["mlp.0.weight"][0, 0] = 1e30
    replace_tensors(folder, FILES[0], tensors)
    with pytest.raises(SpecialistError, match="beyond 1e"):
        load_specialist(folder)


def test_what_is_written_by_hand_is_checked_as_what_is_read():
    fields = {
        "kind": "mlp", "groups": ("policy",), "obs_dim": 6, "num_actions": 3, "hidden_dims": (8,),
        "activation": "elu", "obs_normalization": False, "options": {},
        "distribution": Noise(std_type="log", std_range=(0.1, 2.0)),
    }  # fmt: skip
    assert PolicyConfig(**fields).build().obs_dim == 6
    for wrong in ({"obs_dim": 0}, {"hidden_dims": ()}, {"activation": "os:system"}):
        with pytest.raises(SpecialistError, match=next(iter(wrong))):
            PolicyConfig(**fields | wrong)


@pytest.mark.parametrize("name", ["a|b", "a\x1b[2J", "M\udcff", "a\nb", "x" * 101, "a<b>"])
def test_a_zoo_names_a_folder_that_a_table_could_not_show(make_specialist, tmp_path, name):
    save_specialist(make_specialist(), tmp_path / "zoo" / name)
    with pytest.raises(SpecialistError, match="rename it") as caught:
        load_zoo("toy", tmp_path / "zoo")
    assert "\x1b" not in str(caught.value) and str(caught.value).encode()


def test_a_name_in_a_file_does_not_leave_the_zoo(make_specialist, tmp_path):
    folder = save_specialist(make_specialist(), tmp_path / "steps")
    rewrite(folder, lambda description: description.update(name="../../outside"))
    with pytest.raises(SpecialistError, match="name: a name is"):
        load_specialist(folder)


def test_a_link_goes_on_showing_where_it_did(make_specialist, tmp_path):
    save_specialist(make_specialist(seed=0), tmp_path / "elsewhere" / "v1")
    (tmp_path / "steps").symlink_to(tmp_path / "elsewhere" / "v1")
    save_specialist(second := make_specialist(seed=1), tmp_path / "steps")
    assert (tmp_path / "steps").is_symlink()
    assert same(load_specialist(tmp_path / "elsewhere" / "v1"), second)
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_dir()) == ["elsewhere", "steps", "v1"]
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(StorageError, match="loop"):
        save_specialist(second, tmp_path / "loop")


KILLED = """
import os, signal, sys
from fgtutor.io.storage import beside
from pathlib import Path
for suffix in (".new", ".old"):
    beside(Path(sys.argv[1]), suffix).mkdir()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_next_save_clears_what_a_killed_one_left(make_specialist, tmp_path):
    for name in ("steps", "gaps"):
        subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / name)], check=False)
    left = [path for path in tmp_path.iterdir() if path.name.endswith((".new", ".old"))]
    assert len(left) == 4
    alive = beside(tmp_path / "steps", ".new")  # another thread may be writing it
    alive.mkdir()
    save_specialist(make_specialist(), tmp_path / "steps")
    kept = [path.name for path in tmp_path.iterdir()]
    others = [path.name for path in left if path.exists()]
    assert sorted(kept) == sorted([*others, alive.name, "steps"]) and len(others) == 2


def test_the_shipped_zoo_is_described_by_its_own_words():
    for path in sorted(Path(load_zoo.__globals__["ZOO"]).rglob("specialist.json")):
        text = json.loads(path.read_text())
        specialist = load_specialist(path.parent)
        config = dataclasses.asdict(PolicyConfig.of(specialist.policy))
        assert json.loads(json.dumps(config)) == text["policy"]
        assert json.loads(json.dumps(dataclasses.asdict(specialist.grid))) == text["grid"]
        for name, module in zip(FILES, (specialist.policy, specialist.feasibility), strict=False):
            assert safetensors.torch.save(dict(module.state_dict())) == (
                path.with_name(name).read_bytes()
            )
