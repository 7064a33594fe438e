"""Exercise 05, "From map to tensor": windows, convolution, headings, L_recon (Sec. III-B)."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fgtutor.course.checks.question import Mistake, Question
from fgtutor.course.checks.windows import (
    gathered,
    map_with_gap,
    reassessed,
    stroke,
    tensor_answers,
    update_answers,
)


def _layer_inputs(rng: np.random.Generator) -> tuple:
    shape = (int(rng.integers(5, 9)), int(rng.integers(5, 9)))
    return rng.normal(0, 1, shape), rng.normal(0, 1, (3, 3)), float(rng.normal(0, 1))


def _layer(heights: np.ndarray, kernel: np.ndarray, bias: float) -> np.ndarray:
    return np.einsum("xyij,ij->xy", sliding_window_view(heights, kernel.shape), kernel) + bias


def _tensor(rng: np.random.Generator) -> tuple:
    shape = (int(rng.integers(3, 5)), int(rng.integers(5, 7)), 8)
    return rng.uniform(0, 1, shape), int(rng.integers(1, 4))


def _turned(tensor: np.ndarray, quarter: int, shift: int) -> np.ndarray:
    return np.rot90(np.roll(tensor, shift, axis=-1), quarter, axes=(0, 1))


def _decoder(rng: np.random.Generator) -> tuple:
    n, points, latent = 5, 9, 3
    decoder = rng.normal(0, 1, (points, latent))
    aims, codes = rng.normal(0, 1, (n, points)), rng.normal(0, 1, (n, latent))
    return codes, (aims**2).sum(axis=-1), aims @ decoder, decoder.T @ decoder


def _loss(
    codes: np.ndarray,
    squares: np.ndarray,
    products: np.ndarray,
    gram: np.ndarray,
    cross: float = -2.0,
) -> np.ndarray:
    quadratic = np.einsum("ni,ij,nj->n", codes, gram, codes)
    return squares + cross * (products * codes).sum(axis=-1) + quadratic


QUESTIONS = (
    Question(
        id="ex05.q1",
        name="tensorize",
        points=3,
        title="the sliding window, four headings, little work",
        expects="tensor[ix, iy, k] is what `ask` says of the window that lies ahead of cell (ix, "
        "iy) along heading 0, 90, 180 or 270 degrees, relative to the cell's own height; 0 where "
        "the window leaves the map or holds an unknown cell. Such windows are not asked, every "
        "other one is asked exactly once, in at most four calls.",
        draw=map_with_gap,
        harness=tensor_answers,
        truth=gathered,
        mistakes=(
            Mistake(
                "one call per window: collect the windows of a heading, and ask them together.",
                lambda *given: gathered(*given, single=True),
            ),
            Mistake(
                "windows asked twice: each one is asked once; keep the answer.",
                lambda *given: gathered(*given, twice=True),
            ),
            Mistake(
                "unknown windows asked: leave them out before `ask`; putting 0 into the tensor "
                "afterwards wastes the work.",
                lambda *given: gathered(*given, unknown=True),
            ),
            Mistake(
                "absolute heights: a window is relative to the height of the cell where the robot "
                "stands.",
                lambda *given: gathered(*given, relative=False),
            ),
            Mistake(
                "headings that turn clockwise: index 1 is +y, index 3 is -y.",
                lambda *given: gathered(*given)[..., [0, 3, 2, 1]],
            ),
            Mistake(
                "one heading for all: the window turns with the robot.",
                lambda *given: gathered(*given, headings=(0, 0, 0, 0)),
            ),
            Mistake(
                "left and right exchanged: the columns of a window run from the robot's right to "
                "its left.",
                lambda *given: gathered(*given, mirrored=True),
            ),
            Mistake(
                "a window centred on the robot: its first row is the one that the robot stands in.",
                lambda *given: gathered(*given, back=1),
            ),
        ),
        hints=(
            "Turn the map, not the window: np.rot90(heights, -k) brings heading k to +x. Turn the "
            "answers back with np.rot90(plane, k).",
            "sliding_window_view(turned, (rows, columns)) holds the windows along +x; the robot of "
            "window [i, j] stands at cell [i, j + columns // 2].",
            "known = np.isfinite(windows).all(axis=-1); scores[known] = ask(windows[known])",
        ),
    ),
    Question(
        id="ex05.q2",
        name="first_layer",
        points=1,
        title="one neuron of the first layer, everywhere at once",
        expects="the answer at (i, j) is the sum over the window of heights * kernel, plus the "
        "bias once: what that neuron says to the window at (i, j).",
        draw=_layer_inputs,
        truth=_layer,
        mistakes=(
            Mistake(
                "a flipped kernel: in mathematics a convolution flips its kernel; a network's does "
                "not.",
                lambda h, k, b: _layer(h, k[::-1, ::-1], b),
            ),
            Mistake(
                "a transposed kernel: the first axis of the kernel runs along x, as that of the "
                "map.",
                lambda h, k, b: _layer(h, k.T, b),
            ),
            Mistake(
                "a forgotten bias: a linear layer adds its bias.", lambda h, k, b: _layer(h, k, 0.0)
            ),
            Mistake(
                "a bias for every point: the bias is added once, after the sum.",
                lambda h, k, b: _layer(h, k, b * k.size),
            ),
            Mistake(
                "a mean over the window: a neuron sums its inputs.",
                lambda h, k, b: _layer(h, k / k.size, b),
            ),
        ),
        hints=(
            "For one window: (window * kernel).sum() + bias.",
            "Turn the loop inside out: for each kernel entry [i, j], add kernel[i, j] times the "
            "map shifted by (i, j). That is a convolution layer.",
        ),
    ),
    Question(
        id="ex05.q3",
        name="turned",
        points=1,
        title="turn the map, and the headings turn with it",
        expects="after `quarters` quarter turns counter-clockwise the map is np.rot90(map, "
        "quarters), and what was feasible along heading k is feasible along k + 2 * quarters.",
        draw=_tensor,
        truth=lambda tensor, quarters: _turned(tensor, quarters, 2 * quarters),
        mistakes=(
            Mistake(
                "headings left behind: the cells turn, but each still names the old headings.",
                lambda f, q: _turned(f, q, 0),
            ),
            Mistake(
                "a heading off by one: a quarter turn is two headings of 45 degrees, not one.",
                lambda f, q: _turned(f, q, q),
            ),
            Mistake(
                "headings turned clockwise: counter-clockwise, headings count up: 0 (+x) "
                "becomes 2 (+y).",
                lambda f, q: _turned(f, q, -2 * q),
            ),
            Mistake(
                "a map turned clockwise: np.rot90 turns the first axis (x) towards the second (y): "
                "counter-clockwise already.",
                lambda f, q: _turned(f, -q, 2 * q),
            ),
            Mistake(
                "headings turned alone: the cells must turn as well.",
                lambda f, q: _turned(f, 0, 2 * q),
            ),
        ),
        hints=(
            "np.rot90(tensor, quarters) turns the first two axes.",
            "Where does a robot that was heading +x point after a quarter turn? Which number is "
            "that?",
            "np.roll(tensor, 2 * quarters, axis=-1) moves what stood at k to k + 2 * quarters.",
        ),
    ),
    Question(
        id="ex05.q4",
        name="reconstruction",
        points=1,
        title="L_recon without decoding a patch",
        expects="the squared distance between a patch a and its decoded D g, one number per patch, "
        "worked out without D and without a.",
        draw=_decoder,
        truth=lambda codes, squares, products, gram: _loss(codes, squares, products, gram),
        mistakes=(
            Mistake(
                "a forgotten 2: both mixed terms of the square are there.",
                lambda g, s, p, m: _loss(g, s, p, m, cross=-1.0),
            ),
            Mistake(
                "a turned sign: the mixed term is subtracted: (a - b)^2 = a^2 - 2 a b + b^2.",
                lambda g, s, p, m: _loss(g, s, p, m, cross=2.0),
            ),
            Mistake(
                "a forgotten Gram matrix: ||D g||^2 is g . (D^T D) g, not ||g||^2.",
                lambda g, s, p, m: _loss(g, s, p, np.eye(len(m))),
            ),
            Mistake(
                "only the diagonal of the Gram matrix: the columns of D are not orthogonal: all of "
                "D^T D counts.",
                lambda g, s, p, m: _loss(g, s, p, np.diag(np.diag(m))),
            ),
            Mistake(
                "one number for the whole batch: each patch has a loss of its own: sum over the "
                "latent only.",
                lambda g, s, p, m: _loss(g, s, p, m).sum(),
            ),
        ),
        hints=(
            "Multiply out ||a - D g||^2 as you would (a - b)^2.",
            "((codes @ gram) * codes).sum(axis=-1) is g . gram g for every patch.",
        ),
    ),
    Question(
        id="ex05.q5",
        name="reassess",
        points=3,
        title="paint a step, and ask only where it counts",
        expects="the answers for the map `after` the change; only windows that hold a changed cell "
        "and no unknown one are asked, in one call; a window with an unknown cell has 0, and the "
        "array that was given is not changed.",
        draw=stroke,
        harness=update_answers,
        truth=reassessed,
        mistakes=(
            Mistake(
                "the whole map asked again: only windows that hold a changed cell can have a new "
                "answer.",
                lambda *given: reassessed(*given, everything=True),
            ),
            Mistake(
                "changed corners alone: a window holds rows x columns cells, and each of them may "
                "have changed.",
                lambda *given: reassessed(*given, corner=True),
            ),
            Mistake(
                "an old answer where a cell became unknown: its windows are 0 now.",
                lambda *given: reassessed(*given, stale=True),
            ),
            Mistake(
                "windows of the map before: ask about the map `after` the change.",
                lambda old, before, after, r, c, ask: reassessed(
                    old, before, after, r, c, ask, shown=np.where(np.isnan(before), after, before)
                ),
            ),
            Mistake(
                "one call per window: ask all of them together.",
                lambda *given: reassessed(*given, single=True),
            ),
            Mistake(
                "the given array changed: it belongs to the caller; work on answers.copy().",
                lambda *given: reassessed(*given, in_place=True),
            ),
        ),
        hints=(
            "changed = before != after (an unknown cell, NaN, counts as changed: its windows are 0 "
            "before and after, so no harm is done)",
            "sliding_window_view(changed, (rows, columns)).any(axis=(-2, -1)) says which windows "
            "hold a changed cell.",
            "Set all of these to 0 first, then ask those among them that are known.",
        ),
    ),
)
