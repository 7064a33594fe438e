"""The A1's film: MuJoCo draws the walk, a camera follows, a small map says where.

Reads an `Episode` with its body recorded, the terrain and the route; gives pictures with the active
policy and the time on them. The hull has the active policy's colour, as has the line on the ground.
"""

from collections.abc import Iterable, Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb
from PIL import Image, ImageOps

from fgtutor.elevation import ElevationMap
from fgtutor.execution import Episode, FollowConfig
from fgtutor.figures.episode_film import BAR, SKY, EpisodeFilm, MapView
from fgtutor.robots.a1.looks import a1_scene
from fgtutor.robots.offscreen import Renderer, Shot
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

VIEW = (640, 352)
"""Size of what MuJoCo draws, pixels: on two cores, a second of film takes less than a second."""
TITLE = 36
"""Height of the strip above it that words are written on, pixels."""
INSET = 200
"""Width of the small map, pixels."""
DISTANCE = 1.9
"""From the camera to the robot, m."""
BESIDE = 35.0
"""How far the camera stands aside of the robot's heading, degrees."""
ABOVE = (25.0, 75.0)
"""How steeply the camera looks down, and how steeply at most to see over a wall, degrees."""
CLEARANCE = 0.15
"""How far the line of sight keeps from the ground, m."""


class A1Film(EpisodeFilm):
    """One walk of the A1, ready to be drawn.

    Raises:
        ConfigError: The episode is empty, or its body is not the A1's.
    """

    robot, features = "a1", 19

    def __init__(self, episode: Episode, terrain: Terrain, route: Route) -> None:
        super().__init__(episode, terrain, route)
        self.terrain = terrain
        x, y, z = (self.smooth(values, 0.8) for values in episode.poses[:, :3].T)
        self.targets = np.stack((x, y, z - 0.05), axis=-1)
        self.azimuths = np.degrees(self.smooth(np.unwrap(episode.poses[:, 3]), 3.0)) + BESIDE
        steep = steepness(self.ground, self.targets, self.azimuths)
        # Rise before the wall is there, and sink when it is gone.
        width = max(1, round(1.0 / self.dt)) | 1
        near = np.lib.stride_tricks.sliding_window_view(
            np.pad(steep, width // 2, mode="edge"), width
        )
        self.steepness = self.smooth(near.max(axis=-1), 1.0)

    def shot(self, t: int) -> Shot:
        """Return what the camera shows at step t."""
        # The robot may have walked on one of many tiles: its pose is told in the terrain's frame.
        x, y = self.episode.poses[t, :2].tolist()
        target_x, target_y, target_z = self.targets[t].tolist()
        return Shot(
            qpos=np.concatenate(((x, y), self.body[t, 2:])),
            target=(target_x, target_y, target_z),
            distance=DISTANCE,
            azimuth=float(self.azimuths[t]),
            elevation=-float(self.steepness[t]),
            coat=to_rgb(self.colours[self.policy(t)]),
        )

    def views(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw the robot at these steps, under a strip of words.

        Raises:
            RenderingError: MuJoCo cannot draw on this machine.
        """
        steps = list(steps)
        colours = [to_rgb(self.colours[self.route.names[k]]) for k in self.route.policies]
        width, height = VIEW
        scene = a1_scene(
            self.terrain,
            self.route.xy,
            colours,
            width=width,
            height=height,
            goal_radius=FollowConfig().goal_radius,
        )
        with Renderer(scene, width, height) as renderer:
            for t, pixels in zip(steps, renderer.film(map(self.shot, steps)), strict=True):
                view = Image.new("RGB", (width, TITLE + height + BAR), SKY)
                view.paste(Image.fromarray(pixels), (0, TITLE))
                self.write(view, t)
                yield view

    def frames(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw the same with the map in a corner.

        Raises:
            RenderingError: MuJoCo cannot draw on this machine.
        """
        steps = list(steps)
        for t, frame in zip(steps, self.views(steps), strict=True):
            poses = self.episode.poses[: t + 1]
            colour = self.colours[self.policy(t)]
            inset = self._map.at(poses[:, :2], poses[-1, 3], colour, size=0.9).reduce(2)
            frame.paste(ImageOps.expand(inset, 2, SKY), (VIEW[0] - inset.width - 12, TITLE + 8))
            yield frame

    @cached_property
    def _map(self) -> MapView:
        return MapView(self.ground, self.route, 2 * INSET, bare=True)


def steepness(
    ground: ElevationMap,
    targets: Float[np.ndarray, "steps 3"],
    azimuths: Float[np.ndarray, " steps"],
) -> Float[np.ndarray, " steps"]:
    """Return how steeply a camera must look down to see each target over the ground, degrees.

    The least of `ABOVE` if nothing is in the way, the most if everything is.
    """
    angles = np.linspace(*ABOVE, 11)
    down, around = np.radians(angles)[:, None], np.radians(azimuths)[:, None, None]
    far = np.linspace(0.2, DISTANCE, 18)
    x, y, z = targets.T[:, :, None, None]
    heights = ground.height_at(
        x - far * np.cos(down) * np.cos(around), y - far * np.cos(down) * np.sin(around)
    )
    clear = (z + far * np.sin(down) > heights + CLEARANCE).all(axis=-1)
    clear[:, -1] = True
    return angles[clear.argmax(axis=-1)]
