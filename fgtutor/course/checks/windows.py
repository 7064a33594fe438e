"""Windows of exercise 05: right answers and typical mistakes of its questions that ask a network.

Gives cases, the harnesses that count what is asked (their source is sent to the grader's process,
so they import what they need), and answers that gather each window by itself (Sec. III-B).
"""

from collections.abc import Callable
from typing import Any

import numpy as np


def map_with_gap(rng: np.random.Generator) -> tuple:
    """Draw a map with an unknown cell, the size of a window, and the weights of its network."""
    heights = rng.normal(0, 1, (int(rng.integers(7, 9)), int(rng.integers(6, 8))))
    heights[rng.integers(2, 5), rng.integers(2, 4)] = np.nan
    return heights, 3, 3, rng.normal(0, 0.5, 9)


def tensor_answers(
    target: "Any", heights: "np.ndarray", rows: int, columns: int, weights: "np.ndarray"
) -> tuple:
    """Return the learner's tensor, whether four calls were enough, and the windows asked."""
    import numpy as np

    calls = []

    def ask(windows: np.ndarray) -> np.ndarray:
        windows = np.asarray(windows)
        if windows.ndim != 2 or windows.shape[1] != len(weights):
            raise ValueError(f"ask takes windows [n, {len(weights)}], got {windows.shape}")
        calls.append(len(windows))
        return 1 / (1 + np.exp(-(windows @ weights)))

    tensor = target(heights, rows, columns, ask)
    return tensor, len(calls) <= 4, sum(calls)


def gathered(
    heights: np.ndarray,
    rows: int,
    columns: int,
    ask: Callable[[np.ndarray], np.ndarray],
    *,
    single: bool = False,
    twice: bool = False,
    unknown: bool = False,
    relative: bool = True,
    headings: tuple[int, ...] = (0, 1, 2, 3),
    mirrored: bool = False,
    back: int = 0,
) -> np.ndarray:
    """Gather each window cell by cell, from where the robot stands; the options make it wrong."""
    tensor, places, windows = np.zeros((*heights.shape, 4)), [], []
    for k, heading in enumerate(headings):
        ahead = np.array(((1, 0), (0, 1), (-1, 0), (0, -1))[heading])
        left = np.array((-ahead[1], ahead[0])) * (-1 if mirrored else 1)
        inner = [(i - back, j - columns // 2) for i in range(rows) for j in range(columns)]
        for cell in np.ndindex(heights.shape):
            cells = np.array([cell + i * ahead + j * left for i, j in inner])
            if (cells >= 0).all() and (cells < heights.shape).all():
                window = heights[cells[:, 0], cells[:, 1]] - (heights[cell] if relative else 0)
                if unknown or np.isfinite(window).all():
                    places.append((*cell, k))
                    windows.append(window)
    scores = _asked(windows, ask, single)
    if twice:
        ask(np.array(windows))
    tensor[tuple(np.array(places).T)] = np.nan_to_num(scores)
    return tensor


def _asked(windows: list, ask: Callable[[np.ndarray], np.ndarray], single: bool) -> np.ndarray:
    batches = np.array(windows)[:, None] if single else np.array(windows)[None]
    return np.concatenate([ask(batch) for batch in batches])


def stroke(rng: np.random.Generator) -> tuple:
    """Draw a map before and after a stroke, the size of a window, and the weights."""
    before = rng.normal(0, 1, (9, 8))
    before[0, 0] = before[7, 6] = np.nan
    after = before.copy()
    x, y = rng.integers(3, 5, 2)
    after[x : x + 2, y] += 1.0
    after[x, y - 1] = np.nan  # seen before, unknown now
    after[7, 6] = 0.0  # unknown before, seen now
    return before, after, 3, 2, rng.normal(0, 0.5, 6)


def update_answers(
    target: "Any",
    before: "np.ndarray",
    after: "np.ndarray",
    rows: int,
    columns: int,
    weights: "np.ndarray",
) -> tuple:
    """Return the learner's new answers, the windows asked, the calls, and if the old ones stand."""
    import numpy as np

    asked = []

    def ask(windows: np.ndarray) -> np.ndarray:
        asked.append(len(windows))
        return 1 / (1 + np.exp(-(np.asarray(windows) @ weights)))

    views = np.lib.stride_tricks.sliding_window_view(before, (rows, columns))
    old = np.nan_to_num(ask(views.reshape(*views.shape[:2], -1)))
    asked.clear()
    given = old.copy()
    new = np.array(target(given, before, after, rows, columns, ask))
    return new, sum(asked), len(asked), bool((given == old).all())


def reassessed(
    answers: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    rows: int,
    columns: int,
    ask: Callable[[np.ndarray], np.ndarray],
    *,
    everything: bool = False,
    corner: bool = False,
    stale: bool = False,
    shown: np.ndarray | None = None,
    single: bool = False,
    in_place: bool = False,
) -> np.ndarray:
    """Look at each window in turn; the options make it wrong."""
    new, places, windows = answers if in_place else answers.copy(), [], []
    for i, j in np.ndindex(answers.shape):
        cut = np.s_[i : i + rows, j : j + columns]
        changed = (before[cut] != after[cut]).ravel()
        if not (everything or changed[: 1 if corner else None].any()):
            continue
        if not np.isnan(after[cut]).any():
            places.append((i, j))
            windows.append((after if shown is None else shown)[cut].ravel())
        elif not stale:
            new[i, j] = 0.0
    new[tuple(np.array(places).T)] = _asked(windows, ask, single)
    return new
