"""How an `Explorer` looks: the scene of its widget, and a picture for pages without a kernel.

Reads an `Explorer`; gives a `Scene` of M, F_max, P and every policy's w_ood with the route on top
and the spread of its L_recon below, or one figure with loose, paper and strict taus side by side.
Source: the figures' own colours.
"""

import itertools
from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.panels import (
    Chart,
    Panel,
    Point,
    Scene,
    feasibility_picture,
    ground_picture,
    on_picture,
    picture,
    unknown_boxes,
)
from fgtutor.feasibility import TAU_HIGH, TAU_LOW, ood_weight
from fgtutor.figures.maps import BLOCKED, draw_policy_map, draw_route, draw_weight
from fgtutor.figures.style import TITLE, Picture, policy_colours
from fgtutor.tensorization import Assessment

TAU_CHOICES = {
    "loose": (5 * TAU_LOW, 5 * TAU_HIGH),
    "paper": (TAU_LOW, TAU_HIGH),
    "strict": (TAU_LOW / 5, TAU_HIGH / 5),
}
"""The paper's thresholds, five times looser and five times stricter, for `tau_figure`."""
BINS = 48
"""Bars of the spread of L_recon."""
HOME = ("0.5", "0.9", "0.99")
"""Which quantiles of a policy's own ground are shown below them."""
PANELS = (
    Panel(key="M", title="Elevation map M", caption="blue: below the usual ground; brown: above"),
    Panel(key="F", title="F_max, best heading", caption="yellow: feasible; dark: no way out"),
    Panel(
        key="P", title="Policy map P", caption="the policy that would drive; paler: less feasible"
    ),
)


class TauPictures:
    """Turns an explorer into scenes; what never changes is drawn once."""

    def __init__(self, explorer: Explorer) -> None:
        self.explorer = explorer
        self.colours = policy_colours(explorer.names)
        self._ground = ground_picture(explorer.elevation)
        self._palette = np.array([to_rgb(colour) for colour in self.colours.values()])
        self._hatched = unknown_boxes(explorer.elevation)
        losses = [one.reconstruction.numpy() for one in explorer.assessments.values()]
        both = np.quantile(np.stack(losses), (0.002, 0.998))
        self._span = (
            float(np.log10(np.clip(both[0], 1e-3, TAU_LOW / 2))),
            float(np.log10(max(both[1], 2 * TAU_HIGH))),
        )
        self._shares = [self._spread(one) for one in losses]

    def scene(self) -> Scene:
        """Draw the explorer as it stands."""
        explorer = self.explorer
        f_min, known = explorer.settings.f_min, explorer.elevation.known
        best, policy = explorer.best
        # As in `draw_policy_map`: a fifth of the colour where F is 0, all of it where F is 1.
        chosen = 1 - (0.2 + 0.8 * best[..., None]) * (1 - self._palette[policy])
        chosen[best < f_min] = to_rgb(BLOCKED)
        pictures = {
            "M": self._ground,
            "F": feasibility_picture(best, known, f_min),
            "P": picture(chosen, known),
        }
        weights = []
        for colour, (name, weight) in zip(
            self._palette, explorer.plan.weights.items(), strict=True
        ):
            key, drives = f"w {name}", name in explorer.policies
            mean = weight.mean(dim=-1, keepdim=True).numpy()
            shown = colour if drives else np.full(3, 0.6)
            pictures[key] = picture(1 - mean * (1 - shown), known)
            weights.append(
                Panel(
                    key=key,
                    title=f"w_ood of {name}" + ("" if drives else ", taken away"),
                    caption="colour: seen before; white: never" if drives else "may not drive",
                    colour=self.colours[name] if drives else "#999999",
                )
            )
        return Scene(
            rows=(PANELS, weights),
            pictures=pictures,
            lines=self._lines(),
            marks={
                role: self._on_picture([explorer.elevation.cell_of(*point)])[0]
                for role, point in (("start", explorer.start), ("goal", explorer.goal))
            },
            legend=self.colours | {"blocked": BLOCKED},
            status=explorer.status,
            hatched=self._hatched,
            extent=explorer.elevation.extent,
            charts=[
                Chart(
                    title=f"L_recon of {name}",
                    colour=self.colours[name] if name in explorer.policies else "#999999",
                    span=self._span,
                    shares=shares,
                    weights=self._ramp(one),
                    home=_home(one),
                )
                for (name, one), shares in zip(
                    explorer.assessments.items(), self._shares, strict=True
                )
            ],
        )

    def _spread(self, losses: np.ndarray) -> list[float]:
        """Return the share of the known cells' losses in each bin; the outer bins hold the rest."""
        known = np.log10(np.maximum(losses[self.explorer.elevation.known], 1e-12))
        counts = np.histogram(np.clip(known, *self._span), BINS, self._span)[0]
        return (counts / counts.sum()).tolist()

    def _ramp(self, assessment: Assessment) -> list[float]:
        """Return the weight of losses along the span, by the thresholds in force."""
        losses = torch.logspace(*self._span, BINS + 1)
        taus, score = self.explorer.settings.taus, assessment.score
        if taus == "calibrated":
            # What a loss is worth by itself: nothing is strange about the patch besides.
            return score.weight(losses, torch.zeros_like(losses)).tolist()
        return ood_weight(losses, *((TAU_LOW, TAU_HIGH) if taus == "paper" else taus)).tolist()

    def _on_picture(self, cells: object) -> list[Point]:
        return on_picture(np.asarray(cells), self.explorer.elevation.shape[1])

    def _lines(self) -> list[tuple[str, list[Point]]]:
        """Cut the route where the policy changes: one polyline per stretch, in its colour."""
        route = self.explorer.route
        if route is None or not len(route.policies):
            return []
        points, policies = self._on_picture(route.cells), route.policies
        cuts = [0, *(np.flatnonzero(np.diff(policies)) + 1).tolist(), len(policies)]
        return [
            (self.colours[route.names[policies[a]]], points[a : b + 1])
            for a, b in itertools.pairwise(cuts)
        ]


