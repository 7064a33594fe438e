"""Numbers that summarise trials: success rate with its interval, SPL, calibration error, AUROC.

Reads outcomes of trials; gives plain floats. Sources: Wilson (1927) for the interval; Anderson et
al., "On Evaluation of Embodied Navigation Agents" (2018) for SPL (paper, Table I).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Float

from fgtutor.errors import ConfigError


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate, 95 %.

    Unlike the textbook interval it stays within [0, 1] and keeps its width when every trial
    succeeds. Raises `ConfigError` unless 0 <= successes <= trials and trials > 0.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ConfigError(f"need 0 <= successes <= trials, trials > 0; got {successes} of {trials}")
    from scipy.stats import binomtest  # takes a second to load, and workers ask for no interval

    low, high = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(low), float(high)


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of some trials succeeded, with its 95 % interval (Wilson)."""

    successes: int
    trials: int

    @classmethod
    def of(cls, successes: Iterable[bool]) -> Self:
        """Count successes."""
        outcomes = [bool(success) for success in successes]
        return cls(successes=sum(outcomes), trials=len(outcomes))

    @classmethod
    def reached(cls, trials: Iterable[Mapping[str, Any]]) -> Self:
        """Count the trials that reached their goal."""
        return cls.of(trial["outcome"] == "reached" for trial in trials)

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the interval, in [0, 1]."""
        return wilson_interval(self.successes, self.trials)

    def __str__(self) -> str:
        """Write percent with as many digits as the trials bear: 96 (87-99), 99.96 (99.90-99.98)."""
        digits = 0 if self.trials < 1000 else 1 if self.trials < 10_000 else 2
        share, low, high = (
            f"{100 * x:.{digits}f}" for x in (self.successes / self.trials, *self.interval)
        )
        return f"{share} ({low}-{high})"


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


def auroc(
    scores: Float[np.ndarray, "trials"], outcomes: Bool[np.ndarray, "trials"]
) -> float | None:
    """Return how often a trial that succeeded has a higher score than one that failed.

    Equal scores count one half: 0.5 is what chance gives. None where nothing failed, or all did.
    """
    outcomes = np.asarray(outcomes, dtype=bool)
    from scipy.stats import rankdata  # as above

    won, lost = int(outcomes.sum()), int((~outcomes).sum())
    if not won or not lost:
        return None
    return float((rankdata(scores)[outcomes].sum() - won * (won + 1) / 2) / (won * lost))


def brier(predicted: Float[np.ndarray, "trials"], outcomes: Bool[np.ndarray, "trials"]) -> float:
    """Return the mean squared difference of predicted probabilities from outcomes (Brier, 1950)."""
    return float(np.mean((np.asarray(predicted) - np.asarray(outcomes, dtype=float)) ** 2))
