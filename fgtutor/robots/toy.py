"""The toy: two wheels on extensible legs, in the vertical slice of the map along its heading.

The world is 2-D physics (pymunk), but the robot has a place and a yaw on the map: `ToyEnv` cuts the
map along the heading and lets the robot drive in that cut. So going up a ledge, down it and along
it are three different things, and one toy can drive a planned route. It rolls, lifts an axle to
climb, hops a gap, and it can fail: roll over, get stuck at a ledge, drop into a gap.

All robots live in one `pymunk.Space`, each on a storey of its own, `STOREY` metres above the last.
Yaw is kinematic: the turn rate is the command's, whatever the wheels do.
"""

import itertools
import math
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import pymunk
import pymunk.batch
import torch
from annotated_types import Interval
from jaxtyping import Bool, Float, Int
from pymunk.constraints import DampedSpring, GrooveJoint, SimpleMotor
from torch import Tensor

from fgtutor.io.validation import Ascending, NonNegative, Positive, check_fields
from fgtutor.patches import PatchGrid, sample_heights
from fgtutor.robots.base import LocomotionEnv
from fgtutor.world.terrain import World

STOREY = 1000.0
"""Height of a storey, m: far beyond anything that a robot can reach."""
SLICE = (1.5, 3.5)
"""How far a cut reaches behind and ahead of where it was made, m."""
ROOM = 0.8
"""A cut serves until the robot comes this close to one of its ends, m."""
PARKED = (0.0, -STOREY)
"""Where ground segments lie that no cut needs: on a storey of their own, below all robots."""
CLIFF = 0.09
"""Neighbouring cells that differ by more than this meet in a vertical edge, m."""
RECUT = 0.05
"""Change of yaw after which the map is cut anew, rad."""
MAX_PITCH = 1.1
"""A toy pitched further than this has rolled over, rad."""
DROP = 0.28
"""An axle this far below the ground on both sides has dropped into a hole, m."""
HOLE = 0.45
"""How far from an axle that ground is looked for, m."""

Factors = Annotated[tuple[Positive, Positive], Ascending]
"""Least and greatest factor."""


@dataclass(frozen=True, kw_only=True)
class ToyModel:
    """The toy's body. Sizes are near the A1's, so that both robots share maps of one scale."""

    chassis_mass: Positive = 8.0
    """kg"""
    chassis_size: tuple[Positive, Positive] = (0.56, 0.10)
    """Length and height, m."""
    wheel_mass: Positive = 1.0
    """kg, each"""
    wheel_radius: Positive = 0.09
    """m"""
    half_base: Positive = 0.25
    """Half the distance between the axles, m."""
    leg_range: Annotated[tuple[Positive, Positive], Ascending] = (0.10, 0.38)
    """Shortest and longest distance from the chassis' axis to an axle, m."""
    stance: Positive = 0.20
    """Leg length at rest, m."""
    leg_stiffness: Positive = 2500.0
    """N/m"""
    leg_damping: NonNegative = 90.0
    """N s/m"""
    leg_stroke: NonNegative = 0.16
    """Change of leg length that an action of 1 asks for, m."""
    leg_speed: Positive = 2.0
    """Fastest change of the commanded leg length, m/s."""
    wheel_torque: NonNegative = 7.0
    """Limit of each wheel's motor, N m."""
    wheel_boost: NonNegative = 1.0
    """Surface speed that an action of 1 adds to the commanded speed, m/s."""
    friction: NonNegative = 1.0
    """Of wheels and ground, each; pymunk multiplies them. Rubber on concrete is about 1."""
    dt: Annotated[float, Interval(ge=1e-4, le=0.05)] = 0.005
    """Physics step, s."""
    substeps: Annotated[int, Interval(ge=1, le=1000)] = 8
    """Physics steps per control step: 25 Hz control."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, kw_only=True)
class ToySpread:
    """How toys of a batch differ: ranges of factors on numbers of `ToyModel`, drawn evenly."""

    friction: Factors = (1.0, 1.0)
    chassis_mass: Factors = (1.0, 1.0)
    wheel_torque: Factors = (1.0, 1.0)
    leg_stiffness: Factors = (1.0, 1.0)
    leg_damping: Factors = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_fields(self)

    def draw(self, model: ToyModel, rng: np.random.Generator) -> ToyModel:
        """Return another body."""
        factors = {name: rng.uniform(*ends) for name, ends in asdict(self).items()}
        return replace(model, **{name: f * getattr(model, name) for name, f in factors.items()})


WIDE = ToySpread(
    friction=(0.7, 1.1),
    chassis_mass=(0.9, 1.4),
    wheel_torque=(0.8, 1.1),
    leg_stiffness=(0.8, 1.1),
    leg_damping=(0.7, 1.2),
)
"""For policies that shall hold under evaluation's preset (`toy_conditions`), and beyond it."""
TOY_GRID = PatchGrid(ahead=1.2, behind=0.5, half_width=0.2, footprint=(0.3, 0.1))
"""The toy's patch: 18 x 5 points, mostly ahead, since it looks before it leaps."""


