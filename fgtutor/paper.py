"""The paper's planner as it is written down, Secs. III-B and III-C: slow, complete, to be read.

Reads an elevation map, specialists, a start and a goal; gives the cells of the cheapest route and
the policy of each step. The library's `tensorize`, `fuse` and `plan` compute the same in less time,
and the tests hold them to this file. The paper has 8 headings, each to a neighbouring cell; with 16
or 32 a step may lead over cells between its ends, and `along_steps` and `graph` ask those as well.
"""

from collections.abc import Mapping
from itertools import pairwise

import networkx
import numpy as np
import torch

from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import TAU_HIGH, TAU_LOW, ood_weight
from fgtutor.patches import prepare, sample_patches
from fgtutor.specialist import Specialist


@torch.no_grad()
def feasibility_tensor(
    M: ElevationMap,
    specialist: Specialist,
    tau_low: float = TAU_LOW,
    tau_high: float = TAU_HIGH,
    headings: HeadingCount = 8,
) -> np.ndarray:
    """Return F_i(x, y, k) = w_ood(x, y, k) * f(x, y, k), [nx, ny, d] (Eqs. 4 and 5)."""
    heights = torch.tensor(prepare(M).heights, dtype=torch.float64)
    x, y = (torch.tensor(centres) for centres in M.centres)
    F = np.zeros((*M.shape, headings), dtype=np.float32)
    for k, yaw in enumerate(torch.tensor(Headings(headings).yaws)):
        poses = torch.cartesian_prod(x, y, yaw[None])
        H = sample_patches(
            heights, poses, specialist.grid, resolution=M.resolution, origin=M.origin
        ).float()
        command = torch.tensor(specialist.command).expand(len(H), -1)
        f = specialist.feasibility.feasibility(H, command)
        w_ood = ood_weight(specialist.feasibility.reconstruction(H), tau_low, tau_high)
        F[:, :, k] = (w_ood * f).reshape(M.shape)
    return F


def along_steps(F: np.ndarray) -> np.ndarray:
    """Return F_i of whole steps: the least of the cells that each leaves. Of 8 headings it is F."""
    along, between = F.copy(), Headings.of(F).between
    for ix, iy, k in np.ndindex(F.shape):
        for i, j in between[k]:
            if 0 <= ix + i < len(F) and 0 <= iy + j < len(F[0]):
                along[ix, iy, k] = min(along[ix, iy, k], F[ix + i, iy + j, k])
    return along


def graph(F_max: np.ndarray, P: np.ndarray, M: ElevationMap, f_min: float) -> networkx.DiGraph:
    """Return the graph of all known cells: a step along heading k costs 1 / F_max (Sec. III-C).

    A longer step costs that for each king's move that it replaces.
    """
    G, headings = networkx.DiGraph(), Headings.of(F_max)
    G.add_nodes_from(map(tuple, np.argwhere(M.known)))
    for ix, iy, k in np.argwhere(F_max >= f_min):
        passed = ((0, 0), *headings.between[k], headings.steps[k])
        cells = [(ix + i, iy + j) for i, j in passed]
        if all(cell in G for cell in cells):
            cost = headings.moves[k] / float(F_max[ix, iy, k])
            G.add_edge(cells[0], cells[-1], weight=cost, policy=P[ix, iy, k])
    return G


def plan(
    M: ElevationMap,
    zoo: Mapping[str, Specialist],
    start: tuple[float, float],
    goal: tuple[float, float],
    f_min: float = 0.1,
    headings: HeadingCount = 8,
) -> tuple[list[tuple[int, int]], list[str], float]:
    """Return the cells of the route, the policy of each step and the cost; f_min is ours.

    Raises `networkx.NetworkXNoPath` where no chain of steps joins start and goal.
    """
    cells = [feasibility_tensor(M, specialist, headings=headings) for specialist in zoo.values()]
    F = np.stack([along_steps(one) for one in cells])
    F_max, P = F.max(axis=0), F.argmax(axis=0)  # Eqs. 6 and 7
    G, names = graph(F_max, P, M, f_min), list(zoo)
    cells = networkx.dijkstra_path(G, M.cell_of(*start), M.cell_of(*goal))
    policies = [names[G.edges[step]["policy"]] for step in pairwise(cells)]
    return cells, policies, networkx.path_weight(G, cells, "weight")
