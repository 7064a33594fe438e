"""The site's A1 page: specialists and robot in JavaScript against Python's, and in a browser.

Node runs the tests of `tests/web/` on numbers that are recorded here. The browser has no network
but this machine.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import importlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from browser import run_node, serving
from tensordict import TensorDict

from fgtutor.elevation import ElevationMap
from fgtutor.execution import FollowConfig, _Drive, _Track
from fgtutor.patches import prepare, sample_patches
from fgtutor.robots import condition_of
from fgtutor.robots.a1.env import A1Env
from fgtutor.robots.a1.model import A1Config, build_spec
from fgtutor.specialist import ZOO, Specialist, load_specialist, load_zoo
from fgtutor.world.terrain import World

WEB = Path(__file__).parents[1] / "web"
SPECIALISTS = (
    "toy/steps",
    "toy/general",
    "a1/steps",
    "a1/bridge",
    "a1/general",
    "a1/_checkpoints/late",
)
"""One of each kind: with and without mirror, saturation, other sizes, estimating."""
GROUNDS = int(os.getenv("FGTUTOR_SITE_GROUNDS", "10"))
"""How many grounds are planned and walked; the site has 20."""
WINDOW = "900,900"
"""Width and height of the browser."""
LIMIT = 5_000_000
"""Bytes that the page may load before the first walk."""


@pytest.fixture(scope="module")
def exporter() -> ModuleType:
    """Return web/a1/export.py, which is no part of the package."""
    if not (WEB / "node_modules").is_dir():
        pytest.skip("the site's npm packages are missing: run `npm install` in web/")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(WEB))
        return importlib.import_module("a1.export")


@pytest.fixture(scope="module")
def site(exporter, tmp_path_factory) -> Path:
    """Lay out the page as it is served."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(WEB / "js", folder / "js")
    only = shutil.ignore_patterns("*.py", "__pycache__")
    shutil.copytree(WEB / "a1", folder / "a1", ignore=only)
    for style in WEB.glob("*.css"):
        shutil.copyfile(style, folder / style.name)
    exporter.export(folder / "a1", GROUNDS)
    return folder


# Networks and patches ---------------------------------------------------------------------------


def record_specialist(specialist: Specialist, rng: np.random.Generator) -> dict[str, Any]:
    """Return what a specialist answers to observations and patches drawn at random."""
    policy, net = specialist.policy, specialist.feasibility

    def draw(*shape: int) -> torch.Tensor:
        return torch.tensor(rng.standard_normal(shape), dtype=torch.float32)

    seen = getattr(policy, "seen", 0) or policy.obs_dim
    first = policy.obs_dim - seen
    groups = [draw(5, first)] * (first > 0) + [draw(5, seen)]
    observations = TensorDict(dict(zip(policy.obs_groups, groups, strict=True)), batch_size=[5])
    # More rows than go through the layers together, and an odd number of them.
    patches = 0.2 * draw(67, net.num_points)
    command = torch.tensor(specialist.command).expand(len(patches), -1)
    with torch.no_grad():
        loss, strangeness = net.losses(net.relief(patches))
        return {
            "observations": torch.cat(groups, dim=-1).tolist(),
            "actions": specialist.act(observations).tolist(),
            "patches": patches.tolist(),
            "feasibility": net.feasibility(patches, command).tolist(),
            "reconstruction": loss.tolist(),
            "strangeness": strangeness.tolist(),
        }


def record_patches(rng: np.random.Generator) -> dict[str, Any]:
    """Return patches of a small map at poses on it, on its border and off it."""
    ground = prepare(ElevationMap(rng.uniform(0, 0.3, (30, 20)).cumsum(axis=0) / 5, 0.05, (-1, 2)))
    poses = rng.uniform((-1.5, 1.5, -math.pi), (1.0, 3.5, math.pi), (40, 3)).astype(np.float32)
    grid = A1Env.grid
    patches = sample_patches(
        torch.tensor(ground.heights), torch.tensor(poses), grid,
        resolution=ground.resolution, origin=ground.origin,
    )  # fmt: skip
    size = {"nx": 30, "ny": 20, "resolution": ground.resolution, "origin": list(ground.origin)}
    fields = ("ahead", "behind", "half_width", "spacing", "footprint")
    return {
        "map": size | {"heights": np.asarray(ground.heights).ravel().tolist()},
        "grid": {name: getattr(grid, name) for name in fields},
        "poses": poses.tolist(),
        "patches": patches.tolist(),
    }


def test_networks_and_patches_agree(node, tmp_path, capsys):
    rng = np.random.default_rng(0)
    folders = [ZOO / name for name in SPECIALISTS]
    recorded = {
        "specialists": {
            folder.as_uri(): record_specialist(load_specialist(folder), rng) for folder in folders
        },
        "ground": record_patches(rng),
    }
    (tmp_path / "nets.json").write_text(json.dumps(recorded))
    run_node(node, "nets.mjs", capsys, RECORDED=tmp_path / "nets.json")


# The robot --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_ground_without_a_route_is_not_offered(exporter, monkeypatch):
    zoo, make_ground = load_zoo("a1", include_general=True), exporter.make_ground
    # Without the gaps specialist the first ground, which has gaps, has no route.
    short_handed = {name: zoo[name] for name in zoo if name != "gaps"}
    first, flat = make_ground(exporter.CONFIG, "mixed", 0), make_ground(exporter.CONFIG, "flat", 1)
    monkeypatch.setattr(exporter, "make_ground", lambda *_: [first, flat][_[-1]])
    (plan,) = exporter.plan_grounds(short_handed, 1)
    assert plan.ground is flat and plan.answer


