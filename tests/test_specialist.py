"""Specialist folders: round trips, every kind of damage, interrupted saves, the zoo."""

import dataclasses
import errno
import hashlib
import json
import os
import resource
import shutil

import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import HeteroscedasticGaussianDistribution
from tensordict import TensorDict

from fgtutor.errors import FgtutorError, SpecialistError, StorageError
from fgtutor.patches import PatchGrid
from fgtutor.policies import POLICIES, PolicyConfig, register_policy
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


@pytest.mark.parametrize("call", range(5))
def test_a_save_that_fails_leaves_the_earlier_folder(make_specialist, tmp_path, monkeypatch, call):
    # Five renames make a second save: three files, the old folder aside, the new one in its place.
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
    with pytest.raises(SpecialistError, match="three finite numbers"):
        make_specialist(command=(float("nan"), 0.0, 0.0))
    with pytest.raises(SpecialistError, match="quantiles"):
        make_specialist(quantiles={"0.5": float("inf")})


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
    monkeypatch.setattr("fgtutor.policies.POLICIES", dict(POLICIES))
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
