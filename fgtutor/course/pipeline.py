"""The planner with the learner's functions in it, a picture for each exercise.

Reads the functions that have passed; draws what they do in the planner, and prints which stages
(`stages`) were hers and which the library's.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from fgtutor.course.measured_pictures import (
    draw_advantages,
    draw_calibration,
    draw_labels,
    draw_length,
    draw_scan,
    draw_stance,
    draw_success,
)
from fgtutor.course.planner_pictures import (
    draw_capstone,
    draw_crossing,
    draw_patch,
    draw_plan,
    draw_tensor,
    draw_weights,
)
from fgtutor.course.substitutes import Stages

TENSORS = (
    "tensorize",
    "cut_patch",
    "FeasibilityNet",
    "reconstruction_loss",
    "ood_weight",
    "conformal_weight",
)
"""From the map to F_i, in the order in which they run."""
ROUTE = (*TENSORS, "fuse", "edge_costs", "cheapest_route")
"""From the map to the route."""
PICTURES: dict[str, tuple[Callable[[Stages], Figure], tuple[str, ...]]] = {
    "ex01": (draw_patch, ("cells_of", "patch_points", "cut_patch", "rise")),
    "ex02": (draw_labels, ("tracking_reward", "labels")),
    "ex03": (
        draw_calibration,
        ("FeasibilityNet", "joint_loss", "rollout_labels", "train", "reliability"),
    ),
    "ex04": (draw_weights, ("reconstruction_loss", "ood_weight", "conformal_weight", *TENSORS)),
    "ex05": (draw_tensor, ("tensorize", "first_layer", "turned", "reassess", "cut_patch")),
    "ex06": (
        draw_plan,
        ("fuse", "edge_costs", "cheapest", "route_cost", "cheapest_switching", *ROUTE),
    ),
    "ex07": (draw_crossing, ("aim_point", "turn_rate", "active_policies", "drive", *ROUTE)),
    "ex08": (draw_stance, ("joint_torques", "gravity_in_body")),
    "ex09": (draw_advantages, ("advantages", "batch_advantages")),
    "ex10": (draw_length, ("path_length", "spl")),
    "ex11": (draw_success, ("success_table", "wilson_interval")),
    "ex12": (draw_scan, ("rasterise", "localisation_std", "cheapest_with_switches")),
    "ex13": (
        draw_capstone,
        ("face_map", *TENSORS, "aim_point", "turn_rate", "active_policies", "drive"),
    ),
}
"""For each exercise its picture, and the functions that show in it."""


def show(
    exercise: str, functions: Mapping[str, Callable[..., Any]], faults: Sequence[str]
) -> Figure | None:
    """Draw what an exercise's functions do in the planner, and print whose each stage was.

    Until one has passed there is nothing to show, and it is said what to do first.
    """
    draw, names = PICTURES[exercise]
    print("\n".join(faults), end="\n" * bool(faults))
    if not set(names) & functions.keys():
        print(
            f"Nothing of this picture is yours yet: write {names[0]}, and run its check. What "
            "passes is kept in mine.py, and runs here."
        )
        return None
    own = Stages(functions, [])
    figure = draw(own)
    print(own.report())
    return figure
