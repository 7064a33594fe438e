"""A training curve that redraws itself in a notebook while the training goes on.

Reads the numbers of each iteration; shows them below the cell that trains.
"""

import math
import time
from collections.abc import Mapping, Sequence

from IPython.display import display

from fgtutor.figures.charts import training_curve


class LiveCurve:
    """A training curve that draws itself anew as rows come in: pass it as `on_iteration`."""

    def __init__(self, seconds: float = 3.0) -> None:
        """Show the picture here and now; it is drawn anew after that many seconds at the least."""
        self.rows: list[dict[str, float]] = []
        self.seconds, self.last, self.handle = seconds, -math.inf, None

    def __call__(self, row: dict[str, float]) -> None:
        """Take one iteration's numbers."""
        self.rows.append(row)
        if time.monotonic() - self.last >= self.seconds:
            self.draw()

    def draw(self, rows: Sequence[Mapping[str, float]] | None = None) -> None:
        """Draw these rows, such as those of a run that was resumed; by default those so far."""
        picture = training_curve(self.rows if rows is None else rows)
        if self.handle is None:
            self.handle = display(picture, display_id=True)
        else:
            self.handle.update(picture)
        self.last = time.monotonic()
