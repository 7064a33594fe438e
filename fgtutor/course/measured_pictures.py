"""Pictures of what the learner's functions measure: drives, the A1's stance, tables, a scan.

Reads the stages with her functions; draws what each says of the same drive or trials.
"""
# MuJoCo's functions come from a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

import copy
from functools import cache
from typing import Any

import mujoco
import numpy as np
from matplotlib.figure import Figure

from fgtutor.course import own_net
from fgtutor.course.checks import find
from fgtutor.course.crossing import driven, labelled, rewarded
from fgtutor.course.drives import drive_together, straight_route
from fgtutor.course.route_pictures import draw_drive
from fgtutor.course.stages import F_MIN, corridor, library_route, tensors, zoo
from fgtutor.course.substitutes import Stages, same_shape
from fgtutor.figures.charts import calibration_plot, draw_curves, draw_table
from fgtutor.figures.style import TITLE, Picture
from fgtutor.robots.a1.model import A1Config, build_spec
from fgtutor.statistics import calibration, spl, wilson_interval
from fgtutor.world.terrain import make_terrain

END = 40
"""Last steps of a drive that are not drawn: their advantage is that of an end, not of a step."""


@cache
def drive_of_the_library() -> tuple[Any, dict[str, np.ndarray]]:
    """Return the episode in which the library drives its own route, and what was measured."""
    return driven(Stages({}, []), library_route())


def draw_labels(own: Stages) -> Figure:
    """Draw r_v of a drive, and the labels made of it."""
    episode, measured = drive_of_the_library()
    r_v = rewarded(own, measured)
    labels = labelled(own, r_v, episode.reason == "fell")
    return draw_curves(
        episode.poses[:, 0],
        {"r_v of the step": r_v, "label: mean of the second that follows": labels},
        title=f"The toy drives the corridor ({episode.reason})",
        xlabel="x (m)",
        ylabel="r_v",
    )


def draw_calibration(own: Stages) -> Figure:
    """Train a Feasibility-Net on a rollout; draw what it says of another one against what came."""
    trained = own_net.train(own)
    f, measured = trained.f, trained.measured
    ours = calibration(f, measured, 10)

    def hers(function: Any) -> tuple[np.ndarray, float]:
        table, error = function(f.copy(), measured.copy(), 10)
        return same_shape(table, ours[0]), float(error)

    figure = calibration_plot(*own.run("reliability", lambda: ours, hers))
    figure.axes[0].set_title(
        f"{figure.axes[0].get_title(loc='left')}\nJoint loss "
        f"{trained.losses[0]:.1f} to {trained.losses[-1]:.2f}; {trained.updates} updates more",
        **TITLE,
        loc="left",
    )
    return figure


