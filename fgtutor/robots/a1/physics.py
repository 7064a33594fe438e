"""A batch of simulations of one MuJoCo model, stepped on all CPU threads.

Reads an `MjModel`; gives positions, velocities, controls and sensors of every simulation as torch
tensors that share memory with the simulator: what is written is the state, what is read is current
after each call. Built on `mujoco.batch` (MuJoCo 4), whose results do not depend on the number of
threads.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import warnings
from typing import Annotated, Any

import mujoco
import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float64, Int64
from mujoco import batch
from torch import Tensor

from fgtutor.errors import ConfigError, SimulationError
from fgtutor.io.validation import Count, check_arguments

Threads = Annotated[int, Interval(ge=0, le=256)]
"""Threads of one process, or 0 for one per core."""
BAD_STATE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)
"""MuJoCo's warnings about NaN, infinite or huge numbers; the first three also reset the state."""


class Physics:
    """`num_sims` simulations of `model`, as float64 tensors on one device.

    After `step`, whatever depends on positions and velocities is current, sensors included; forces
    and accelerations are those of the last substep. `forward` recomputes them all.

    These members are all an environment may use, which makes them the seam for a GPU: a class with
    the same members over `mujoco_warp` (one world per simulation, `wp.to_torch` for the tensors)
    takes this one's place. Observations and rewards are torch code that knows neither.
    """

    def __init__(self, model: mujoco.MjModel, num_sims: Count, *, threads: Threads = 0) -> None:
        """Start every simulation at the model's first keyframe, or at its defaults.

        `threads` 0 means one per core. Raises `ConfigError` if a count makes no sense.
        """
        check_arguments(Physics.__init__, locals(), ConfigError)
        self.model = model
        # One MjData each costs memory (0.2 MB, or 0.5 MB with 2,500 boxes), but lets the terrain
        # sleep, and a step continues from what the last one computed at its end.
        self._batch = batch.Batch(model, num_sims, threads, persistent=True)
        self.qpos: Float64[Tensor, "sims nq"] = torch.from_numpy(self._batch.bind("qpos"))
        self.qvel: Float64[Tensor, "sims nv"] = torch.from_numpy(self._batch.bind("qvel"))
        self.ctrl: Float64[Tensor, "sims nu"] = torch.from_numpy(self._batch.bind("ctrl"))
        self.sensors: Float64[Tensor, "sims nsensordata"] = self.derived("sensordata")
        self._history = torch.from_numpy(self._batch.bind("history"))
        self.reset()
        self.forward()

    @property
    def num_sims(self) -> int:
        """How many simulations run side by side."""
        return self._batch.nsim

    def step(self, n: int = 1) -> None:
        """Advance every simulation by `n` time steps with the present controls."""
        self._call(self._batch.step, nstep=n, stage=int(mujoco.mjtStage.mjSTAGE_VEL))

    def forward(self, ids: Int64[Tensor, " ids"] | None = None) -> None:
        """Make the sensors and derived quantities of some simulations current."""
        if ids is None or ids.numel():
            self._call(self._batch.forward, _numpy(ids))

    def reset(self, ids: Int64[Tensor, " ids"] | None = None) -> None:
        """Return some simulations to the first keyframe, also after an explosion.

        Write their poses to `qpos` next, then call `forward` with the same ids.
        """
        if ids is None or ids.numel():
            # Forwarding is left to the caller, which has yet to place the robots.
            keyframe = 0 if self.model.nkey else -1
            stage = int(mujoco.mjtStage.mjSTAGE_NONE)
            self._call(self._batch.reset, _numpy(ids), keyframe=keyframe, stage=stage)

    def hold(self, ids: Int64[Tensor, " ids"], ctrl: Float64[Tensor, "ids nu"]) -> None:
        """Let delayed actuators follow `ctrl` until newer controls arrive; call it after `reset`.

        Without delays there is nothing to do.
        """
        if self.model.nhistory:
            # MuJoCo keeps, for each actuator, 2 numbers, its samples' times, and their values.
            samples = self.model.actuator_history[:, 0]
            for k, (first, n) in enumerate(
                zip(self.model.actuator_historyadr, samples, strict=True)
            ):
                self._history[ids, first + 2 + n : first + 2 + 2 * n] = ctrl[:, k : k + 1].double()

    def exploded(self) -> Int64[Tensor, " ids"]:
        """Return the simulations that met NaN, infinite or huge numbers since their last reset.

        MuJoCo puts such a simulation back to the model's defaults and goes on, so its numbers look
        healthy again; its episode is over all the same. The other simulations are not touched.
        """
        counts = self._batch.warning[:, [int(kind) for kind in BAD_STATE], 1]
        bad = torch.from_numpy((counts > 0).any(axis=1))
        finite = torch.isfinite(self.qpos).all(dim=1) & torch.isfinite(self.qvel).all(dim=1)
        return (bad | ~finite).nonzero().flatten()

    def derived(self, name: str) -> Tensor:
        """Return a field of MjData, e.g. "xpos" or "actuator_force", refreshed by every call.

        Read only: what is written there is lost. Zero until the next `step` or `forward`.
        """
        with warnings.catch_warnings():
            # torch warns that the array is read only, which it has to be; nothing writes to it.
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            return torch.from_numpy(self._batch.bind(name))

    def parameter(self, name: str) -> Tensor:
        """Return a field of MjModel, e.g. "geom_friction", with one value per simulation to write.

        Call `set_const` after a write to a mass, inertia or other field that constants follow from.
        """
        return torch.from_numpy(self._batch.expand(name))

    def set_const(self) -> None:
        """Recompute the constants that follow from masses and inertias."""
        self._call(self._batch.set_const)

    def _call(self, function: Any, *args: Any, **kwargs: Any) -> None:
        """Call MuJoCo, turning its errors into ours and its log file into Python warnings."""
        messages: list[str] = []
        handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(messages.append)
        try:
            function(*args, **kwargs)
        except batch.SimulationError as error:
            raise SimulationError(
                f"MuJoCo gave up: {error}. The model itself is at fault, most often too little "
                "memory for its contacts: raise MjSpec.memory or use fewer boxes"
            ) from error
        finally:
            mujoco.set_mju_user_warning(handler)
        # Bad numbers are counted per simulation, see `exploded`; what remains concerns the model.
        others = [message for message in messages if not message.startswith("Nan, Inf")]
        if others:
            text = f"MuJoCo warned {len(others)} times, first: {others[0]}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)


def _numpy(ids: Tensor | None) -> np.ndarray | None:
    return None if ids is None else ids.cpu().numpy()
