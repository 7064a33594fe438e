"""Exercise 03, "Feasibility-Net": network, loss, calibration, labels, training (Eqs. 1-3)."""

import numpy as np

from fgtutor.course.checks.nets import (
    build_net,
    flawed_loss,
    flawed_net,
    flawed_training,
    joint_loss,
    loss_answers,
    loss_case,
    narrow_net,
    net_answers,
    net_case,
    train,
    training_answers,
    training_case,
)
from fgtutor.course.checks.question import Mistake, Question

# Calibration --------------------------------------------------------------------------------------


def _predictions(rng: np.random.Generator) -> tuple:
    predicted = np.clip(rng.beta(2, 1, 40), 0.21, 1)  # the lowest bins stay empty
    predicted[:2] = 1.0
    # Too low below 0.6, too high above: signed differences would cancel.
    tilt = np.where(predicted < 0.6, 0.2, -0.2)
    measured = np.clip(predicted + tilt + rng.normal(0, 0.1, 40), 0, 1)
    return predicted, measured, int(rng.choice([5, 8, 10]))


def _rows(
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


def _with_error(table: np.ndarray) -> tuple[np.ndarray, float]:
    gaps = np.abs(table[:, 1] - table[:, 0])
    return table, float(np.nansum(gaps * table[:, 2]) / table[:, 2].sum())


def _centred(predicted: np.ndarray, measured: np.ndarray, bins: int) -> tuple:
    table = _rows(predicted, measured, bins)
    table[:, 0] = (np.arange(bins) + 0.5) / bins
    return _with_error(table)


def _half_open(predicted: np.ndarray, measured: np.ndarray, bins: int) -> tuple:
    inside = predicted < 1
    return _with_error(_rows(predicted[inside], measured[inside], bins))


def _unweighted(predicted: np.ndarray, measured: np.ndarray, bins: int) -> tuple:
    table = _rows(predicted, measured, bins)
    return table, float(np.nanmean(np.abs(table[:, 1] - table[:, 0])))


def _signed(predicted: np.ndarray, measured: np.ndarray, bins: int) -> tuple:
    table = _rows(predicted, measured, bins)
    return table, float(np.nansum((table[:, 1] - table[:, 0]) * table[:, 2]) / table[:, 2].sum())


# Labels -------------------------------------------------------------------------------------------


def _rollout(rng: np.random.Generator) -> tuple:
    steps, robots, window = 16, 3, int(rng.integers(4, 7))
    failed, ended = np.zeros((2, steps, robots), dtype=bool)
    failed[rng.integers(4, 8), 0] = True
    ended[rng.integers(4, 8), 1] = True  # a time-out
    ended |= failed
    return rng.uniform(0.2, 1, (steps, robots)), failed, ended, window


def _labels(
    r_v: np.ndarray,
    failed: np.ndarray,
    ended: np.ndarray,
    window: int,
    *,
    least: float = 0.5,
) -> tuple[np.ndarray, np.ndarray]:
    """Take for each step the slice of its window up to the end of the episode."""
    labels, trusted = np.zeros(r_v.shape), np.zeros(r_v.shape, dtype=bool)
    for t, robot in np.ndindex(r_v.shape):
        seen = r_v[t : t + window, robot]
        if ended[t : t + window, robot].any():
            seen = seen[: int(ended[t : t + window, robot].argmax()) + 1]
        fell = bool(failed[t + len(seen) - 1, robot])
        labels[t, robot] = seen.sum() / (window if fell else len(seen))
        trusted[t, robot] = fell or len(seen) >= least * window
    return labels, trusted


def _late_end(r_v: np.ndarray, failed: np.ndarray, ended: np.ndarray, window: int) -> tuple:
    """Leave the last step of each episode out of the labels of the steps before it."""
    return _labels(np.where(ended, 0, r_v), failed, ended, window)


QUESTIONS = (
    Question(
        id="ex03.q1",
        name="FeasibilityNet",
        points=3,
        title="the network",
        expects="a class whose nets have a head (patch and command -> hidden -> 1), an encoder "
        "(patch -> hidden -> 2 latent) and a decoder (latent -> hidden -> patch), in this order; f "
        "in [0, 1], and L_recon of the latent mean, summed over the patch; heights enter times 4.",
        draw=net_case,
        harness=net_answers,
        truth=build_net,
        mistakes=(
            Mistake(
                "a score in place of a feasibility: the sigmoid is missing, so f leaves [0, 1].",
                flawed_net("score"),
            ),
            Mistake(
                "heights in metres: head, encoder and L_recon work with 4 * patch.",
                flawed_net("metres"),
            ),
            Mistake(
                "a mean over the points: L_recon is the SUM of the squared errors of a patch.",
                flawed_net("mean"),
            ),
            Mistake(
                "the wrong half of the encoder's answer: the first `latent` numbers are the mean, "
                "the others the log variance.",
                flawed_net("halves"),
            ),
            Mistake(
                "a latent that is not the mean: no noise and no spread enter L_recon, so that the "
                "same patch always has the same loss.",
                flawed_net("sampled"),
            ),
            Mistake(
                "a head that ignores the command: the same ground can be fine at a walk and too "
                "hard at a run.",
                flawed_net("deaf"),
            ),
            Mistake(
                "an encoder that gives the mean alone: it gives 2 * latent numbers, mean and log "
                "variance.",
                narrow_net,
            ),
        ),
        hints=(
            "nn.Sequential(nn.Linear(points + command, hidden), nn.ELU(), nn.Linear(hidden, 1)) is "
            "the head. Head and autoencoder share no weight.",
            "torch.cat((4 * patch, command), dim=-1) goes into the head; .squeeze(-1) takes the "
            "last axis, of length 1, away.",
            "mean, log_variance = self.encoder(heights).chunk(2, dim=-1)",
        ),
    ),
    Question(
        id="ex03.q2",
        name="joint_loss",
        points=3,
        title="the joint loss",
        expects="the batch mean of (f - r_v)^2 + alpha * (L_recon + beta * L_KL), a scalar tensor "
        "whose gradient reaches head, encoder and decoder; the latent that is decoded is mean + "
        "standard deviation * noise.",
        draw=loss_case,
        harness=loss_answers,
        truth=joint_loss,
        mistakes=(
            Mistake(
                "beta outside the bracket: alpha weighs the KL term too.", flawed_loss("bracket")
            ),
            Mistake(
                "a variance in place of a standard deviation: the noise is multiplied by "
                "exp(log_variance / 2).",
                flawed_loss("variance"),
            ),
            Mistake(
                "a decoded mean: in training the latent is sampled, mean + spread * noise.",
                flawed_loss("no noise"),
            ),
            Mistake(
                "a gradient that stops: detach(), .item() or .data between encoder and decoder "
                "keep the encoder from learning.",
                flawed_loss("cut"),
            ),
            Mistake(
                "a mean over the points: L_recon is summed over the patch; the mean is over the "
                "batch.",
                flawed_loss("point mean"),
            ),
            Mistake(
                "a sum over the batch: the loss must not grow with the number of samples.",
                flawed_loss("batch sum"),
            ),
            Mistake(
                "heights in metres: the autoencoder works with 4 * patch.", flawed_loss("metres")
            ),
            Mistake(
                "no KL term: without it the latent is free to memorise patches.",
                flawed_loss("no kl"),
            ),
        ),
        hints=(
            "Four steps: encode, sample, decode, add up. L_KL = 1/2 sum of mean^2 + variance - 1 - "
            "log variance, over the latent.",
            "latent = mean + torch.exp(0.5 * log_variance) * noise",
            "((f - r_v) ** 2 + alpha * (recon + beta * kl)).mean(), with one number per sample in "
            "f, r_v, recon and kl.",
        ),
    ),
    Question(
        id="ex03.q3",
        name="reliability",
        points=3,
        title="predicted against measured",
        expects="row b of the table holds, of the samples whose PREDICTION lies in the b-th of "
        "`bins` equal parts of [0, 1], the mean prediction, the mean measurement and the count (1 "
        "belongs to the last part; an empty part has NaN means). The error is the mean distance of "
        "the two means, each part weighted by its count.",
        draw=_predictions,
        truth=lambda predicted, measured, bins: _with_error(_rows(predicted, measured, bins)),
        mistakes=(
            Mistake(
                "parts by measurement: the question is how those fared that were PREDICTED to be "
                "so; sort by the prediction.",
                lambda p, m, bins: _with_error(_rows(p, m, bins, by=m)),
            ),
            Mistake(
                "a lost 1.0: predictions of exactly 1 fall out of the last part: limit the index.",
                _half_open,
            ),
            Mistake(
                "centres in place of means: the first column is the mean prediction in the part, "
                "not the middle of the part.",
                _centred,
            ),
            Mistake(
                "zeros in an empty part: it has no mean; 0 would draw a point that was never "
                "measured.",
                lambda p, m, bins: (
                    np.nan_to_num(_rows(p, m, bins)),
                    _with_error(_rows(p, m, bins))[1],
                ),
            ),
            Mistake(
                "swapped columns: the mean prediction comes first, then the mean measurement.",
                lambda p, m, bins: (
                    _rows(p, m, bins)[:, [1, 0, 2]],
                    _with_error(_rows(p, m, bins))[1],
                ),
            ),
            Mistake(
                "parts of equal weight: a part with one sample would count as much as one with "
                "twenty.",
                _unweighted,
            ),
            Mistake(
                "a signed difference: too high in one part and too low in another would cancel.",
                _signed,
            ),
        ),
        hints=(
            "(predicted * bins).astype(int) is the index of the part, but for 1.0; "
            "np.minimum(index, bins - 1) puts 1.0 into the last part.",
            "Start from a table of NaN, set the counts, and fill in the means of the parts that "
            "are not empty.",
            "0 * NaN is NaN: np.nansum skips the empty parts.",
        ),
    ),
    Question(
        id="ex03.q4",
        name="rollout_labels",
        points=3,
        title="labels from a rollout",
        expects="a label is the mean r_v over the next `window` steps of the SAME episode; the "
        "steps that a fall takes away count as zeros, those that a time-out or the end of the "
        "rollout takes away do not count. A label is trusted if a fall ends its window, or if at "
        "least half of the window was seen.",
        draw=_rollout,
        truth=lambda r_v, failed, ended, window: _labels(r_v, failed, ended, window),
        mistakes=(
            Mistake(
                "a window that looks into the next episode: it must stop at the step that ended "
                "this one.",
                lambda r, f, e, w: _labels(r, f & False, e & False, w),
            ),
            Mistake(
                "a fall that only cuts the window short: the steps that never happened are zeros, "
                "or the edge of a gap looks feasible.",
                lambda r, f, e, w: (_labels(r, f & False, e, w)[0], _labels(r, f, e, w)[1]),
            ),
            Mistake(
                "a time-out treated as a fall: nothing went wrong, the episode was only over.",
                lambda r, f, e, w: _labels(r, e, e, w),
            ),
            Mistake(
                "an end without its own step: the step that ends an episode still belongs to it.",
                _late_end,
            ),
            Mistake(
                "labels of a fall not trusted: the zeros after it are known, however few steps "
                "were seen.",
                lambda r, f, e, w: (_labels(r, f, e, w)[0], _labels(r, f & False, e, w)[1]),
            ),
            Mistake(
                "all labels trusted: one step is no window: at least half of it must be seen.",
                lambda r, f, e, w: _labels(r, f, e, w, least=0.0),
            ),
            Mistake(
                "only whole windows trusted: half of the window is enough.",
                lambda r, f, e, w: _labels(r, f, e, w, least=1.0),
            ),
        ),
        hints=(
            "Three nested loops are fine: robots, steps, and the steps of the window; break at the "
            "step where `ended` is True, after adding its r_v.",
            "Divide by `window` if that step was a fall, else by the number of steps that you "
            "added.",
        ),
    ),
    Question(
        id="ex03.q5",
        name="train",
        points=3,
        title="a training loop with a test it has not seen",
        expects="after at most `most` updates, none of which looked at the held-out data, the "
        "net's calibration error on the held-out data is at most `goal`, and its mean squared "
        "error there at most a quarter of the labels' variance; the answer is the number of "
        "updates and that calibration error.",
        draw=training_case,
        harness=training_answers,
        seconds=20.0,
        truth=train,
        mistakes=(
            Mistake(
                "a net that was not trained: call backward() on the loss and step() on the "
                "optimizer, in a loop.",
                flawed_training("untrained"),
            ),
            Mistake(
                "training on the held-out data: then its error says nothing about new ground.",
                flawed_training("held out"),
            ),
            Mistake(
                "one update too many: `most` is the budget. (Each pass through the net with "
                "gradients counts: evaluate under torch.no_grad().)",
                flawed_training("over budget"),
            ),
            Mistake(
                "a net that answers the mean for everything: it is calibrated, and useless; aim at "
                "each sample's own r_v.",
                flawed_training("constant"),
            ),
            Mistake(
                "an error that is not the net's: return the calibration error on the held-out "
                "data, of the net as it is at the end.",
                flawed_training("made up"),
            ),
            Mistake(
                "updates that are not counted: return how many there were.",
                flawed_training("uncounted"),
            ),
        ),
        hints=(
            "optimizer = torch.optim.Adam(net.parameters(), lr=0.05); per update: f = net(patch), "
            "loss = ((f - r_v) ** 2).mean(), zero_grad, backward, step.",
            "Every ten updates, with torch.no_grad(): f = net(held_patch); reliability of question "
            "3 with 5 bins gives the error. f.numpy() turns a tensor into an array.",
            "Stop when both conditions hold, or after `most` updates.",
        ),
    ),
)
