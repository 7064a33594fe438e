"""The widgets where people meet them: a real JupyterLab in a real, headless Chromium.

Everything listens on loopback only, JupyterLab behind its token (`browser` has the rest).
"""

import json
import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import end, fetch, until

from fgtutor.course.widgets.explorer import Explorer

ROOT = Path(__file__).parents[1]
PRESSES = 20
"""Key presses whose latency is taken."""
WORLD = """
import numpy as np, torch
from fgtutor.elevation import ElevationMap
from fgtutor.tensorization import Assessment

x, y = np.meshgrid(np.arange(128), np.arange(128), indexing="ij")
M = ElevationMap(0.1 * np.sin(x / 9) * np.cos(y / 7))
said = {}
for i, name in enumerate(("steps", "gaps", "slopes", "rubble")):
    f = 0.6 + 0.35 * np.sin(x / 13 + i) * np.cos(y / 17 - i)
    loss = 1.8 + 1.7 * np.sin(x / 21 + 2 * i) * np.cos(y / 15 + i)
    said[name] = Assessment(
        *(torch.tensor(np.repeat(a[..., None], 8, -1), dtype=torch.float32) for a in (f, loss)), M
    )
start, goal = (1.05, 6.45), (11.55, 6.05)
"""
"""Four policies on 128 x 128 cells: the size that a drag is promised to be quick for."""
CELLS = (
    WORLD,
    "from fgtutor.course.widgets.jupyter import TauExplorer\n"
    "TauExplorer(M, said, start, goal, taus=(0.1, 2.0), switch_cost=1.0)",
    "from fgtutor.course.widgets.slides import TrackingSlides\nTrackingSlides()",
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Iterator[tuple[str, str]]:
    """Start a JupyterLab with one notebook and settings of its own; give its address and token."""
    pytest.importorskip("jupyterlab", reason="the lab extra is not installed: make test does")
    pytest.importorskip("anywidget", reason="the lab extra is not installed: make test does")
    home = tmp_path_factory.mktemp("lab")
    (home / "work").mkdir(parents=True)
    metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    cells = [
        {"cell_type": "code", "id": f"cell{i}", "metadata": {}, "execution_count": None,
         "outputs": [], "source": source}
        for i, source in enumerate(CELLS)
    ]  # fmt: skip
    notebook = {"nbformat": 4, "nbformat_minor": 5, "metadata": metadata, "cells": cells}
    (home / "work" / "taus.ipynb").write_text(json.dumps(notebook))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    token = secrets.token_hex(24)
    folders = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR",
               "JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR")  # fmt: skip
    environment = os.environ | {name: str(home / name.lower()) for name in folders}
    # In the environment, not on the command line, which every user of a machine can read.
    environment |= {"JUPYTER_TOKEN": token, "OMP_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.getenv("PYTHONPATH"))))
    command = [
        sys.executable, "-m", "jupyterlab", "--no-browser", "--ip=127.0.0.1", f"--port={port}",
        "--ServerApp.port_retries=0", f"--ServerApp.root_dir={home / 'work'}",
        "--expose-app-in-browser", "--LabApp.news_url=None",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.append("--allow-root")
    with (home / "log").open("w") as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=log, env=environment, cwd=home / "work"
        )
    try:
        address = f"http://127.0.0.1:{port}"
        answered = f"{address}/api/status?token={token}"
        until(lambda: fetch(answered)[0] == 200, f"JupyterLab, see {home / 'log'}", process)
        yield address, token
    finally:
        end(process)


def p95(values: list[float]) -> float:
    return float(np.quantile(values, 0.95))


@pytest.mark.slow
def test_the_lab_is_closed_without_its_token(lab):
    address, token = lab
    assert fetch(f"{address}/api/contents")[0] == 403
    assert fetch(f"{address}/api/contents?token={token}")[0] == 200
    port = int(address.rsplit(":", 1)[1])
    # Bound to 127.0.0.1 alone: the rest of the loopback range is refused, as any other address is.
    with socket.socket() as stranger:
        assert stranger.connect_ex(("127.0.0.2", port)) != 0


@pytest.mark.slow
def test_the_tau_slider_by_keyboard_and_the_goal_by_click(
    chromium, lab, page, tmp_path, record_property, capsys
):
    world: dict[str, Any] = {}
    exec(WORLD, world)
    explorer = Explorer(
        world["M"], world["said"], world["start"], world["goal"], taus=(0.1, 2.0), switch_cost=1.0
    )
    address, token = lab
    page.call("Page.navigate", url=f"{address}/lab/tree/taus.ipynb?token={token}")
    ready = "window.jupyterapp?.shell.currentWidget?.context?.isReady"
    page.wait(ready, "the notebook to open")
    kernel = "jupyterapp.shell.currentWidget.sessionContext.session?.kernel?.status === 'idle'"
    page.wait(kernel, "the kernel")
    page.errors.clear()  # what the lab says while it starts is not the widget's doing
    page.evaluate("jupyterapp.commands.execute('notebook:run-all-cells').then(() => true)")
    scene = "document.querySelector('.fgtutor-scene')"
    page.wait(f"{scene}?.dataset.frame", "the widget to draw")

    def status() -> str:
        return page.evaluate(f"{scene}.querySelector('.fgtutor-status').textContent")

    def drawn(key: str) -> str:
        return page.evaluate(f"{scene}.querySelector('canvas[data-key={json.dumps(key)}]')"
                             ".toDataURL()")  # fmt: skip

    def said_and_painted(before: int) -> float:
        page.wait(f"Number({scene}.dataset.frame) > {before}", "a new frame")
        return page.evaluate(f"Number({scene}.dataset.painted)")

    def frame() -> int:
        return page.evaluate(f"Number({scene}.dataset.frame)")

    assert status() == explorer.status
    page.evaluate(f"{scene}.scrollIntoView({{block: 'end'}})")
    page.screenshot(tmp_path / "before.png")

    # Drag tau_high down by keyboard, one step of 0.05 at a time.
    before = {key: drawn(key) for key in ("M", "F", "P", "w steps")}
    page.evaluate(
        "document.addEventListener('keydown', () => {window.pressedAt = performance.now()}, true)"
    )
    page.evaluate("document.querySelectorAll('.jp-OutputArea [role=slider]')[1].focus()")
    waits = []
    for press in range(1, PRESSES + 1):
        shown = frame()
        page.press("ArrowLeft", 37)
        painted = said_and_painted(shown)
        waits.append(painted - page.evaluate("window.pressedAt"))
        explorer.update(taus=(0.1, 2.0 - 0.05 * press))
        assert status() == explorer.status
    for key in ("F", "P", "w steps"):
        assert drawn(key) != before[key], f"{key} did not follow the slider"

    # A click on the map moves the goal there; an arrow key moves it by a cell.
    after = drawn("M")
    area = json.loads(
        page.evaluate(f"JSON.stringify({scene}.querySelector('canvas').getBoundingClientRect())")
    )
    cell = (100, 20)
    shown = frame()
    page.click(
        area["left"] + (cell[0] + 0.5) / 128 * area["width"],
        area["top"] + (128 - cell[1] - 0.5) / 128 * area["height"],
    )
    said_and_painted(shown)
    explorer.update(goal=world["M"].centre_of(*cell))
    assert status() == explorer.status
    assert drawn("M") != after
    reading = page.wait(
        f"{scene}.querySelector('.fgtutor-reading').textContent.includes('(100, 20)')", "a reading"
    )
    assert reading
    shown = frame()
    page.evaluate(f"{scene}.querySelector('canvas').focus()")
    page.press("ArrowUp", 38)
    said_and_painted(shown)
    explorer.update(goal=world["M"].centre_of(100, 21))
    assert status() == explorer.status

    page.screenshot(tmp_path / "after.png")

    # A slide of matplotlib's pictures follows the arrow keys too, and says what came out.
    slides = "[...document.querySelectorAll('.jp-Cell')].at(-1)"
    page.wait(f"{slides}.querySelector('img')?.naturalWidth === 760", "the slide to be drawn")
    page.evaluate(f"{slides}.scrollIntoView({{block: 'end'}})")
    said = "[...document.querySelectorAll('.jp-Cell')].at(-1).querySelector('.jp-OutputArea')"
    assert "sigma 0.25 m/s" in page.evaluate(f"{said}.textContent")
    page.evaluate(f"{slides}.querySelector('[role=slider]').focus()")
    page.press("ArrowRight", 39)
    page.wait(f"{said}.textContent.includes('sigma 0.30 m/s')", "the slide to follow")
    page.screenshot(tmp_path / "slides.png")
    assert page.errors == []
    record_property("key_press_to_paint_ms_p95", round(p95(waits), 1))
    with capsys.disabled():
        print(
            f"\nkey press to paint: median {np.median(waits):.0f} ms, p95 {p95(waits):.0f} ms "
            f"({PRESSES} presses, 128 x 128 x 8, four policies); screenshots in {tmp_path}"
        )
