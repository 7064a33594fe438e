"""Drawing a MuJoCo model without a window, by a process of its own.

Reads a model, and one `Shot` per picture; gives the pictures. A graphics library that is missing or
broken may abort the process that loads it, and MuJoCo chooses the library when it is imported: so a
child process draws, and sends raw pixels. It is a plain `python -m`, because multiprocessing (and
pebble on top of it) would run the caller's script a second time to start one.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, Self, cast

import numpy as np
from jaxtyping import Float, UInt8

from fgtutor.errors import RenderingError
from fgtutor.robots import GL_BACKENDS

if TYPE_CHECKING:
    import mujoco

COAT = "coat"
"""The material that a `Shot` gives its colour to."""
CURE = (
    "on Debian or Ubuntu, apt install libegl1 or libosmesa6; if a library was chosen by "
    "MUJOCO_GL, unset it; `fgtutor doctor` tells more"
)
READY = b"+"


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """What one picture shows."""

    qpos: Float[np.ndarray, " nq"]
    """The state of the model."""
    target: tuple[float, float, float]
    """Where the camera looks at, m."""
    distance: float
    """How far from there it stands, m."""
    azimuth: float
    """The direction it looks in, degrees: 0 along +x, 90 along +y."""
    elevation: float
    """By how much it looks up, degrees: -90 straight down."""
    coat: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Red, green and blue of the material "coat", each in [0, 1]."""


class Renderer:
    """A process that draws one model, for a `with` block.

    Raises:
        RenderingError: No graphics library of this machine draws anything.
    """

    def __init__(
        self, model: "mujoco.MjModel", width: int, height: int, *, patience: float = 60.0
    ) -> None:
        """Start the process with the first library that works.

        `patience` is how long the start, or one picture, may take at most, s. The model's
        off-screen buffer must be at least as large as the pictures.
        """
        self.shape, self.patience = (height, width, 3), patience
        wanted = os.environ.get("MUJOCO_GL")
        refusals = []
        for self.backend in (wanted,) if wanted else GL_BACKENDS.get(sys.platform, ()):
            self._start()
            try:
                self._read(len(READY), question=model)
                return
            except EOFError as error:
                refusals.append(f"{self.backend}: {error}")
                self.close()
        reasons = "; ".join(refusals) or f"none is known for {sys.platform}"
        raise RenderingError(f"no graphics library draws MuJoCo's scenes ({reasons}): {CURE}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        with suppress(BrokenPipeError):
            self._process.communicate()
        self._log.close()

    def draw(self, shot: Shot) -> UInt8[np.ndarray, "height width 3"]:
        """Return one picture; raises `RenderingError` if the process ends or hangs."""
        return next(self.film([shot]))

    def film(self, shots: Iterable[Shot]) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """Yield a picture of each shot, while the next one is being drawn already.

        Raises:
            RenderingError: The process ends or hangs.
        """
        waiting = 0
        try:
            for shot in shots:
                self._ask(shot)
                waiting += 1
                if waiting == 2:
                    waiting -= 1
                    yield self._picture()
            if waiting:
                waiting -= 1
                yield self._picture()
        finally:
            # A film that is left half-way must not leave a picture in the pipe for the next one.
            with suppress(RenderingError):
                for _ in range(waiting):
                    self._picture()

    def _start(self) -> None:
        # What PyOpenGL was told in this process may contradict the library to try.
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
        height, width, _ = self.shape
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, `close` closes it
        self._process = subprocess.Popen(
            # -P: no module of the current folder
            [sys.executable, "-P", "-m", __name__, str(width), str(height)],
            env={**environment, "MUJOCO_GL": self.backend},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )

    def _ask(self, question: object) -> None:
        # A pipe that breaks means that the process has ended; reading its answer says why.
        pipe = cast(IO[bytes], self._process.stdin)
        with suppress(BrokenPipeError):
            pickle.dump(question, pipe)
            pipe.flush()

    def _picture(self) -> UInt8[np.ndarray, "height width 3"]:
        try:
            pixels = self._read(int(np.prod(self.shape)))
        except EOFError as error:
            stopped = f"drawing with {self.backend} stopped ({error}): {CURE}"
            raise RenderingError(stopped) from error
        return np.frombuffer(pixels, dtype=np.uint8).reshape(self.shape)

    def _read(self, size: int, question: object = None) -> bytes:
        """Return `size` bytes of the process's answer, asking the question before if there is one.

        Raises `EOFError`, which says why, if the process ends or takes longer than `patience`.
        """
        process, late = self._process, threading.Event()

        def stop() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.patience, stop)
        timer.start()
        try:
            if question is not None:
                self._ask(question)
            answer = cast(IO[bytes], process.stdout).read(size)
        finally:
            timer.cancel()
        if len(answer) == size:
            return answer
        process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        if late.is_set():
            raise EOFError(f"no picture within {self.patience:g} s")
        raise EOFError(said[-1] if said else f"it ended with code {process.returncode}")


def serve(width: int, height: int) -> None:
    """Draw the shots of a model, both read from standard input; the work of the child process."""
    import mujoco

    # Whatever a graphics library prints must not end up between the pixels.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    model = pickle.load(sys.stdin.buffer)
    data = mujoco.MjData(model)
    coats = [i for i in range(model.nmat) if model.material(i).name == COAT]
    camera = mujoco.MjvCamera()
    with mujoco.Renderer(model, height, width) as renderer:
        # Mirrors would double the work for a ground that does not shine.
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

        def draw(state: Any) -> np.ndarray:
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera)
            return renderer.render()

        if draw(model.key_qpos[0] if model.nkey else model.qpos0).max() == 0:
            raise SystemExit("the picture came out black")
        answers.write(READY)
        answers.flush()
        while True:
            try:
                shot = pickle.load(sys.stdin.buffer)
            except EOFError:
                return
            camera.lookat[:] = shot.target
            camera.distance, camera.azimuth = shot.distance, shot.azimuth
            camera.elevation = shot.elevation
            model.mat_rgba[coats, :3] = shot.coat
            answers.write(draw(shot.qpos).tobytes())
            answers.flush()


if __name__ == "__main__":
    serve(int(sys.argv[1]), int(sys.argv[2]))
