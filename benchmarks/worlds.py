"""The maps, policies and tensors that several benchmarks measure on."""

import numpy as np
from scipy import ndimage

from fgtutor.cli.demo import MAP
from fgtutor.elevation import ElevationMap
from fgtutor.specialist import Specialist, load_zoo

TERRAINS = ("steps", "gaps", "bridge", "valley")
"""The A1's specialists that share a map."""


def natural(cells: int, resolution: float = 0.05) -> ElevationMap:
    """Return hills of half a metre with stones and noise on them: no two patches are alike."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(3, cells, cells))
    scales = (1.2 / resolution, 0.15 / resolution, 0.0)
    heights = [
        height * layer / layer.std()
        for height, layer in zip(
            (0.15, 0.02, 0.004),
            (ndimage.gaussian_filter(one, s) for one, s in zip(noise, scales, strict=True)),
            strict=True,
        )
    ]
    return ElevationMap(np.sum(heights, axis=0), resolution)


def built(cells: int) -> ElevationMap:
    """Return the toy's demo map, mirrored at its border until it is large enough."""
    small = ElevationMap.load(MAP).filled()
    more = [(0, max(0, cells - n)) for n in small.shape]
    heights = np.pad(small.heights, more, mode="reflect")[:cells, :cells]
    return ElevationMap(heights, small.resolution)


def a1() -> dict[str, Specialist]:
    """Return the A1's four specialists."""
    zoo = load_zoo("a1")
    return {name: zoo[name] for name in TERRAINS}


def layers(cells: int, headings: int, policies: int = 4) -> np.ndarray:
    """Return F of policies on a square map that vary over eight cells: [policies, nx, ny, d]."""
    tensors = np.random.default_rng(0).uniform(size=(policies, cells, cells, headings))
    smooth = ndimage.gaussian_filter(tensors, (0, 8, 8, 0))
    return (0.05 + 0.95 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)
