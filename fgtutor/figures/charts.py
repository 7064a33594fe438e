"""Charts of what is learned and measured: curves, losses, labels, rates and tables.

Reads numbers by name; gives pictures. A policy has its own colour here as everywhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike
from torch import Tensor

from fgtutor.errors import ConfigError
from fgtutor.feasibility import ood_weight
from fgtutor.figures.style import DASHES, INK, LINES, TITLE, Picture, colours_of
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.statistics import Share, auroc, brier
from fgtutor.world.terrain import Terrain

if TYPE_CHECKING:
    from fgtutor.execution import Episode


def draw_curves(
    x: ArrayLike,
    curves: Mapping[str, ArrayLike],
    *,
    title: str,
    xlabel: str,
    ylabel: str,
    log: bool = False,
    log_x: bool = False,
    steps: bool = False,
    axes: Axes | None = None,
) -> Figure:
    """Draw a few curves over one x; a policy's curve has the policy's colour.

    `log` and `log_x` make the axis of y or x logarithmic; `steps` joins the points by steps, for
    what jumps.
    """
    axes = axes or Picture(7.2, 3.0).subplots()
    style: dict[str, Any] = {"drawstyle": "steps-mid"} if steps else {}
    looks = zip(colours_of(curves), itertools.cycle(DASHES), strict=False)
    for (name, y), (colour, dash) in zip(curves.items(), looks, strict=True):
        axes.plot(np.asarray(x), np.asarray(y), color=colour, linestyle=dash, label=name, **style)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.set(xscale="log" if log_x else "linear", yscale="log" if log else "linear")
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
    looks = zip(colours_of(arrays), itertools.cycle(DASHES), strict=False)
    for (name, values), (colour, dash) in zip(arrays.items(), looks, strict=True):
        share = np.histogram(values, bins)[0] / len(values)
        spread.stairs(share, bins, color=colour, fill=True, alpha=0.25)
        spread.stairs(share, bins, color=colour, linewidth=1.6, linestyle=dash, label=name)
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
    """Draw success rates (successes, trials) with their 95 % intervals."""
    shares = {name: Share(successes=won, trials=n) for name, (won, n) in counts.items()}
    return draw_shares({"": shares}, title=title)


def draw_shares(groups: Mapping[str, Mapping[str, Share]], *, title: str) -> Picture:
    """Draw groups of success rates with their 95 % intervals, each group under its heading."""
    rows = [len(shares) for shares in groups.values()]
    figure = Picture(7.0, 1.0 + 0.3 * sum(rows) + 0.3 * len(rows))
    panels = figure.subplots(len(rows), sharex=True, squeeze=False, height_ratios=rows)[:, 0]
    for axes, (group, shares) in zip(panels, groups.items(), strict=True):
        places = range(len(shares))
        low, high = zip(*(share.interval for share in shares.values()), strict=True)
        rates = [share.successes / share.trials for share in shares.values()]
        axes.barh(places, rates, color=colours_of(shares), alpha=0.55, height=0.6)
        axes.hlines(places, low, high, color=INK, linewidth=2)
        for place, share in zip(places, shares.values(), strict=True):
            label = f"{share.successes} of {share.trials}"
            axes.text(1.02, place, label, va="center", fontsize=9)
        axes.set_yticks(places, shares, fontsize=9)
        axes.tick_params(axis="y", length=0)
        axes.set(xlim=(0, 1))
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.invert_yaxis()
        axes.set_title(group, fontsize=9.5, loc="left")
    panels[-1].set_xlabel("share that reached the goal; the line is the 95 % interval")
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def draw_reliability(
    promised: Float[np.ndarray, " trials"], arrived: Bool[np.ndarray, " trials"], *, bins: int = 10
) -> Picture:
    """Draw how many of the routes that promised as much arrived, in equal bins of the promise."""
    figure = Picture(5.0, 6.2)
    axes, counts = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    index = np.clip((promised * bins).astype(int), 0, bins - 1)
    edges, used = np.linspace(0, 1, bins + 1), np.unique(index)
    shares = [Share.of(arrived[index == one]) for one in used]
    means = [promised[index == one].mean() for one in used]
    low, high = zip(*(share.interval for share in shares), strict=True)
    axes.plot((0, 1), (0, 1), "--", color="grey", label="perfect: what is promised comes true")
    axes.vlines(means, low, high, color=INK, linewidth=2, label="95 % interval")
    rates = [share.successes / share.trials for share in shares]
    axes.plot(means, rates, "o", color=LINES[0], label="these routes")
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), ylabel="share that arrived")
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    rank = auroc(promised, arrived)
    words = f"Brier score {brier(promised, arrived):.3f}"
    words += f", AUROC {rank:.3f}" if rank is not None else ", none failed or all did"
    axes.set_title(words, **TITLE, loc="left")
    counts.bar(
        edges[:-1],
        np.bincount(index, minlength=bins),
        np.diff(edges),
        align="edge",
        color="#9DB8C9",
        edgecolor="white",
    )
    counts.set(xlabel="what the route promised", ylabel="trials")
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


def training_curve(rows: Sequence[Mapping[str, float]]) -> Picture:
    """Draw what training reported (`on_iteration`, or a specialist's provenance["curve"])."""
    if not rows:
        raise ConfigError("training_curve needs at least one row: let the training run longer")
    figure = Picture(7.0, 6.5)
    tracking, level, loss = figure.subplots(3, 1, sharex=True)
    samples = np.array([row["samples"] for row in rows])
    mark = "." if len(rows) < 3 else ""
    for axes, key, label, colour, dash in (
        (tracking, "r_v", "tracking reward r_v", LINES[0], "-"),
        (tracking, "failed", "share of episodes that fail", LINES[1], "--"),
        (level, "row", "mean difficulty row", LINES[2], "-"),
        (loss, "feasibility_feasibility", "(f - r_v)²", LINES[0], "-"),
        (loss, "feasibility_reconstruction", "L_recon", LINES[1], "--"),
    ):
        if all(key in row for row in rows):
            values = [row[key] for row in rows]
            axes.plot(samples, values, marker=mark, linestyle=dash, color=colour, label=label)
            axes.legend(loc="best", fontsize=8, frameon=False)
        axes.grid(alpha=0.25)
    tracking.set(ylim=(0, 1.02))
    tracking.set_title("The policy learns to track its command ...", **TITLE, loc="left")
    level.set(ylim=(0, None))
    level.set_title("... on ever harder ground ...", **TITLE, loc="left")
    loss.set(yscale="log", xlabel="samples")
    loss.set_title("... and its Feasibility-Net learns from the same data", **TITLE, loc="left")
    return figure


def calibration_plot(table: Float[np.ndarray, "bins 3"], error: float) -> Picture:
    """Draw predicted against measured feasibility, from `statistics.calibration`."""
    figure = Picture(5.0, 6.2)
    axes, counts = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    predicted, measured, count = np.asarray(table, dtype=float).T
    filled = count > 0
    axes.plot((0, 1), (0, 1), "--", color="grey", label="perfect: what is promised comes true")
    axes.plot(predicted[filled], measured[filled], "o-", color="#0072B2", label="this network")
    axes.vlines(predicted[filled], predicted[filled], measured[filled], color="#D55E00", alpha=0.6)
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="measured r_v")
    axes.legend(loc="upper left", frameon=False, fontsize=9)
    axes.set_title(f"Calibration: off by {error:.3f} on average", **TITLE, loc="left")
    edges = np.linspace(0, 1, len(count) + 1)
    counts.bar(edges[:-1], count, np.diff(edges), align="edge", color="#9DB8C9", edgecolor="white")
    counts.set(xlabel="predicted feasibility f", ylabel="patches")
    return figure
