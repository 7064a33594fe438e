"""A third robot is one file and one entry: `puck.py` and the line below do for everything."""

import inspect

import numpy as np
import pytest
import test_robots

from fgtutor import execute, fuse, make_terrain, plan, tensorize, train
from fgtutor.cli.export import describe
from fgtutor.errors import ConfigError
from fgtutor.evaluation.switching import SwitchingConfig, courses
from fgtutor.figures.videos import film_of
from fgtutor.learning.config import TrainConfig, config_of, make_training_env
from fgtutor.robots import ROBOTS, Robot
from fgtutor.world.obstacles import TerrainScale

PUCK = Robot(env="puck:PuckEnv", scale=TerrainScale(resolution=0.1, mixed=("steps", "gaps")))
CONTRACT = [
    test
    for name, test in vars(test_robots).items()
    if name.startswith("test_") and list(inspect.signature(test).parameters) == ["robot"]
]


@pytest.fixture(autouse=True)
def puck(monkeypatch):
    monkeypatch.setitem(ROBOTS, "puck", PUCK)


@pytest.mark.parametrize("contract", CONTRACT, ids=lambda test: test.__name__)
def test_it_keeps_the_contract_of_all_robots(contract):
    contract("puck")


def test_it_has_no_wide_disturbances_and_says_so(tmp_path):
    config = TrainConfig(robot="puck", terrain="steps", out=tmp_path, disturbances="wide")
    with pytest.raises(ConfigError, match="puck knows no wide disturbances: leave them usual"):
        make_training_env(config)


@pytest.mark.slow
def test_it_is_trained_assessed_planned_for_and_driven(tmp_path):
    assert config_of(["--robot", "puck"]) is TrainConfig
    config = TrainConfig(
        robot="puck", terrain="steps", out=tmp_path, iterations=4, num_envs=32, steps=20, rows=2,
        columns=2, hidden=(16,),
    )  # fmt: skip
    steps = train(config)
    assert steps.robot == "puck" and describe(steps)["observation"]["size"] == steps.policy.obs_dim

    # Four iterations teach it no steps, so it is flat ground that it is planned for.
    terrain = make_terrain("flat", robot="puck", seed=1)
    fused = fuse([tensorize(terrain.elevation, steps, taus=(1e6, 2e6))])
    route = plan(
        *fused,
        grid=terrain.elevation,
        start=terrain.start,
        goal=terrain.goal,
        names=["steps"],
        f_min=0.01,
    ).raise_for()
    assert route.length == pytest.approx(terrain.goal[0] - terrain.start[0], abs=0.2)
    episode = execute(route, terrain, {"steps": steps})
    assert (episode.reason, episode.robot) == ("reached", "puck")
    assert episode.body is not None and episode.body.shape == (len(episode.poses), 4)
    with pytest.raises(ConfigError, match="puck has no film: name one in its entry"):
        film_of(episode, terrain, route)


def test_its_obstacles_can_be_laid_and_evaluated():
    assert list(courses(SwitchingConfig(robot="puck"))) == ["steps-gaps", "full"]
    for kind in (*PUCK.scale.mixed, "mixed"):
        heights = make_terrain(kind, robot="puck", seed=1).elevation.heights
        assert np.abs(heights).max() > 0.05
