"""Routes made by hand or read from JSON: what cannot be a route is refused, whatever is wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fgtutor.errors import PlanningError
from fgtutor.routes import Route


@pytest.fixture
def route() -> Route:
    """Two steps along +x and one along +x+y; the second policy takes the last one."""
    cells = np.array([(0, 0), (1, 0), (2, 0), (3, 1)])
    return Route(
        cells=cells,
        xy=0.1 * cells,
        headings=np.array([0, 0, 1]),
        policies=np.array([0, 0, 1]),
        feasibility=np.array([0.5, 1.0, 0.25]),
        costs=np.array([2.0, 1.0, 4.0]),
        length=0.341,
        names=("steps", "gaps"),
        choices=np.full((3, 2), 0.25),
        ood=np.ones((3, 2)),
    )


def test_a_route_comes_back_from_json(route):
    for one in (route, replace(route, choices=None, ood=None)):
        again = Route.from_json(json.loads(json.dumps(one.to_json())))
        assert repr(again) == repr(one) and again.explain() == one.explain()
        assert again.to_json() == one.to_json() and again.headings.dtype.kind == "i"


def test_a_route_of_one_cell_comes_back(route):
    none = np.zeros(0)
    one = replace(
        route, cells=route.cells[:1], xy=route.xy[:1], headings=none.astype(int), length=0.0,
        policies=none.astype(int), feasibility=none, costs=none,
        choices=np.zeros((0, 2)), ood=np.zeros((0, 2)),
    )  # fmt: skip
    again = Route.from_json(json.loads(json.dumps(one.to_json())))
    assert again.explain() == [] and again.choices is not None and again.choices.shape == (0, 2)
    assert "one cell (0, 0)" in repr(again)


VALUES = [
    None,
    -1,
    2,
    0.5,
    1e999,
    10**30,
    10**400,
    True,
    "x",
    [],
    {},
    [[]],
    [None],
    [1, 2],
    [[1, 2]],
]


@pytest.mark.parametrize("key", [
    "cells", "xy", "headings", "policies", "feasibility", "costs", "length", "names", "choices",
    "ood", "cost", "switches", "more",
])  # fmt: skip
def test_a_key_of_another_kind_is_refused_or_means_the_same(route, key):
    data = route.to_json()
    for value in VALUES:
        try:
            again = Route.from_json(data | {key: value})
        except PlanningError as error:
            assert "not a route" in str(error) and len(str(error)) < 400
            continue
        assert key in ("choices", "ood", "length", "cost", "switches")
        assert repr(again) and len(again.explain()) == 3
    with pytest.raises(PlanningError, match="not a route"):
        Route.from_json({k: v for k, v in data.items() if k != key} if key in data else [])  # type: ignore


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("cells", 1, 0), 10**30, "cells"),
        (("cells", 1, 0), 1.0, "cells"),
        (("cells", 1, 0), -1, "cells"),
        (("cells", 1, 0), 5, "where the heading leads"),
        (("headings", 0), 8, "headings should be numbers from 0 to 7"),
        (("headings", 0), 4, "where the heading leads"),
        (("headings", 0), -8, "headings"),
        (("policies", 0), 2, "policies should be numbers from 0 to 1"),
        (("policies", 0), 0.5, "policies"),
        (("xy", 0, 0), float("nan"), "finite"),
        (("feasibility", 0), float("inf"), "finite"),
        (("costs", 0), -1.0, "costs"),
        (("costs", 0), 1e308, "costs should hold finite numbers"),
        (("xy", 0, 0), -1e308, "xy should hold finite numbers"),
        (("costs", 0), "2", "costs"),
        (("names", 0), 3, "names"),
        (("names", 0), "gaps", "name of its own"),
        (("names", 0), "a\x1b[2J", "printable"),
        (("choices", 0), [1.0], "not a route"),
        (("choices", 0), [1.0, [2.0]], "choices"),
    ],
)
def test_one_wrong_number_is_named(route, place, value, says):
    data = json.loads(json.dumps(route.to_json()))
    *way, last = place
    parent = data
    for key in way:
        parent = parent[key]
    parent[last] = value
    with pytest.raises(PlanningError, match=says) as caught:
        Route.from_json(data)
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("cells", np.zeros((0, 2), dtype=int)),
        ("cells", [(0, 0), (1, 0), (2, 0), (3, 1)]),
        ("cells", np.zeros((4, 2))),
        ("policies", np.array([0, 0, 2])),
        ("policies", np.array([0, 0, 0.5])),
        ("policies", np.array([0, 0, -1])),
        ("headings", np.array([0, 0])),
        ("headings", np.array([0, 0, 9])),
        ("feasibility", np.array([0.5, np.nan, 1])),
        ("costs", np.array([1j, 1, 1])),
        ("length", float("nan")),
        ("names", ()),
        ("names", ("a", "a")),
        ("names", ("a", 3)),
        ("choices", np.ones((3, 3))),
    ],
)
def test_a_route_by_hand_is_checked_too(route, field, value):
    with pytest.raises(PlanningError):
        replace(route, **{field: value})


def test_a_route_that_costs_nothing_explains_itself(route):
    assert [step["share"] for step in replace(route, costs=np.zeros(3)).explain()] == [0, 0, 0]
