"""Plan over several locomotion specialists by how feasible each finds every step of a map.

    terrain --> ElevationMap M [nx, ny]        specialists: policy + Feasibility-Net, one folder
                     |                                    |
                     +----------------+-------------------+
                                      v
         assess      f [nx, ny, d] and L_recon [nx, ny, d], per specialist       (paper, Eqs. 2-3)
         tensorize   F_i = f * w_ood(L_recon)  [nx, ny, d]                       (Eqs. 4-5)
         fuse        F_max = max_i F_i,  P = argmax_i F_i  [nx, ny, d]           (Eqs. 6-7)
         plan        Dijkstra over edges of cost 1 / F_max  -->  Route           (Sec. III-C)
         execute     follow the Route, the active policy being P  -->  Episode   (Sec. III-C)

Every stage is a function over plain values, so that you can stop anywhere and look. The names below
are imported when first used: `import fgtutor` itself loads neither torch nor a simulator.

Imports point one way, from a layer to those below it:

    course                                   notebooks, exercises and their marks, widgets
    cli                                      the commands demo, plan, map, doctor, export
    evaluation                               the tables: trials, matrix, adaptation, switching
    figures                                  every picture and film
    execution | baselines                    driving a route; planners to compare with
    planning | paper | learning              the route; the paper in one file; training
    fusion | tensorization | graphs | routes
    specialist
    policies | robots | feasibility          what a specialist is made of and trained on
    tiles                                    the patches of a whole map
    patches | world                          what a policy sees; terrains
    elevation | settings
    io                                       files, progress, checks of values from outside
    directions | statistics | grid
    errors
"""

import importlib
from typing import TYPE_CHECKING

from fgtutor import errors

if TYPE_CHECKING:
    from fgtutor.elevation import ElevationMap
    from fgtutor.execution import execute
    from fgtutor.fusion import fuse
    from fgtutor.learning.training import train
    from fgtutor.planning import plan, plan_on_map
    from fgtutor.settings import PAPER, PlanSettings
    from fgtutor.specialist import Specialist, load_specialist, load_zoo
    from fgtutor.tensorization import assess, tensorize
    from fgtutor.world.terrain import Terrain, make_terrain

__version__ = "0.1.0"

__all__ = [
    "PAPER",
    "ElevationMap",
    "PlanSettings",
    "Specialist",
    "Terrain",
    "__version__",
    "assess",
    "errors",
    "execute",
    "fuse",
    "load_specialist",
    "load_zoo",
    "make_terrain",
    "plan",
    "plan_on_map",
    "tensorize",
    "train",
]

_HOMES = {
    "PAPER": "settings",
    "ElevationMap": "elevation",
    "PlanSettings": "settings",
    "Specialist": "specialist",
    "Terrain": "world.terrain",
    "assess": "tensorization",
    "execute": "execution",
    "fuse": "fusion",
    "load_specialist": "specialist",
    "load_zoo": "specialist",
    "make_terrain": "world.terrain",
    "plan": "planning",
    "plan_on_map": "planning",
    "tensorize": "tensorization",
    "train": "learning.training",
}


def __getattr__(name: str) -> object:
    """Import a re-exported name when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'fgtutor' has no attribute {name!r}; it offers {__all__}")
    value = getattr(importlib.import_module(f"fgtutor.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
