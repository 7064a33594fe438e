import math
from xml.etree import ElementTree

import numpy as np
import pytest

from fgtutor.evaluation.report import reliability_chart
from fgtutor.figures.charts import draw_reliability
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
