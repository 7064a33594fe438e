"""Write what the A1 page needs: the robot, its specialists, and grounds with routes over them.

Gives, in a folder: `robot.json` (MuJoCo's model without ground, how the robot is drawn, and the
numbers of its environment), `specialists/NAME/`, `vendor/` (what comes from npm), and
`grounds.json` with a `grounds/NN.json.gz` each: what the simulator stands on, what is seen of it,
what is drawn, the route that Python planned over it, and how Python's robot fared. The grounds are
those on which evaluation measures mixed terrain (`success.make_ground`), undisturbed.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import base64
import itertools
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from exports import PACKED, as_json, copy_specialist, pack
from matplotlib.colors import to_rgb

from fgtutor.baselines import OURS, ours
from fgtutor.evaluation.success import TrialsConfig, make_ground
from fgtutor.evaluation.trials import Planned, Trial, drive_plans, plan_all
from fgtutor.execution import FollowConfig
from fgtutor.figures.style import policy_colours
from fgtutor.patches import prepare
from fgtutor.robots.a1.env import A1_EPISODES, DROP, FREE_FALL, MAX_TILT, RIM
from fgtutor.robots.a1.ground import rims
from fgtutor.robots.a1.looks import a1_scene
from fgtutor.robots.a1.model import FOOT_RADIUS, STANCE, STANCE_HEIGHT, A1Config, build_spec
from fgtutor.robots.a1.observation import NOISE, SCAN_GRID, SCAN_LIMIT, SCAN_SCALE
from fgtutor.robots.a1.randomise import UNDISTURBED
from fgtutor.robots.offscreen import COAT
from fgtutor.specialist import ZOO, Specialist, load_zoo
from fgtutor.world.boxes import Box
from fgtutor.world.terrain import World

PACKAGES = Path(__file__).parents[1] / "node_modules"
"""Where npm put the packages of web/package.json."""
VENDOR = {
    "@mujoco/mujoco/mujoco.js": False,
    "@mujoco/mujoco/mujoco.wasm": True,
    "three/build/three.module.min.js": True,
    "three/build/three.core.min.js": True,
}
"""What the page needs of them, and whether it is compressed."""
CONFIG = TrialsConfig(robot="a1")
"""How evaluation draws grounds and plans over them, by default."""
GROUNDS = 20
"""How many grounds the page offers: the first of evaluation's that have a route."""
SENSORS = ("foot_position", "trunk_contact")
"""What of `model.SENSORS` the page reads: it tells a fall by them."""
LENGTHS = {"box": 3, "cylinder": 2, "capsule": 2, "sphere": 1}
"""How many numbers of a shape's size count."""


def export(folder: Path, count: int = GROUNDS) -> None:
    """Write everything into `folder`, with the first `count` grounds."""
    zoo = load_zoo("a1", include_general=True)
    (folder / "grounds").mkdir(parents=True, exist_ok=True)
    for name in zoo:
        copy_specialist(ZOO / "a1" / name, folder / "specialists" / name)
    plans = plan_grounds(zoo, count)
    entries = []
    for index, trial in enumerate(drive(plans, zoo)):
        plan, file = trial.planned, f"grounds/{index:02d}.json"
        ground = describe_ground(trial)
        pack(as_json(ground), folder / file)
        entries.append({"seed": plan.ground.terrain.seed, "file": file + PACKED})
        if not index:
            scene = scene_of(plan)
            (folder / "robot.json").write_bytes(as_json(describe_robot(scene, zoo)))
    (folder / "grounds.json").write_bytes(as_json({"grounds": entries}))
    copy_packages(folder / "vendor")


def copy_packages(folder: Path) -> None:
    """Copy simulator and 3-D library; raises `FileNotFoundError` if npm has not installed them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, packed in VENDOR.items():
        source = PACKAGES / name
        if not source.is_file():
            raise FileNotFoundError(f"{source} is missing: run `npm install` in {PACKAGES.parent}")
        if packed:
            pack(source.read_bytes(), folder / source.name)
        else:
            shutil.copyfile(source, folder / source.name)


def plan_grounds(zoo: Mapping[str, Specialist], count: int) -> list[Planned]:
    """Plan as evaluation does, over its first `count` mixed grounds that have a route."""
    settings = CONFIG.planning

    def planned() -> Iterator[Planned]:
        for index in itertools.count():
            ground = make_ground(CONFIG, "mixed", index)
            yield from plan_all(ours, [ground], [ground.assess(zoo, settings)], settings)

    return list(itertools.islice((plan for plan in planned() if plan.answer), count))


def drive(plans: Sequence[Planned], zoo: Mapping[str, Specialist]) -> list[Trial]:
    """Drive the routes in Python's MuJoCo, undisturbed, as evaluation does."""
    follow = FollowConfig(hold_steps=CONFIG.planning.hold_steps)
    return list(drive_plans(OURS, plans, zoo, follow, CONFIG.condition))


