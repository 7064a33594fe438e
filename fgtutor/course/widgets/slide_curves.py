"""Pictures of the slides that show curves: the tracking reward, a label's window, the advantage.

Reads the numbers at hand and the values of the sliders; gives a picture whose `alt` says in one
sentence what came out. Nothing here knows the notebook. Source: paper, Eq. 1 (the reward) and
Sec. III-A (labels from a rollout); Schulman et al. (2016), arXiv 1506.02438 (the advantage).
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation
from numpy.typing import ArrayLike

from fgtutor.errors import ConfigError
from fgtutor.feasibility import feasibility_labels, tracking_reward
from fgtutor.figures.style import INK, LINES, TITLE, Picture

WIDTH = 7.6
"""Width of a slide, inches."""
X_LABEL, Y_LABEL = -0.26, -0.36
"""Where the label of an axis begins, from its panel, inches."""
FASTEST = 2.0
"""The largest speed of the tracking slide, m/s."""


def sheet(
    height: float,
    rows: int = 1,
    columns: int = 1,
    *,
    heights: Sequence[float] | None = None,
    widths: Sequence[float] | None = None,
    shared: bool = False,
    gap: float = 0.75,
) -> tuple[Picture, list[Axes]]:
    """Return a picture of `WIDTH` by `height` inches and its panels, row by row.

    The margins are fixed: a layout that measures its words takes several times as long to draw.
    `gap` is what lies between two rows, inches; `shared` gives all panels one x axis.
    """
    picture = Picture(WIDTH, height)
    picture.set_layout_engine("none")
    inner = (height - 0.35 - 0.55 - gap * (rows - 1)) / rows
    spacing = {
        "left": 0.6 / WIDTH,
        "right": 1 - 0.15 / WIDTH,
        "bottom": 0.55 / height,
        "top": 1 - 0.35 / height,
        "hspace": gap / max(inner, 0.1),
        "wspace": 0.22,
    }
    panels = picture.subplots(
        rows,
        columns,
        squeeze=False,
        sharex=shared,
        height_ratios=heights,
        width_ratios=widths,
        gridspec_kw=spacing,
    )
    for axes in panels.ravel():
        axes.tick_params(labelsize=8)
        axes.locator_params(nbins=6 if columns == 1 else 4)  # each number takes time to draw
    return picture, list(panels.ravel())


def name_panel(axes: Axes, title: str, x: str, y: str) -> None:
    """Write the title and the labels of a panel, at fixed distances from it.

    Placed by themselves they would measure every tick label: a third of the time of a redraw.
    """
    axes.set_title(title, **TITLE, loc="left", y=1.0)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    inches = axes.figure.dpi_scale_trans
    for axis, place, (right, up) in (
        (axes.xaxis, (0.5, 0.0), (0.0, X_LABEL)),
        (axes.yaxis, (0.0, 0.5), (Y_LABEL, 0.0)),
    ):
        axis.set_label_coords(*place, axes.transAxes + ScaledTranslation(right, up, inches))


def draw_reward(sigma: float, command: float, speed: float) -> Picture:
    """Draw r_v over the speed, and where a robot stands that drives `speed` (all three in m/s)."""
    picture, (axes,) = sheet(3.0)
    speeds = torch.linspace(-0.5, FASTEST, 251)
    told = torch.tensor([command, 0.0])

    def reward(v: torch.Tensor) -> torch.Tensor:
        return tracking_reward(torch.stack((v, torch.zeros_like(v)), dim=-1), told, sigma)

    off = speeds - command
    r_v = float(reward(torch.tensor(speed)))
    axes.plot(speeds, reward(speeds), color=LINES[0], label="r_v: the norm as it is")
    squared = torch.exp(-((off / sigma) ** 2))
    axes.plot(speeds, squared, "--", color="#8A9299", label="if the norm were squared")
    axes.plot([speed, speed], [0, r_v], ":", color=INK)
    axes.plot(speed, r_v, "o", color=LINES[1], markersize=8)
    axes.axvline(command, color=INK, linewidth=0.8)
    axes.set(xlim=(-0.5, FASTEST), ylim=(0, 1.05))
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    name_panel(axes, f"r_v = {r_v:.2f}", "speed v (m/s); the thin line is the command", "r_v")
    picture.alt = (
        f"Told {command:.2f} m/s, driving {speed:.2f} m/s, sigma {sigma:.2f} m/s: "
        f"r_v = exp(-{abs(speed - command):.2f} / {sigma:.2f}) = {r_v:.2f}"
    )
    return picture


def draw_label_window(
    tracking: Float[ArrayLike, "time 3"], dt: float, window: int, step: int
) -> Picture:
    """Draw the window of r_v that becomes the label of one moment, and the labels of all moments.

    Args:
        tracking: (r_v, failed, ended) of one robot; row t tells of the step that led to moment t.
        dt: Length of a step, s.
        window: Steps that a label looks ahead.
        step: The moment.

    Raises:
        ConfigError: `tracking` is not [time, 3], or has no such moment.
    """
    rows = torch.as_tensor(np.asarray(tracking), dtype=torch.float32)
    if rows.ndim != 2 or rows.shape[1] != 3 or not 0 <= step < len(rows):
        raise ConfigError(
            f"need one robot's (r_v, failed, ended) over time, [time, 3], and a moment of it, got "
            f"shape {tuple(rows.shape)} and moment {step}: take rollout['tracking'][:, robot]"
        )
    labels, valid = (one[:, 0] for one in feasibility_labels(rows[:, None], window))
    picture, (axes,) = sheet(3.3)
    t, (r_v, failed, ended) = np.arange(len(rows)) * dt, rows.T.numpy()
    axes.fill_between(t, r_v, step="mid", color="#9DB8C9", label="r_v of each step")
    axes.plot(t, np.where(valid, labels, np.nan), color=LINES[1], label="label of each moment")
    last = min(step + window, len(rows) - 1)
    span = (t[step] + dt / 2, t[step] + (max(window, 1) + 0.5) * dt)
    axes.axvspan(*span, facecolor=LINES[4], alpha=0.25, hatch="//", edgecolor=LINES[4], linewidth=0)
    for moment in t[failed > 0]:
        axes.axvline(moment, color=INK, linewidth=1.2)
        axes.text(moment, 1.06, "failed", ha="center", fontsize=8)
    for moment in t[(ended > 0) & (failed == 0)]:
        axes.axvline(moment, color=INK, linestyle=":")
    ends = np.flatnonzero(ended[step + 1 : last + 1])
    fell = len(ends) > 0 and failed[step + 1 + ends[0]] > 0
    name = "no label: too little of its window was seen"
    if valid[step]:
        axes.plot(t[step], labels[step], "o", color=LINES[1], markersize=8)
        name = f"label = {labels[step]:.2f}"
    axes.set(xlim=(-dt / 2, t[-1] + dt / 2), ylim=(0, 1.12))
    # Above the panel: inside it would hide bars, and the moment.
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    name_panel(axes, f"Moment {t[step]:.2f} s: {name}", "time (s); hatched: the window", "r_v")
    after = "; after the failure in it r_v counts as 0" if fell else ""
    picture.alt = (
        f"Moment {t[step]:.2f} s, window {window} steps = {window * dt:.2f} s: {name}{after}"
    )
    return picture


def advantages(
    rewards: ArrayLike, values: ArrayLike, gamma: float, lam: float
) -> tuple[Float[np.ndarray, " steps"], Float[np.ndarray, " steps"]]:
    """Return the surprise delta_t = r_t + gamma V_(t+1) - V_t and the advantage of each step.

    A_t is the sum over l of (gamma lam)^l delta_(t+l), for one episode that ends with its last
    reward. Raises `ConfigError` unless there is one value more than rewards.
    """
    r, v = (np.asarray(one, dtype=float) for one in (rewards, values))
    if r.ndim != 1 or v.shape != (len(r) + 1,):
        raise ConfigError(
            f"need T rewards and T + 1 values (the last is that after the end), got {r.shape} and "
            f"{v.shape}"
        )
    surprise = r + gamma * v[1:] - v[:-1]
    advantage, later = np.empty(len(r)), 0.0
    for t in reversed(range(len(r))):
        advantage[t] = later = surprise[t] + gamma * lam * later
    return surprise, advantage


def draw_advantage(rewards: ArrayLike, values: ArrayLike, gamma: float, lam: float) -> Picture:
    """Draw the surprise of each step above, and the advantage that lambda makes of it below."""
    surprise, advantage = advantages(rewards, values, gamma, lam)
    picture, (above, below) = sheet(4.2, rows=2, shared=True, heights=(1, 1.4), gap=0.5)
    steps = np.arange(len(surprise))
    above.vlines(steps, 0, surprise, color=LINES[0], linewidth=8)
    below.plot(steps, advantages(rewards, values, gamma, 0.0)[1], ":", color=INK, label="λ = 0")
    below.plot(
        steps, advantages(rewards, values, gamma, 1.0)[1], "--", color="#8A9299", label="λ = 1"
    )
    below.plot(steps, advantage, color=LINES[1], linewidth=2.2, label=f"λ = {lam:.2f}")
    for axes in (above, below):
        axes.axhline(0, color=INK, linewidth=0.6)
    below.legend(frameon=False, fontsize=8, loc="lower left")
    name_panel(above, "Surprise of each step", "", "δ")
    reach = np.inf if gamma * lam >= 1 else 1 / (1 - gamma * lam)
    name_panel(below, "Advantage: what each action has to answer for", "control step", "advantage")
    picture.alt = (
        f"lambda {lam:.2f}, gamma {gamma:.3f}: an action answers for about {reach:.0f} "
        f"steps; the first action's advantage is {advantage[0]:+.2f}"
    )
    return picture
