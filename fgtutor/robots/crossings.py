"""Training episodes: where they begin, which way each robot is told to go, and on how hard a tile.

Reads the tiles of a `World` and the robots' poses; gives start poses, wanted headings, and which
robots have left their way. Most episodes cross a tile's obstacle along its lane, as a route does;
the others go straight on from anywhere. Tiles get harder with success, row by row, as in Rudin et
al., CoRL 2021. Routes are steered by the same rules (`execution`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Interval
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor

from fgtutor.io.validation import Ascending, NonNegative, Share, Unbounded, check_fields
from fgtutor.patches import PatchGrid
from fgtutor.robots.steering import LOOKAHEAD, bearing, off_by, turn_rate
from fgtutor.world.terrain import Terrain, World

Speed = Annotated[float, Interval(ge=0, le=20)]
"""A speed, m/s."""
Time = Annotated[float, Interval(gt=0, le=3600)]
"""A part of an episode, s."""
UNTRIED = 1 / 3
"""How far back the labels become 0 before a robot enters another tile's obstacle, as a share of
their window. Over the whole window, no policy would be feasible where one must hand over to the
next; over none, an obstacle that was never tried would look feasible."""
LANE_STEP = 0.1
"""Distance between the points at which a lane is tabulated, m."""
SLIGHT = 0.15
"""Greatest angle by which an episode that is no crossing begins askew, rad."""
TRIES = 8
"""Places of which the most level one is where such an episode begins."""


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """How episodes are drawn and ended; the robot's own numbers live beside the robot."""

    speed: Annotated[tuple[Speed, Speed], Ascending] = (0.7, 1.0)
    """Range of the commanded forward speed, m/s."""
    max_turn_rate: Annotated[float, Interval(gt=0, le=20)] = 1.5
    """Limit of the commanded turn rate, rad/s."""
    episode_seconds: Time = 8.0
    """Time limit of an episode, s."""
    stuck_seconds: Unbounded = 2.0
    """An episode without `stuck_progress` for this long has failed, s; waiting must not pay."""
    stuck_progress: NonNegative = 0.05
    """Progress that counts as moving, m."""
    stray: Unbounded = 1.0
    """In training a robot this far beside its line has failed, m, and so has one that heads more
    than 45 degrees off the heading that it was told."""
    slowest: Share = 1.0
    """Least share of its speed at which a robot turns; 1: it never slows down to turn."""
    obedience: Annotated[float, Interval(gt=0, le=1)] = 1.0
    """Share of the greatest turn rate at which a robot is expected to follow a new heading."""
    start_yaw: Annotated[float, Interval(ge=0, le=math.pi)] = 0.15
    """Greatest angle at which a crossing comes to its lane, rad; routes do at 45 or 90 degrees."""
    start_beside: NonNegative = 0.3
    """Greatest distance beside the corridor over the obstacle at which a crossing begins, m."""
    run_up: Annotated[float, Ge(0), Field(allow_inf_nan=True)] = math.inf
    """Least distance before the obstacle at which a crossing begins, m, since a route may bend as
    late; infinite: all begin at the tile's end."""
    traverse_share: Share = 0.6
    """Share of episodes that start before the obstacle and cross it; others start anywhere."""
    turn_share: Share = 0.25
    """Share of episodes whose heading changes on the way, as a route's does."""
    promote_above: Share = 0.5
    """Mean r_v of an unfailed episode from which its robot moves to a harder row."""
    demote_below: Share = 0.3
    """Mean r_v of a crossing below which its robot moves to an easier row; so does a failure in the
    tile's first half."""
    oblique: bool = False
    """Whether episodes that are no crossing go on at any heading, not only at one of 8."""
    train: bool = True
    """Draw new episodes when one ends; False leaves finished robots where they are."""
    history: Annotated[int, Interval(ge=0, le=100)] = 0
    """Frames that a policy which estimates remembers; with any, there are more groups, see
    `LocomotionEnv`."""

    def __post_init__(self) -> None:
        check_fields(self)


