"""Exercise 05, "From map to tensor": windows, convolution, headings, L_recon (Sec. III-B)."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fgtutor.course.checks.question import Mistake, Question


def _map_and_window(rng: np.random.Generator) -> tuple:
    shape = (int(rng.integers(6, 9)), int(rng.integers(5, 8)))
    return rng.normal(0, 1, shape), 3, 2


def _windows(heights: np.ndarray, rows: int, columns: int) -> np.ndarray:
    windows = sliding_window_view(heights, (rows, columns))
    return windows.reshape(*windows.shape[:2], rows * columns)


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
        name="windows",
        points=2,
        title="the sliding window",
        expects="window [i, j] holds the rows x columns heights whose lowest corner is cell (i, "
        "j), flattened with y fastest; one window for every place where it fits.",
        draw=_map_and_window,
        truth=_windows,
        mistakes=(
            Mistake(
                "a window read y first: x varies slowest in a flattened patch: rows follow one "
                "another as they lie.",
                lambda h, r, c: (
                    sliding_window_view(h, (r, c))
                    .swapaxes(-1, -2)
                    .reshape(len(h) - r + 1, -1, r * c)
                ),
            ),
            Mistake(
                "one window too few: a map of nx cells holds nx - rows + 1 windows along x, not nx "
                "- rows.",
                lambda h, r, c: _windows(h, r, c)[:-1, :-1],
            ),
            Mistake(
                "windows side by side: it jumps by whole windows; it should slide by one cell.",
                lambda h, r, c: _windows(h, r, c)[::r, ::c],
            ),
            Mistake(
                "a window turned on its side: rows run along x, the first axis; columns along y.",
                lambda h, r, c: _windows(h, c, r),
            ),
            Mistake(
                "windows in swapped order: the first axis of the answer is i, along x.",
                lambda h, r, c: _windows(h, r, c).swapaxes(0, 1),
            ),
        ),
        hints=(
            "How many places are there along x for 3 rows in a map of 6?",
            "heights[i : i + rows, j : j + columns].ravel() is one window.",
            "numpy.lib.stride_tricks.sliding_window_view makes them all without copying.",
        ),
    ),
    Question(
        id="ex05.q2",
        name="first_layer",
        points=3,
        title="one neuron of the first layer, everywhere at once",
        expects="the answer at (i, j) is the sum over the window of heights * kernel, plus the "
        "bias once: what that neuron says to the window at (i, j).",
        draw=_layer_inputs,
        truth=_layer,
        mistakes=(
            Mistake(
                "a flipped kernel: that is the mathematician's convolution; a network correlates, "
                "without flipping.",
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
                "mean for sum: a neuron sums its inputs.", lambda h, k, b: _layer(h, k / k.size, b)
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
        points=2,
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
                "headings turned the other way: counter-clockwise, headings count up: 0 (+x) "
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
        points=2,
        title="L_recon without decoding a patch",
        expects="||a - D g||^2 = squares - 2 products . g + g . gram g, one number per patch; with "
        "squares = ||a||^2, products = D^T a and gram = D^T D no patch is decoded.",
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
)
