"""The stages of the planner, each the learner's function if it has passed, else the library's.

Reads functions by name; runs them on one terrain of the toy, a corridor with all four obstacles
across it. A function that fails on the real data is named, and the library's runs in its place.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from fgtutor.course.grading.replies import TooSlow, explain, time_limit
from fgtutor.directions import STEPS, Headings
from fgtutor.execution import Episode, FollowConfig
from fgtutor.feasibility import tracking_reward
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.robots import env_class
from fgtutor.robots.steering import slowdown, turn_rate
from fgtutor.routes import Route
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.tensorization import Assessment, assess_all
from fgtutor.world.terrain import Terrain, World, make_terrain

SECONDS = 20.0
"""CPU time that one stage may take with a function of the learner's, s."""
SEED = 1
"""The corridor that is planned over: its four obstacles can all be crossed."""
TAUS = 0.1, 2.0
"""The paper's thresholds on L_recon."""
F_MIN = 0.1
"""Least feasibility of an edge."""
WINDOW = 50
"""Control steps that a label is the mean of: one second."""
DRIVEN = 1500
"""Control steps after which a drive is given up: a minute."""


class Stages:
    """The learner's functions, which of them ran, and what went wrong."""

    def __init__(self, functions: Mapping[str, Callable[..., Any]], faults: Sequence[str]) -> None:
        self.functions = dict(functions)
        self.faults = [*faults]
        self.hers: dict[str, None] = {}
        self.ours: dict[str, None] = {}

    def run(self, name: str, ours: Callable[[], Any], hers: Callable[[Any], Any]) -> Any:
        """Return hers(function) if the learner's function has passed and runs here, else ours()."""
        function = self.functions.get(name)
        if function is not None:
            try:
                with time_limit(SECONDS):
                    value = hers(function)
            except TooSlow:
                self._give_up(name, f"it took more than {SECONDS:g} s")
            except Exception as error:
                self._give_up(name, explain(error, ""))
            else:
                self.hers[name] = None
                return value
        if name not in self.hers:
            self.ours[name] = None
        return ours()

    def _give_up(self, name: str, reason: str) -> None:
        del self.functions[name]  # from here on the library's
        self.hers.pop(name, None)
        self.faults.append(f"Your `{name}` fails on the real data, so the library's runs: {reason}")

    def report(self) -> str:
        """Say whose each stage was, and what went wrong."""
        yours, ours = (", ".join(names) or "nothing yet" for names in (self.hers, self.ours))
        return "\n".join([f"Yours: {yours}.", f"The library's: {ours}.", *self.faults])


def same_shape(value: Any, like: Any) -> np.ndarray:
    """Return an answer as an array; raises `ValueError` if its shape is not the library's."""
    array = np.asarray(value, dtype=float)
    if array.shape != np.shape(like):
        raise ValueError(f"it gives an array of shape {array.shape} instead of {np.shape(like)}")
    return array


# What the planner runs on -------------------------------------------------------------------------


@cache
def corridor() -> Terrain:
    """Return the terrain: steps, slopes, rubble and gaps, one after another, from wall to wall."""
    return make_terrain("mixed", robot="toy", seed=SEED)


@cache
def zoo() -> dict[str, Specialist]:
    """Return the shipped specialists of the toy."""
    return dict(load_zoo("toy"))


@cache
def assessed() -> dict[str, Assessment]:
    """Return f and L_recon of every cell and heading of the corridor."""
    return assess_all(corridor().elevation, zoo())


# The stages ---------------------------------------------------------------------------------------


def weights(own: Stages) -> dict[str, Float[np.ndarray, "nx ny 8"]]:
    """Return w_ood of each specialist, by the paper's thresholds (Eq. 4)."""
    found = {}
    for name, said in assessed().items():
        loss, ours = said.reconstruction.numpy(), said.ood(*TAUS).numpy()
        found[name] = own.run(
            "ood_weight",
            lambda ours=ours: ours,
            lambda f, loss=loss, ours=ours: same_shape(f(loss, *TAUS), ours),
        )
    return found