def record_episode(exporter: ModuleType) -> list[dict[str, Any]]:
    """Drive the first ground in Python; return the state, what is seen and done, at each step."""
    zoo = load_zoo("a1", include_general=True)
    (plan,) = exporter.plan_grounds(zoo, 1)
    route, names = plan.answer.raise_for(), tuple(zoo)
    frames = max(specialist.history for specialist in zoo.values())
    config = replace(A1Env.episodes, train=False, stuck_seconds=math.inf, history=frames)
    options = condition_of("a1", "undisturbed").options
    env = A1Env(World([[plan.ground.terrain]]), 1, config=config, **options)
    places = {i: names.index(name) for i, name in enumerate(route.names)}
    track = _Track(route, places)
    follow = FollowConfig(hold_steps=exporter.CONFIG.planning.hold_steps)
    drive = _Drive(env, torch.tensor([0]), [track], [*zoo.values()], plan.ground.seeds, follow)
    steps: list[dict[str, Any]] = []
    act, fallen = drive._act, env.fallen

    def watched_act() -> torch.Tensor:
        seen = env.get_observations()
        state = {
            "qpos": env.physics.qpos[0].tolist(),
            "qvel": env.physics.qvel[0].tolist(),
            "lastAction": env.last_action[0].tolist(),
            "clock": float(env.clock[0]),
            "command": env.command[0].tolist(),
            "observation": seen["policy"][0].tolist(),
            "history": seen["history"][0].tolist() if frames else [],
            "policy": names[drive.active[0]],
        }
        action = act()
        steps.append(state | {"action": action[0].tolist()})
        return action

    def watched_fallen() -> torch.Tensor:
        fell = fallen()
        steps[-1]["fell"] = bool(fell[0])
        return fell

    drive._act, env.fallen = watched_act, watched_fallen
    (episode,) = drive.run(record_body=False, progress=False)
    assert episode.success
    return steps


@pytest.mark.slow
def test_the_robot_walks_as_in_python(node, site, exporter, tmp_path, capsys):
    (tmp_path / "episode.json").write_text(json.dumps(record_episode(exporter)))
    run_node(node, "a1.mjs", capsys, SITE=site, RECORDED=tmp_path / "episode.json")


def test_the_model_keeps_what_version_4_says_in_a_word(exporter):
    written = mujoco.MjModel.from_xml_string(exporter.robot_xml(A1Config()))
    own = build_spec(config=A1Config()).compile()
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_armature",
                 "dof_damping", "jnt_range", "body_mass", "body_ipos"):  # fmt: skip
        np.testing.assert_allclose(getattr(written, name), getattr(own, name), rtol=1e-5, atol=1e-6)
    assert written.nsensor == 5
    assert "input" not in exporter.robot_xml(A1Config())


def test_packages_that_npm_has_not_installed_are_named(exporter, tmp_path, monkeypatch):
    monkeypatch.setattr(exporter, "PACKAGES", tmp_path)
    with pytest.raises(FileNotFoundError, match="npm install"):
        exporter.copy_packages(tmp_path / "vendor")


# The page ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(site) -> Iterator[tuple[str, dict[str, int]]]:
    """Serve the site under a prefix; give the page's address, and what was sent."""
    with serving(site.parent) as (address, sent):
        yield f"{address}{site.name}/a1/", sent


STATUS = "document.querySelector('#status')?.textContent"


@pytest.mark.slow
def test_the_page_walks_to_the_goal_by_keyboard(page, served, capsys):
    address, sent = served
    page.call("Page.navigate", url=f"{address}?pace=40")
    page.wait(f"{STATUS}?.startsWith('Ready')", "the page to load")
    loaded = dict(sent)
    page.evaluate("document.querySelector('#start').focus()")
    page.press(" ", 32)
    page.wait(f"{STATUS}.startsWith('It walks')", "the key to start the walk")
    page.evaluate("document.querySelector('#view').focus()")
    page.press("ArrowLeft", 37)
    end_words = page.wait(f"{STATUS}.match(/It reached|It fell|It came/) && {STATUS}", "the end")
    assert end_words.startswith("It reached the goal after"), end_words
    assert page.evaluate("Number(document.querySelector('#walked').textContent)") > 15
    assert page.errors == []
    with capsys.disabled():
        print()
        for path, size in sorted(loaded.items()):
            print(f"    {size:>9,} bytes {path.split('/', 2)[2]}")
        print(f"    {sum(loaded.values()):>9,} bytes until the first walk")
    assert sum(loaded.values()) < LIMIT


@pytest.mark.slow
def test_one_policy_alone_falls_and_a_shove_is_felt(page, served):
    address, _ = served
    page.call("Page.navigate", url=f"{address}?who=gaps&pace=20&start&ground=2")
    page.wait(f"{STATUS}?.match(/It fell|It came no further/)", "gaps to fail on other obstacles")
    assert page.evaluate("document.querySelector('#policy').textContent") == "gaps"
    assert page.evaluate("document.querySelector('#start').textContent") == "Walk again"
    # Reset, choose the strongest shove by keyboard, and feel it at rest.
    page.evaluate("document.querySelector('#reset').click()")
    page.wait(f"{STATUS}.startsWith('Ready')", "the reset")
    page.evaluate("document.querySelector('#strength').focus()")
    page.press("End", 35)
    words = page.evaluate("document.querySelector('#strength-words').textContent")
    assert words == "20 N s: the robot weighs 13.7 kg, its speed changes by 1.46 m/s"
    page.evaluate("document.querySelector('#shove').click()")
    shown = page.wait("Number(document.querySelector('#speed').textContent)", "the speed to show")
    assert shown == pytest.approx(1.46, abs=0.01)
    assert page.errors == []
