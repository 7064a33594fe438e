"""Driving by hand: commands are obeyed, falls end it, a reset is a new start, robots are drawn."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from fgtutor.course.widgets.driving import Drive
from fgtutor.errors import ConfigError
from fgtutor.figures import style
from fgtutor.world.terrain import make_terrain


def test_a_drive_moves_at_command_and_starts_anew(make_rolling):
    terrain = make_terrain("flat", robot="toy")
    drive = Drive(terrain, {"steps": make_rolling("steps"), "gaps": make_rolling("gaps")})
    assert drive.speed == 0.85
    drive.speed = 0.6
    drive.advance(2.0)
    drive.policy = "gaps"
    drive.advance(1.0)
    episode = drive.episode
    assert len(episode.poses) == 76  # the start, and 3 s at 25 Hz
    np.testing.assert_allclose(episode.poses[0, :2], terrain.start, atol=1e-3)
    assert episode.poses[-1, 0] - episode.poses[25, 0] == pytest.approx(0.6 * 2, rel=0.1)
    assert episode.policies.tolist() == [0] * 51 + [1] * 25
    assert not drive.fallen and "3.0 s, gaps at x" in drive.status
    first = episode.poses
    drive.reset()
    assert len(drive.episode.poses) == 1
    drive.policy = "steps"
    drive.advance(2.0)
    np.testing.assert_allclose(drive.episode.poses, first[:51], atol=1e-6)


def test_a_command_to_turn_turns(make_rolling):
    drive = Drive(make_terrain("flat", robot="toy"), {"steps": make_rolling()}, yaw=0.5)
    drive.speed, drive.turn = 0.3, 0.8
    drive.advance(1.0)
    assert drive.episode.poses[-1, 3] == pytest.approx(0.5 + 0.8, abs=0.05)


def test_a_fall_ends_the_drive(make_rolling):
    """A toy that cannot lift its axles drops into a gap."""
    drive = Drive(make_terrain("gaps", robot="toy", difficulty=1.0, seed=0),
                  {"gaps": make_rolling("gaps")})  # fmt: skip
    for _ in range(40):
        drive.advance(0.5)
    assert drive.fallen
    steps = len(drive.episode.poses)
    drive.advance(1.0)
    assert len(drive.episode.poses) == steps and drive.episode.reason == "fell"
    assert "fallen: press reset" in drive.status


def test_a_toy_draws_itself_and_others_are_drawn(make_rolling, make_specialist):
    terrain, zoo = make_terrain("flat", robot="toy"), {"steps": make_rolling()}
    frame = Drive(terrain, zoo).frame()
    assert frame.shape == (272, 720, 3)
    blue = np.array(to_rgb(style.POLICY_COLOURS["steps"])) * 255
    assert (np.abs(frame - blue).max(axis=-1) < 3).sum() > 1000
    drive = Drive(terrain, zoo, render=lambda env: np.full((4, 6, 3), env.num_envs, np.uint8))
    assert drive.frame().tolist() == np.ones((4, 6, 3)).tolist()
    with pytest.raises(ConfigError, match="robot 'a1' needs render"):
        Drive(terrain, {"steps": make_specialist(robot="a1")})
    with pytest.raises(ConfigError, match="one robot's policies"):
        Drive(terrain, {})


def test_a_drive_begins_with_the_policy_of_its_ground_in_its_colour(make_rolling):
    class View:
        coat = (0.0, 0.0, 0.0)

        def __call__(self, env):
            return np.full((4, 6, 3), np.round(255 * np.array(self.coat)), np.uint8)

    zoo = {name: make_rolling(name) for name in ("bridge", "steps")}
    drive = Drive(make_terrain("steps", robot="toy"), zoo, render=View())
    assert drive.policy == "steps"
    for name in ("steps", "bridge"):
        drive.policy = name
        colour = 255 * np.array(to_rgb(style.POLICY_COLOURS[name]))
        np.testing.assert_allclose(drive.frame()[0, 0], colour, atol=1)
    assert Drive(make_terrain("flat", robot="toy"), zoo).policy == "bridge"  # the first of them


def test_a_drive_refuses_commands_without_meaning(make_rolling):
    drive = Drive(make_terrain("flat", robot="toy"), {"steps": make_rolling()})
    drive.speed = float("nan")
    with pytest.raises(ConfigError, match="command must be finite"):
        drive.advance(0.1)
    drive.speed, drive.policy = 0.5, "skates"
    with pytest.raises(ConfigError, match="no policy 'skates'; there are steps"):
        drive.advance(0.1)
