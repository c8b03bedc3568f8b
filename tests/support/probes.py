"""Environments with known answers (after Andy Jones, "Debugging RL"), and ones that fail as told.

Each is also registered, so that `probes:ConstantReward-v0` names it wherever this folder is on the path.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Collection
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box

Result = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


class Probe(gymnasium.Env):
    """One observation and one action in [-1, 1]; one step of reward 1, then the end."""

    metadata = {"render_modes": []}  # noqa: RUF012
    observation_space = Box(-np.inf, np.inf, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self) -> None:
        self.observation = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.observation = self.first_observation()
        return self.observation, {}

    def step(self, action: np.ndarray) -> Result:
        return self.observation, self.reward(float(action[0])), True, False, {}

    def first_observation(self) -> np.ndarray:
        return np.zeros(1, np.float32)

    def reward(self, action: float) -> float:
        return 1.0


class ConstantReward(Probe):
    """Value: 1, whatever is done."""


class ObservationReward(Probe):
    """Observation -1 or 1, and that is the reward. Value: the observation."""

    def first_observation(self) -> np.ndarray:
        return self.np_random.choice(np.array([-1.0, 1.0], np.float32), 1)

    def reward(self, action: float) -> float:
        return float(self.observation[0])


class DelayedReward(Probe):
    """Two steps, observations 0 and 1, reward 1 on the second. Values: discount at 0, 1 at 1."""

    def step(self, action: np.ndarray) -> Result:
        is_last = bool(self.observation[0] == 1)
        self.observation = np.ones(1, np.float32)
        return self.observation, float(is_last), is_last, False, {}


class ActionReward(Probe):
    """Reward -(action - 0.5)². Best action: 0.5, of value 0."""

    def reward(self, action: float) -> float:
        return -((action - 0.5) ** 2)


class ObservationActionReward(ObservationReward):
    """Observation x = -1 or 1, reward -(action - x/2)². Best action: x/2, of value 0."""

    def reward(self, action: float) -> float:
        return -((action - 0.5 * float(self.observation[0])) ** 2)


class Endless(Probe):
    """Never terminates and is truncated every `length` steps. Value: reward / (1 - discount), at every step."""

    def __init__(self, length: int = 10, constant_reward: float = 1.0) -> None:
        super().__init__()
        self.length, self.constant_reward, self.steps = length, constant_reward, 0

    def first_observation(self) -> np.ndarray:
        self.steps = 0
        return np.zeros(1, np.float32)

    def step(self, action: np.ndarray) -> Result:
        self.steps += 1
        return self.observation, self.constant_reward, False, self.steps == self.length, {}


class Large(Endless):
    """Observations and actions of 4 kB each."""

    observation_space = Box(-np.inf, np.inf, (1000,), np.float32)
    action_space = Box(-1.0, 1.0, (1000,), np.float32)

    def step(self, action: np.ndarray) -> Result:
        return action, *super().step(action)[1:]

    def first_observation(self) -> np.ndarray:
        super().first_observation()
        return np.zeros(1000, np.float32)


class Failing(Endless):
    """Raises in the `at`-th `step`, `reset` or `close` of its life, in episodes reset with one of `seeds` (None: any).

    With `exits` it does as a script does that is over: it calls `sys.exit(7)`.
    """

    def __init__(
        self,
        where: Literal["step", "reset", "close"] = "step",
        at: int = 1,
        seeds: Collection[int] | None = None,
        exits: bool = False,
    ) -> None:
        super().__init__(length=3)
        self.where, self.at, self.seeds, self.exits = where, at, seeds, exits
        self.count = {"step": 0, "reset": 0, "close": 0}
        self.is_chosen = seeds is None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.is_chosen = self.seeds is None or seed in self.seeds
        self.maybe_fail("reset")
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> Result:
        self.maybe_fail("step")
        return super().step(action)

    def close(self) -> None:
        self.maybe_fail("close")

    def maybe_fail(self, where: str) -> None:
        self.count[where] += 1
        if self.is_chosen and where == self.where and self.count[where] >= self.at:
            if self.exits:
                sys.exit(7)
            raise RuntimeError("the simulator\nbroke")


class NonFinite(Endless):
    """Gives `value` as its reward or observation in the `at`-th step of an episode reset with one of `seeds`."""

    def __init__(
        self,
        where: Literal["reward", "observation"] = "reward",
        value: float = float("nan"),
        at: int = 1,
        seeds: Collection[int] | None = None,
    ) -> None:
        super().__init__()
        self.where, self.value, self.at, self.seeds = where, float(value), at, seeds
        self.is_chosen = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.is_chosen = self.seeds is None or seed in self.seeds
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> Result:
        observation, reward, terminated, truncated, info = super().step(action)
        if not self.is_chosen or self.steps < self.at:
            return observation, reward, terminated, truncated, info
        if self.where == "reward":
            return observation, self.value, terminated, truncated, info
        return np.array([self.value], np.float32), reward, terminated, truncated, info


class Unsavable(Endless):
    """Ends after 40 steps, and has a `get_snapshot` that raises, exits or gives what no file or nobody takes."""

    def __init__(self, gives: Literal["error", "exit", "nothing", "objects", "values", "one way"] = "error") -> None:
        super().__init__(length=40)
        self.gives = gives

    def get_snapshot(self) -> Any:
        if self.gives == "error":
            raise KeyError("position")
        if self.gives == "exit":
            sys.exit(7)
        arrays = {"bodies": np.array([object()])} if self.gives == "objects" else {}
        return None if self.gives == "nothing" else (arrays, {"process": os} if self.gives == "values" else {})


class Cases(Endless):
    """Ends after three steps and says in `info` how: drawn from the reset seed, in one dict that it gives every time.

    `crashed` is a NumPy boolean, `stops` a count up to 4, `phase` no number. With `tell` the process is told as well.
    """

    def __init__(self, tell: bool = False) -> None:
        super().__init__(length=3)
        self.tell, self.info = tell, {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        observation, _ = super().reset(seed=seed, options=options)
        self.info = {"crashed": np.bool_(False), "stops": 0, "phase": "flying", "is_success": False}
        if self.tell:
            self.info |= {"process": os.getpid(), "has_jax": "jax" in sys.modules}
        return observation, self.info

    def step(self, action: np.ndarray) -> Result:
        observation, reward, terminated, truncated, _ = super().step(action)
        if truncated:
            self.info["crashed"] = np.bool_(self.np_random.random() < 0.5)
            self.info["stops"] = int(self.np_random.integers(5))
            self.info["is_success"] = not self.info["crashed"]
        return observation, reward, terminated, truncated, self.info


class Picky(Endless):
    """Raises where an action is above `most` in an episode reset with one of `seeds`."""

    def __init__(self, most: float = 0.0, seeds: Collection[int] = ()) -> None:
        super().__init__(length=3)
        self.most, self.seeds, self.is_chosen = most, seeds, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.is_chosen = seed in self.seeds
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> Result:
        if self.is_chosen and action[0] > self.most:
            raise RuntimeError("too much")
        return super().step(action)


class Deadly(Endless):
    """Kills its process in an episode reset with `seed`; with `spare_first`, all processes but Python's first."""

    def __init__(self, seed: int = 0, spare_first: bool = False) -> None:
        super().__init__(length=3)
        self.seed = None if spare_first and multiprocessing.parent_process() is None else seed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        if self.seed is not None and seed == self.seed:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed, options=options)