def draw_stance(own: Stages) -> Figure:
    """Draw how high the A1's trunk stays, and how it tilts, while torques hold its stance."""
    spec, config = build_spec(), A1Config()
    model = spec.compile()
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0  # its own controllers rest
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    stance, height, quaternions = data.qpos[7:19].copy(), [], []
    for _ in range(400):
        q, dq = data.qpos[7:19].copy(), data.qvel[6:18].copy()
        limit = config.torque_limit
        torque = np.clip(config.kp * (stance - q) - config.kd * dq, -limit, limit)
        data.qfrc_applied[6:18] = own.run(
            "joint_torques",
            lambda torque=torque: torque,
            lambda f, q=q, dq=dq: same_shape(f(q, dq, np.zeros(12), stance.copy()), q),
        )
        mujoco.mj_step(model, data)
        height.append(data.qpos[2])
        quaternions.append(data.qpos[3:7].copy())
    w, x, y, z = np.array(quaternions).T
    down = -np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=-1)
    down = own.run(
        "gravity_in_body",
        lambda: down,
        lambda f: same_shape(f(np.array(quaternions)), down),
    )
    figure = Picture(7.0, 4.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    seconds = model.opt.timestep * np.arange(len(height))
    upper.plot(seconds, height)
    upper.set(ylabel="trunk (m)", ylim=(0, None))
    upper.set_title("The A1 is let go in its stance; the torques hold it", **TITLE, loc="left")
    lower.plot(seconds, np.degrees(np.arccos(np.clip(-down[:, 2], -1, 1))))
    lower.set(xlabel="time (s)", ylabel="tilt (degrees)", ylim=(0, None))
    return figure


def draw_advantages(own: Stages) -> Figure:
    """Draw the advantages of a drive, and of a rollout, if a critic always says the mean."""
    episode, measured = drive_of_the_library()
    rewards, gamma, lam = rewarded(Stages({}, []), measured), 0.97, 0.95
    done = np.zeros(len(rewards), dtype=bool)
    done[-1] = True
    given = rewards, np.full(len(rewards) + 1, rewards.mean() / (1 - gamma)), done, gamma, lam
    found = own.run(
        "advantages",
        lambda: find("ex09.q2").truth(*given),
        lambda f: same_shape(f(*copy.deepcopy(given)), rewards),
    )
    r_v, failed, ended = own_net.rollout(0)["tracking"][1:].double().numpy().transpose(2, 0, 1)
    fell, values = failed > 0, np.full(r_v.shape, r_v.mean() / (1 - gamma))
    table = r_v, values, values.copy(), fell, (ended > 0) & ~fell, gamma, lam
    batch = own.run(
        "batch_advantages",
        lambda: find("ex09.q4").truth(*table),
        lambda f: same_shape(f(*copy.deepcopy(table)), r_v),
    )
    figure = Picture(7.4, 5.0)
    upper, lower = figure.subplots(2, 1)
    x = episode.poses[:-END, 0]
    upper.plot(x, found[:-END], label="advantage")
    upper.plot(x, rewards[:-END], "--", label="r_v of the step")
    upper.axhline(0, color="grey", linewidth=0.8)
    upper.set(xlabel="x (m)")
    upper.legend(loc="lower left", fontsize=9)
    upper.set_title("Where did the toy do better (above 0) than usual?", **TITLE, loc="left")
    image = lower.imshow(
        batch.T,
        extent=(0, own_net.SECONDS, own_net.ROBOTS, 0),
        aspect="auto",
        cmap="BrBG",
        vmin=-3,
        vmax=3,
    )
    when, who = np.nonzero(fell)
    lower.plot(own_net.SECONDS * (when + 1) / len(r_v), who + 0.5, "kx", markersize=5)
    lower.set(xlabel="time (s)", ylabel="robot")
    figure.colorbar(image, ax=lower, label="advantage")
    lower.set_title("A rollout, normalised; a cross is a failure", **TITLE, loc="left")
    return figure


def draw_length(own: Stages) -> Figure:
    """Draw a drive, and say how long it was and what its SPL is."""
    route, (episode, _) = library_route(), drive_of_the_library()
    xy = episode.poses[:, :2]
    length = own.run("path_length", lambda: episode.length, lambda f: float(f(xy.copy())))
    trial = np.array([episode.success]), np.array([length]), np.array([route.length])
    score = own.run("spl", lambda: spl(*trial), lambda f: float(f(*trial)))
    figure = draw_drive(episode, route, corridor().elevation)
    figure.axes[0].set_title(
        f"Driven {length:.2f} m; SPL {score:.2f} against the route's {route.length:.2f} m",
        **TITLE,
        loc="left",
    )
    return figure


def draw_success(own: Stages) -> Figure:
    """Draw how often each specialist crosses each obstacle, and how sure that is."""
    names, drives, jobs = [*zoo()], 3, []
    for seed in range(drives):
        for kind in names:
            terrain = make_terrain(kind, robot="toy", seed=seed)
            jobs += [(straight_route(terrain, name), terrain, seed) for name in names]
    episodes = drive_together(jobs, zoo())
    terrain = np.array([i for _ in range(drives) for i in range(len(names)) for _ in names])
    policy = np.tile(np.arange(len(names)), drives * len(names))
    outcome = np.array([{"reached": 0, "fell": 2}.get(one.reason, 3) for one in episodes])
    shape = (len(names), len(names))
    wins = np.zeros(shape, dtype=int)
    np.add.at(wins, (terrain, policy), outcome == 0)
    table = own.run(
        "success_table",
        lambda: wins / drives,
        lambda f: same_shape(f(terrain.copy(), policy.copy(), outcome.copy(), *shape), wins),
    )
    flat, trials = wins.ravel(), np.full(wins.size, drives)
    ours = np.array([wilson_interval(int(k), drives) for k in flat]).T
    low, high = own.run(
        "wilson_interval", lambda: ours, lambda f: same_shape(f(flat.copy(), trials), ours)
    )
    texts = [
        [f"{low[i * len(names) + j]:.2f}-{high[i * len(names) + j]:.2f}" for j in range(len(names))]
        for i in range(len(names))
    ]
    return draw_table(
        table,
        names,
        names,
        title="Which specialist (column) crosses which obstacle (row)?",
        caption=f"colour: the share of {drives} drives; numbers: its 95 % interval",
        texts=texts,
    )


def draw_scan(own: Stages) -> Figure:
    """Draw a map made from a cloud of points, and what switching costs on the route."""
    elevation, rng = corridor().elevation, np.random.default_rng(0)
    truth, resolution = elevation.heights.astype(float), elevation.resolution
    cells = np.argwhere(rng.uniform(size=truth.shape) < 0.95).repeat(4, axis=0)
    places = (cells + rng.uniform(0.05, 0.95, cells.shape)) * resolution
    points = np.column_stack((places, truth[tuple(cells.T)] - rng.uniform(0, 0.01, len(cells))))
    highest = np.full(truth.shape, -np.inf)
    np.maximum.at(highest, tuple(cells.T), points[:, 2])
    highest[np.isinf(highest)] = np.nan
    heights = own.run(
        "rasterise",
        lambda: highest,
        lambda f: same_shape(f(points.copy(), truth.shape, resolution, 2), truth),
    )
    route = library_route()
    at = (slice(None), *route.cells[:-1].T, route.headings)
    choices = np.maximum(tensors(Stages({}, []))[at].T, F_MIN)
    switch = 2.0
    cost = 1 / choices[0]
    for step in choices[1:]:
        cost = np.minimum(cost, cost.min() + switch) + 1 / step
    total = own.run(
        "cheapest_with_switches",
        lambda: float(cost.min()),
        lambda f: float(f(choices.copy(), switch)),
    )
    seconds = np.arange(0.0, 20.0)
    error = own.run(
        "localisation_std",
        lambda: np.hypot(0.02, 0.03 * np.sqrt(seconds)),
        lambda f: same_shape(f(seconds.copy(), 0.02, 0.03), seconds),
    )
    figure = Picture(7.4, 4.4)
    upper, lower = figure.subplots(2, 1)
    x0, y0, x1, y1 = elevation.extent
    image = upper.imshow(
        heights.T, origin="lower", extent=(x0, x1, y0, y1), cmap="cividis", vmin=-0.4, aspect="auto"
    )
    figure.colorbar(image, ax=upper, label="height (m)")
    upper.set_title(
        f"The map from {len(points):,} points; white was not hit",
        **TITLE,
        loc="left",
    )
    caption = (
        f"x (m)\nThe route's {len(choices)} steps cost {total:.1f}, each 1 / F, a switch {switch:g}"
    )
    upper.set(xlabel=caption, ylabel="y (m)")
    lower.plot(seconds, 100 * error)
    lower.set(xlabel="time (s)", ylabel="error (cm)", ylim=(0, None))
    lower.set_title("How lost the robot is by then (standard deviation)", **TITLE, loc="left")
    return figure
