"""Charts of what is learned and measured: curves, losses, labels, rates and tables.

Reads numbers by name; gives pictures. A policy has its own colour here as everywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from torch import Tensor

from fgtutor.errors import ConfigError
from fgtutor.feasibility import ood_weight
from fgtutor.figures.canvas import POLICY_COLOURS, TITLE, Picture
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.statistics import wilson_interval
from fgtutor.world.terrain import Terrain

if TYPE_CHECKING:
    from fgtutor.execution import Episode

LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of curves that belong to no policy, in turn."""
INK = "#1E2328"


def colours_of(names: Iterable[str]) -> list[str]:
    """Return for each name the policy's own colour, or the next of the curves' colours."""
    return [POLICY_COLOURS.get(n, LINES[i % len(LINES)]) for i, n in enumerate(names)]


def draw_curves(
    x: ArrayLike,
    curves: Mapping[str, ArrayLike],
    *,
    title: str,
    xlabel: str,
    ylabel: str,
    log: bool = False,
    axes: Axes | None = None,
) -> Figure:
    """Draw a few curves over one x; a policy's curve has the policy's colour."""
    axes = axes or Picture(7.0, 2.9).subplots()
    for (name, y), colour in zip(curves.items(), colours_of(curves), strict=True):
        axes.plot(np.asarray(x), np.asarray(y), color=colour, label=name)
    axes.set(xlabel=xlabel, ylabel=ylabel, yscale="log" if log else "linear")
    axes.grid(alpha=0.25)
    if len(curves) > 1:
        axes.legend(frameon=False, fontsize=9)
    axes.set_title(title, **TITLE, loc="left")
    return cast(Figure, axes.get_figure(root=True))


def draw_losses(
    losses: Mapping[str, ArrayLike], taus: Mapping[str, tuple[float, float]]
) -> Picture:
    """Draw how L_recon is spread on each terrain and, below, the w_ood that taus make of it."""
    figure = Picture(7.0, 4.6)
    spread, ramp = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    arrays = {name: np.ravel(np.asarray(values)) for name, values in losses.items()}
    everything = np.concatenate(list(arrays.values()))
    low, high = np.log10(np.quantile(everything, (0.001, 0.999)))
    bins = np.logspace(low, high, 60)
    for (name, values), colour in zip(arrays.items(), colours_of(arrays), strict=True):
        share = np.histogram(values, bins)[0] / len(values)
        spread.stairs(share, bins, color=colour, fill=True, alpha=0.25)
        spread.stairs(share, bins, color=colour, linewidth=1.6, label=name)
    spread.set(xscale="log", ylabel="share of patches")
    spread.legend(frameon=False, fontsize=9)
    spread.set_title("The further right, the less the patches look like home", **TITLE, loc="left")
    x = np.logspace(low, high, 200)
    for (name, (tau_low, tau_high)), dashes in zip(taus.items(), ("-", "--", ":"), strict=False):
        label = f"{name}: {tau_low:.2f} to {tau_high:.2f}"
        ramp.plot(x, ood_weight(x, tau_low, tau_high), dashes, color=INK, label=label)
    ramp.set(xlabel="L_recon, summed over the patch", ylabel="w_ood", ylim=(-0.05, 1.05))
    ramp.legend(frameon=False, fontsize=9)
    return figure


def draw_rates(counts: Mapping[str, tuple[int, int]], *, title: str) -> Picture:
    """Draw success rates (successes, trials) with their 95 % Wilson intervals."""
    figure = Picture(7.0, 0.9 + 0.42 * len(counts))
    axes = figure.subplots()
    for place, ((name, (successes, trials)), colour) in enumerate(
        zip(counts.items(), colours_of(counts), strict=True)
    ):
        low, high = wilson_interval(successes, trials)
        axes.barh(place, successes / trials, color=colour, alpha=0.55, height=0.6)
        axes.plot((low, high), (place, place), color=INK, linewidth=2)
        axes.text(1.02, place, f"{successes} of {trials}", va="center", fontsize=9)
        axes.text(-0.01, place, name, va="center", ha="right", fontsize=9)
    axes.set(
        xlim=(0, 1), yticks=(), xlabel="share that reached the goal; the line is the 95 % interval"
    )
    axes.invert_yaxis()
    axes.set_title(title, **TITLE, loc="left")
    return figure


