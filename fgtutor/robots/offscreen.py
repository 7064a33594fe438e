"""Drawing a MuJoCo model without a window, by a process of its own.

Reads a model, and one `Shot` a picture; gives the pictures. A graphics library that is missing or
broken may abort the process that loads it, and MuJoCo chooses the library when it is imported: so a
child process draws, and sends raw pixels.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
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

    def pack(self) -> bytes:
        """Return the bytes that the drawing process reads."""
        camera = (*self.target, self.distance, self.azimuth, self.elevation, *self.coat)
        return np.concatenate((camera, self.qpos)).astype(np.float64).tobytes()


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
        import mujoco  # here, because the drawing process must choose its library before

        self.shape, self.patience = (height, width, 3), patience
        self._folder = tempfile.TemporaryDirectory(prefix="fgtutor-", ignore_cleanup_errors=True)
        mujoco.mj_saveModel(model, str(self._path("model.mjb")))
        wanted = os.environ.get("MUJOCO_GL")
        refusals = []
        for self.backend in (wanted,) if wanted else GL_BACKENDS.get(sys.platform, ()):
            self._process = self._start()
            with self._deadline() as late:
                answer = self._pipe("stdout").read(len(READY))
            if answer == READY:
                return
            refusals.append(f"{self.backend}: {self._last_words(late)}")
        self.close()
        reasons = "; ".join(refusals) or f"none is known for {sys.platform}"
        raise RenderingError(f"no graphics library draws MuJoCo's scenes ({reasons}): {CURE}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        if process := getattr(self, "_process", None):
            process.kill()
            with suppress(BrokenPipeError):
                process.communicate()
        self._folder.cleanup()

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
            for shot in chain(shots, (None,)):
                if shot:
                    self._ask(shot)
                    waiting += 1
                if waiting == 2 or (waiting and not shot):
                    waiting -= 1
                    yield self._receive()
        finally:
            # Whoever stops half-way must not leave a picture in the pipe for the next film.
            with suppress(RenderingError):
                for _ in range(waiting):
                    self._receive()

    def _ask(self, shot: Shot) -> None:
        # A pipe that breaks means that the process has ended; reading its answer says why.
        with suppress(BrokenPipeError):
            self._pipe("stdin").write(shot.pack())
            self._pipe("stdin").flush()

    def _receive(self) -> UInt8[np.ndarray, "height width 3"]:
        size = int(np.prod(self.shape))
        with self._deadline() as late:
            pixels = self._pipe("stdout").read(size)
        if len(pixels) < size:
            words = self._last_words(late)
            raise RenderingError(f"drawing with {self.backend} stopped ({words}): {CURE}")
        return np.frombuffer(pixels, dtype=np.uint8).reshape(self.shape)

    def _start(self) -> subprocess.Popen[bytes]:
        # What PyOpenGL was told in this process may contradict the library to try.
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
        height, width, _ = self.shape
        with self._path("log.txt").open("wb") as log:
            return subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", __name__),  # -P: no module of the current folder
                    *(self._path("model.mjb"), str(width), str(height)),
                ],
                env={**environment, "MUJOCO_GL": self.backend},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
            )

    @contextmanager
    def _deadline(self) -> Iterator[threading.Event]:
        """End the process, and set the event, if the block takes longer than `patience`."""
        late, process = threading.Event(), self._process

        def stop() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.patience, stop)
        timer.start()
        try:
            yield late
        finally:
            timer.cancel()

    def _last_words(self, late: threading.Event) -> str:
        """Return why the process ended: its last line, or its exit code."""
        with suppress(BrokenPipeError):
            self._process.communicate()
        if late.is_set():
            return f"no picture within {self.patience:g} s"
        lines = self._path("log.txt").read_text(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return said[-1] if said else f"it ended with code {self._process.returncode}"

    def _pipe(self, name: str) -> IO[bytes]:
        return cast(IO[bytes], getattr(self._process, name))

    def _path(self, name: str) -> Path:
        return Path(self._folder.name) / name


def serve(path: str, width: int, height: int) -> None:
    """Draw what standard input asks for, until it ends; the work of the child process."""
    import mujoco

    # Whatever a graphics library prints must not end up between the pixels.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    model = mujoco.MjModel.from_binary_path(path)
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
        size = 8 * (9 + model.nq)
        while len(row := sys.stdin.buffer.read(size)) == size:
            numbers = np.frombuffer(row)
            camera.lookat[:] = numbers[:3]
            camera.distance, camera.azimuth, camera.elevation = numbers[3:6]
            model.mat_rgba[coats, :3] = numbers[6:9]
            answers.write(draw(numbers[9:]).tobytes())
            answers.flush()


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
