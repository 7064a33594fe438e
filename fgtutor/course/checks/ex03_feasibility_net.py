"""Exercise 03, "Feasibility-Net": its loss, and whether its predictions are true (Eqs. 2-3)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question


def _loss_inputs(rng: np.random.Generator) -> tuple:
    n = int(rng.integers(4, 9))
    f, r_v = rng.uniform(0, 1, (2, n))
    alpha, beta = float(rng.uniform(0.3, 3)), float(rng.uniform(0.05, 0.5))
    return f, r_v, rng.exponential(1, n), rng.exponential(2, n), alpha, beta


def _latent(rng: np.random.Generator) -> tuple:
    return rng.normal(0, 1, (4, 3)), rng.normal(0, 0.7, (4, 3))


def _predictions(rng: np.random.Generator) -> tuple:
    predicted = np.clip(rng.beta(2, 1, 40), 0.21, 1)  # the lowest bins stay empty
    predicted[:2] = 1.0
    measured = np.clip(predicted + rng.normal(-0.1, 0.2, 40), 0, 1)
    return predicted, measured, int(rng.choice([5, 8, 10]))


def _reliability(
    predicted: np.ndarray, measured: np.ndarray, bins: int, by: np.ndarray | None = None
) -> np.ndarray:
    by = predicted if by is None else by
    index = np.minimum((by * bins).astype(int), bins - 1)
    table = np.full((bins, 3), np.nan)
    table[:, 2] = 0
    for b in set(index.tolist()):
        inside = index == b
        table[b] = predicted[inside].mean(), measured[inside].mean(), inside.sum()
    return table


def _centred(predicted: np.ndarray, measured: np.ndarray, bins: int) -> np.ndarray:
    table = _reliability(predicted, measured, bins)
    table[:, 0] = (np.arange(bins) + 0.5) / bins
    return table


def _half_open(predicted: np.ndarray, measured: np.ndarray, bins: int) -> np.ndarray:
    inside = predicted < 1
    return _reliability(predicted[inside], measured[inside], bins)


def _table(rng: np.random.Generator) -> tuple:
    return (_reliability(*_predictions(rng)),)


def _gaps(table: np.ndarray) -> np.ndarray:
    return table[:, 1] - table[:, 0]


QUESTIONS = (
    Question(
        id="ex03.q1",
        name="feasibility_loss",
        points=2,
        title="the joint loss",
        expects="the loss is mean((f - r_v)^2) + alpha * (mean(recon) + beta * mean(kl)): alpha "
        "weighs the whole VAE, beta only its KL term within it.",
        draw=_loss_inputs,
        truth=lambda f, r_v, recon, kl, alpha, beta: np.mean(
            (f - r_v) ** 2 + alpha * (recon + beta * kl)
        ),
        mistakes=(
            Mistake(
                "beta outside the bracket: alpha weighs the KL term too.",
                lambda f, r, rec, kl, a, b: np.mean((f - r) ** 2 + a * rec + b * kl),
            ),
            Mistake(
                "a forgotten beta: the KL term enters at its full weight.",
                lambda f, r, rec, kl, a, b: np.mean((f - r) ** 2 + a * (rec + kl)),
            ),
            Mistake(
                "sum for mean: the loss must not grow with the batch.",
                lambda f, r, rec, kl, a, b: np.sum((f - r) ** 2 + a * (rec + b * kl)),
            ),
            Mistake(
                "absolute for squared errors: f - r_v is squared.",
                lambda f, r, rec, kl, a, b: np.mean(np.abs(f - r) + a * (rec + b * kl)),
            ),
            Mistake(
                "a forgotten VAE: only the head learns; the reconstruction loss is missing.",
                lambda f, r, rec, kl, a, b: np.mean((f - r) ** 2),
            ),
        ),
        hints=("Write L_VAE first: recon + beta * kl.", "Everything is a mean over the batch."),
    ),
    Question(
        id="ex03.q2",
        name="kl_divergence",
        points=2,
        title="the KL term",
        expects="KL(N(mean, variance) || N(0, 1)) = 1/2 sum over the latent of mean^2 + variance - "
        "1 - log variance: one number per patch, 0 only for mean 0 and variance 1.",
        draw=_latent,
        examples=((np.zeros((1, 2)), np.zeros((1, 2))),),
        truth=lambda mean, log_variance: (
            0.5 * (mean**2 + np.exp(log_variance) - 1 - log_variance).sum(axis=-1)
        ),
        mistakes=(
            Mistake(
                "mean for sum: the divergence of independent dimensions adds up over the latent.",
                lambda m, v: 0.5 * (m**2 + np.exp(v) - 1 - v).mean(axis=-1),
            ),
            Mistake(
                "a log variance read as log std: exp(log_variance) is the variance already; exp(2 "
                "...) squares it.",
                lambda m, v: 0.5 * (m**2 + np.exp(2 * v) - 1 - 2 * v).sum(axis=-1),
            ),
            Mistake(
                "a forgotten -1: a latent equal to the prior must cost 0.",
                lambda m, v: 0.5 * (m**2 + np.exp(v) - v).sum(axis=-1),
            ),
            Mistake(
                "a turned sign: a divergence is never negative.",
                lambda m, v: 0.5 * (1 + v - m**2 - np.exp(v)).sum(axis=-1),
            ),
            Mistake(
                "a forgotten half: the formula begins with 1/2.",
                lambda m, v: (m**2 + np.exp(v) - 1 - v).sum(axis=-1),
            ),
        ),
        hints=(
            "The variance is np.exp(log_variance).",
            "Sum over the last axis: one divergence per patch.",
        ),
    ),
    Question(
        id="ex03.q3",
        name="reliability",
        points=3,
        title="predicted against measured",
        expects="row b holds, of the samples whose PREDICTION lies in the b-th of `bins` equal "
        "parts of [0, 1], the mean prediction, the mean measurement and the count; a prediction of "
        "1 is in the last part; means of an empty part are NaN.",
        draw=_predictions,
        truth=lambda predicted, measured, bins: _reliability(predicted, measured, bins),
        mistakes=(
            Mistake(
                "binning by the measurement: the question is: of those predicted so, how many did "
                "it? So bin by the prediction.",
                lambda p, m, bins: _reliability(p, m, bins, by=m),
            ),
            Mistake(
                "a lost 1.0: predictions of exactly 1 fall out of the last part: clip the index.",
                _half_open,
            ),
            Mistake(
                "centres for means: the first column is the mean prediction in the part, not its "
                "centre.",
                _centred,
            ),
            Mistake(
                "zeros for nothing: an empty part has no mean: NaN, or the plot shows a bad "
                "prediction that never was.",
                lambda p, m, bins: np.nan_to_num(_reliability(p, m, bins)),
            ),
            Mistake(
                "swapped columns: the mean prediction comes first, then the mean measurement.",
                lambda p, m, bins: _reliability(p, m, bins)[:, [1, 0, 2]],
            ),
        ),
        hints=(
            "(predicted * bins).astype(int) is the part's index, but for 1.0.",
            "np.minimum(index, bins - 1) puts 1.0 into the last part.",
            "np.bincount(index, weights=measured, minlength=bins) sums by part.",
        ),
    ),
    Question(
        id="ex03.q4",
        name="calibration_error",
        points=2,
        title="one number for a calibration plot",
        expects="the mean of |measured - predicted| over the parts, each weighted by its count; "
        "empty parts (NaN) do not count.",
        draw=_table,
        truth=lambda table: np.nansum(np.abs(_gaps(table)) * table[:, 2]) / table[:, 2].sum(),
        mistakes=(
            Mistake(
                "parts of equal weight: a part with one sample counts as much as one with twenty.",
                lambda t: np.nanmean(np.abs(_gaps(t))),
            ),
            Mistake(
                "a signed difference: too high here and too low there would cancel.",
                lambda t: np.nansum(_gaps(t) * t[:, 2]) / t[:, 2].sum(),
            ),
            Mistake(
                "a NaN that spreads: empty parts make the sum NaN: leave them out (np.nansum).",
                lambda t: (np.abs(_gaps(t)) * t[:, 2]).sum() / t[:, 2].sum(),
            ),
            Mistake(
                "the worst part: the mean is asked for, not the maximum.",
                lambda t: np.nanmax(np.abs(_gaps(t))),
            ),
            Mistake(
                "squared differences: differences are taken as they are, not squared.",
                lambda t: np.nansum(_gaps(t) ** 2 * t[:, 2]) / t[:, 2].sum(),
            ),
        ),
        hints=(
            "The counts are the weights: they stand in the last column.",
            "0 * NaN is NaN, so np.sum will not do; np.nansum skips it.",
        ),
    ),
)
