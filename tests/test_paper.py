"""The paper's planner, written to be read, is the oracle of the fast one."""

import networkx
import numpy as np
import pytest

from fgtutor import fuse, load_zoo, make_terrain, paper, plan, tensorize
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap


def lopsided(robot: str) -> ElevationMap:
    """Ground that no turn or mirror image maps onto itself, off the origin, partly unseen."""
    whole = make_terrain("mixed", robot=robot, difficulty=0.4, seed=7).elevation
    first = int(0.3 * whole.shape[0])
    heights = whole.heights[first : first + 34, :26].copy()
    heights[4:9, 3:7] += 0.06
    heights[20:24, 15:18] = np.nan
    return ElevationMap(heights, whole.resolution, (3.7, -12.4))


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "headings"), [("toy", 8), ("a1", 8), ("toy", 16), ("toy", 32)])
def test_tensors_fusion_and_cost_are_the_paper_s(robot, headings):
    M, zoo = lopsided(robot), load_zoo(robot)
    if headings > 8:  # in python's loops a policy takes seconds
        zoo = {name: zoo[name] for name in ("steps", "gaps")}
    slow = [paper.feasibility_tensor(M, one, headings=headings) for one in zoo.values()]
    options = {"taus": "paper", "headings": headings, "unknown": "fill"}
    fast = [tensorize(M, one, **options).numpy() for one in zoo.values()]
    on_map = Headings(headings).steps_within(np.ones(M.shape, dtype=bool))
    for mine, theirs in zip(fast, slow, strict=True):
        np.testing.assert_allclose(mine[on_map], paper.along_steps(theirs)[on_map], atol=1e-5)
    fused, policy_map = fuse(fast)
    start, goal = M.centre_of(1, 1), M.centre_of(32, 24)
    f_min = 1e-6  # so that there is a route wherever the ground is known
    cells, policies, cost = paper.plan(M, zoo, start, goal, f_min=f_min, headings=headings)
    route = plan(fused, policy_map, grid=M, start=start, goal=goal, cost="inverse", f_min=f_min)
    assert route.cost == pytest.approx(cost, rel=1e-4)
    assert cells[0] == (1, 1) and cells[-1] == (32, 24) and len(policies) == len(cells) - 1
    assert set(policies) <= set(zoo) and M.known[tuple(np.transpose(cells))].all()


def test_without_a_way_there_is_none():
    M, zoo = lopsided("toy"), load_zoo("toy")
    with pytest.raises(networkx.NetworkXNoPath):
        paper.plan(M, zoo, M.centre_of(1, 1), M.centre_of(32, 24), f_min=0.999)
