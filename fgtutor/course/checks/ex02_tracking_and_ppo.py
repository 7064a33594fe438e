"""Exercise 02, "A robot that falls": r_v, labels, returns, PPO, episodes (Sec. III-A)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

SIGMA = 0.25


def _velocities(rng: np.random.Generator) -> tuple:
    command = rng.uniform(-1, 1, (6, 2))
    return command + rng.uniform(-0.5, 0.5, (6, 2)), command


def _episode(rng: np.random.Generator) -> tuple:
    steps = int(rng.integers(10, 16))
    fell = np.arange(steps) >= rng.integers(4, 8)
    return rng.uniform(0.2, 1, steps), fell, int(rng.integers(3, 6))


def _runs(rng: np.random.Generator) -> tuple:
    steps, robots = 14, 4
    rewards = rng.uniform(0, 1, (steps, robots))
    fell, timed_out = np.zeros((2, steps, robots), dtype=bool)
    fell[rng.integers(2, 5), 0] = fell[rng.integers(6, 9), 0] = True  # falls twice
    timed_out[steps - 1, 1] = True  # ends with the rollout
    timed_out[rng.integers(3, 6), 2] = True  # and an episode that goes on
    return rewards, fell, timed_out


def _statistics(
    rewards: np.ndarray, fell: np.ndarray, timed_out: np.ndarray, unfinished: bool = False
) -> tuple[float, float, float]:
    """Cut the steps of each robot behind every end, and look at the pieces."""
    returns, falls, lengths = [], [], []
    for robot in range(rewards.shape[1]):
        ends = np.flatnonzero(fell[:, robot] | timed_out[:, robot])
        pieces = np.split(np.arange(len(rewards)), ends + 1)
        for piece in pieces if unfinished else pieces[:-1]:
            if len(piece):
                returns.append(rewards[piece, robot].sum())
                falls.append(fell[piece[-1], robot])
                lengths.append(len(piece))
    if not lengths:
        return np.nan, np.nan, np.nan
    return float(np.mean(returns)), float(np.mean(falls)), float(np.mean(lengths))


def _in_one_row(
    rewards: np.ndarray, fell: np.ndarray, timed_out: np.ndarray
) -> tuple[float, float, float]:
    rewards, fell, timed_out = (table.T.reshape(-1, 1) for table in (rewards, fell, timed_out))
    return _statistics(rewards, fell, timed_out)


def _per_step(
    rewards: np.ndarray, fell: np.ndarray, timed_out: np.ndarray
) -> tuple[float, float, float]:
    mean, falls, length = _statistics(rewards, fell, timed_out)
    return mean / length, falls, length


def _labels(r_v: np.ndarray, fell: np.ndarray, window: int, first: int = 0) -> np.ndarray:
    counted = np.where(fell, 0.0, r_v)
    ends = np.arange(len(r_v)) + first
    return np.array([counted[max(t, 0) : max(t + window, 0)].mean() for t in ends])


def _of_survivors(r_v: np.ndarray, fell: np.ndarray, window: int) -> np.ndarray:
    alive = np.where(fell, 0.0, 1.0)
    sums = np.array([(alive * r_v)[t : t + window].sum() for t in range(len(r_v))])
    counts = np.array([alive[t : t + window].sum() for t in range(len(r_v))])
    return sums / np.maximum(counts, 1)


def _rewards(rng: np.random.Generator) -> tuple:
    done = np.zeros(9, dtype=bool)
    done[rng.integers(2, 6)] = True
    return rng.uniform(0, 1, 9), done, float(rng.uniform(0.8, 0.99))


def _returns(rewards: np.ndarray, done: np.ndarray, gamma: float) -> np.ndarray:
    episode = np.cumsum(np.concatenate(([0], done[:-1])))
    time = np.arange(len(rewards))
    counts = (episode[:, None] == episode) & (time[:, None] <= time)
    weight = np.where(counts, gamma ** np.maximum(time - time[:, None], 0), 0.0)
    return weight @ rewards


def _ratios(rng: np.random.Generator) -> tuple:
    return rng.uniform(0.4, 1.8, 12), rng.normal(0, 1, 12), float(rng.choice([0.1, 0.2, 0.3]))


QUESTIONS = (
    Question(
        id="ex02.q1",
        name="tracking_reward",
        points=1,
        title="the tracking reward r_v",
        expects="r_v is 1 where the command is met, and falls to 1/e where the velocity is "
        "0.25 m/s off in any direction; one number per robot.",
        draw=_velocities,
        examples=((np.array([[0.5, 0.0], [0.5, 0.25]]), np.array([[0.5, 0.0], [0.5, 0.0]])),),
        truth=lambda velocity, command: np.exp(-np.hypot(*(velocity - command).T) / SIGMA),
        mistakes=(
            Mistake(
                "the squared norm: Eq. 1 has the norm itself, so that a small error is already "
                "felt.",
                lambda v, c: np.exp(-((v - c) ** 2).sum(axis=-1) / SIGMA),
            ),
            Mistake(
                "a forgotten sigma: the norm is divided by 0.25 m/s before the exponential.",
                lambda v, c: np.exp(-np.linalg.norm(v - c, axis=-1)),
            ),
            Mistake(
                "a multiplication by sigma: dividing by 0.25 makes errors count more, multiplying "
                "less.",
                lambda v, c: np.exp(-np.linalg.norm(v - c, axis=-1) * SIGMA),
            ),
            Mistake(
                "the sum of both errors: |ex| + |ey| is not the length of the error.",
                lambda v, c: np.exp(-np.abs(v - c).sum(axis=-1) / SIGMA),
            ),
            Mistake(
                "one norm for the whole batch: each robot has an error of its own: np.linalg.norm "
                "needs axis=-1.",
                lambda v, c: np.exp(-np.linalg.norm(v - c) / SIGMA),
            ),
            Mistake(
                "the forward error alone: a robot that drifts sideways does not track its command "
                "either.",
                lambda v, c: np.exp(-np.abs(v - c)[:, 0] / SIGMA),
            ),
        ),
        hints=(
            "v - v_cmd is a vector for every robot: how long is it?",
            "np.linalg.norm(velocity - command, axis=-1)",
        ),
    ),
    Question(
        id="ex02.q2",
        name="labels",
        points=1,
        title="what the Feasibility-Net is taught",
        expects="the label of step t is the mean of r_v over steps t ... t + window - 1 (fewer at "
        "the end of the rollout), in which every step of a fallen robot counts as 0.",
        draw=_episode,
        # No fall, so the last labels are means over fewer steps.
        examples=((np.linspace(0.3, 1.0, 8), np.zeros(8, dtype=bool), 3),),
        truth=lambda r_v, fell, window: _labels(r_v, fell, window),
        mistakes=(
            Mistake(
                "a mean over survivors: steps after the fall are left out instead of counting 0: "
                "that hides the very places where robots fall.",
                _of_survivors,
            ),
            Mistake(
                "a fall that costs nothing: r_v goes on after the fall; a robot on its back tracks "
                "nothing.",
                lambda r_v, fell, window: _labels(r_v, fell & False, window),
            ),
            Mistake(
                "a window that looks back: feasibility predicts what comes NEXT, from here on.",
                lambda r_v, fell, window: _labels(r_v, fell, window, first=1 - window),
            ),
            Mistake(
                "a sum over the window: a label is a mean, and lies in [0, 1].",
                lambda r_v, fell, window: np.array(
                    [np.where(fell, 0, r_v)[t : t + window].sum() for t in range(len(r_v))]
                ),
            ),
            Mistake(
                "a window one step short: it ends before step t + window - 1.",
                lambda r_v, fell, window: _labels(r_v, fell, window - 1),
            ),
        ),
        hints=(
            "Make a copy of r_v with zeros where fell is True: np.where.",
            "counted[t : t + window].mean() also works at the end, where the slice is shorter.",
        ),
    ),
    Question(
        id="ex02.q3",
        name="discounted_returns",
        points=1,
        title="what a step was worth",
        expects="a reward counts gamma times less for every step that it lies ahead, and nothing "
        "is carried back over the step where done is True.",
        draw=_rewards,
        truth=_returns,
        mistakes=(
            Mistake(
                "a return that crosses a reset: after done a new episode begins, whose rewards "
                "this one did not earn.",
                lambda r, done, g: _returns(r, done & False, g),
            ),
            Mistake(
                "a discount too early: the step's own reward counts in full: only what follows is "
                "discounted.",
                lambda r, done, g: g * _returns(r, done, g),
            ),
            Mistake(
                "a forgotten discount: each later reward counts gamma times less.",
                lambda r, done, g: _returns(r, done, 1.0),
            ),
            Mistake(
                "an episode that ends one step early: the reward of the done step itself still "
                "belongs to the episode before it.",
                lambda r, done, g: _returns(r, np.append(done[1:], False), g),
            ),
            Mistake(
                "a sum of the past: returns look ahead: begin at the last step and go backwards.",
                lambda r, done, g: _returns(r[::-1], np.append(done[:-1][::-1], True), g)[::-1],
            ),
        ),
        hints=(
            "Go through the steps from the last to the first, carrying G along.",
            "Where done[t] is True, forget what you carry before adding r_t.",
        ),
    ),
    Question(
        id="ex02.q4",
        name="clipped_objective",
        points=1,
        title="PPO's objective",
        expects="a mean over the samples: no gain from moving the ratio further than epsilon from "
        "1, but every loss is felt.",
        draw=_ratios,
        truth=lambda ratio, advantage, epsilon: np.mean(
            np.where(
                advantage >= 0,
                np.minimum(ratio, 1 + epsilon) * advantage,
                np.maximum(ratio, 1 - epsilon) * advantage,
            )
        ),
        mistakes=(
            Mistake(
                "the larger of the two: the bound must be pessimistic: the smaller of the two "
                "counts.",
                lambda r, a, e: np.maximum(r * a, np.clip(r, 1 - e, 1 + e) * a).mean(),
            ),
            Mistake(
                "a forgotten clip: nothing stops one update from moving the policy far away.",
                lambda r, a, e: (r * a).mean(),
            ),
            Mistake(
                "the clipped term alone: without the min, a policy that has moved the wrong way is "
                "not called back.",
                lambda r, a, e: (np.clip(r, 1 - e, 1 + e) * a).mean(),
            ),
            Mistake(
                "a sum over the samples: the objective is a mean; it must not grow with the batch.",
                lambda r, a, e: np.minimum(r * a, np.clip(r, 1 - e, 1 + e) * a).sum(),
            ),
            Mistake(
                "a loss in place of an objective: the sign is turned: the objective is what PPO "
                "makes large.",
                lambda r, a, e: -np.minimum(r * a, np.clip(r, 1 - e, 1 + e) * a).mean(),
            ),
        ),
        hints=(
            "Compute both products for every sample, then take the smaller one.",
            "np.minimum(ratio * advantage, np.clip(...) * advantage).mean()",
        ),
    ),
    Question(
        id="ex02.q5",
        name="episode_statistics",
        points=3,
        title="a point of the learning curve",
        expects="over all episodes that ended (by a fall or a time-out), of all robots: the mean "
        "sum of rewards, the share that ended by a fall, and the mean number of steps; NaN three "
        "times if none ended.",
        draw=_runs,
        examples=((np.ones((3, 2)), np.zeros((3, 2), dtype=bool), np.zeros((3, 2), dtype=bool)),),
        truth=lambda rewards, fell, timed_out: _statistics(rewards, fell, timed_out),
        mistakes=(
            Mistake(
                "episodes that have not ended: the last one of a robot may still be going on; it "
                "would look shorter and poorer than it will be.",
                lambda r, f, t: _statistics(r, f, t, unfinished=True),
            ),
            Mistake(
                "time-outs overlooked: an episode ends by a fall or by a time-out.",
                lambda r, f, t: _statistics(r, f, t & False),
            ),
            Mistake(
                "time-outs counted as falls: a robot that was still upright when time ran out did "
                "not fall.",
                lambda r, f, t: _statistics(r, f | t, t),
            ),
            Mistake(
                "episodes that run on into the next robot: every column is a robot of its own.",
                _in_one_row,
            ),
            Mistake(
                "reward per step: the return of an episode is the SUM of its rewards.",
                _per_step,
            ),
            Mistake(
                "zeros for no episode: 0 would say that all of them earned nothing; where none "
                "ended, answer NaN.",
                lambda r, f, t: tuple(np.nan_to_num(_statistics(r, f, t))),
            ),
        ),
        hints=(
            "Two loops: over the robots, and over the steps of one robot. Carry along what the "
            "current episode has earned and how long it has lasted.",
            "At an end, write both down and start again from zero. What is still being carried "
            "after the last step belongs to an episode that has not ended.",
        ),
    ),
)
