"""The corridor that holds the best route when changing the policy has a cost: a search made small.

Reads the F_i of some policies, start and goal; says which steps of the map the cheapest route can
still use. Source: ours. `planning.Planner` searches (cell, policy) states, 16 edges a step for four
policies, too many for a slider; but a route with free switching bounds what a step can be good for:

    cost of any route over a step  >=  cheapest way to it + 1 / F_max + cheapest way on to the goal

A step whose right side exceeds the cost of some route that exists cannot be on the cheapest one.
That route is the free one, driven with the best policies for it once a switch has a cost. What is
left is exact: the `Planner` finds the same cost in it as in the whole map (a test).
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csgraph, csr_array

from fgtutor import directions

Cell = tuple[int, int]


class Corridor:
    """The steps of one map, laid out once for both directions of search."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """List every step that stays on a map of `shape` cells."""
        self.shape = shape
        count = shape[0] * shape[1]
        cells = np.stack(np.unravel_index(np.arange(count), shape), axis=-1)
        ends = cells[:, None] + directions.STEPS
        stays = ((ends >= 0) & (ends < shape)).all(axis=-1)
        self._steps = np.flatnonzero(stays)
        self._tails = (self._steps // directions.NUM_HEADINGS).astype(np.int32)
        self._heads = np.ravel_multi_index(tuple(ends[stays].T), shape).astype(np.int32)
        # Rows of a CSR matrix are where a search leaves from: sorted by tail, then by head.
        self._forth = np.concatenate(([0], np.bincount(self._tails, minlength=count).cumsum()))
        self._order = np.argsort(self._heads, kind="stable")
        self._back = np.concatenate(([0], np.bincount(self._heads, minlength=count).cumsum()))

    def promising(
        self,
        tensors: Float[np.ndarray, "policies nx ny 8"],
        fused: Float[np.ndarray, "nx ny 8"],
        start: Cell,
        goal: Cell,
        *,
        f_min: float,
        switch_cost: float,
    ) -> Bool[np.ndarray, "nx ny 8"] | None:
        """Return the steps that the cheapest route can use; None if no bound is known.

        `fused` is the largest of `tensors`; a closed step is 0 in all of them.
        """
        first, last = (int(np.ravel_multi_index(cell, self.shape)) for cell in (start, goal))
        f = fused.reshape(-1)[self._steps].astype(np.float64)
        # An edge of infinite cost is never taken, and keeps the layout the same for every F.
        cost = np.full(len(f), np.inf)
        np.divide(1.0, f, out=cost, where=f >= f_min)
        size = (len(self._forth) - 1,) * 2
        forth = csr_array((cost, self._heads, self._forth), shape=size)
        back = csr_array((cost[self._order], self._tails[self._order], self._back), shape=size)
        to_goal, following = csgraph.dijkstra(back, indices=last, return_predecessors=True)
        if not math.isfinite(to_goal[first]):
            return None
        path = [first]
        while path[-1] != last:
            path.append(int(following[path[-1]]))
        bound = self._cost_along(np.array(path), tensors, f_min, switch_cost)
        if not math.isfinite(bound):
            return None
        from_start = csgraph.dijkstra(forth, indices=first)
        least = from_start[self._tails] + cost + to_goal[self._heads]
        keep = np.zeros(fused.size, dtype=bool)
        # Sums in another order differ in the last digits: nothing may be lost to that.
        keep[self._steps] = least <= bound * (1 + 1e-9)
        return keep.reshape(fused.shape)

    def _cost_along(
        self,
        path: Int[np.ndarray, " cells"],
        tensors: Float[np.ndarray, "policies nx ny 8"],
        f_min: float,
        switch_cost: float,
    ) -> float:
        """Return the least cost of driving along `path`; infinite if policies cannot hand over."""
        ix, iy = np.unravel_index(path, self.shape)
        steps = np.diff(np.stack((ix, iy), axis=-1), axis=0)
        headings = (steps[:, None] == directions.STEPS).all(axis=-1).argmax(axis=-1)
        best = np.zeros(len(tensors))
        for f in tensors[:, ix[:-1], iy[:-1], headings].T.astype(np.float64):
            able = f >= f_min  # both the old and the new policy must be able to take the step
            if not able.any():
                return math.inf
            step = np.full(len(f), np.inf)
            np.divide(1.0, f, out=step, where=able)
            best = step + np.minimum(best, best[able].min() + switch_cost)
        return float(best.min())
