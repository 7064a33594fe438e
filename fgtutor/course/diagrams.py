"""Diagrams of ideas: the pipeline of the course, the Feasibility-Net, frames, and a label's window.

Reads nothing but the library's own sizes and conventions; gives matplotlib figures with alt text.
Every notebook shows `draw_pipeline` near its top, with its own stages marked "you are here".
Source: paper, Figs. 2-4 for the pipeline and the net, Sec. III-A for the label.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Interval
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle

from fgtutor.directions import NAMES, STEPS
from fgtutor.errors import ConfigError
from fgtutor.feasibility import FeasibilityNet, feasibility_labels
from fgtutor.figures.style import INK, LINES, TITLE, Picture
from fgtutor.io.validation import check_arguments
from fgtutor.robots import env_class

NOTEBOOKS = 13
"""Number of notebooks in the course."""
Notebook = Annotated[int, Interval(ge=1, le=NOTEBOOKS)]
"""Number of a notebook."""
Window = Annotated[int, Interval(ge=1, le=6)]
"""Steps that a label averages over, as many as the diagram has room for."""
QUIET, HERE = "#F2F3F4", "#FFE2A8"
"""Fill of a box, and of one that is marked."""
LEGEND: dict[str, Any] = {"fontsize": 8.5, "framealpha": 1, "edgecolor": "white"}
"""How legends look that lie over lines."""
MARK = LINES[1]
"""Colour of what a diagram points at."""


# The pipeline -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stage:
    """A box of the pipeline."""

    at: tuple[int, int]
    """Column, and row from the top."""
    name: str
    """What it is called."""
    symbols: str
    """What it gives, in the notation of the paper."""
    taught: tuple[int, ...]
    """Notebooks that are about it."""


STAGES = {
    "scan": Stage((0, 0), "LiDAR scan", "points (x, y, z)", (12,)),
    "robot": Stage((1, 0), "Robot, policy", r"toy or A1, $\pi_i$", (2, 8)),
    "training": Stage((2, 0), "Training", r"PPO and net, $r_v$", (2, 3, 9, 13)),
    "map": Stage((0, 1), "Elevation map", r"$M$", (1, 12)),
    "patch": Stage((1, 1), "Patches", r"$H_{x,y}$, 8 headings", (1, 5)),
    "net": Stage((2, 1), "Feasibility-Net", r"$f$ and $L_{recon}$", (3, 4)),
    "weight": Stage((3, 1), "OOD weight", r"$w_{ood}$", (4,)),
    "tensor": Stage((4, 1), "Tensor", r"$F_i = w_{ood} \cdot f$", (5,)),
    "fuse": Stage((4, 2), "Fuse", r"$F_{max}$ and $P$", (6, 11)),
    "route": Stage((3, 2), "Route", r"Dijkstra, $1 / F_{max}$", (6, 10)),
    "drive": Stage((2, 2), "Drive", r"$P$ says which $\pi_i$", (7, 11, 12)),
    "measure": Stage((1, 2), "Measure", "success, length", (7, 10, 11, 13)),
}
"""The course as one diagram: each notebook is about one or more of these."""
FLOW = (
    ("robot", "training"), ("training", "net"), ("scan", "map"), ("map", "patch"), ("patch", "net"),
    ("net", "weight"), ("weight", "tensor"), ("tensor", "fuse"), ("fuse", "route"),
    ("route", "drive"), ("drive", "measure"),
)  # fmt: skip
ROWS = (
    ((4.02, 0.1), "Above: once for each policy."), ((4.02, -0.1), "Below: once for each map."),
    ((-0.66, -2.04), "Small numbers:"), ((-0.66, -2.2), "the notebooks"),
    ((-0.66, -2.36), "about it."),
)  # fmt: skip
"""Where words stand beside the boxes, and what they say."""
BOX, PITCH = (1.32, 0.62), (1.56, 1.06)
"""Size of a box and distance from one to the next, along x and y."""


def draw_pipeline(here: Notebook) -> Picture:
    """Draw the pipeline of the whole course; the stages of notebook `here` are marked.

    Raises:
        ConfigError: There is no such notebook.
    """
    check_arguments(draw_pipeline, locals(), ConfigError)
    figure = Picture(7.7, 3.1)
    axes = _canvas(figure, (-0.76, 7.0), (-2.62, 0.45))
    for at, words in ROWS:
        axes.text(*at, words, va="center", fontsize=8, style="italic")
    for tail, head in FLOW:
        _connect(axes, STAGES[tail].at, STAGES[head].at)
    marked = [stage for stage in STAGES.values() if here in stage.taught]
    for stage in STAGES.values():
        _stage(axes, stage, marked=stage in marked)
    axes.set_title(
        f"The pipeline of the course; you are in notebook {here:02}", **TITLE, loc="left"
    )
    order = (
        "LiDAR scan, elevation map M, patches, Feasibility-Net (trained beside the policy, from "
    )
    order += "rollouts of the robot), OOD weight, tensor F of each policy, fused F_max and P, "
    order += "route, drive, measured success"
    names = " and ".join(stage.name for stage in marked)
    figure.alt = f"Pipeline of the course: {order}. You are here: {names}."
    return figure


def _place(at: tuple[int, int]) -> tuple[float, float]:
    """Return the centre of the box in a column and row."""
    return at[0] * PITCH[0], -at[1] * PITCH[1]


def _stage(axes: Axes, stage: Stage, *, marked: bool) -> None:
    """Draw one stage: its name, what it gives and the notebooks about it."""
    x, y = _place(stage.at)
    _box(axes, (x, y), BOX, marked=marked)
    axes.text(x, y + 0.17, stage.name, ha="center", va="center", fontsize=9, weight="bold")
    axes.text(x, y - 0.02, stage.symbols, ha="center", va="center", fontsize=8.5)
    numbers = ", ".join(f"{number:02}" for number in stage.taught)
    axes.text(x, y - 0.21, numbers, ha="center", va="center", fontsize=7.5, color="#555B61")
    if marked:
        flag = {"boxstyle": "round,pad=0.2", "facecolor": MARK, "edgecolor": "none"}
        style: dict[str, Any] = {"fontsize": 7.5, "weight": "bold", "color": "white", "bbox": flag}
        axes.text(x, y - 0.38, "you are here", ha="center", va="center", **style)


def _connect(axes: Axes, tail: tuple[int, int], head: tuple[int, int]) -> None:
    """Draw an arrow from box to box, from border to border."""
    a, b = np.array(_place(tail)), np.array(_place(head))
    border = np.sign(b - a) * np.array(BOX) / 2
    _arrow(axes, a + border, b - border)


# The Feasibility-Net ------------------------------------------------------------------------------


def draw_net() -> Picture:
    """Draw the toy's Feasibility-Net: the head above, the autoencoder below, every width."""
    grid = env_class("toy").grid
    net = FeasibilityNet(grid.num_points)
    points, (rows, columns) = grid.num_points, grid.shape
    figure = Picture(7.7, 4.4)
    axes = _canvas(figure, (-0.2, 7.7), (-2.55, 1.65))
    head, auto = 0.75, -1.0
    _box(axes, (0.55, head - 0.3), (1.3, 0.5))
    axes.text(0.55, head - 0.3, f"command\n{net.command_dim} numbers", **_MIDDLE)
    _box(axes, (0.55, auto), (1.3, 0.75))
    axes.text(0.55, auto, f"patch $H_{{x,y}}$\n{rows} x {columns} heights\n= {points}", **_MIDDLE)
    first = _layers(axes, 2.0, head, (points + net.command_dim, *net.hidden, 1), LINES[0])
    coder = (points, *net.vae_hidden, 2 * net.latent)
    second = _layers(axes, 2.0, auto, coder, LINES[4])
    third = _layers(axes, 4.45, auto, (net.latent, *net.vae_hidden[::-1], points), LINES[2])
    _arrow(axes, (1.2, head - 0.2), (1.86, head - 0.05))
    _arrow(axes, (1.2, auto + 0.3), (1.86, head - 0.3))
    _arrow(axes, (1.2, auto), (1.86, auto))
    _arrow(axes, (second, auto), (4.31, auto))
    axes.text((second + 4.31) / 2, auto + 0.08, "$z$", ha="center", fontsize=9)
    for x, words in ((first, "sigmoid"), (third, r"$\Sigma(\hat H - H)^2$")):
        y = head if x == first else auto
        _arrow(axes, (x, y), (6.93, y))
        axes.text((x + 6.93) / 2, y + 0.1, words, ha="center", fontsize=8)
    axes.text(7.0, head, "$f$\nin 0 ... 1", ha="left", va="center", fontsize=9)
    axes.text(7.0, auto, "$L_{recon}$", ha="left", va="center", fontsize=9)
    axes.text(2.0, 1.5, "Head (ELU): will the policy follow this command here?", fontsize=9)
    words = f"Encoder (tanh): mean and\nlog variance of $z$, {net.latent} each"
    axes.text(1.86, auto - 1.1, words, fontsize=8.5)
    axes.text(4.31, auto - 1.1, "Decoder (tanh): the patch again,\nfrom $z$ alone", fontsize=8.5)
    axes.plot((1.75, 6.8), (-0.12, -0.12), "--", color=MARK, linewidth=1)
    axes.text(6.8, -0.08, "no weight is shared", ha="right", fontsize=8.5, color=MARK)
    loss = r"$L_{feas} = (f - r_v)^2 + \alpha\,(L_{recon} + \beta\,L_{KL})$"
    axes.text(-0.1, -2.48, f"Trained together: {loss}", fontsize=10)
    axes.set_title("The Feasibility-Net: two networks, one loss", **TITLE, loc="left")
    figure.alt = (
        f"Feasibility-Net. A head of widths {points + net.command_dim}, {net.hidden[0]}, "
        f"{net.hidden[1]}, 1 turns patch and command into f. A variational autoencoder, encoder "
        f"{', '.join(map(str, coder))}, decoder from {net.latent} numbers back to {points}, "
        "rebuilds the patch; its error is L_recon. The two share no weight."
    )
    return figure


