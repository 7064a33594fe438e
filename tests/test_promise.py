import math
from xml.etree import ElementTree

import numpy as np
import pytest

from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, DoubtfulRouteError
from fgtutor.evaluation.report import reliability_chart
from fgtutor.figures.charts import draw_reliability
from fgtutor.planning import PAPER, plan
from fgtutor.routes import HAZARD, RELIEF, Route
from fgtutor.statistics import auroc, brier


def make_route(feasibility, spacing=0.05):
    """Return a route straight along x with these feasibilities."""
    n = len(feasibility)
    cells = np.stack((np.arange(n + 1), np.zeros(n + 1, dtype=int)), axis=-1)
    return Route(
        cells=cells,
        xy=cells * spacing,
        headings=np.zeros(n, dtype=int),
        policies=np.zeros(n, dtype=int),
        feasibility=np.array(feasibility, dtype=float),
        costs=np.ones(n),
        length=n * spacing,
        names=("steps",),
    )


def test_a_promise_by_hand():
    # Two steps of 0.5 m: each ends exp(HAZARD - RELIEF F) walks per metre.
    low, high = (math.exp(HAZARD - RELIEF * f) for f in (0.1, 0.6))
    route = make_route([0.1, 0.6], spacing=0.5)
    assert route.promise == pytest.approx(math.exp(-0.5 * low - 0.5 * high))
    assert make_route([]).promise == 1.0  # start and goal in one cell


def test_promises_of_parts_multiply_and_cells_do_not_matter():
    first, second = [0.2, 0.3, 0.9], [0.5, 0.05]
    whole = make_route(first + second).promise
    assert whole == pytest.approx(make_route(first).promise * make_route(second).promise)
    coarse, fine = make_route([0.3] * 20, 0.1), make_route([0.3] * 40, 0.05)
    assert coarse.promise == pytest.approx(fine.promise)


def test_a_route_promises_less_the_less_feasible_a_step_is():
    promises = [make_route([0.9] * 100 + [f] * 10).promise for f in (0.0, 0.05, 0.1, 0.3, 0.9)]
    assert promises == sorted(promises) and 0 < promises[0] < promises[-1] < 1


def across_a_strip(gate: bool, **options):
    """Plan over a strip that can hardly be crossed, 0.3 m of F = 0.12; the gate in it is far off.

    The way through the gate is longer and costs more: 4.5 against 4.0.
    """
    tensor, grid = np.ones((40, 41, 8)), ElevationMap(np.zeros((40, 41)), resolution=0.05)
    tensor[17:23, : 38 if gate else 41] = 0.12
    ends = {"start": grid.centre_of(2, 2), "goal": grid.centre_of(37, 2)}
    given = {"grid": grid, "tensors": [tensor], "names": ["steps"]} | ends
    return plan(tensor, np.zeros(tensor.shape, int), **given | options)


@pytest.mark.parametrize("backend", ["networkx", "scipy"])
def test_a_way_round_what_promises_too_little_is_found(backend):
    daring = across_a_strip(True, least_promise=0.0, backend=backend)
    assert daring.cost == pytest.approx(0.3 / 0.12 + 1.45)
    assert daring.promise == pytest.approx(math.exp(-0.3 * math.exp(HAZARD - RELIEF * 0.12)), 1e-4)
    sure = across_a_strip(True, backend=backend)
    assert sure.feasibility.min() == 1 and sure.promise > 0.99
    assert daring.cost < sure.cost == pytest.approx(sure.length)
    assert sure.cells[:, 1].max() >= 38
    # What promises enough is not given up for more.
    assert across_a_strip(True, least_promise=0.2, backend=backend).cost == daring.cost


def test_without_a_way_round_it_is_refused_and_the_worst_step_is_named():
    refusal = across_a_strip(False)
    assert isinstance(refusal.error, DoubtfulRouteError)
    for words in ("1.75 m long, promises 0.23, less than least_promise = 0.25", "with F = 0.12"):
        assert words in refusal.reason
    strip = ElevationMap(np.zeros((40, 41)), resolution=0.05).cell_of(*refusal.nearest)
    assert 17 <= strip[0] < 23 and Headings(8).steps[refusal.heading][0] == 1
    for brave in ({"settings": PAPER}, {"least_promise": 0.2}):
        assert across_a_strip(False, **brave).feasibility.min() == 0.12
    for nonsense in (-0.1, 1.0, math.nan):
        with pytest.raises(ConfigError, match="least_promise"):
            across_a_strip(False, least_promise=nonsense)


def test_auroc_and_brier_by_hand():
    arrived = np.array([True, True, False, False])
    # Of the four pairs of a success and a failure three are in order, one is a tie.
    assert auroc(np.array([0.9, 0.5, 0.5, 0.1]), arrived) == (1 + 1 + 0.5 + 1) / 4
    assert auroc(np.array([0.9, 0.8, 0.2, 0.1]), arrived) == 1.0
    assert auroc(np.ones(4), arrived) == 0.5
    assert auroc(np.ones(2), arrived[:2]) is None
    assert brier(np.array([1.0, 0.5, 0.5, 0.0]), arrived) == (0 + 0.25 + 0.25 + 0) / 4


def row(outcome, **fields):
    return {"terrain": "gaps", "policy": "ours", "outcome": outcome} | fields


def test_a_report_draws_promises_against_arrivals(tmp_path):
    trials = [row("reached", promise=0.95)] * 3 + [
        row("fell", promise=0.95),
        row("fell", promise=0.1),
    ]
    (name,) = charts = reliability_chart([*trials, row("no_route", promise=None)])
    charts[name](tmp_path / name)
    assert name == "reliability.svg"
    ElementTree.parse(tmp_path / name)
    picture = (tmp_path / name).read_text()
    # ((3 * 0.05^2 + 0.95^2 + 0.1^2) / 5; of 3 * 2 pairs three are in order, three are ties.
    assert "Brier score 0.184, AUROC 0.750" in picture


def test_rows_that_say_no_promise_draw_nothing():
    assert reliability_chart([row("reached"), row("no_route", promise=None)]) == {}


def test_the_diagram_shows_each_bin_once_and_how_many_are_in_it():
    promised = np.array([0.0, 0.05, 0.95, 1.0, 1.0])
    figure = draw_reliability(promised, np.array([False, False, True, True, True]))
    axes, counts = figure.axes
    x, y = axes.lines[-1].get_data()
    assert x == pytest.approx([0.025, 2.95 / 3]) and list(y) == [0.0, 1.0]
    heights = [bar.get_height() for bar in counts.patches]
    assert heights == [2, 0, 0, 0, 0, 0, 0, 0, 0, 3]
