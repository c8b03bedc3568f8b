"""TensorBoard files of a run: one sub-directory per seed, with Stable-Baselines3's tag names."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from typing import TYPE_CHECKING, Any

import numpy as np
from tensorboardX import SummaryWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    Row = Mapping[str, Any]

FLUSH_SECONDS = 30
EPISODES_AVERAGED = 100  # as Stable-Baselines3's rollout/ep_rew_mean


class TensorBoardLog:
    """Writes the rows of a run's tables to `path/seed_<k>` as well, each group of rows at its own steps.

    `rollout/ep_rew_mean` and `rollout/ep_len_mean` are means over the last 100 training episodes, `eval/mean_reward`,
    `eval/mean_ep_length` and `eval/success_rate` over one evaluation's episodes; `time/fps` is environment steps per
    second of this seed since the log was made, for a run that goes on from step `begin` since then.
    """

    def __init__(
        self, path: Path, seeds: Sequence[int], begin: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        purge = begin + 1 if begin else None  # what a run wrote after the step that it goes on from
        self._writers = {
            seed: SummaryWriter(str(path / f"seed_{seed}"), flush_secs=FLUSH_SECONDS, purge_step=purge)
            for seed in seeds
        }
        self._begin = begin
        self._recent: dict[int, deque[tuple[float, int]]] = {seed: deque(maxlen=EPISODES_AVERAGED) for seed in seeds}
        self._clock, self._began = clock, clock()

    def episodes(self, rows: Sequence[Row]) -> None:
        """Write one point per seed for the training episodes that ended, rows of episodes.csv."""
        for (seed, _), ended in _grouped(rows).items():
            self._recent[seed].extend((row["return"], row["length"]) for row in ended)
        for seed, step in {row["seed"]: row["step"] for row in rows}.items():
            returns, lengths = np.array(self._recent[seed]).T
            self._write(seed, step, {"rollout/ep_rew_mean": returns.mean(), "rollout/ep_len_mean": lengths.mean()})

    def metrics(self, rows: Sequence[Row]) -> None:
        """Write each metric of rows of metrics.csv, and the speed."""
        elapsed = self._clock() - self._began
        for row in rows:
            values = {f"train/{name}": value for name, value in row.items() if name not in ("seed", "step")}
            if elapsed > 0:
                values["time/fps"] = (row["step"] - self._begin) / elapsed
            self._write(row["seed"], row["step"], values)

    def evaluations(self, rows: Sequence[Row]) -> None:
        """Write the means over each evaluation's episodes, rows of evaluations.csv."""
        for (seed, step), episodes in _grouped(rows).items():
            values = {
                "eval/mean_reward": np.mean([row["return"] for row in episodes]),
                "eval/mean_ep_length": np.mean([row["length"] for row in episodes]),
            }
            successes = [row["success"] for row in episodes if row.get("success") is not None]
            if successes:
                values["eval/success_rate"] = np.mean(successes)
            self._write(seed, step, values)

    def close(self) -> None:
        """Write what still waits and close the files. May be called again."""
        for writer in self._writers.values():
            writer.close()

    def _write(self, seed: int, step: int, values: Mapping[str, Any]) -> None:
        for tag, value in values.items():
            self._writers[seed].add_scalar(tag, float(value), step)


def _grouped(rows: Sequence[Row]) -> dict[tuple[int, int], list[Row]]:
    """Return the rows of each (seed, step)."""
    groups: dict[tuple[int, int], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["seed"], row["step"]].append(row)
    return groups
