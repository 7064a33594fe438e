"""The exceptions of fgtutor: each says what was expected, what came, and what to do next.

All derive from `FgtutorError`, itself a `ValueError`, so one `except` at a stage boundary is
enough.
"""


class FgtutorError(ValueError):
    """Base of every error that fgtutor raises on purpose."""


class MapError(FgtutorError):
    """An elevation map, or a file that should hold one, is not usable."""


class TerrainError(FgtutorError):
    """A terrain was asked for by an unknown name or with parameters out of range."""


class ThresholdError(FgtutorError):
    """The reconstruction thresholds tau_low and tau_high are not usable."""


class SpecialistError(FgtutorError):
    """A specialist folder is missing, corrupt, truncated or made for something else."""


class CheckpointError(FgtutorError):
    """A training checkpoint cannot be resumed: corrupt, or of another robot, terrain or config."""


class DivergedError(FgtutorError):
    """A training's numbers are no longer finite; its last checkpoint is as it was."""


class StorageError(FgtutorError):
    """A file could not be written (full disk, read-only folder); nothing partial is left."""


class ConfigError(FgtutorError):
    """A setting has a value that cannot work."""


class SimulationError(FgtutorError):
    """A simulator was given, or produced, a state that cannot be used."""


class PlanningError(FgtutorError):
    """No route can be planned; the subclasses say why."""


class OffMapError(PlanningError):
    """The start or the goal lies outside the map."""


class UnknownCellError(PlanningError):
    """The start or the goal lies on a cell that was never observed."""


class InfeasibleCellError(PlanningError):
    """The start or the goal lies on a cell that no policy can leave, or none can enter."""


class UnreachableError(PlanningError):
    """Start and goal are both usable, but no chain of feasible edges joins them."""


class DoubtfulRouteError(PlanningError):
    """The cheapest route promises less than was asked: it would hardly be walked to its end."""


class RenderingError(FgtutorError):
    """MuJoCo cannot draw on this machine: no graphics library works, or it gave up on the way."""


class NotebookError(FgtutorError):
    """A notebook of the course could not be built from its source."""


class GradingError(FgtutorError):
    """A submission could not be run, by no fault of its own: the machine is busy or has no room."""


class CloudError(FgtutorError):
    """A point cloud, or a file that should hold one, is not usable."""


class MissingExtraError(FgtutorError):
    """Something optional was asked for whose package is not installed."""


class EvaluationError(FgtutorError):
    """A task of an evaluation failed, or took its worker down each time it was tried."""


class ReportError(FgtutorError):
    """A report folder holds another run's results, or not yet all of this one's."""


class ExportError(FgtutorError):
    """An exported network does not answer as the policy it was made from."""


class TooLargeError(FgtutorError):
    """What was asked for needs more memory than this machine has left."""