class IdEncoded(gymnasium.Env):
    """Says in each observation where it comes from: [reset seed mod 65536, episode of its life, step, last action].

    The reward is the step. Episode e has 2 + e % 3 steps and is terminated, truncated or both, in turn.
    """

    observation_space = Box(-np.inf, np.inf, (4,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self) -> None:
        self.instance, self.episode, self.steps = 0, -1, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.instance = (seed or 0) % 65536
        self.episode, self.steps = self.episode + 1, 0
        return self.observe(0.0), {}

    def step(self, action: np.ndarray) -> Result:
        self.steps += 1
        is_last = self.steps == 2 + self.episode % 3
        terminated, truncated = is_last and self.episode % 3 != 1, is_last and self.episode % 3 != 0
        return self.observe(float(action[0])), float(self.steps), terminated, truncated, {}

    def observe(self, action: float) -> np.ndarray:
        return np.array([self.instance, self.episode, self.steps, action], np.float32)


for name in (
    "ConstantReward",
    "ObservationReward",
    "DelayedReward",
    "ActionReward",
    "ObservationActionReward",
    "Endless",
    "Failing",
    "NonFinite",
    "Unsavable",
    "Cases",
    "Picky",
    "Deadly",
    "IdEncoded",
):
    if f"{name}-v0" not in gymnasium.registry:
        gymnasium.register(f"{name}-v0", entry_point=f"{__name__}:{name}")
