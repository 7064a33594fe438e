"""The paper's planner as it is written down, Secs. III-B and III-C: slow, complete, to be read.

Reads an elevation map, specialists, a start and a goal; gives the cells of the cheapest route and
the policy of each step. The library's `tensorize`, `fuse` and `plan` compute the same in less time,
and the tests hold them to this file.
"""

from collections.abc import Mapping
from itertools import pairwise

import networkx
import numpy as np
import torch

from fgtutor.directions import STEPS, YAWS
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import TAU_HIGH, TAU_LOW, ood_weight
from fgtutor.patches import prepare, sample_patches
from fgtutor.specialist import Specialist


@torch.no_grad()
def feasibility_tensor(
    M: ElevationMap, specialist: Specialist, tau_low: float = TAU_LOW, tau_high: float = TAU_HIGH
) -> np.ndarray:
    """Return F_i(x, y, k) = w_ood(x, y, k) * f(x, y, k), [nx, ny, 8] (Eqs. 4 and 5)."""
    heights = torch.tensor(prepare(M).heights, dtype=torch.float64)
    x, y = (torch.tensor(centres) for centres in M.centres)
    F = np.zeros((*M.shape, len(YAWS)), dtype=np.float32)
    for k, yaw in enumerate(torch.tensor(YAWS)):
        poses = torch.cartesian_prod(x, y, yaw[None])
        H = sample_patches(
            heights, poses, specialist.grid, resolution=M.resolution, origin=M.origin
        ).float()
        command = torch.tensor(specialist.command).expand(len(H), -1)
        f = specialist.feasibility.feasibility(H, command)
        w_ood = ood_weight(specialist.feasibility.reconstruction(H), tau_low, tau_high)
        F[:, :, k] = (w_ood * f).reshape(M.shape)
    return F


def graph(F_max: np.ndarray, P: np.ndarray, M: ElevationMap, f_min: float) -> networkx.DiGraph:
    """Return the graph of all known cells: a step along heading k costs 1 / F_max (Sec. III-C)."""
    G = networkx.DiGraph()
    G.add_nodes_from(map(tuple, np.argwhere(M.known)))
    for ix, iy, k in np.argwhere(F_max >= f_min):
        cell, neighbour = (ix, iy), (ix + STEPS[k, 0], iy + STEPS[k, 1])
        if cell in G and neighbour in G:
            G.add_edge(cell, neighbour, weight=1 / float(F_max[ix, iy, k]), policy=P[ix, iy, k])
    return G


def plan(
    M: ElevationMap,
    zoo: Mapping[str, Specialist],
    start: tuple[float, float],
    goal: tuple[float, float],
    f_min: float = 0.1,
) -> tuple[list[tuple[int, int]], list[str], float]:
    """Return the cells of the route, the policy of each step and the cost; f_min is ours.

    Raises `networkx.NetworkXNoPath` where no chain of steps joins start and goal.
    """
    F = np.stack([feasibility_tensor(M, specialist) for specialist in zoo.values()])
    F_max, P = F.max(axis=0), F.argmax(axis=0)  # Eqs. 6 and 7
    G, names = graph(F_max, P, M, f_min), list(zoo)
    cells = networkx.dijkstra_path(G, M.cell_of(*start), M.cell_of(*goal))
    policies = [names[G.edges[step]["policy"]] for step in pairwise(cells)]
    return cells, policies, networkx.path_weight(G, cells, "weight")