def fused(own: Stages) -> tuple[Float[np.ndarray, "nx ny 8"], Int[np.ndarray, "nx ny 8"]]:
    """Return F_max and P of all specialists (Eqs. 5-7)."""
    every, closed = weights(own), []
    for name, said in assessed().items():
        weighted = torch.as_tensor(every[name], dtype=torch.float32) * said.f
        closed.append(said.closed(weighted).numpy())
    ours = tuple(np.asarray(part) for part in fuse(closed))

    def hers(function: Any) -> tuple[np.ndarray, np.ndarray]:
        best, policy = function(np.stack(closed))
        return same_shape(best, ours[0]), same_shape(policy, ours[1]).astype(int)

    return own.run("fuse", lambda: ours, hers)


def planned(own: Stages) -> Route:
    """Return the cheapest route over the corridor (Sec. III-C)."""
    best, policy = fused(own)
    terrain = corridor()
    grid = terrain.elevation

    def ours() -> Route:
        start, goal = terrain.start, terrain.goal
        options = {"names": tuple(zoo()), "f_min": F_MIN}
        return plan(best, policy, grid=grid, start=start, goal=goal, **options).raise_for()

    with np.errstate(divide="ignore"):
        costs = np.where(best >= F_MIN, 1 / best, np.inf)
    costs = own.run("edge_costs", lambda: costs, lambda f: same_shape(f(best, F_MIN), costs))
    start, goal = grid.cell_of(*terrain.start), grid.cell_of(*terrain.goal)

    def hers(function: Any) -> Route:
        return route_of(np.asarray(function(costs.copy(), start, goal)), best, policy, costs)

    return own.run("cheapest_route", ours, hers)


def route_of(
    cells: Int[np.ndarray, "n 2"],
    best: Float[np.ndarray, "nx ny 8"],
    policy: Int[np.ndarray, "nx ny 8"],
    costs: Float[np.ndarray, "nx ny 8"],
) -> Route:
    """Describe a chain of cells; raises `ValueError` if it is none from start to goal."""
    terrain = corridor()
    grid, headings = terrain.elevation, Headings()
    ends = [grid.cell_of(*terrain.start), grid.cell_of(*terrain.goal)]
    if len(cells) < 2 or [*map(tuple, cells[[0, -1]].tolist())] != ends:
        raise ValueError("its cells do not lead from the start to the goal")
    steps = np.diff(cells, axis=0)
    if not (steps[:, None] == STEPS).all(axis=-1).any(axis=-1).all():
        raise ValueError("its cells are not all neighbours")
    along = headings.index_of(steps)
    at = (*cells[:-1].T, along)
    x, y = grid.centres
    return Route(
        cells=cells,
        xy=np.stack((x[cells[:, 0]], y[cells[:, 1]]), axis=-1),
        headings=along,
        policies=policy[at],
        feasibility=best[at],
        costs=costs[at],
        length=float(headings.lengths[along].sum() * grid.resolution),
        names=tuple(zoo()),
    )


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

    That is the velocity (vx, vy) [n, 2] and the command [n, 2], m/s, and f of the active policy.
    """
    config, specialists = FollowConfig(), [*zoo().values()]
    robot = env_class("toy")
    episodes = replace(robot.episodes, train=False, stuck_seconds=math.inf)
    env = robot(World([[corridor()]]), 1, config=episodes)
    corner = env.offsets[0, 0].numpy().astype(float)
    speed = min(specialist.command[0] for specialist in specialists)
    env.start(torch.arange(1), torch.tensor([[*(route.xy[0] + corner), 0.0]]).float(), speed)
    seen: dict[str, list] = {"pose": [], "policy": [], "velocity": [], "command": [], "f": []}
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
        env.command[0, 0] = speed * float(slowdown(*both, env.config.slowest))
        env.command[0, 2] = float(rate[0])
        with torch.inference_mode():
            observations = env.get_observations()
            command = torch.tensor([specialists[policy].command])
            f = specialists[policy].feasibility.feasibility(env.patches(), command)
            _, _, _, extras = env.step(specialists[policy].act(observations))
        after, velocity = env.motion()
        moved = after[0].double().numpy() - [*corner, 0, 0]
        seen["pose"].append(moved)
        seen["policy"].append(policy)
        seen["velocity"].append(velocity[0, :2].double().numpy())
        seen["command"].append(env.command[0, :2].double().numpy().copy())
        seen["f"].append(float(f[0]))
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
