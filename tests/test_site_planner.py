"""The site's planner page: maps, routes and drives against Python's, and the page in a browser.

Node runs the tests of `tests/web/planner.mjs` on numbers that are recorded here. The browser has no
network but this machine.
"""

import base64
import gzip
import importlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from browser import Page, run_node, serving

from fgtutor import load_zoo, make_terrain
from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.execution import execute_batch
from fgtutor.patches import prepare
from fgtutor.planning import SETTINGS, Plan, PlanSettings, plan_on_map
from fgtutor.robots.toy import ToyEnv
from fgtutor.routes import Route
from fgtutor.specialist import ZOO, Specialist
from fgtutor.tensorization import assess_all
from fgtutor.world.terrain import Terrain

WEB = Path(__file__).parents[1] / "web"
LIMIT = 20_000_000
"""Bytes that the page may have."""
DRIVES = 10
"""Maps that are driven over in Python and in JavaScript."""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Lay out the page as it is served, compiled and exported."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(WEB / "js", folder / "js")
    only = shutil.ignore_patterns("*.py", "*.c", "__pycache__")
    shutil.copytree(WEB / "planner", folder / "planner", ignore=only)
    shutil.copyfile(WEB / "style.css", folder / "style.css")
    build = importlib.import_module("planner.build")
    if not build.ready():
        pytest.skip(f"the page's WebAssembly is not built: pip install ziglang=={build.ZIG}")
    importlib.import_module("planner.export").export(folder / "planner")
    return folder


@pytest.fixture(scope="module", autouse=True)
def importable() -> Iterator[None]:
    """Let `planner` be imported from web/, as web/build.py does."""
    sys.path.insert(0, str(WEB))
    yield
    sys.path.remove(str(WEB))


@pytest.fixture(scope="module")
def zoo() -> dict[str, Specialist]:
    return load_zoo("toy")


def packed(array: Any) -> str:
    """Return numbers as text that JavaScript reads as a Float32Array."""
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f4").tobytes()).decode()


def plain(elevation: ElevationMap) -> dict[str, Any]:
    """Return a map as JavaScript reads it."""
    nx, ny = elevation.shape
    return {
        "heights": packed(elevation.filled().heights),
        "prepared": packed(prepare(elevation).heights),
        "known": elevation.known.astype(int).ravel().tolist(),
        "nx": nx,
        "ny": ny,
        "resolution": elevation.resolution,
        "origin": list(elevation.origin),
    }


# Maps, weights and routes -----------------------------------------------------------------------


def painted(rng: np.random.Generator) -> ElevationMap:
    """Paint rectangles of random height on flat ground."""
    heights = np.zeros((48, 40))
    for _ in range(14):
        i, j = rng.integers(0, 44), rng.integers(0, 36)
        heights[i : i + rng.integers(2, 12), j : j + rng.integers(2, 9)] += rng.uniform(-0.3, 0.2)
    return ElevationMap(heights)


def planned(
    elevation: ElevationMap, zoo: dict[str, Specialist], settings: PlanSettings, rng: Any
) -> dict[str, Any]:
    """Plan between random places; return every stage and the answers."""
    x0, y0, x1, y1 = elevation.extent
    answers: list[dict[str, Any]] = []
    stages: Plan | None = None
    while len(answers) < 8 or stages is None:
        start, goal = rng.uniform((x0, y0), (x1, y1), (2, 2)).tolist()
        # The page knows the eight headings only.
        one = plan_on_map(elevation, zoo, start, goal, settings=settings, finer_headings=8)
        stages = one if one.tensors else stages
        answer: dict[str, Any] = {"start": start, "goal": goal}
        if isinstance(one.answer, Route):
            route = one.answer
            said = {"cost": route.cost, "promise": route.promise, "length": route.length}
            answer |= said | {"cells": route.cells.tolist(), "policies": route.policies.tolist()}
        else:
            answer["refused"] = type(one.answer.error).__name__
        answers.append(answer)
    return {
        "weights": [packed(weight) for weight in stages.weights.values()],
        "tensors": [packed(tensor) for tensor in stages.tensors],
        "fused": packed(stages.fused),
        "policies": packed(stages.policy_map),
        "answers": answers,
    }


def test_every_stage_agrees_with_python(node, site, zoo, tmp_path, capsys):
    rng = np.random.default_rng(3)
    mixed = ElevationMap.load(ZOO / "maps" / "toy_mixed.npz").crop(4, 1, 10.4, 7.4)
    records = []
    for elevation in (mixed, painted(rng)):
        said = assess_all(elevation, zoo)
        record = plain(elevation)
        record["said"] = [
            {name: packed(values) for name, values in said[one].said.items()} for one in zoo
        ]
        record["settings"] = {
            name: planned(elevation, zoo, settings, rng) for name, settings in SETTINGS.items()
        }
        records.append(record)
    assert any("refused" in one for r in records for one in r["settings"]["ours"]["answers"])
    path = tmp_path / "stages.json"
    steps = {count: Headings(count).steps.tolist() for count in get_args(HeadingCount)}
    path.write_text(json.dumps({"names": list(zoo), "maps": records, "steps": steps}))
    run_node(node, "planner.mjs", capsys, SITE=site, RECORDED=path)


# Drives -----------------------------------------------------------------------------------------


