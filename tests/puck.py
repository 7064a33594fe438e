"""A puck, the smallest robot there is: it slides as commanded and loses its way at a ledge.

Nothing but `fgtutor/robots/base.py` was needed to write it; the recipe is in CONTRIBUTING.md.
"""

import torch

from fgtutor.patches import PatchGrid, sample_heights
from fgtutor.robots.base import LocomotionEnv

LEDGE = 0.1
"""A step up or down that a puck does not survive, m."""


class PuckEnv(LocomotionEnv):
    """A batch of pucks without physics."""

    num_actions = 1
    """What is added to the commanded speed, m/s."""
    grid = PatchGrid(ahead=0.4, behind=0.2, half_width=0.1, footprint=(0.1, 0.1))
    control_dt = 0.1

    def __init__(self, world, num_envs=16, **options):
        super().__init__(world, num_envs, **options)
        self.pose, self.velocity = torch.zeros(num_envs, 4), torch.zeros(num_envs, 3)
        self.reset_all()

    def place(self, ids, poses):
        self.pose[ids] = torch.cat(
            (poses[:, :2], self._ground(poses)[:, None], poses[:, 2:]), dim=-1
        )
        self.velocity[ids] = 0.0

    def advance(self, actions):
        self.velocity = self.command.clone()
        self.velocity[:, 0] += 0.1 * actions[:, 0].clamp(-1.0, 1.0)
        yaw, step = self.pose[:, 3], self.control_dt * self.velocity[:, 0]
        x, y = self.pose[:, 0] + step * yaw.cos(), self.pose[:, 1] + step * yaw.sin()
        z = self.pose[:, 2]
        self.pose = torch.stack((x, y, z, yaw + self.control_dt * self.velocity[:, 2]), dim=-1)
        rise = self._ground(self.pose) - z
        self.pose[:, 2] += torch.where(rise.abs() < LEDGE, rise, 0.0)

    def proprioception(self):
        return self.velocity.clone()

    def motion(self):
        return self.pose, self.velocity

    def fallen(self):
        return (self._ground(self.pose) - self.pose[:, 2]).abs() >= LEDGE

    def reward(self, r_v, failed):
        return r_v - failed.float()

    def drawing(self):
        return self.pose.numpy().copy()

    def _ground(self, poses):
        return sample_heights(
            self.heights, poses[:, :2], resolution=self.resolution, origin=self.origin
        )