_MIDDLE: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8.5}
"""How words stand in a box."""


def _layers(axes: Axes, x: float, y: float, widths: Sequence[int], colour: str) -> float:
    """Draw layers as bars joined by trapezia, the longer the wider; return where the last ends."""
    pitch, thick = 0.5, 0.14
    tall = [0.1 + 0.2 * float(np.log2(width)) / 2 for width in widths]
    for number, (width, height) in enumerate(zip(widths, tall, strict=True)):
        at = x + number * pitch
        if number:
            before = tall[number - 1]
            corners = [
                (at - pitch + thick / 2, y - before / 2), (at - pitch + thick / 2, y + before / 2),
                (at - thick / 2, y + height / 2), (at - thick / 2, y - height / 2),
            ]  # fmt: skip
            axes.add_patch(Polygon(corners, facecolor=colour, alpha=0.18))
        corner = (at - thick / 2, y - height / 2)
        axes.add_patch(Rectangle(corner, thick, height, facecolor=colour, edgecolor=INK))
        axes.text(at, y - height / 2 - 0.06, str(width), ha="center", va="top", fontsize=8)
    return x + (len(widths) - 1) * pitch + thick / 2 + 0.02


# Frames, headings and cells -----------------------------------------------------------------------


def draw_frames() -> Picture:
    """Draw the world's frame with a robot in it, the eight headings, and how cells are counted."""
    figure = Picture(7.7, 2.8)
    panels = figure.subplots(1, 3)
    titles = ("A pose (x, y, yaw)", "Headings 0 to 7", "Cells [ix, iy]")
    for axes, title, draw in zip(panels, titles, (_pose, _headings, _cells), strict=True):
        axes.set_axis_off()
        axes.set_aspect("equal")
        draw(axes)
        axes.set_title(title, **TITLE, loc="left")
    figure.alt = (
        "Three sketches. A pose: x and y in metres in the world's frame, yaw psi counter-clockwise "
        "from +x to the way the robot faces; its own frame points ahead and to its left. The "
        "headings: 0 is +x, 2 is +y, 4 is -x, 6 is -y, every 45 degrees. The cells: ix counts "
        "along x and iy along y, from the origin in the lower left corner."
    )
    return figure


