"""The curves of a run as TensorBoard and W&B show them: from rows of its tables, with Stable-Baselines3's tags."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from csac.record.csv_tables import COLUMNS
from csac.record.statistics import is_case, mean_over_episodes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Row = Mapping[str, Any]
    Tables = Mapping[Any, Sequence[Row]]

EPISODES_AVERAGED = 100  # as Stable-Baselines3's rollout/ep_rew_mean


class Point(NamedTuple):
    """What is shown of one seed at one step, by tag."""

    seed: int
    step: int
    values: dict[str, float]


class Log(Protocol):
    """Where a run's curves go beside its tables."""

    def write(self, tables: Tables) -> Sequence[str]:
        """Take rows of each table, later ones than before; return what the user should know, a line each."""
        ...

    def flush(self) -> None:
        """Have on disk what a run counts on that goes on from now, as far as this log can say. Raises OSError."""
        ...

    def close(self) -> Sequence[str]:
        """Write what still waits and let go; return what the user should know, a line each. May be called again."""
        ...


class Scalars:
    """Turns rows of a run's tables into points, each group of rows at its own steps.

    `rollout/ep_rew_mean` and `rollout/ep_len_mean` are means over the last 100 training episodes, `eval/mean_reward`,
    `eval/mean_ep_length`, `eval/success_rate` and `eval/<event>` over one evaluation's episodes; `time/fps` is
    environment steps per second of this seed since the log was made, for a run that goes on from step `begin` since
    then. What such a run has in its tables already, `before`, counts in the means.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        begin: int = 0,
        before: Tables | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._begin = begin
        self._recent: dict[int, deque[tuple[float, int]]] = {seed: deque(maxlen=EPISODES_AVERAGED) for seed in seeds}
        self._cases: set[str] = set()  # events that happen or do not: where nobody speaks of one, it did not
        self._clock, self._began = clock, clock()
        self.points(before or {})  # they were told when they were new

    def points(self, tables: Tables) -> list[Point]:
        """Return the points of these rows, by table: `episodes`, `metrics` and `evaluations`."""
        makers = {"episodes": self._episodes, "metrics": self._metrics, "evaluations": self._evaluations}
        return [point for table, rows in tables.items() for point in makers[table](rows)]

    def _episodes(self, rows: Sequence[Row]) -> list[Point]:
        """Return one point per seed for the training episodes that ended."""
        for (seed, _), ended in _grouped(rows).items():
            self._recent[seed].extend((row["return"], row["length"]) for row in ended)
        points = []
        for seed, step in {row["seed"]: row["step"] for row in rows}.items():
            returns, lengths = np.array(self._recent[seed]).T
            means = {"rollout/ep_rew_mean": float(returns.mean()), "rollout/ep_len_mean": float(lengths.mean())}
            points.append(Point(seed, step, means))
        return points

    def _metrics(self, rows: Sequence[Row]) -> list[Point]:
        """Return each metric, and the speed."""
        elapsed, points = self._clock() - self._began, []
        for row in rows:
            values = {f"train/{name}": float(value) for name, value in row.items() if name not in ("seed", "step")}
            if elapsed > 0:
                values["time/fps"] = (row["step"] - self._begin) / elapsed
            points.append(Point(row["seed"], row["step"], values))
        return points

    def _evaluations(self, rows: Sequence[Row]) -> list[Point]:
        """Return the means over each evaluation's episodes."""
        points = []
        for (seed, step), episodes in _grouped(rows).items():
            values = {
                "eval/mean_reward": float(np.mean([row["return"] for row in episodes])),
                "eval/mean_ep_length": float(np.mean([row["length"] for row in episodes])),
            }
            for name in ("success", *(name for name in episodes[0] if name not in COLUMNS["evaluations"])):
                told = np.array([row.get(name) for row in episodes], float)
                if is_case(told):
                    self._cases.add(name)
                elif not np.isnan(told).all():
                    self._cases.discard(name)
                mean = mean_over_episodes(told, name in self._cases)
                if not np.isnan(mean):
                    values["eval/success_rate" if name == "success" else f"eval/{name}"] = mean
            points.append(Point(seed, step, values))
        return points


def _grouped(rows: Sequence[Row]) -> dict[tuple[int, int], list[Row]]:
    """Return the rows of each (seed, step)."""
    groups: dict[tuple[int, int], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["seed"], row["step"]].append(row)
    return groups
