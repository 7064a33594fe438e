"""Numbers that summarise trials: success rate with its interval, SPL, calibration error.

Reads outcomes of trials; gives plain floats. Sources: Wilson (1927) for the interval; Anderson et
al., "On Evaluation of Embodied Navigation Agents" (2018) for SPL (paper, Table I).
"""

import math

import numpy as np
from jaxtyping import Float

from fgtutor.errors import ConfigError

Z95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


def wilson_interval(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate.

    Unlike the textbook interval it stays within [0, 1] and keeps its width when every trial
    succeeds. Raises `ConfigError` unless 0 <= successes <= trials and trials > 0.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ConfigError(f"need 0 <= successes <= trials, trials > 0; got {successes} of {trials}")
    share = successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = (
        z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    )
    # Exact at the ends, where rounding would leave 1e-17 or 0.9999999999999999.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def spl(
    successes: Float[np.ndarray, "trials"],
    lengths: Float[np.ndarray, "trials"],
    reference: Float[np.ndarray, "trials"] | float,
) -> float:
    """Return success weighted by path length: mean of S * reference / max(length, reference)."""
    reference = np.broadcast_to(np.asarray(reference, dtype=float), np.shape(lengths))
    if np.any(reference <= 0):
        raise ConfigError("SPL needs reference lengths > 0 m")
    return float(np.mean(np.asarray(successes) * reference / np.maximum(lengths, reference)))


def calibration(
    predicted: Float[np.ndarray, "n"], measured: Float[np.ndarray, "n"], bins: int = 10
) -> tuple[Float[np.ndarray, "bins 3"], float]:
    """Compare predictions with outcomes in `bins` equal bins of the prediction over [0, 1].

    Returns rows (mean predicted, mean measured, count), NaN means where a bin is empty, and the
    mean absolute error over the bins, each weighted by its count.
    """
    if np.shape(predicted) != np.shape(measured) or np.size(predicted) == 0:
        raise ConfigError(
            "calibration needs as many measured values as predicted ones, at least one"
        )
    index = np.clip((np.asarray(predicted) * bins).astype(int), 0, bins - 1)
    count = np.bincount(index, minlength=bins).astype(float)
    with np.errstate(invalid="ignore"):
        means = [np.bincount(index, w, minlength=bins) / count for w in (predicted, measured)]
    table = np.stack((*means, count), axis=1)
    error = np.nansum(np.abs(table[:, 0] - table[:, 1]) * count) / count.sum()
    return table, float(error)
