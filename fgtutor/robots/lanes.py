"""Where crossings begin and end on every tile of a world, and where their way lies between.

Reads a `World`; gives tables that a batch of robots looks up by its tiles. A terrain says all this
of itself (`Terrain.lane`, `spread`, `limits`, `span`); here it is laid out for thousands at once.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fgtutor.world.terrain import World

SPACING = 0.1
"""Distance between the points at which a lane is tabulated, m."""


class Lanes:
    """Tables over the tiles (rows, columns) of a world; positions from a tile's corner, m."""

    spreads: Float[Tensor, "rows columns"]
    """How far to either side of its lane the obstacle may be crossed."""
    limits: Float[Tensor, "rows columns 2"]
    """The x between which the tile is its own; beyond them a neighbour's obstacle begins."""
    ends: Float[Tensor, "rows columns 2"]
    """The x of start and goal, where a crossing that way begins at the earliest."""
    near: Float[Tensor, "rows columns 2"]
    """The x where one begins at the latest: `run_up` before the obstacle, if that is later."""

    def __init__(self, world: World, run_up: float, device: str) -> None:
        """Lay out the lanes of `world`; crossings begin at least `run_up` before an obstacle, m."""
        tiles, length = world.tiles, world.tiles[0][0].elevation.size[0]
        x = np.arange(0.0, length + SPACING, SPACING)
        lanes = [[np.interp(x, *np.array(sorted(t.lane)).T) for t in row] for row in tiles]
        spreads = [[tile.spread for tile in row] for row in tiles]
        limits = [[tile.limits or (0.0, length) for tile in row] for row in tiles]
        ends = np.array([[(tile.start[0], tile.goal[0]) for tile in row] for row in tiles])
        near = np.array([[tile.span for tile in row] for row in tiles])
        near = near + run_up * np.array([-1.0, 1.0])
        near = np.clip(near, ends.min(-1, keepdims=True), ends.max(-1, keepdims=True))
        self.lanes, self.spreads, self.limits, self.ends, self.near = (
            torch.as_tensor(np.array(table), dtype=torch.float32, device=device)
            for table in (lanes, spreads, limits, ends, near)
        )

    def at(
        self, row: Int[Tensor, "n"], column: Int[Tensor, "n"], x: Float[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Return the y of each tile's lane at x."""
        along = (x / SPACING).round().long()
        return self.lanes[row, column, along.clamp(0, self.lanes.shape[-1] - 1)]
