"""The robot crosses the corridor by the learner's follower: a drive over a route, r_v and labels.

Reads a route and the stages (`stages`); gives the episode and what was measured at each step
(Sec. III-A, Eq. 1).
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from fgtutor.course.own_net import WINDOW
from fgtutor.course.stages import corridor, zoo
from fgtutor.course.substitutes import Stages, same_shape
from fgtutor.execution import Episode, FollowConfig
from fgtutor.feasibility import tracking_reward
from fgtutor.robots import env_class
from fgtutor.robots.steering import slowdown, turn_rate
from fgtutor.routes import Route
from fgtutor.world.terrain import World

DRIVEN = 1500
"""Control steps after which a drive is given up: a minute."""


def nearest_ahead(route: Route, place: np.ndarray, distance: float) -> np.ndarray:
    """Return the vertex `distance` further along the route than the one nearest to a place."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route.xy, axis=0).T))))
    here = along[np.hypot(*(route.xy - place).T).argmin()]
    return route.xy[min(int(np.searchsorted(along, here + distance)), len(along) - 1)]


def held(wanted: Int[np.ndarray, " steps"], hold: int) -> Int[np.ndarray, " steps"]:
    """Return the active policies: one takes over when it was wanted for `hold` steps in a row."""
    active, waiting, chosen = wanted[0], 0, []
    for policy in wanted.tolist():
        waiting = waiting + 1 if policy != active else 0
        if waiting >= hold:
            active, waiting = policy, 0
        chosen.append(active)
    return np.array(chosen)


def driven(own: Stages, route: Route) -> tuple[Episode, dict[str, np.ndarray]]:
    """Drive a route in simulation, and return what was measured at each step too.

    That is the velocity (vx, vy) [n, 2] and the command [n, 2], m/s.
    """
    config, specialists = FollowConfig(), [*zoo().values()]
    robot = env_class("toy")
    episodes = replace(robot.episodes, train=False, stuck_seconds=math.inf)
    env = robot(World([[corridor()]]), 1, config=episodes)
    corner = env.offsets[0, 0].numpy().astype(float)
    env.start(torch.arange(1), torch.tensor([[*(route.xy[0] + corner), 0.0]]).float(), 0.0)
    seen: dict[str, list] = {"pose": [], "policy": [], "velocity": [], "command": []}
    wanted: list[int] = []
    limit = env.config.max_turn_rate
    reason = "timeout"
    for _ in range(DRIVEN):
        pose = env.motion()[0][0].double().numpy()
        place = pose[:2] - corner
        ahead = nearest_ahead(route, place, config.lookahead)
        aim = own.run(
            "aim_point",
            lambda ahead=ahead: ahead,
            lambda f, place=place, ahead=ahead: same_shape(
                f(route.xy.copy(), place.copy(), config.lookahead), ahead
            ),
        )
        bearing, yaw = math.atan2(*(aim - place)[::-1]), float(pose[3])
        both = torch.tensor([bearing]), torch.tensor([yaw])
        rate = own.run(
            "turn_rate",
            lambda both=both: turn_rate(*both, limit).numpy(),
            lambda f, b=bearing, y=yaw: same_shape(f(np.array([b]), np.array([y]), limit), [0]),
        )
        step = min(int(np.hypot(*(route.xy - place).T).argmin()), len(route.policies) - 1)
        wanted.append(int(route.policies[step]))
        history = np.array(wanted)
        active = own.run(
            "active_policies",
            lambda history=history: held(history, config.hold_steps),
            lambda f, history=history: same_shape(f(history, config.hold_steps), history),
        )
        policy = int(active[-1])
        speed = specialists[policy].command[0]
        env.command[0, 0] = speed * float(slowdown(*both, env.config.slowest))
        env.command[0, 2] = float(rate[0])
        with torch.inference_mode():
            observations = env.get_observations()
            _, _, _, extras = env.step(specialists[policy].act(observations))
        after, velocity = env.motion()
        moved = after[0].double().numpy() - [*corner, 0, 0]
        seen["pose"].append(moved)
        seen["policy"].append(policy)
        seen["velocity"].append(velocity[0, :2].double().numpy())
        seen["command"].append(env.command[0, :2].double().numpy().copy())
        if bool(extras["fell"][0]):
            reason = "fell"
        elif np.hypot(*(moved[:2] - route.xy[-1])) <= config.goal_radius:
            reason = "reached"
        if reason != "timeout":
            break
    measured = {name: np.array(values) for name, values in seen.items()}
    poses = measured["pose"]
    episode = Episode(
        success=reason == "reached",
        reason=reason,
        poses=poses,
        policies=measured["policy"],
        length=float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
        seconds=len(poses) * env.control_dt,
        robot="toy",
    )
    return episode, measured


def glided(own: Stages, route: Route, dt: float) -> Float[np.ndarray, "steps 3"]:
    """Return the poses (x, y, yaw), `dt` seconds apart, of a robot without physics on a route.

    It follows as the toy does, at the speed that the specialists are told.
    """
    config, robot = FollowConfig(), env_class("toy").episodes
    speed = min(specialist.command[0] for specialist in zoo().values())
    start = np.array((*route.xy[0], 0.0))
    limit, near = robot.max_turn_rate, config.goal_radius

    def ours() -> np.ndarray:
        poses = [start]
        while len(poses) <= DRIVEN and np.hypot(*(poses[-1][:2] - route.xy[-1])) > near:
            place, yaw = poses[-1][:2], poses[-1][2]
            aim = nearest_ahead(route, place, config.lookahead)
            both = torch.tensor([math.atan2(*(aim - place)[::-1])]), torch.tensor([yaw])
            yaw = yaw + float(turn_rate(*both, limit)[0]) * dt
            step = speed * dt * np.array((math.cos(yaw), math.sin(yaw)))
            poses.append(np.array((*(place + step), yaw)))
        return np.array(poses)

    def hers(function: Any) -> np.ndarray:
        given = route.xy.copy(), start.copy(), speed, config.lookahead, limit, near, dt, DRIVEN
        poses = np.asarray(function(*given), dtype=float)
        return same_shape(poses, np.zeros((len(poses), 3)))

    return own.run("drive", ours, hers)


def rewarded(own: Stages, measured: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return r_v of every step of a drive (Eq. 1)."""
    velocity, command = measured["velocity"], measured["command"]
    ours = tracking_reward(torch.tensor(velocity), torch.tensor(command)).numpy()
    return own.run(
        "tracking_reward",
        lambda: ours,
        lambda f: same_shape(f(velocity.copy(), command.copy()), ours),
    )


def labelled(own: Stages, r_v: np.ndarray, fell: bool) -> np.ndarray:
    """Return the label of every step of a drive, the mean of r_v over the second that follows."""
    fallen = np.zeros(len(r_v), dtype=bool)
    fallen[-1] = fell
    counted = np.where(fallen, 0.0, r_v)
    ours = np.array([counted[t : t + WINDOW].mean() for t in range(len(r_v))])
    return own.run(
        "labels", lambda: ours, lambda f: same_shape(f(r_v.copy(), fallen.copy(), WINDOW), ours)
    )