def draw_table(
    values: ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    title: str,
    caption: str,
    texts: Sequence[Sequence[object]] | None = None,
) -> Picture:
    """Draw a table of numbers from 0 to 1, the higher the fuller the colour."""
    array = np.asarray(values, dtype=float)
    wide = max(1.8 + 0.85 * len(columns), 0.1 * len(title))  # room for the title
    figure = Picture(wide, 1.3 + 0.42 * len(rows))
    axes = figure.subplots()
    axes.imshow(array, cmap="Blues", vmin=0, vmax=1.25, aspect="auto")
    for (row, column), value in np.ndenumerate(array):
        text = str(texts[row][column]) if texts else f"{value:.2f}"
        ink = "white" if value > 0.65 else INK
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color=ink)
    axes.set_xticks(range(len(columns)), columns, fontsize=9)
    axes.set_yticks(range(len(rows)), rows, fontsize=9)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(caption, fontsize=9)
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def draw_tracking(episode: Episode, terrain: Terrain, speed: float, r_v: ArrayLike) -> Picture:
    """Draw along the way: the ground, the speed beside the commanded one, and r_v of each step."""
    figure = Picture(7.0, 5.0)
    ground, pace, reward = figure.subplots(3, 1, sharex=True, height_ratios=(1, 1.4, 1))
    x, y = episode.poses[:, 0], episode.poses[:, 1]
    at = np.linspace(x.min() - 0.3, x.max() + 0.3, 600)
    heights = terrain.elevation.filled().height_at(at, np.full_like(at, np.median(y)))
    ground.fill_between(at, heights, heights.min() - 0.1, color="#B7A68A")
    ground.set(ylabel="ground (m)")
    ground.set_title("Where it drives ...", **TITLE, loc="left")
    velocity = np.gradient(x, episode.seconds / len(x))
    pace.plot(x, velocity, color=LINES[0], label="speed")
    pace.axhline(speed, color=INK, linestyle="--", label="command")
    pace.legend(frameon=False, fontsize=9)
    pace.set(ylabel="speed (m/s)")
    pace.set_title("... how fast, ...", **TITLE, loc="left")
    reward.fill_between(x, np.asarray(r_v), color=LINES[2], alpha=0.5)
    reward.set(xlabel="x (m)", ylabel="r_v", ylim=(0, 1.02))
    reward.set_title("... and what that earns", **TITLE, loc="left")
    return figure


def draw_labels(
    tracking: Float[Tensor, "time 3"],
    labels: Float[Tensor, " time"],
    valid: Bool[Tensor, " time"],
    dt: Positive,
) -> Picture:
    """Draw one robot's r_v over time and the labels made of it; grey where there is no label."""
    figure = Picture(7.0, 3.2)
    axes = figure.subplots()
    check_arguments(draw_labels, locals(), ConfigError)
    t = np.arange(len(labels)) * dt
    r_v, failed, ended = np.asarray(tracking).T
    usable = np.asarray(valid)
    axes.fill_between(t, r_v, color="#9DB8C9", label="r_v of each step")
    axes.plot(t, np.where(usable, labels, np.nan), color=LINES[1], label="label: mean r_v ahead")
    axes.fill_between(t, 1.02, where=~usable, color="#DDDDDD", label="no label")
    for moment in t[(ended > 0) & (failed == 0)]:
        axes.axvline(moment, color=INK, linestyle=":")
    for moment in t[failed > 0]:
        axes.axvline(moment, color=INK)
        axes.text(moment, 1.04, "failed", ha="center", fontsize=9)
    axes.set(xlabel="time (s)", ylabel="r_v", ylim=(0, 1.02), xlim=(0, t[-1]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3, frameon=False, fontsize=9)
    axes.set_title("A label looks ahead", **TITLE, loc="left", y=1.08)
    return figure
