"""Tells callbacks what happens to the runs of a loop, and records the scalars that they answer with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from csac.training.callbacks import Answer, Event, Moment

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from csac.deploy.policy import Policy
    from csac.record.recorder import Recorder
    from csac.record.run import RunDirectory
    from csac.tasks.vector import FinishedEpisode
    from csac.training.callbacks import Hears


class Notifier:
    """Tells the callbacks what happens in the loop.

    `call` tells them and returns their answer; `policy` returns the policy of a seed as it is now.
    """

    def __init__(
        self,
        hears: Hears,
        call: Callable[[Event], Answer],
        runs: Sequence[RunDirectory],
        recorders: Sequence[Recorder],
        metrics: tuple[str, ...],
        policy: Callable[[int], Policy],
    ) -> None:
        self._hears, self._call, self._runs, self._recorders = hears, call, runs, recorders
        self._metrics, self._policy = metrics, policy
        self.stopped_by = ""  # what ended the runs

    def after_step(self, step: int, stride: int, alive: np.ndarray, episodes: Sequence[FinishedEpisode]) -> bool:
        """Tell of the last `stride` steps and of the episodes that ended; return whether to stop."""
        if episodes and self._hears.episodes:
            told = [episode.seed_index for episode in episodes]
            self._tell("on_episode", step, told, [(episode,) for episode in episodes])
        due = tuple(interval for interval in self._hears.intervals if step % interval < stride)
        if due:
            indices = np.flatnonzero(alive).tolist()
            self._tell("on_step", step, indices, [()] * len(indices), due)
        return bool(self.stopped_by)

    def evaluated(self, step: int, results: Mapping[int, tuple[Policy, Any]]) -> bool:
        """Tell of an evaluation, by seed index the policy and its episodes; return whether to stop."""
        if results and self._hears.evaluations:
            policies = {index: policy for index, (policy, _) in results.items()}
            self._tell("on_evaluation", step, [*results], [(e,) for _, e in results.values()], policies=policies)
        return bool(self.stopped_by)

    def _tell(
        self,
        method: str,
        step: int,
        indices: Sequence[int],
        arguments: list[tuple[Any, ...]],
        intervals: tuple[int, ...] = (),
        policies: Mapping[int, Policy] | None = None,
    ) -> None:
        policy_of = policies.__getitem__ if policies else self._policy
        moments = [
            Moment(
                self._runs[index].seed,
                step,
                self._runs[index].path,
                policy_of(index) if self._hears.policies else None,
                metrics=self._metrics,
            )
            for index in indices
        ]
        answer = self._call(Event(method, moments, arguments, intervals))
        for index, scalars in zip(indices, answer.scalars, strict=False):
            if scalars:
                self._recorders[index].add("metrics", [{"seed": self._runs[index].seed, "step": step, **scalars}])
        if answer.stopped_by and not self.stopped_by:
            self.stopped_by = answer.stopped_by
            for run in self._runs:
                run.log(f"stopped early at step {step:,} ({answer.stopped_by})")