def _pose(axes: Axes) -> None:
    x, y, yaw = 1.15, 0.85, np.radians(35)
    axes.set(xlim=(-0.35, 2.6), ylim=(-0.45, 2.5))
    for end, name, at in (((2.35, 0), "x", (2.48, 0)), ((0, 2.2), "y", (0, 2.36))):
        _arrow(axes, (0, 0), end)
        axes.text(*at, name, ha="center", va="center", fontsize=9)
    axes.plot((x, x, 0), (0, y, y), ":", color=INK, linewidth=1)
    ahead, left = np.array((np.cos(yaw), np.sin(yaw))), np.array((-np.sin(yaw), np.cos(yaw)))
    here = np.array((x, y))
    body = [here + 0.32 * a * ahead + 0.18 * b * left for a, b in _HULL]
    axes.add_patch(Polygon(body, facecolor=HERE, edgecolor=INK))
    for direction, name, colour in ((ahead, "ahead", LINES[0]), (left, "left", LINES[2])):
        _arrow(axes, here, here + 0.85 * direction, colour)
        at = here + 1.02 * direction
        axes.text(at[0], at[1], name, **_MIDDLE, color=colour)
    axes.plot((x, x + 1.0), (y, y), "--", color=INK, linewidth=0.8)
    turn = np.linspace(0, yaw, 20)
    axes.plot(x + 0.62 * np.cos(turn), y + 0.62 * np.sin(turn), color=MARK, linewidth=1.5)
    axes.text(x + 0.68, y + 0.1, r"yaw $\psi$", fontsize=9, color=MARK)
    axes.text(x, -0.06, "x (m)", ha="center", va="top", fontsize=8)
    axes.text(-0.06, y, "y (m)", ha="right", va="center", fontsize=8, rotation=90)