def _home(assessment: Assessment) -> list[float]:
    """Return log10 of the losses that a policy's own ground has, where it was calibrated."""
    specialist = assessment.specialist
    known = specialist.quantiles if specialist else {}
    return [float(np.log10(known[level])) for level in HOME if level in known]


def tau_figure(
    explorer: Explorer, taus: Mapping[str, tuple[float, float]] = TAU_CHOICES
) -> Picture:
    """Draw what each choice of taus makes of the map, side by side: a page without sliders.

    The upper row shows the largest w_ood of all policies. The explorer is left as it was. Raises
    `ThresholdError` for taus that are not tau_low < tau_high.
    """
    before, elevation = explorer.settings.taus, explorer.elevation
    aspect = elevation.size[1] / elevation.size[0]
    figure = Picture(4.2 * len(taus), 2 * (3.6 * aspect + 1.0) + 0.6)
    try:
        for (above, below), (name, (low, high)) in zip(
            figure.subplots(2, len(taus), squeeze=False).T, taus.items(), strict=True
        ):
            explorer.update(taus=(low, high))
            draw_weight(
                torch.stack([*explorer.plan.weights.values()]).amax(dim=0), elevation, axes=above
            )
            above.set_title(f"{name}: tau {low:g} to {high:g}", **TITLE, loc="left")
            above.set_xlabel("dark: some policy has seen such ground", fontsize=9)
            draw_policy_map(
                explorer.plan.policy_map,
                explorer.plan.fused,
                elevation,
                explorer.names,
                f_min=explorer.settings.f_min,
                axes=below,
                bare=True,
            )
            said = "no route: not enough ground is known"
            if explorer.route is not None:
                draw_route(explorer.route, elevation, axes=below, bare=True)
                said = explorer.status.split(": ", 1)[1].split(" (")[0]
            below.set_title("P and the route", **TITLE, loc="left")
            below.set_xlabel(f"x (m)\n{said}", fontsize=9)
    finally:
        explorer.update(taus=before)
    colours = policy_colours(explorer.names) | {"blocked": BLOCKED}
    figure.legend(
        handles=[Patch(color=colour, label=name) for name, colour in colours.items()],
        loc="outside lower center",
        ncols=len(colours),
        frameon=False,
        fontsize=9,
    )
    return figure