def polyline(
    s: Float[np.ndarray, "samples"], h: Float[np.ndarray, "samples"]
) -> Float[np.ndarray, "vertices 2"]:
    """Return the bends of a sampled profile; an edge becomes two vertices at the same s."""
    jump = np.abs(np.diff(h)) > CLIFF / 2
    bend = np.ones(len(s), dtype=bool)
    bend[1:-1] = (np.abs(np.diff(h, n=2)) > 1e-4) | jump[:-1] | jump[1:]
    edges = np.flatnonzero(jump)
    middle, twice = (s[edges] + s[edges + 1]) / 2, np.repeat(edges + 1, 2)
    ends = np.stack((h[edges], h[edges + 1]), axis=-1).ravel()
    vertices = (np.insert(s, twice, np.repeat(middle, 2)), np.insert(h, twice, ends))
    return np.stack(vertices, axis=-1)[np.insert(bend, twice, True)]


class ToyEnv(LocomotionEnv):
    """A batch of toys in one pymunk space."""

    num_actions = 4
    """Rear wheel, front wheel (surface speed), rear leg, front leg (length)."""
    grid = TOY_GRID
    # Without its speeds and its height above the ground; with the command.
    felt, unfelt = (0, 1, 2, *range(6, 21)), (3, 4, 5)
    disturbances: ClassVar = {"usual": ToySpread(), "wide": WIDE}

    def __init__(
        self,
        world: World,
        num_envs: int = 64,
        *,
        model: ToyModel | None = None,
        settings: ToySpread | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Build the space; the further options are those of `LocomotionEnv`.

        By `settings` the toys differ from `model` and from one another; None: they do not.
        """
        self.model, self.settings = model or ToyModel(), settings or ToySpread()
        self.body_seed = seed
        self.control_dt = self.model.dt * self.model.substeps
        super().__init__(world, num_envs, seed=seed, **options)
        self.ground = world.elevation.filled().heights.astype(np.float64)
        self.reset_all()

    # Physics ----------------------------------------------------------------------------------

    def rebuild(self) -> None:
        """Build the space anew: no cached contact survives, so resuming is exact."""
        n = self.num_envs
        rng = np.random.default_rng(self.body_seed)
        self.models = [self.settings.draw(self.model, rng) for _ in range(n)]
        self.space = pymunk.Space()
        self.space.gravity = (0.0, -9.81)
        self.space.iterations = 12
        self.bodies: list[list[pymunk.Body]] = []
        self.motors: list[list[SimpleMotor]] = []
        self.legs: list[list[DampedSpring]] = []
        self.segments: list[list[pymunk.Segment]] = [[] for _ in range(n)]
        self.laid = [0] * n
        # A toy drives along a ray: (x, y) = ray_start + (s - ray_offset) * (cos, sin)(ray_yaw).
        self.ray_start, self.ray_offset, self.ray_yaw = np.zeros((n, 2)), np.zeros(n), np.zeros(n)
        self.yaw, self.yaw_rate, self.speed = np.zeros(n), np.zeros(n), np.zeros(n)
        self.leg_target = np.full((n, 2), self.model.stance)
        self.last_action, self.action_change = torch.zeros(n, 4), torch.zeros(n, 4)
        self.buffer = pymunk.batch.Buffer()
        for i in range(n):
            self._build_robot(i)
        self._read()

    def _build_robot(self, i: int) -> None:
        """Add robot i: a chassis, and two wheels that slide on grooves under spring and motor."""
        m = self.models[i]
        chassis = pymunk.Body(m.chassis_mass, pymunk.moment_for_box(m.chassis_mass, m.chassis_size))
        box = pymunk.Poly.create_box(chassis, m.chassis_size, radius=0.01)
        box.friction = 0.4
        # Parts of one robot share a group, so that wheels never touch their own chassis.
        box.filter = pymunk.ShapeFilter(group=i + 1)
        chassis.position = (0.0, i * STOREY)
        self.space.add(chassis, box)
        bodies, motors, legs = [chassis], [], []
        for side in (-1, 1):
            moment = pymunk.moment_for_circle(m.wheel_mass, 0.0, m.wheel_radius)
            wheel = pymunk.Body(m.wheel_mass, moment)
            wheel.position = (side * m.half_base, i * STOREY - m.stance)
            circle = pymunk.Circle(wheel, m.wheel_radius)
            circle.friction = m.friction
            circle.filter = pymunk.ShapeFilter(group=i + 1)
            hip = (side * m.half_base, 0.0)
            near, far = ((hip[0], -length) for length in m.leg_range)
            groove = GrooveJoint(chassis, wheel, near, far, (0.0, 0.0))
            spring = (m.stance, m.leg_stiffness, m.leg_damping)
            leg = DampedSpring(chassis, wheel, hip, (0.0, 0.0), *spring)
            motor = SimpleMotor(chassis, wheel, 0.0)
            motor.max_force = m.wheel_torque
            self.space.add(wheel, circle, groove, leg, motor)
            bodies.append(wheel)
            motors.append(motor)
            legs.append(leg)
        self.bodies.append(bodies)
        self.motors.append(motors)
        self.legs.append(legs)

    def _read(self) -> None:
        """Copy every body's state out of the space: state [envs, 3 bodies, 6]."""
        fields = pymunk.batch.BodyFields
        wanted = fields.POSITION | fields.ANGLE | fields.VELOCITY | fields.ANGULAR_VELOCITY
        self.buffer.clear()
        pymunk.batch.get_space_bodies(self.space, wanted, self.buffer)
        flat = np.frombuffer(bytes(self.buffer.float_buf()), dtype=np.float64)
        # The static body comes last, once it has shapes.
        self.state = flat[: self.num_envs * 18].reshape(self.num_envs, 3, 6).copy()
        self.state[:, :, 1] -= np.arange(self.num_envs)[:, None] * STOREY

    def advance(self, actions: Tensor) -> None:
        """Set wheel rates and leg lengths, turn by the commanded rate, and simulate."""
        m = self.model
        action = actions.detach().to("cpu", torch.float32).clamp(-1.0, 1.0)
        self.action_change = action - self.last_action
        self.last_action = action
        a = action.numpy().astype(np.float64)
        command = self.command.cpu().numpy()
        surface = command[:, :1] + m.wheel_boost * a[:, :2]
        goal = np.clip(m.stance + m.leg_stroke * a[:, 2:], *m.leg_range)
        most = m.leg_speed * self.control_dt
        self.leg_target += np.clip(goal - self.leg_target, -most, most)
        self.yaw_rate = command[:, 2].astype(np.float64)
        self._turn(self.yaw_rate * self.control_dt)
        rates = (surface / m.wheel_radius).tolist()
        lengths = self.leg_target.tolist()
        for motors, legs, rate, length in zip(self.motors, self.legs, rates, lengths, strict=True):
            # pymunk's motor drives angular velocity of a minus that of b; forward is clockwise.
            motors[0].rate, motors[1].rate = rate
            legs[0].rest_length, legs[1].rest_length = length
        for _ in range(m.substeps):
            self.space.step(m.dt)
        before = self.state[:, 0, 0]
        self._read()
        # The mean over the control step: a hop or a jolt must not look like tracking.
        self.speed = (self.state[:, 0, 0] - before) / self.control_dt

    # Places -----------------------------------------------------------------------------------

    def place(self, ids: Int[Tensor, "n"], poses: Float[Tensor, "n 3"]) -> None:
        """Put toys at rest, both wheels on the ground, at (x, y, yaw)."""
        m = self.model
        which = ids.cpu().numpy()
        place, self.yaw[which] = poses[:, :2].cpu().numpy(), poses[:, 2].cpu().numpy()
        self.state[which] = 0.0
        s, h = self._cut(which, place)
        rear, front = (
            h[:, np.abs(s - side * m.half_base) <= m.wheel_radius].max(axis=1) for side in (-1, 1)
        )
        pitches = np.arctan2(front - rear, 2 * m.half_base).tolist()
        heights = ((rear + front) / 2 + m.wheel_radius + m.stance + 0.01).tolist()
        for i, pitch, z in zip(which.tolist(), pitches, heights, strict=True):
            cos, sin = math.cos(pitch), math.sin(pitch)
            for body, side in zip(self.bodies[i], (0, -1, 1), strict=True):
                a, b = side * m.half_base, -m.stance * abs(side)
                body.position = (cos * a - sin * b, i * STOREY + z + sin * a + cos * b)
                body.angle = pitch
                body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
                self.space.reindex_shapes_for_body(body)
        self.leg_target[which] = m.stance
        self.last_action[which] = 0.0
        self.speed[which] = 0.0
        self._read()

    def _position(self) -> Float[np.ndarray, "envs 2"]:
        """Return the chassis' place (x, y) on the map."""
        along = np.stack((np.cos(self.ray_yaw), np.sin(self.ray_yaw)), axis=-1)
        return self.ray_start + (self.state[:, 0, 0] - self.ray_offset)[:, None] * along

    def _cut(self, ids: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cut the map along each robot's yaw through its `place`; lay the cut under the robot.

        Returns the cuts as sampled: s relative to the place [samples], heights h [n, samples].
        """
        self.ray_start[ids], self.ray_yaw[ids] = place, self.yaw[ids]
        self.ray_offset[ids] = self.state[ids, 0, 0]
        s = np.arange(-SLICE[0], SLICE[1] + 1e-9, self.resolution / 2)
        h = self._profile(place, self.yaw[ids], s)
        for i, heights in zip(ids.tolist(), h, strict=True):
            vertices = polyline(s, heights) + np.array((self.ray_offset[i], i * STOREY))
            self._lay(i, vertices.tolist())
        return s, h

    def _profile(
        self, place: Float[np.ndarray, "n 2"], yaw: Float[np.ndarray, "n"], s: np.ndarray
    ) -> Float[np.ndarray, "n samples"]:
        """Sample the ground along rays.

        Gentle ground is interpolated between cell centres; where neighbouring cells differ by more
        than `CLIFF` each keeps its height, so that the edge between them stays vertical.
        """
        along = np.stack((np.cos(yaw), np.sin(yaw)), axis=-1)
        uv = place[:, None] + s[:, None] * along[:, None] - np.asarray(self.origin)
        nx, ny = self.ground.shape
        uv = np.clip(uv / self.resolution - 0.5, 0, (nx - 1, ny - 1))
        i, j = (np.minimum(uv[..., k].astype(int), n - 2) for k, n in enumerate((nx, ny)))
        a, b = uv[..., 0] - i, uv[..., 1] - j
        flat, base = self.ground.reshape(-1), i * ny + j
        h00, h01, h10, h11 = flat[base], flat[base + 1], flat[base + ny], flat[base + ny + 1]
        smooth = (h00 * (1 - b) + h01 * b) * (1 - a) + (h10 * (1 - b) + h11 * b) * a
        nearest = flat[base + ny * (a >= 0.5) + (b >= 0.5)]
        return np.where(np.ptp((h00, h01, h10, h11), axis=0) > CLIFF, nearest, smooth)

    def _lay(self, i: int, vertices: list[list[float]]) -> None:
        """Move robot i's ground segments onto a polyline.

        Moving segments is many times cheaper than making them; those not needed are parked.
        """
        pool, used = self.segments[i], len(vertices) - 1
        while len(pool) < used:
            segment = pymunk.Segment(self.space.static_body, PARKED, PARKED, 0.0)
            segment.friction = self.models[i].friction
            self.space.add(segment)
            pool.append(segment)
        spare = [(PARKED, PARKED)] * (self.laid[i] - used)
        ends = [*itertools.pairwise(vertices), *spare]
        for segment, (start, end) in zip(pool, ends, strict=False):
            segment.unsafe_set_endpoints(start, end)
            self.space.reindex_shape(segment)
        self.laid[i] = used

    def _turn(self, angle: Float[np.ndarray, "envs"]) -> None:
        """Turn the toys by `angle` (rad); cut the map anew where the last cut no longer serves."""
        self.yaw += angle
        travelled = self.state[:, 0, 0] - self.ray_offset
        stale = np.abs(self.yaw - self.ray_yaw) > RECUT
        stale |= (travelled < ROOM - SLICE[0]) | (travelled > SLICE[1] - ROOM)
        if stale.any():
            self._cut(np.flatnonzero(stale), self._position()[stale])

    # What the base class asks -------------------------------------------------------------------

    def motion(self) -> tuple[Float[Tensor, "envs 4"], Float[Tensor, "envs 3"]]:
        """Return poses (x, y, z, yaw) and velocities (vx, vy, wz); a toy never slides sideways."""
        pose = np.concatenate((self._position(), self.state[:, 0, 1:2], self.yaw[:, None]), axis=1)
        velocity = np.stack((self.speed, np.zeros(self.num_envs), self.yaw_rate), axis=1)
        return self._tensor(pose), self._tensor(velocity)

    def conditions(self) -> dict[str, Any]:
        """Return how the toys differ, and the body that they differ from, as plain values."""
        return {"settings": asdict(self.settings), "model": asdict(self.model)}

    def proprioception(self) -> Float[Tensor, "envs 18"]:
        """Return pitch, speeds, height above ground, legs, wheel speeds and the last action."""
        m, state = self.model, self.state
        pitch = state[:, 0, 2]
        leg, leg_rate = self._legs()
        height = state[:, 0, 1] - self._ground_under()
        features = (
            np.sin(pitch),
            np.cos(pitch),
            0.2 * state[:, 0, 5],
            self.speed,
            state[:, 0, 4],
            3.0 * (height - m.stance - m.wheel_radius),
            *(5.0 * (leg - m.stance)).T,
            *(5.0 * (self.leg_target - m.stance)).T,
            *(0.3 * leg_rate).T,
            *(-m.wheel_radius * state[:, 1:, 5]).T,
        )
        return torch.cat((self._tensor(np.stack(features, axis=1)), self.last_action), dim=-1)

    def scan(self, patch: Float[Tensor, "envs points"]) -> Float[Tensor, "envs rows"]:
        """Return the patch's middle line: what lies in the slice the toy drives in."""
        rows, columns = self.grid.shape
        return 4.0 * patch.reshape(-1, rows, columns)[..., columns // 2]

    def fallen(self) -> Bool[Tensor, "envs"]:
        """Tell which toys have rolled over or dropped an axle into a hole."""
        tipped = np.abs(self.state[:, 0, 2]) > MAX_PITCH
        wheels = torch.as_tensor(self.state[:, 1:, 0] - self.ray_offset[:, None])
        behind, ahead = (
            self._heights_at(wheels[:, :, None] + side * torch.linspace(0.0, HOLE, 6)).amax(dim=-1)
            for side in (-1, 1)
        )
        # In a hole the ground is higher on both sides; beside a wall it is on one.
        edge = torch.minimum(behind, ahead).numpy()
        dropped = (self.state[:, 1:, 1] < edge - DROP).any(axis=1)
        return torch.as_tensor(tipped | dropped, device=self.device)

    def drawing(self) -> Float[np.ndarray, "envs 9"]:
        """Return (s, z, angle) of chassis, rear and front wheel; s counts from the chassis, m."""
        parts = self.state[:, :, :3].copy()
        parts[:, :, 0] -= self.state[:, :1, 0]
        return parts.reshape(self.num_envs, 9)

    def reward(self, r_v: Tensor, failed: Bool[Tensor, "envs"]) -> Tensor:
        """Return r_v (Eq. 1), a wider term to climb by, and small costs of rough driving."""
        error = self._tensor(self.speed) - self.command[:, 0]
        wide = torch.exp(-error.square() / 0.5)
        rocking = self._tensor(self.state[:, 0, 5] ** 2)
        rough = 0.02 * self.action_change.square().sum(-1) + 0.002 * rocking
        return r_v + 0.5 * wide - rough - 5.0 * failed

    def _legs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return leg lengths (m) and their rates (m/s), [envs, 2] each."""
        chassis, wheels = self.state[:, :1], self.state[:, 1:]
        down = np.stack((np.sin(chassis[..., 2]), -np.cos(chassis[..., 2])), axis=-1)
        length = ((wheels[..., :2] - chassis[..., :2]) * down).sum(-1)
        rate = ((wheels[..., 3:5] - chassis[..., 3:5]) * down).sum(-1)
        return length, rate

    def _ground_under(self) -> Float[np.ndarray, "envs"]:
        s = torch.as_tensor(self.state[:, 0, 0] - self.ray_offset)[:, None]
        return self._heights_at(s + torch.tensor((-0.25, 0.0, 0.25))).median(dim=-1).values.numpy()

    def _heights_at(self, s: Float[Tensor, "envs *points"]) -> Tensor:
        """Return ground heights at driving coordinates relative to each robot's ray start."""
        shape = (-1,) + (1,) * (s.ndim - 1)
        yaw = torch.as_tensor(self.ray_yaw).reshape(shape)
        start = torch.as_tensor(self.ray_start).reshape(*shape, 2)
        xy = start + s[..., None] * torch.stack((torch.cos(yaw), torch.sin(yaw)), dim=-1)
        return sample_heights(
            torch.as_tensor(self.ground), xy, resolution=self.resolution, origin=self.origin
        )

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)