_HULL = ((-1, -1), (0.7, -1), (1.1, 0), (0.7, 1), (-1, 1))
"""Outline of the robot that points ahead, in halves of its length and width."""


def _headings(axes: Axes) -> None:
    axes.set(xlim=(-1.75, 1.75), ylim=(-1.75, 1.75))
    for number, (step, name) in enumerate(zip(STEPS, NAMES, strict=True)):
        direction = step / np.hypot(*step)
        _arrow(axes, 0.12 * direction, 0.95 * direction, LINES[0], width=2.5)
        x, y = 1.32 * direction
        axes.text(x, y, f"{number}\n{name}", **_MIDDLE)


def _cells(axes: Axes) -> None:
    nx, ny = 4, 3
    axes.set(xlim=(-0.75, 4.3), ylim=(-1.1, 3.9))
    marked = (2, 1)
    for ix, iy in np.ndindex(nx, ny):
        face = HERE if (ix, iy) == marked else QUIET
        axes.add_patch(Rectangle((ix, iy), 1, 1, facecolor=face, edgecolor="#8A9097"))
        weight = "bold" if (ix, iy) == marked else "normal"
        axes.text(ix + 0.5, iy + 0.5, f"{ix}, {iy}", **_MIDDLE, weight=weight)
    axes.plot(0, 0, "o", color=MARK)
    axes.text(0, -0.2, "origin\n(m)", ha="center", va="top", fontsize=8, color=MARK)
    _arrow(axes, (0.8, -0.3), (3.9, -0.3))
    axes.text(2.4, -0.45, "ix, along x", ha="center", va="top", fontsize=8.5)
    _arrow(axes, (-0.3, 0.4), (-0.3, 2.9))
    axes.text(-0.4, 1.6, "iy, along y", ha="right", va="center", fontsize=8.5, rotation=90)
    axes.annotate("", (3, 3.2), (2, 3.2), arrowprops={"arrowstyle": "<->", "color": INK})
    axes.text(2.5, 3.3, "resolution (m)", ha="center", va="bottom", fontsize=8.5)


# How a label is made ------------------------------------------------------------------------------


