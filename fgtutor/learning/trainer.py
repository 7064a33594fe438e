"""A training run, one iteration at a time: robots, learner, curriculum and checkpoints.

Reads a `TrainConfig` and, to go on, a checkpoint; gives each iteration's numbers, checkpoints,
snapshots and a `Specialist`. No data is collected for the Feasibility-Net alone: labels come from
the tracking rewards in rsl_rl's rollout storage. Under torchrun, several processes train one
specialist together (see `distributed`).
Source: paper, Sec. III-A (Eqs. 1-3) and Fig. 2; PPO from rsl_rl.
"""

import contextlib
import ctypes
import gc
import io
import math
import time
import warnings
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from fgtutor.errors import CheckpointError, ConfigError, DivergedError
from fgtutor.learning import distributed
from fgtutor.learning.checkpoints import CHECKPOINT, foreign, read_checkpoint, write_checkpoint
from fgtutor.learning.config import TrainConfig, comparable, make_training_env, runner_config
from fgtutor.learning.distributed import leads
from fgtutor.learning.ppo import FeasibilityPPO
from fgtutor.policies.dreamwaq import EstimatingModel
from fgtutor.robots.base import LocomotionEnv
from fgtutor.specialist import Specialist, load_specialist, save_specialist, sizes_of

OUTGROWN = 0.45
"""Share of the way to the last row at which, on the mean, robots have outgrown the first one."""
LIFT = 0.25
"""Share of what is missing to full difficulty by which the first row is then lifted."""
GENTLY = 0.02
"""Share of the learning rate at which a trained policy begins to learn on, with an optimiser that
knows nothing of it yet; the rate then adapts within an iteration or two."""
KEPT = ("iteration", "samples_before", "critic_warmup", "easiest", "seconds", "history")
"""What a checkpoint keeps of the trainer's own fields."""


