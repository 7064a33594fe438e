"""The settings that every evaluation of planned routes shares: whose zoo, and how to plan in it.

Reads nothing; gives `PlannedConfig`, from which the commands' own configurations derive.
Source: paper, Sec. III-B (taus) and III-C (edge cost, f_min).
"""

from dataclasses import dataclass
from pathlib import Path

from fgtutor.evaluation.shards import RunConfig, digest
from fgtutor.io.validation import Seed
from fgtutor.settings import PlanOptions
from fgtutor.specialist import DESCRIPTION, ZOO, Specialist, load_zoo


@dataclass(frozen=True, kw_only=True)
class PlannedConfig(PlanOptions, RunConfig):
    """Which specialists plan, and by what rules."""

    robot: str = "toy"
    """Which robot."""
    seed: Seed = 0
    """What grounds and starts are drawn from."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo."""

    @property
    def home(self) -> Path:
        """Where the specialists' folders lie."""
        return self.zoo or ZOO / self.robot

    @property
    def folders(self) -> list[Path]:
        """The specialists' folders."""
        return sorted(path.parent for path in self.home.glob(f"[!._]*/{DESCRIPTION}"))

    def load_zoo(self) -> dict[str, Specialist]:
        """Return the specialists and the generalist, if there is one."""
        return load_zoo(self.robot, self.home, include_general=True)

    def zoo_digests(self) -> dict[str, str]:
        """Return a digest of each of them, which changes with any of its weights."""
        return {folder.name: digest((folder / DESCRIPTION).read_bytes()) for folder in self.folders}