def draw_label_timeline(window: Window = 5) -> Picture:
    """Draw r_v of each step, the windows that labels average, a failure, and the reset after it.

    Steps last from one moment to the next; a label belongs to a moment. The labels are those of
    `feasibility_labels`; r_v is made up: a walk that slows down and fails.
    """
    check_arguments(draw_label_timeline, locals(), ConfigError)
    steps, fails, seen = 26, 14, 3
    t = np.arange(steps)
    r_v = 0.8 + 0.12 * np.sin(0.9 * t) - 0.4 * ((t > fails - 4) & (t <= fails))
    r_v[fails + 1] = 0.35  # it starts again from rest
    ended = (t == fails).astype(float)
    tracking = torch.tensor(np.stack((r_v, ended, ended), axis=-1))[:, None]
    labels, valid = (part[:, 0].numpy() for part in feasibility_labels(tracking, window))
    figure = Picture(7.7, 4.4)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    first, second = (t > 0) & (t <= fails), t > fails
    bars: dict[str, Any] = {"width": -0.92, "align": "edge", "edgecolor": INK}
    above.bar(t[first], r_v[first], color="#9DB8C9", label="r_v of a step", **bars)
    above.bar(t[second], r_v[second], color="white", hatch="//", label="the next episode", **bars)
    _bracket(above, seen, seen + window, seen + window)
    _bracket(above, fails - 2, fails, fails - 2 + window)
    for axes in (above, below):
        axes.axvline(fails, color=MARK, linewidth=2, zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    words = "failed, then reset"
    above.text(fails + 0.2, 1.6, words, fontsize=8.5, color=MARK, va="top")
    above.set(ylabel="r_v", ylim=(0, 1.65), yticks=(0, 0.5, 1))
    above.legend(loc="upper left", ncols=2, **LEGEND)
    below.plot(t[valid], labels[valid], "o", color=LINES[0], label="label of moment t")
    short = t[~valid]
    below.plot(short, 0 * short, "x", color=INK, label="none: too little of its window was seen")
    below.set(xlabel="t, control steps", ylabel="label", ylim=(-0.1, 1.4), yticks=(0, 0.5, 1))
    below.legend(loc="upper left", ncols=2, **LEGEND)
    title = f"A label is the mean r_v of the {window} steps ahead; after a failure they count as 0"
    above.set_title(title, **TITLE, loc="left")
    figure.alt = (
        f"Timeline of r_v over {steps} control steps. A bracket marks the {window} steps ahead of "
        f"moment {seen}, whose mean is its label. The robot fails at moment {fails}: what a window "
        "has beyond that counts as zero, so labels fall before it. No window reaches into the next "
        "episode, and the last moments have no label."
    )
    return figure


def _bracket(axes: Axes, start: int, until: int, end: int) -> None:
    """Mark the window of a label: whole as far as steps were driven, dashed where they count 0."""
    y, foot = 1.1, 1.03
    axes.plot((start, start, until), (foot, y, y), color=LINES[0], linewidth=2)
    axes.plot((until, end), (y, y), "--", color=LINES[0], linewidth=2)
    axes.plot((end, end), (foot, y), color=LINES[0], linewidth=2)
    axes.plot(start, foot, "o", color=LINES[0], markersize=6)
    axes.text(start - 0.3, y - 0.04, f"label of {start}", ha="right", fontsize=8.5)
    if until < end:
        axes.text(until + 0.15, y + 0.05, "count as 0", ha="left", fontsize=8.5)


# What the diagrams share --------------------------------------------------------------------------


def _canvas(figure: Picture, xlim: tuple[float, float], ylim: tuple[float, float]) -> Axes:
    """Return one panel without axes."""
    axes = figure.subplots()
    axes.set(xlim=xlim, ylim=ylim)
    axes.set_axis_off()
    return axes


def _box(
    axes: Axes, centre: tuple[float, float], size: tuple[float, float], *, marked: bool = False
) -> None:
    """Draw a box with round corners; a marked one has a thick border."""
    corner = (centre[0] - size[0] / 2, centre[1] - size[1] / 2)
    edge, width, face = (MARK, 2.2, HERE) if marked else ("#8A9097", 1.0, QUIET)
    shape = "round,pad=0,rounding_size=0.08"
    box = FancyBboxPatch(corner, *size, shape, edgecolor=edge, linewidth=width, facecolor=face)
    axes.add_patch(box)


def _arrow(axes: Axes, tail: Any, head: Any, colour: str = INK, *, width: float = 1.4) -> None:
    """Draw an arrow from point to point."""
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tuple(head), tuple(tail), arrowprops=style)