def driven(
    terrain: Terrain, zoo: dict[str, Specialist], seed: int, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any] | None:
    """Drive a planned route in Python, and record what the toy was told, saw and did."""
    answer = plan_on_map(terrain.elevation, zoo, terrain.start, terrain.goal).answer
    if not isinstance(answer, Route):
        return None
    places: list[list[float]] = []
    steps: list[dict[str, list[float]]] = []
    place, advance = ToyEnv.place, ToyEnv.advance

    def noted_place(env: ToyEnv, ids: Any, poses: Any) -> None:
        places.append(poses[0].tolist())
        place(env, ids, poses)

    def noted_advance(env: ToyEnv, actions: Any) -> None:
        seen = env.get_observations()["policy"][0].tolist()
        told = {"command": env.command[0].tolist(), "observation": seen}
        advance(env, actions)
        steps.append(told | {"action": actions[0].tolist(), "state": env.state[0].ravel().tolist()})

    with monkeypatch.context() as patched:
        patched.setattr(ToyEnv, "place", noted_place)
        patched.setattr(ToyEnv, "advance", noted_advance)
        episode = execute_batch([answer], [terrain], zoo, seeds=[seed])[0]
    route = {"xy": answer.xy.tolist(), "policies": answer.policies.tolist()}
    record = plain(terrain.elevation) | {"route": route, "places": places, "steps": steps}
    return record | {"reason": episode.reason, "policies": episode.policies.tolist()}


def test_a_recorded_drive_replayed(node, site, zoo, tmp_path, monkeypatch, capsys):
    terrain = make_terrain("mixed", robot="toy", seed=100)
    path = tmp_path / "drive.json"
    record = driven(terrain, zoo, 0, monkeypatch)
    assert record and len(record["steps"]) > 300
    path.write_text(json.dumps({"names": list(zoo), "drives": [record]}))
    run_node(node, "toy.mjs", capsys, SITE=site, RECORDED=path)


@pytest.mark.slow
def test_ten_maps_are_driven_alike(node, site, zoo, tmp_path, monkeypatch, capsys):
    drives: list[dict[str, Any]] = []
    for seed in range(200, 300):
        terrain = make_terrain("mixed", robot="toy", seed=seed)
        record = driven(terrain, zoo, seed, monkeypatch)
        drives += [record] if record else []
        if len(drives) == DRIVES:
            break
    path = tmp_path / "drives.json"
    path.write_text(json.dumps({"names": list(zoo), "drives": drives}))
    run_node(node, "toy.mjs", capsys, SITE=site, RECORDED=path)


# In a browser -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    """Serve the site under a prefix."""
    with serving(site.parent) as (address, _):
        yield f"{address}{site.name}/planner/index.html"


def words(page: Page, name: str) -> str:
    return page.evaluate(f"document.getElementById({name!r}).textContent")


def answers(page: Page) -> int:
    return page.evaluate("Number(document.getElementById('map')?.dataset.answers ?? 0)")


def presses(page: Page, name: str, key: str, code: int, times: int = 1) -> list[float]:
    """Focus a control and press a key; return how long each answer took, ms."""
    page.evaluate(f"document.getElementById({name!r}).focus()")
    passed = []
    for _ in range(times):
        before = answers(page)
        page.press(key, code)
        count = "Number(document.getElementById('map').dataset.answers)"
        page.wait(f"{count} > {before}", f"an answer to {key} on {name}")
        passed.append(float(page.evaluate("document.getElementById('map').dataset.milliseconds")))
    return passed


@pytest.mark.slow
def test_the_page_plans_and_drives_by_keyboard(page, address, tmp_path, capsys):
    page.call("Page.navigate", url=address)
    page.wait(
        "Number(document.getElementById('map')?.dataset.answers ?? 0) > 0", "the first answer"
    )
    first = words(page, "answer")
    assert "1 change of the policy" in first and "steps → gaps" in first, first
    times = {"first": page.evaluate("document.getElementById('map').dataset.milliseconds")}
    # A slider by keyboard: what no policy does well enough closes the way, and back.
    times["f_min"] = presses(page, "fmin", "End", 35)
    assert words(page, "answer").startswith("No route: no policy can leave the start")
    times["f_min"] += presses(page, "fmin", "Home", 36)
    times["switch cost"] = presses(page, "switch", "ArrowRight", 39, 5)
    times["goal"] = presses(page, "map", "ArrowLeft", 37, 5)
    assert words(page, "answer") != first
    # A brush by keyboard: a wall across the way to the goal is planned around, or it refuses.
    page.evaluate("document.getElementById('tool').value = 'raise'")
    page.press("ArrowDown", 40)
    times["stroke"] = presses(page, "map", " ", 32, 5)
    assert "windows asked anew" in words(page, "timing")
    assert not words(page, "timing").startswith("Last answer: 0 windows")
    # The drive, by its button, on the map as it was.
    page.evaluate(
        "(document.getElementById('preset').dispatchEvent(new Event('change')),"
        "document.getElementById('pace').value = '4')"
    )
    before = answers(page)
    page.wait(f"Number(document.getElementById('map').dataset.answers) > {before}", "the map")
    page.evaluate("document.getElementById('drive').focus()")
    page.press(" ", 32)
    said = "document.getElementById('outcome').textContent"
    outcome = page.wait(f"{said}.match(/Reached|Fell|Ran out/) && {said}", "the end of the drive")
    assert outcome.startswith("Reached the goal after"), outcome
    page.screenshot(tmp_path / "planner.png")
    assert page.errors == []
    with capsys.disabled():
        print(f"\n    ms from the key to the drawing: {times}; screenshot in {tmp_path}")


def test_the_page_is_small(site, capsys):
    files = [path for path in site.rglob("*") if path.is_file()]
    raw = sum(path.stat().st_size for path in files)
    sent = sum(len(gzip.compress(path.read_bytes())) for path in files)
    with capsys.disabled():
        print(f"\n    the planner's page: {raw / 1e6:.2f} MB, {sent / 1e6:.2f} MB gzipped")
    assert raw < LIMIT