def describe_ground(trial: Trial) -> dict[str, Any]:
    """Return one ground, its route and what became of Python's robot, as plain values.

    The simulator's boxes are in the frame of `World`, whose corner of the terrain is `corner`;
    all else is in the terrain's own frame.
    """
    plan, drove = trial.planned, trial.row
    terrain, route = plan.ground.terrain, plan.answer.raise_for()
    world = World([[terrain]])
    seen, rough = prepare(terrain.elevation), np.asarray(terrain.elevation.filled().heights)
    follow, seed = FollowConfig(), plan.ground.seeds[0]
    noise = np.random.default_rng(seed).standard_normal(3)
    return {
        "seed": terrain.seed,
        "size": list(terrain.elevation.size),
        "sections": [[part.name, part.x0, part.x1] for part in terrain.sections],
        "corner": world.offset[0, 0].tolist(),
        "map": {
            "nx": seen.shape[0],
            "ny": seen.shape[1],
            "resolution": seen.resolution,
            "origin": list(seen.origin),
            "heights": _floats(seen.heights),
            "rims": _floats(rims(rough, round(RIM / seen.resolution))),
        },
        "boxes": [describe_box(box) for box in world.boxes],
        "scene": [shape for shape in describe_shapes(scene_of(plan)) if not shape["body"]],
        "route": {
            "xy": np.round(route.xy, 6).tolist(),
            "policies": route.policies.tolist(),
            "names": list(route.names),
            "length": route.length,
        },
        "goal": list(terrain.goal),
        "noise": [*(follow.start_noise * noise[:2]), follow.start_yaw_noise * noise[2]],
        "python": {
            "outcome": drove["outcome"],
            "seconds": round(drove["seconds"], 2),
            "length": round(drove["length"], 2),
        },
    }


def describe_box(box: Box) -> list[float]:
    """Return centre, half lengths and, where it is tilted, quaternion (w, x, y, z)."""
    half = [length / 2 for length in box.size]
    return [*map(float, box.centre), *half, *(box.quaternion if any(box.rpy) else ())]


def describe_robot(scene: mujoco.MjModel, zoo: Mapping[str, Specialist]) -> dict[str, Any]:
    """Return the robot: its model, its looks, and the numbers of its environment."""
    settings, model = UNDISTURBED, A1Config()
    return {
        "xml": robot_xml(model),
        "shapes": [shape for shape in describe_shapes(scene) if shape["body"]],
        "mass": float(scene.body_subtreemass[1]),
        "substeps": settings.substeps,
        "control_dt": model.timestep * settings.substeps,
        "action_scale": settings.action_scale,
        "gait_frequency": settings.gait_frequency,
        "stance": list(STANCE),
        "stance_height": STANCE_HEIGHT,
        "scales": [[count, scale] for count, _, scale in NOISE.values()],
        "scan": {
            "grid": {name: getattr(SCAN_GRID, name) for name in ("ahead", "behind", "half_width")},
            "limit": SCAN_LIMIT,
            "scale": SCAN_SCALE,
        },
        "falls": {
            "tilt": MAX_TILT,
            "drop": DROP,
            "speed": FREE_FALL,
            "foot_radius": FOOT_RADIUS,
        },
        "slowest": A1_EPISODES.slowest,
        "max_turn_rate": A1_EPISODES.max_turn_rate,
        "history": max(specialist.history for specialist in zoo.values()),
        "policies": [
            {"name": name, "colour": colour} for name, colour in policy_colours(list(zoo)).items()
        ],
    }


def robot_xml(model: A1Config) -> str:
    """Return the robot as XML that MuJoCo 3.14 reads, without ground and with `SENSORS` only.

    MuJoCo 4 writes `input="pos"` for an actuator whose control is a position. 3.14 does not know
    the word, and needs none: what such an actuator does is in its gain and its biases.
    """
    root = ElementTree.fromstring(build_spec(config=model).to_xml())
    world, actuators, sensors = (_part(root, tag) for tag in ("worldbody", "actuator", "sensor"))
    for geom in world.findall("geom"):
        world.remove(geom)
    for actuator in actuators:
        actuator.attrib.pop("input", None)
    for sensor in list(sensors):
        if not sensor.get("name", "").endswith(SENSORS):
            sensors.remove(sensor)
    return ElementTree.tostring(root, encoding="unicode")


def scene_of(plan: Planned) -> mujoco.MjModel:
    """Return the scene that films of this route show."""
    route = plan.answer.raise_for()
    colours = policy_colours(route.names)
    steps = [to_rgb(colours[route.names[policy]]) for policy in route.policies]
    radius = FollowConfig().goal_radius
    return a1_scene(plan.ground.terrain, route.xy, steps, width=640, height=480, goal_radius=radius)


def describe_shapes(scene: mujoco.MjModel) -> list[dict[str, Any]]:
    """Return every shape of a scene that is drawn: its body (0: the ground), and how it looks."""
    shapes = []
    for i in range(scene.ngeom):
        if scene.geom_group[i] == 3:  # what collides is not what is drawn
            continue
        kind = mujoco.mjtGeom(scene.geom_type[i]).name.removeprefix("mjGEOM_").lower()
        material = int(scene.geom_matid[i])
        rgba = scene.geom_rgba[i] if material < 0 else scene.mat_rgba[material]
        shape = {
            "body": int(scene.geom_bodyid[i]),
            "type": kind,
            "size": _rounded(scene.geom_size[i][: LENGTHS[kind]]),
            "pos": _rounded(scene.geom_pos[i]),
            "rgba": [round(float(value), 3) for value in rgba],
        }
        if (quat := _rounded(scene.geom_quat[i])) != [1.0, 0.0, 0.0, 0.0]:
            shape["quat"] = quat
        if material >= 0 and scene.material(material).name == COAT:
            shape["coat"] = True
        shapes.append(shape)
    return shapes


def _part(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Return the part of a model with this tag."""
    found = root.find(tag)
    if found is None:
        raise ValueError(f"MuJoCo wrote no <{tag}>")
    return found


def _rounded(values: np.ndarray) -> list[float]:
    return np.round(np.asarray(values, dtype=float), 5).tolist()


def _floats(values: np.ndarray) -> str:
    """Return numbers as base64 of 32-bit floats, little endian."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()