class Crossings:
    """The way that each robot of a batch is to go, and the tile that it goes on.

    A terrain says where its way lies (`Terrain.lane`, `spread`, `limits`, `span`); tables hold it
    for all tiles (rows, columns) at once, as distances from the tile's corner, m. In training a way
    may lead anywhere: its tables are those of the tile turned about its centre until it leads along
    x (`turn`).

    Attributes:
        row, column: Each robot's tile; the row is its difficulty.
        yaws: Direction in which the way of each tile leads, rad.
        crossing: Whether it is to cross the tile's obstacle; if not, it goes straight on.
        aside: How far to the left of the lane its crossing leads, m.
        target_yaw, anchor: The heading and a point (x, y) of its straight line otherwise.
        told_yaw: The heading it should have by now, which follows a new one at a limited rate.
    """

    def __init__(
        self,
        world: World,
        num_envs: int,
        config: EnvConfig,
        *,
        grid: PatchGrid,
        look: Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch points"]],
        uniform: Callable[..., Tensor],
        device: str,
    ) -> None:
        """Tabulate the lanes of `world` and put all robots on its first row.

        `look` returns the patches at poses (x, y, yaw), sampled at `grid`; `uniform` draws numbers
        in [0, 1) of a given shape.
        """
        self.config, self.grid, self._look, self._uniform = config, grid, look, uniform
        tiles, size = world.tiles, world.tiles[0][0].elevation.size
        x = np.arange(0.0, size[0] + LANE_STEP, LANE_STEP)
        self.tile_size = torch.tensor(size, dtype=torch.float32, device=device)
        yaws = np.array([[_direction(tile) * config.train for tile in row] for row in tiles])
        self.yaws = torch.as_tensor(yaws, dtype=torch.float32, device=device)
        ways = [
            [_turned(np.array(tile.lane), yaw, size) for tile, yaw in zip(row, turn, strict=True)]
            for row, turn in zip(tiles, yaws, strict=True)
        ]
        ends = np.array([[(way[0, 0], way[-1, 0]) for way in row] for row in ways])
        # Where a crossing begins at the latest, if that is beyond the tile's end.
        near = np.where(yaws[..., None], ends, [[tile.span for tile in row] for row in tiles])
        near = near + config.run_up * np.array([-1.0, 1.0])
        near = np.clip(near, ends.min(-1, keepdims=True), ends.max(-1, keepdims=True))
        lanes = [
            [np.interp(x, *way[way[:, 0].argsort(kind="stable")].T) for way in row] for row in ways
        ]
        spreads = [[tile.spread for tile in row] for row in tiles]
        limits = [[tile.limits or (0.0, size[0]) for tile in row] for row in tiles]
        self.offsets, self.lanes, self.spreads, self.limits, self.ends, self.near = (
            torch.as_tensor(np.array(table), dtype=torch.float32, device=device)
            for table in (world.offset, lanes, spreads, limits, ends, near)
        )
        self.num_rows, self.num_columns = self.offsets.shape[:2]
        self.everyone = torch.arange(num_envs, device=device)
        self.row = torch.zeros(num_envs, dtype=torch.long)
        self.column = torch.arange(num_envs) % self.num_columns
        self.target_yaw, self.told_yaw, self.aside = torch.zeros(3, num_envs, device=device)
        self.anchor, self.begin, self.stuck_from = torch.zeros(3, num_envs, 2, device=device)
        self.turning, self.crossing = torch.zeros(2, num_envs, dtype=torch.bool, device=device)
        self.stuck_steps = torch.zeros(num_envs, dtype=torch.long, device=device)

    def corner(self, ids: Int[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return the world position of the corner (0, 0) of each robot's tile, m."""
        return self.offsets[self.row[ids], self.column[ids]]

    def yaw(self, ids: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Return the direction of each robot's way, rad."""
        return self.yaws[self.row[ids], self.column[ids]]

    def turn(self, ids: Int[Tensor, "n"], xy: Float[Tensor, "n 2"], yaw: Tensor) -> Tensor:
        """Return where places in the world lie once their tiles are turned about their centres."""
        if not yaw.any():
            return xy
        centre = self.corner(ids) + self.tile_size / 2
        (x, y), cos, sin = (xy - centre).unbind(-1), torch.cos(yaw), torch.sin(yaw)
        return centre + torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)

    def _lane(self, ids: Int[Tensor, "n"], x: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Return how far to the left of its tile's corner each robot's lane lies at world x, m."""
        row, column = self.row[ids], self.column[ids]
        along = ((x - self.offsets[row, column, 0]) / LANE_STEP).round().long()
        return self.lanes[row, column, along.clamp(0, self.lanes.shape[-1] - 1)]

    # The beginning ----------------------------------------------------------------------------

    def draw(self, ids: Int[Tensor, "n"]) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """Draw poses on the next column, and which of them are to cross the obstacle.

        Those begin before it; the others anywhere that the ground is level.
        """
        n = len(ids)
        self.column[ids] = (self.column[ids] + 1) % self.num_columns
        corner = self.corner(ids)
        row, column = self.row[ids], self.column[ids]
        first, last = self.limits[row, column].unbind(-1)
        width = self.tile_size[1]
        backwards = self._uniform(n) < 0.3
        side = backwards.long()
        x = self.ends[row, column, side]
        if math.isfinite(self.config.run_up):
            x = x + self._uniform(n) * (self.near[row, column, side] - x)
        # Near enough to the lane to reach it before the obstacle begins.
        beside = (self.spreads[row, column] + self.config.start_beside).clamp(max=0.3 * width)
        beside = beside * (2 * self._uniform(n) - 1)
        y = self._lane(ids, corner[:, 0] + x) + beside
        ahead = self.yaw(ids)
        place = self.turn(ids, corner + torch.stack((x, y), dim=-1), ahead)
        yaw = torch.where(backwards, math.pi, 0.0) + ahead
        across = torch.cat((place, yaw[:, None]), dim=-1)
        inside = 0.1 + 0.8 * self._uniform(n, TRIES, 2)
        size = torch.stack((last - first, width.expand(n)), dim=-1)
        corner[:, 0] += first
        eighths = self._uniform(n, TRIES) * 8
        if not self.config.oblique:
            eighths = torch.floor(eighths)
        anywhere = torch.cat(
            (corner[:, None] + inside * size[:, None], eighths[..., None] * (math.pi / 4)), dim=-1
        )
        under = self._look(anywhere)[..., self.grid.footprint_index]
        best = (under.amax(-1) - under.amin(-1)).argmin(dim=1)
        level = anywhere[torch.arange(n), best]
        crossing = self._uniform(n) < self.config.traverse_share
        poses = torch.where(crossing[:, None], across, level)
        # Crossings begin askew towards the lane, as a route comes to it, and at large angles more
        # often than at small ones: a robot that fails to turn leaves few samples.
        share = self._uniform(n)
        to_lane = -torch.sign(torch.where(backwards, -beside, beside))
        askew = to_lane * ((self.config.start_yaw + SLIGHT) * share.sqrt() - SLIGHT)
        poses[:, 2] += torch.where(crossing, askew, SLIGHT * (2 * share - 1))
        return poses, crossing

    def start(self, ids: Int[Tensor, "n"], poses: Float[Tensor, "n 3"]) -> None:
        """Let each robot go straight on from its pose."""
        self.anchor[ids] = self.begin[ids] = self.stuck_from[ids] = poses[:, :2]
        self.stuck_steps[ids] = 0
        self.target_yaw[ids] = self.told_yaw[ids] = poses[:, 2]
        self.crossing[ids] = self.turning[ids] = False

    def assign(
        self, ids: Int[Tensor, "n"], poses: Float[Tensor, "n 3"], crossing: Bool[Tensor, "n"]
    ) -> None:
        """Let some robots cross their tile beside its lane, and draw which ones turn on the way."""
        self.turning[ids] = self._uniform(len(ids)) < self.config.turn_share
        self.crossing[ids] = crossing
        x, y = self.turn(ids, poses[:, :2], -self.yaw(ids)).unbind(-1)
        beside = y - self.corner(ids)[:, 1] - self._lane(ids, x)
        spread = self.spreads[self.row[ids], self.column[ids]]
        self.aside[ids] = torch.minimum(torch.maximum(beside, -spread), spread)

    # On the way -------------------------------------------------------------------------------

    def headings(self, pose: Float[Tensor, "envs 4"], dt: float) -> Float[Tensor, "envs"]:
        """Return the heading that keeps each robot on its way; draw new lines for some, every `dt`.

        Moves `told_yaw` towards these headings.
        """
        turn = self.turning & (self._uniform(len(pose)) < dt / 2.0)
        if turn.any():
            eighths = torch.floor(self._uniform(len(pose)) * 5) - 2
            turned = self.target_yaw + eighths * (math.pi / 4)
            self.target_yaw = torch.where(turn, turned, self.target_yaw)
            self.anchor = torch.where(turn[:, None], pose[:, :2], self.anchor)
            self.crossing &= ~turn
        wanted = self.target_yaw - bearing(self._beside_line(pose))
        if self.crossing.any():
            yaw = self.yaw(self.everyone)
            forth = torch.sign(torch.cos(self.target_yaw - yaw))
            beside = forth * self.beside_lane(pose, LOOKAHEAD * forth)
            ahead = torch.where(forth > 0, 0.0, math.pi) + yaw
            wanted = torch.where(self.crossing, ahead - bearing(beside), wanted)
        expected = self.config.obedience * self.config.max_turn_rate
        self.told_yaw += dt * turn_rate(wanted, self.told_yaw, expected)
        # A robot may turn faster than expected: `told_yaw` is never behind its yaw.
        to_go, left = off_by(wanted, self.told_yaw), off_by(wanted, pose[:, 3])
        further = (to_go * left > 0) & (left.abs() < to_go.abs())
        self.told_yaw = torch.where(further, pose[:, 3], self.told_yaw)
        return wanted

    def _beside_line(self, pose: Float[Tensor, "envs 4"]) -> Float[Tensor, "envs"]:
        """Return how far to the left of the straight line from its anchor each robot is, m."""
        x, y = (pose[:, :2] - self.anchor).unbind(dim=-1)
        return torch.cos(self.target_yaw) * y - torch.sin(self.target_yaw) * x

    def beside_lane(
        self, pose: Float[Tensor, "envs 4"], forth: Tensor | float = 0.0
    ) -> Float[Tensor, "envs"]:
        """Return how far left of its way over the tile, `forth` further on, each robot is, m."""
        ids = self.everyone
        x, y = self.turn(ids, pose[:, :2], -self.yaw(ids)).unbind(-1)
        return y - (self._lane(ids, x + forth) + self.aside) - self.corner(ids)[:, 1]

    def strayed(self, pose: Float[Tensor, "envs 4"]) -> Bool[Tensor, "envs"]:
        """Tell which robots are too far beside their way, or head elsewhere."""
        beside = torch.where(self.crossing, self.beside_lane(pose), self._beside_line(pose))
        away = torch.cos(pose[:, 3] - self.told_yaw) < math.cos(math.pi / 4)
        return (beside.abs() > self.config.stray) | away

    def stuck(self, pose: Float[Tensor, "envs 4"], dt: float) -> Bool[Tensor, "envs"]:
        """Tell which robots have made no progress for too long; call it once every `dt`, s."""
        moved = (pose[:, :2] - self.stuck_from).norm(dim=-1) > self.config.stuck_progress
        self.stuck_from = torch.where(moved[:, None], pose[:, :2], self.stuck_from)
        self.stuck_steps = torch.where(moved, 0, self.stuck_steps + 1)
        return self.stuck_steps * dt > self.config.stuck_seconds

    def outside(
        self, pose: Float[Tensor, "envs 4"]
    ) -> tuple[Bool[Tensor, "envs"], Bool[Tensor, "envs"]]:
        """Tell which robots have left their tile, and which of them for a neighbour's obstacle."""
        x, y = (pose[:, :2] - self.corner(self.everyone)).unbind(dim=-1)
        first, last = self.limits[self.row, self.column].unbind(-1)
        beyond = (x < first) | (x > last)
        strange = beyond & (x > 0.0) & (x < self.tile_size[0])
        return beyond | (y < 0.0) | (y > self.tile_size[1]), strange

    def along_heading(
        self, pose: Float[Tensor, "envs 4"], velocity: Float[Tensor, "envs 3"]
    ) -> Float[Tensor, "envs 2"]:
        """Return the planar velocity along and across the heading that each robot was told.

        In its own frame, a robot that turns away from an obstacle and walks off would track its
        command perfectly. On a route, the heading is the follower's to correct.
        """
        if not self.config.train:
            return velocity[:, :2]
        off = pose[:, 3] - self.told_yaw
        cos, sin, (vx, vy) = torch.cos(off), torch.sin(off), velocity[:, :2].unbind(-1)
        return torch.stack((cos * vx - sin * vy, sin * vx + cos * vy), dim=-1)

    # The curriculum ---------------------------------------------------------------------------

    def promote(
        self,
        ids: Int[Tensor, "n"],
        mean: Float[Tensor, "n"],
        xy: Float[Tensor, "n 2"],
        failed: Bool[Tensor, "n"],
    ) -> None:
        """Move robots along the rows by the mean r_v of the episode that just ended at `xy`.

        Only crossings count against a robot: what other episodes ask for may be impossible. One
        that masters the last row is sent to a random one of the harder half.
        """
        way = (xy - self.begin[ids]).norm(dim=-1) / self.tile_size[0]
        up = (mean > self.config.promote_above) & (way > 0.25) & ~failed
        down = (mean < self.config.demote_below) | (failed & (way < 0.5))
        down &= self.crossing[ids]
        row = self.row[ids] + up.long() - (down & ~up).long()
        half = self.num_rows // 2
        anywhere = half + torch.floor(self._uniform(len(ids)) * (self.num_rows - half)).long()
        self.row[ids] = torch.where(row >= self.num_rows, anywhere, row.clamp(min=0))

    def state_dict(self) -> dict[str, Int[Tensor, "envs"]]:
        """Return each robot's tile."""
        return {"row": self.row.clone(), "column": self.column.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over stored tiles; raises `ValueError` if there is no such row or column here."""
        for name, number in (("row", self.num_rows), ("column", self.num_columns)):
            value, own = state[name], getattr(self, name)
            fits = (value.shape, value.dtype) == (own.shape, own.dtype)
            if not (fits and ((value >= 0) & (value < number)).all()):
                raise ValueError(f"the {name} of each robot should be one of {number}")
        self.row, self.column = state["row"].clone(), state["column"].clone()


def _direction(tile: Terrain) -> float:
    """Return where the way from a terrain's start to its goal leads, rad."""
    return math.atan2(tile.goal[1] - tile.start[1], tile.goal[0] - tile.start[0])


def _turned(way: np.ndarray, yaw: float, size: tuple[float, float]) -> np.ndarray:
    """Return points [n, 2] of a tile turned back by `yaw` about its centre."""
    if not yaw:
        return way
    centre, (cos, sin) = np.array(size) / 2, (math.cos(yaw), math.sin(yaw))
    return (way - centre) @ np.array([[cos, -sin], [sin, cos]]) + centre