class Trainer:
    """One training run: environment, runner, checkpoints, curves."""

    def __init__(self, config: TrainConfig) -> None:
        """Build the world, the robots and the learner; nothing is simulated yet."""
        start = config.start_from
        if start and start.resolve().is_relative_to(config.folder.resolve()):
            raise ConfigError(
                f"{config.folder} would be overwritten by the run that starts from it: give "
                "another --out, or go on with --resume and without --from"
            )
        self.config = config
        self.iteration = self.saved = 0
        self.easiest = config.easiest
        distributed.check_device(config.device)
        torch.set_num_threads(config.threads)
        torch.manual_seed(distributed.own_seed(config.seed))
        self.env = self._make_env()
        half_window = (round(config.label_seconds / self.env.control_dt) + 1) // 2
        if config.steps <= half_window:
            raise ConfigError(
                f"rollouts of {config.steps} steps never see half of a {config.label_seconds:g} s "
                f"label: set steps to {half_window + 1} or more, or label_seconds lower"
            )
        with contextlib.redirect_stdout(io.StringIO()):
            self.runner = distributed.Runner(
                self.env,
                runner_config(config, self.env),
                log_dir=None,
                device=distributed.own_device(config.device),
            )
        self.algorithm: FeasibilityPPO = self.runner.alg  # type: ignore[assignment]
        self.samples_before = 0
        self.critic_warmup = 0
        if config.start_from:
            self._start_from(config.start_from)
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []

    @property
    def checkpoint(self) -> Path:
        """Where this run's checkpoint lies."""
        return self.config.folder / CHECKPOINT

    @property
    def samples(self) -> int:
        """Control steps learned from so far, those of the policy it started from included."""
        own = self.iteration * self.config.num_envs * self.config.steps
        return self.samples_before + own * distributed.processes()

    def _make_env(self) -> LocomotionEnv:
        """Build this process's robots, on the CPU as their physics, on ground of its own."""
        seed = distributed.own_seed(self.config.seed)
        config = replace(self.config, seed=seed, device="cpu", easiest=self.easiest)
        return make_training_env(config, self.iteration)

    def _start_from(self, folder: Path) -> None:
        """Take over a trained policy, all but its action noise.

        From a run's folder, finished or not, its critic comes along; otherwise that is new, and
        learns first, alone, but for an estimator of the velocity, which learns all the while. On
        the same terrain the Feasibility-Net comes along, unless it was refitted with other widths
        or units (as the shipped A1's were): then it begins anew.
        """
        checkpoint = folder / CHECKPOINT
        run = read_checkpoint(checkpoint) if checkpoint.exists() else None
        specialist = load_specialist(folder / f"snapshots/{run['iteration']}" if run else folder)
        mine, start = self.algorithm.get_policy(), specialist.policy
        told = (
            mine if isinstance(mine, EstimatingModel) and start.obs_groups == ["policy"] else None
        )
        fits = told or start.obs_dim == mine.obs_dim
        if specialist.robot != self.config.robot or not fits:
            raise CheckpointError(
                f"{self.config.start_from} drives {specialist.robot} on {start.obs_dim} numbers of "
                f"{start.obs_groups}, {self.config.robot} with the {self.config.actor} actor needs "
                f"{mine.obs_dim} of {mine.obs_groups}: start from another"
            )
        self.samples_before = int(specialist.provenance.get("samples", 0))
        noise = {k: v for k, v in mine.state_dict().items() if k.startswith("distribution")}
        try:
            if told:
                told.adopt(start, self.env.felt, self.env.unfelt)
            else:
                mine.load_state_dict(start.state_dict() | noise)
            if run and not told:
                self.algorithm.critic.load_state_dict(run["algorithm"]["critic_state_dict"])
            net = specialist.feasibility
            alike = sizes_of(net) == sizes_of(self.algorithm.feasibility)
            if specialist.name == self.config.terrain and alike:
                self.algorithm.feasibility.load_state_dict(specialist.feasibility.state_dict())
        except (LookupError, RuntimeError) as error:
            raise CheckpointError(
                f"{folder} holds networks of other sizes than these with --hidden "
                f"{' '.join(map(str, self.config.hidden))}: give its own --hidden, or start from "
                "another"
            ) from error
        self.critic_warmup = 0 if run and not told else self.config.critic_warmup

    def iterate(self) -> dict[str, float]:
        """Collect one rollout, learn from it, and return this iteration's numbers.

        Raises:
            DivergedError: A number is no longer finite; what was saved before is kept.
        """
        if self.config.start_from and self.iteration in (0, self.critic_warmup):
            self._free_policy()
            share = 1.0 if self.iteration < self.critic_warmup else GENTLY
            self.algorithm.learning_rate = share * self.config.learning_rate
        began, done = time.monotonic(), self.iteration / self.config.iterations
        self.algorithm.entropy_coef = self.config.entropy * max(0.0, 1 - 1.25 * done)
        for group in self.algorithm.feasibility_optimizer.param_groups:
            group["lr"] = self.config.feasibility_learning_rate * 0.05**done
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # what rsl_rl says of its processes
                self.runner.learn(1)
        except (RuntimeError, ValueError) as error:
            strange = self._strange_weights()
            if not strange and isinstance(error, RuntimeError):
                raise
            # A ValueError: rsl_rl or MuJoCo met something that is no number.
            raise self._diverged(strange or str(error).splitlines()[0]) from error
        if strange := self._strange_weights():
            raise self._diverged(strange)
        self._limit_noise()
        self.iteration += 1
        self.seconds += time.monotonic() - began
        row = {
            "iteration": self.iteration,
            "samples": self.samples,
            "seconds": self.seconds,
            **distributed.mean(
                {
                    "row": self.env.crossings.row.float().mean().item(),
                    "easiest": self.easiest,
                    "std": self.algorithm.get_policy().output_std.mean().item(),
                    **self.algorithm.metrics,
                }
            ),
        }
        if strange := [name for name, value in row.items() if not math.isfinite(value)]:
            raise self._diverged(f"{', '.join(strange)} not finite")
        self.history.append(row)
        return row

    def _free_policy(self) -> None:
        """Let the policy learn, once the critic has learned enough; its estimator always does."""
        for name, weight in self.algorithm.get_policy().named_parameters():
            estimates = name.startswith("context.")
            weight.requires_grad_(estimates or self.iteration >= self.critic_warmup)

    def _strange_weights(self) -> str:
        """Say which network has weights that are not finite, if one has."""
        nets = {
            "policy": self.algorithm.get_policy(),
            "critic": self.algorithm.critic,
            "Feasibility-Net": self.algorithm.feasibility,
        }
        for name, net in nets.items():
            if not all(value.isfinite().all() for value in net.state_dict().values()):
                return f"weights of the {name} are not finite"
        return ""

    def _diverged(self, what: str) -> DivergedError:
        again = "anew"
        if self.saved:
            again = (
                f"from --from {self.config.folder}, which keeps iteration {self.saved}, into "
                "another --out,"
            )
        return DivergedError(
            f"the training diverged in iteration {len(self.history) + 1} ({what}): begin {again} "
            "with a lower --learning-rate or --feasibility-learning-rate"
        )

    def _lift_first_row(self, rows: torch.Tensor) -> torch.Tensor:
        """Lift the first row where the robots have outgrown it; return the rows they stand on then.

        A robot keeps its difficulty, as far as there is still such a row.
        """
        last, top = self.config.easiest_at_last, self.config.rows - 1
        if last is None or self.easiest >= last or top < 1:
            return rows
        if self.history[-1]["row"] < OUTGROWN * top:
            return rows
        difficulty = self.easiest + (1 - self.easiest) * rows / top
        self.easiest = min(last, self.easiest + LIFT * (1 - self.easiest))
        lifted = top * (difficulty - self.easiest) / (1 - self.easiest)
        return lifted.round().clamp(min=0).long()

    @torch.no_grad()
    def _limit_noise(self) -> None:
        """Hold the action noise down as far as the first row has risen."""
        config, last = self.config, self.config.easiest_at_last
        if last is None or config.std_at_last is None:
            return
        way = last - config.easiest
        risen = (self.easiest - config.easiest) / way if way > 0 else 1.0
        most = config.first_std * (config.std_at_last / config.first_std) ** risen
        noise = self.algorithm.get_policy().get_parameter("distribution.log_std_param")
        noise.clamp_(max=math.log(most))

    def save(self) -> None:
        """Write a snapshot and then the checkpoint, each atomically, and go on in a new world.

        Physics engines keep caches that no checkpoint can hold. So a checkpoint is a point where
        the physics is rebuilt, in the run that goes on as in the run that resumes: both continue
        from the same state, bit for bit. The new world holds other terrain of the same kind, so
        that a policy sees many variants of it and a simulation at a time only few.

        Of several processes the first one writes, for all of them.
        """
        mine = {"env": self.env.state_dict(), "torch_random": torch.get_rng_state()}
        mine["env"]["row"] = self._lift_first_row(mine["env"]["row"])
        first, *others = distributed.gather(mine)
        if leads():
            # The snapshot first: then a checkpoint always has the one that `_start_from` reads.
            snapshot = self.config.folder / "snapshots" / f"{self.iteration}"
            save_specialist(self.specialist(), snapshot)
            own = {"config": comparable(self.config), "algorithm": self.algorithm.save()}
            own |= {name: getattr(self, name) for name in KEPT}
            write_checkpoint(self.checkpoint, own | first | {"others": others})
        self.saved = self.iteration
        self._renew(mine["env"])
        self.algorithm.memory.clear()

    def _renew(self, state: dict[str, torch.Tensor]) -> None:
        """Move to the world that belongs to this iteration, with the curriculum of `state`."""
        # The last world goes first: two of rubble would take 6 GB, and it holds itself in a cycle.
        del self.env, self.runner.env
        gc.collect()
        give_back_memory()
        self.env = self.runner.env = self._make_env()
        self.env.load_state_dict(state)
        self.env.reset_all()

    def resume(self) -> None:
        """Continue from the run folder's checkpoint, to more iterations if `config` says so.

        What the run once started from need not be given again, nor still be there. Raises
        `CheckpointError` if there is no checkpoint, it cannot be read, or it is of another run.
        """
        path = self.checkpoint
        if not path.exists():
            raise CheckpointError(f"no checkpoint at {path}: start without --resume")
        state = read_checkpoint(path)
        stored = state["config"]
        start = stored.get("start_from")
        if start and isinstance(start, str) and not self.config.start_from:
            self.config = replace(self.config, start_from=Path(start))
        mine = comparable(self.config)
        changed = sorted(k for k in mine if k != "iterations" and stored.get(k) != mine[k])
        if changed:
            what = ", ".join(f"{k} was {stored.get(k)!r}, now {mine[k]!r}" for k in changed)
            raise CheckpointError(
                f"{path} belongs to another run: {what}. Use the same settings, or another --out"
            )
        parts = [state, *state["others"]]
        if len(parts) != distributed.processes():
            raise CheckpointError(
                f"{path} was written by {len(parts)} processes, these are "
                f"{distributed.processes()}: go on with as many, or use another --out"
            )
        try:
            self._restore(state, parts[distributed.rank()])
        except Exception as error:  # of rsl_rl, torch and the robots, whatever is in the state
            raise foreign(path, error) from error

    def _restore(self, state: dict[str, Any], own: dict[str, Any]) -> None:
        """Restore all that a checkpoint holds; `own` is this process's part of it."""
        with warnings.catch_warnings(action="ignore"):  # torch warns of what it then refuses
            self.algorithm.load(state["algorithm"])
        if strange := self._strange_weights():
            raise ValueError(strange)
        for name in KEPT:
            setattr(self, name, state[name])
        self.saved = self.iteration
        self._free_policy()
        self._renew(dict(own["env"]))
        self.specialist()  # raises where none could be made of it at the end
        torch.set_rng_state(own["torch_random"])

    def specialist(self) -> Specialist:
        """Return what has been learned so far as a `Specialist`."""
        config = self.config
        every = max(1, len(self.history) // 100)
        return Specialist(
            name=config.terrain,
            robot=config.robot,
            policy=self.algorithm.get_policy(),
            feasibility=self.algorithm.feasibility,
            grid=self.env.grid,
            command=(config.planning_speed, 0.0, 0.0),
            label_seconds=config.label_seconds,
            provenance={
                "terrain": config.terrain,
                "iteration": self.iteration,
                "samples": self.samples,
                "seed": config.seed,
                "processes": distributed.processes(),
                "seconds": round(self.seconds, 1),
                "config": comparable(config),
                "conditions": self.env.conditions(),
                "versions": {p: version(p) for p in ("torch", "rsl-rl-lib", "pymunk", "mujoco")},
                "curve": self.history[::every],
            },
        )


def give_back_memory() -> None:
    """Ask glibc, where there is one, to return to the system what the last world has freed.

    It keeps freed pieces between others still in use: 0.4 GB for each world of 640 A1s.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
