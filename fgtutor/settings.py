"""How to plan: the thresholds, the cost of a step and of a switch, and the hysteresis of the drive.

Gives `PlanSettings()`, which are ours, and `PAPER`, the paper's: every command, table, notebook and
widget starts from one of the two. Source: paper, Secs. III-B, III-C and IV-B.
"""

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal

from annotated_types import Interval

from fgtutor.directions import HeadingCount
from fgtutor.io.validation import Count, NonNegative, Positive, check_fields

Taus = Literal["paper", "calibrated"] | tuple[float, float]
Unknown = Literal["block", "fill"]
Backend = Literal["auto", "networkx", "scipy"]
Cost = Literal["inverse", "length"]
Promise = Annotated[float, Interval(ge=0, lt=1)]

HEADINGS: HeadingCount = 8
"""The number of headings d unless another is asked for."""


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """How to plan. The defaults are ours, by which every table is made; `PAPER` is the paper's."""

    taus: Taus = "calibrated"
    """Thresholds of w_ood: "calibrated" (each specialist's own), "paper", or a pair for all."""
    headings: HeadingCount = HEADINGS
    """d, the number of headings: 8 (the paper's, to the neighbouring cells), 16, 32 or 48."""
    finer_headings: HeadingCount = 48
    """Headings that `plan_on_map` tries where `headings` find no route, or a doubtful one: a bridge
    askew has none along the eight. Not more than `headings`: no others are tried."""
    cost: Cost = "length"
    """Cost of a step: "inverse" is 1 / F (the paper, by which a diagonal step costs no more than a
    straight one and routes zigzag), "length" is that times the step's metres."""
    f_min: Positive = 0.1
    """Steps with a lower F do not exist; above 0."""
    switch_cost: NonNegative = 1.0
    """Cost of changing the policy, in the unit of `cost`; above 0 the policy changes only for a
    step that the old and the new policy can both take. At 0 policies of equal F take turns."""
    hold_steps: Count = 3
    """Hysteresis on the drive: a policy takes over once it has been wanted for this many control
    steps; 1 is none."""
    least_promise: Promise = 0.25
    """What a route has to promise (`Route.promise`); 0: any will do. A way round the worst steps of
    a route that promises less is looked for, else it is refused. On the grounds by which it was
    chosen routes of 0.1 or less failed and nearly all of 0.4 or more arrived."""
    unknown: Unknown = "block"
    """What to do with unknown cells: "block" closes them, "fill" trusts the filled heights."""
    backend: Backend = "auto"
    """Which library searches, "networkx" or "scipy"; both find the same cost. "auto" is scipy,
    which won at every size measured (benchmarks/bench_plan.py)."""

    def __post_init__(self) -> None:
        check_fields(self)

    def __str__(self) -> str:
        taus = self.taus if isinstance(self.taus, str) else "{:g} to {:g}".format(*self.taus)
        more = self.finer_headings > self.headings
        finer = f" ({self.finer_headings} where they find no sure route)" if more else ""
        promise = f", least promise {self.least_promise:g}" if self.least_promise else ""
        return (
            f"tau {taus}, {self.headings} headings{finer}, f_min {self.f_min:g}, cost {self.cost}, "
            f"switch cost {self.switch_cost:g}, hysteresis of {self.hold_steps} steps{promise}"
        )


PAPER = PlanSettings(
    taus="paper",
    headings=8,
    finer_headings=8,
    cost="inverse",
    switch_cost=0.0,
    hold_steps=1,
    least_promise=0.0,
)
"""The paper's own: tau 0.1 and 2.0, 8 headings, cost 1 / F, free switching, no hysteresis; any
route will do."""
SETTINGS = {"ours": PlanSettings(), "paper": PAPER}
"""The two settings that have a name."""


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """`PlanSettings` as options of a command: one of the two by name, and single ones changed."""

    settings: Literal["ours", "paper"] = "ours"
    """How to plan: our settings, or the paper's. The options below change one thing each."""
    taus: Literal["paper", "calibrated"] | None = None
    """Thresholds of w_ood: the paper's 0.1 and 2.0, or each specialist's own."""
    headings: HeadingCount | None = None
    """Headings that a cell can be left along (the paper's 8): more see ways off the axes."""
    finer_headings: HeadingCount | None = None
    """Headings to try where those find no sure route (ours 32, the paper's 8: no others)."""
    cost: Cost | None = None
    """Cost of a step: 1 / F (inverse, the paper's), or that times the step's metres."""
    f_min: Annotated[float, Interval(gt=0, le=1)] | None = None
    """Steps less feasible than this do not exist (0.1 in both)."""
    least_promise: Promise | None = None
    """How likely a route has to be walked to its end (ours 0.25, the paper's 0: any will do)."""
    switch_cost: NonNegative | None = None
    """Cost of changing the policy (ours 1, the paper's 0)."""
    hold_steps: Count | None = None
    """Control steps for which a policy is wanted before it takes over (ours 3, the paper's 1)."""

    @property
    def planning(self) -> PlanSettings:
        """The settings that these options choose."""
        single = {one.name: getattr(self, one.name) for one in fields(PlanOptions)}
        chosen = SETTINGS[single.pop("settings")]
        return replace(chosen, **{name: v for name, v in single.items() if v is not None})
