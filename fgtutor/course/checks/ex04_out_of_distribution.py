"""Exercise 04, "Have I seen this before?": L_recon, w_ood, p-values (paper, Eqs. 3-5)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question


def _patches(rng: np.random.Generator) -> tuple:
    n, points = rng.integers(3, 6), rng.integers(4, 9)
    patch = rng.normal(0, 0.1, (n, points))
    return patch, 4 * patch + rng.normal(0, 0.2, (n, points)), float(rng.choice([2.0, 4.0, 5.0]))


def _losses(rng: np.random.Generator) -> tuple:
    low = float(rng.uniform(0.05, 0.5))
    high = low + float(rng.uniform(0.5, 3.0))
    loss = rng.uniform(0, high + 1, (4, 5))
    loss[0, :4] = 0.5 * low, low, high, high + 1.0
    return loss, low, high


def _weight(loss: np.ndarray, tau_low: float, tau_high: float) -> np.ndarray:
    return np.interp(loss, (tau_low, tau_high), (1.0, 0.0))


def _own_losses(rng: np.random.Generator) -> tuple:
    own = rng.lognormal(-1, 0.8, rng.integers(100, 200))
    tail = np.sort(own)[-int(rng.integers(2, 5))]  # as strange as one of its own
    losses = np.array([*rng.lognormal(-1, 0.8, 4), tail, 1.2 * tail, 2 * own.max()])
    return losses, own, float(rng.choice([0.05, 0.1, 0.2]))


def _share_beyond(losses: np.ndarray, own: np.ndarray) -> np.ndarray:
    return 1 - np.searchsorted(np.sort(own), losses) / len(own)


def _interpolated(losses: np.ndarray, own: np.ndarray, alpha: float) -> np.ndarray:
    levels = 1 - np.arange(len(own)) / len(own)
    return np.minimum(np.interp(losses, np.sort(own), levels, right=0.0) / alpha, 1.0)


def _ceiling(f: float, f_min: float) -> float:
    return 0.1 + 1.9 * (1 - f_min / f)


QUESTIONS = (
    Question(
        id="ex04.q1",
        name="reconstruction_loss",
        points=1,
        title="L_recon of a patch",
        expects="L_recon is one number per patch: the SUM over its points of the squared error, in "
        "the scaled units that the VAE sees (height_scale * metres).",
        draw=_patches,
        truth=lambda patch, decoded, height_scale: np.einsum(
            "np,np->n", height_scale * patch - decoded, height_scale * patch - decoded
        ),
        mistakes=(
            Mistake(
                "a mean over the points: the errors are averaged over the points, so tau = 0.1 and "
                "2.0 lose their meaning.",
                lambda x, y, s: ((s * x - y) ** 2).mean(axis=-1),
            ),
            Mistake(
                "a forgotten scale: the patch is compared in metres, but the decoder speaks in "
                "scaled heights.",
                lambda x, y, s: ((x - y) ** 2).sum(axis=-1),
            ),
            Mistake(
                "the sum over the wrong axis: it sums over the patches of the batch; each patch "
                "keeps a loss of its own.",
                lambda x, y, s: ((s * x - y) ** 2).sum(axis=0),
            ),
            Mistake(
                "one number for the whole batch: it sums over patches too; each patch keeps a loss "
                "of its own (axis=-1).",
                lambda x, y, s: ((s * x - y) ** 2).sum(),
            ),
            Mistake(
                "absolute errors: the errors are not squared.",
                lambda x, y, s: np.abs(s * x - y).sum(axis=-1),
            ),
            Mistake(
                "a root too many: the square root is taken: L_recon is the squared distance "
                "itself.",
                lambda x, y, s: np.sqrt(((s * x - y) ** 2).sum(axis=-1)),
            ),
        ),
        hints=(
            "Bring both into one unit first: the decoder's output is already scaled.",
            "A patch is one row: which axis runs over its points?",
            "((height_scale * patch - decoded) ** 2), summed over the last axis.",
        ),
    ),
    Question(
        id="ex04.q2",
        name="ood_weight",
        points=1,
        title="the weight w_ood",
        expects="w_ood is 1 up to tau_low, 0 from tau_high on, and falls linearly between.",
        draw=_losses,
        examples=((np.array([0.0, 0.1, 1.05, 2.0, 50.0]), 0.1, 2.0),),
        truth=_weight,
        mistakes=(
            Mistake(
                "swapped taus, or a forgotten '1 -' (both come to the same): it grows with the "
                "loss, so that unknown terrain gets the weight 1.",
                lambda loss, low, high: np.clip((loss - low) / (high - low), 0, 1),
            ),
            Mistake(
                "a forgotten clip: below tau_low it exceeds 1, and above tau_high it is negative.",
                lambda loss, low, high: 1 - (loss - low) / (high - low),
            ),
            Mistake(
                "half a clip: it stops at 0, but below tau_low it exceeds 1.",
                lambda loss, low, high: np.maximum(1 - (loss - low) / (high - low), 0),
            ),
            Mistake(
                "a hard threshold: it jumps from 1 to 0 at tau_high; between the taus it should "
                "fall gradually.",
                lambda loss, low, high: np.where(loss < high, 1.0, 0.0),
            ),
            Mistake(
                "division by tau_high alone: the ramp must span tau_high - tau_low, so that it "
                "reaches 0 at tau_high.",
                lambda loss, low, high: np.clip(1 - (loss - low) / high, 0, 1),
            ),
        ),
        hints=(
            "What should a loss of exactly tau_low give, and exactly tau_high?",
            "(loss - tau_low) / (tau_high - tau_low) runs from 0 to 1 between the two.",
            "np.clip keeps what lies beyond the ends at 0 and 1.",
        ),
    ),
    Question(
        id="ex04.q3",
        name="conformal_weight",
        points=1,
        title="a weight that means the same in every network",
        expects="p is the share of the own losses that are at least as large as the loss; the "
        "weight is p / alpha, and never above 1.",
        draw=_own_losses,
        truth=lambda losses, own, alpha: np.minimum(_share_beyond(losses, own) / alpha, 1.0),
        mistakes=(
            Mistake(
                "the wrong tail: the share of own losses BELOW the loss grows with strangeness; "
                "count those at least as large.",
                lambda losses, own, alpha: np.minimum((1 - _share_beyond(losses, own)) / alpha, 1),
            ),
            Mistake(
                "p itself: it has to be divided by alpha, so that all but a share alpha of the own "
                "terrain keeps full weight.",
                lambda losses, own, alpha: _share_beyond(losses, own),
            ),
            Mistake(
                "a hard test: p >= alpha says familiar or not; between 0 and alpha the weight "
                "should fall gradually.",
                lambda losses, own, alpha: (_share_beyond(losses, own) >= alpha).astype(float),
            ),
            Mistake(
                "a weight above 1: p / alpha is clipped to 1 where the patch is familiar.",
                lambda losses, own, alpha: _share_beyond(losses, own) / alpha,
            ),
            Mistake(
                "a count in place of a share: divide the number of own losses beyond by how many "
                "there are (or take the mean).",
                lambda losses, own, alpha: np.minimum(
                    len(own) * _share_beyond(losses, own) / alpha, 1.0
                ),
            ),
            Mistake(
                "a share that is interpolated between own losses: p is a count divided by the "
                "number of own losses, so it is a step function of the loss.",
                _interpolated,
            ),
            Mistake(
                "a rank that starts at 1: count the own losses that are at least as large; the "
                "loss itself is not one of them.",
                lambda losses, own, alpha: np.minimum(
                    (_share_beyond(losses, own) * len(own) + 1) / (len(own) + 1) / alpha, 1.0
                ),
            ),
            Mistake(
                "larger, not at least as large: an own patch is as strange as itself.",
                lambda losses, own, alpha: np.minimum(
                    np.mean(own > losses[:, None], axis=1) / alpha, 1.0
                ),
            ),
        ),
        hints=(
            "Compare every loss with every own loss: own[None, :] >= losses[:, None] is [m, n].",
            "The mean of True and False along an axis is a share.",
            "np.clip(p / alpha, 0, 1).",
        ),
    ),
    Question(
        id="ex04.q4",
        name="largest_loss",
        points=2,
        title="when does a good place close?",
        expects="the L_recon from which on F lies below f_min = 0.1 although f = 0.9, with the "
        "paper's taus, 0.1 and 2.0.",
        truth=lambda: _ceiling(0.9, 0.1),
        mistakes=(
            Mistake(
                "tau_high itself: there w_ood is 0; the place closes before, as soon as w_ood * f "
                "< f_min.",
                lambda: 2.0,
            ),
            Mistake(
                "a forgotten f: w_ood need not fall to 0.1, only to 0.1 / f.",
                lambda: _ceiling(1.0, 0.1),
            ),
            Mistake(
                "the ramp read backwards: that is where w_ood has fallen BY 1/9, not TO 1/9.",
                lambda: 0.1 + 1.9 / 9,
            ),
            Mistake(
                "a ramp that starts at 0: w_ood begins to fall at tau_low = 0.1: add it.",
                lambda: 1.9 * (1 - 1 / 9),
            ),
        ),
        hints=("Which w_ood makes w_ood * 0.9 = 0.1?", "Solve 1 - (L - 0.1) / 1.9 = 1/9 for L."),
        rtol=5e-3,
    ),
)
