"""Callbacks: the caller's own code, called on training events. It may log scalars and end training.

They run in the process that called `train`, one at a time, even if seeds train in separate processes: a callback may be
a closure, keeps its state, and sees every seed. Training waits for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from csac.checks import check_callable, check_whole
from csac.evaluation.episode import EvaluationEpisode
from csac.record.config import NEVER
from csac.record.run import RunDirectory
from csac.tasks.failures import raised
from csac.tasks.registry import is_column
from csac.types import Failure, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from csac.deploy.policy import Policy
    from csac.record.recorder import Recorder
    from csac.tasks.vector import FinishedEpisode


class CallbackFailure(Failure):
    """A callback raised. The runs were saved as on Ctrl-C. The message is one line; `__cause__` is the exception."""


@dataclass
class Moment:
    """The state of a run when a callback is called."""

    seed: int
    step: int
    """Environment steps that the seed has made."""
    directory: Path
    """The run's directory."""
    policy: Policy | None = None
    """The current policy, if a callback has `needs_policy`."""
    scalars: dict[str, float] = field(default_factory=dict)
    """The scalars logged so far."""
    metrics: tuple[str, ...] = ()
    """The algorithm's metrics, whose names cannot be logged."""

    @property
    def run(self) -> RunDirectory:
        """The run. Its tables hold the rows written so far; its evaluations are complete."""
        return RunDirectory.open(self.directory)

    def log(self, name: str, value: float) -> None:
        """Log a scalar to a column of metrics.csv, and to TensorBoard and W&B as `train/NAME` (NAME if it has a slash).

        Raises:
            InputError: the name is not a plain word, or is already a column.
        """
        if not is_column(name) or name in self.metrics:
            raise InputError(f"{name!r} cannot name a scalar: it is not a plain word, or is already a column")
        self.scalars[name] = float(value)


class Callback:
    """Base class of callbacks. Override the methods you need; one that returns False ends the run, as finished.

    Seeds that share a program (`seeds_per_process`) end together.
    """

    interval: int = 1_000
    """Environment steps of a seed between two calls of `on_step`."""
    needs_policy: bool = False
    """Whether moments hold the policy, which is copied for each one."""

    def on_step(self, moment: Moment) -> bool | None:
        """Handle `interval` further steps, after their updates."""

    def on_episode(self, moment: Moment, episode: FinishedEpisode) -> bool | None:
        """Handle a finished training episode: its `episode_return`, `length` and `events`."""

    def on_evaluation(self, moment: Moment, episodes: Sequence[EvaluationEpisode]) -> bool | None:
        """Handle an evaluation of the policy of step `moment.step`."""


class StopOnReturn(Callback):
    """Ends a run once the mean return of an evaluation is at least `threshold`."""

    def __init__(self, threshold: float) -> None:
        self.threshold = float(threshold)

    def on_evaluation(self, moment: Moment, episodes: Sequence[EvaluationEpisode]) -> bool:
        """Compare the mean with the threshold."""
        return mean_return(episodes) < self.threshold


class StopAfterNoImprovement(Callback):
    """Ends a run after a number of evaluations in a row without a new best mean return, counted across resumes.

    Args:
        evaluations: the number of evaluations.
        after: the step before which no run ends.
    """

    def __init__(self, evaluations: int, after: int = 0) -> None:
        check_whole("evaluations", evaluations, 1, NEVER)
        self.evaluations, self.after = evaluations, after

    def on_evaluation(self, moment: Moment, episodes: Sequence[EvaluationEpisode]) -> bool:
        """Count the evaluations since the best one."""
        rows = moment.run.evaluations
        steps = np.unique(rows["step"][rows["step"] <= moment.step])
        means = [rows["return"][rows["step"] == step].mean() for step in steps]
        return moment.step < self.after or len(means) - 1 - int(np.argmax(means)) < self.evaluations


class SaveEvery(Callback):
    """Saves the policy every `steps` steps, as `policies/step_<n>` in the run's directory; `csac.load` reads it."""

    needs_policy = True

    def __init__(self, steps: int) -> None:
        self.interval = steps

    def on_step(self, moment: Moment) -> None:
        """Save the policy."""
        assert moment.policy
        moment.policy.save(moment.directory / "policies" / f"step_{moment.step}")


def mean_return(episodes: Iterable[EvaluationEpisode]) -> float:
    """Return the mean return of episodes."""
    return float(np.mean([episode.episode_return for episode in episodes]))


class Interests(NamedTuple):
    """The events that callbacks handle."""

    intervals: tuple[int, ...] = ()
    episodes: bool = False
    evaluations: bool = False
    policies: bool = False


class Event(NamedTuple):
    """A training event to pass to callbacks, with one moment for each seed of a program that it concerns."""

    method: str
    """The method of `Callback` to call."""
    moments: list[Moment]
    arguments: list[tuple[Any, ...]]
    """The method's further arguments, for each moment."""
    intervals: tuple[int, ...] = ()
    """The intervals of `on_step` that have passed."""


class Answer(NamedTuple):
    """The callbacks' answer to an event: what ends the runs, or an empty string, and the scalars of each moment."""

    stopped_by: str = ""
    scalars: tuple[dict[str, float], ...] = ()
    failed: bool = False
    """Whether a callback has raised, in this event or before."""


STOPPED = Answer("a stop of all runs")


class Callbacks:
    """A caller's callbacks, and its functions `on_evaluation` and `stop_when`. After one raises, none is called.

    Raises:
        InputError: an argument is not a callback.
    """

    def __init__(
        self,
        callbacks: Iterable[Callback] = (),
        on_evaluation: Callable[[int, dict[int, float]], Any] | None = None,
        stop_when: Callable[[int, dict[int, float]], Any] | None = None,
    ) -> None:
        check_callable("on_evaluation", on_evaluation)
        check_callable("stop_when", stop_when)
        if isinstance(callbacks, Callback) or not isinstance(callbacks, list | tuple):
            raise InputError(f"callbacks are a list such as [StopOnReturn(3_000)], not {callbacks!r:.40}")
        self.callbacks = tuple(callbacks)
        for callback in self.callbacks:
            if not isinstance(callback, Callback):
                raise InputError(f"{callback!r:.60} is no callback: derive its class from csac.Callback, and call it")
            check_whole(f"{type(callback).__name__}.interval", callback.interval, 1, NEVER)
        self.on_evaluation, self.stop_when = on_evaluation, stop_when
        self.failure: CallbackFailure | None = None

    @property
    def interests(self) -> Interests:
        """The events that they handle."""

        def overriding(method: str) -> list[Callback]:
            return [one for one in self.callbacks if getattr(type(one), method) is not getattr(Callback, method)]

        has_function = self.on_evaluation is not None or self.stop_when is not None
        return Interests(
            tuple(sorted({callback.interval for callback in overriding("on_step")})),
            bool(overriding("on_episode")),
            bool(overriding("on_evaluation")) or has_function,
            any(callback.needs_policy for callback in self.callbacks),
        )

    def call(self, event: Event) -> Answer:
        """Pass an event to all of them, and return their answer."""
        stopped_by: list[str] = []
        pairs = list(zip(event.moments, event.arguments, strict=True))
        for callback in self.callbacks:
            if event.method == "on_step" and callback.interval not in event.intervals:
                continue
            name = f"{type(callback).__name__}.{event.method}"
            method = getattr(callback, event.method)
            answers = [self._guarded(name, _truth, method, moment, *arguments) for moment, arguments in pairs]
            stopped_by += [type(callback).__name__ for answer in answers if not (answer is None or answer)]
        if event.method == "on_evaluation":
            returns = {moment.seed: mean_return(episodes) for moment, (episodes,) in pairs}
            step = event.moments[0].step
            self._guarded("on_evaluation", self.on_evaluation, step, dict(returns))
            if self.stop_when and self._guarded("stop_when", _truth, self.stop_when, step, dict(returns)):
                stopped_by.append("stop_when")
        stopper = str(self.failure) if self.failure else next(iter(stopped_by), "")
        return Answer(stopper, tuple(moment.scalars for moment in event.moments), self.failure is not None)

    def would_stop_again(self, run: RunDirectory) -> bool:
        """Return whether the callbacks would end a run at its last evaluation, as they did before."""
        if not self.interests.evaluations or not len(run.evaluations):
            return False
        rows, names = run.evaluations, run.evaluations.dtype.names or ()
        episodes = [
            EvaluationEpisode(*row[2:6], events=dict(zip(names[6:], row[6:], strict=True)))  # in `row`'s order
            for row in rows[rows["step"] == rows["step"][-1]].tolist()
        ]
        callbacks = Callbacks([c for c in self.callbacks if not c.needs_policy], None, self.stop_when)
        moment = Moment(run.seed, int(rows["step"][-1]), run.path)
        answer = callbacks.call(Event("on_evaluation", [moment], [(episodes,)]))
        return bool(answer.stopped_by) and not answer.failed

    def _guarded(self, name: str, function: Callable[..., Any] | None, *arguments: Any) -> Any:
        """Return what a caller's function returns, or None if it raises or another has raised before."""
        if function is None or self.failure:
            return None
        try:
            return function(*arguments)
        except (Exception, SystemExit) as error:
            self.failure = CallbackFailure(f"{name} raised {raised(error)}")
            self.failure.__cause__ = error
            return None


def _truth(function: Callable[..., Any], *arguments: Any) -> bool | None:
    answer = function(*arguments)
    return None if answer is None else bool(answer)


class Notifier:
    """Passes a loop's events to the callbacks, and records the scalars that they log.

    `call` passes an event and returns their answer; `policy` returns the current policy of a seed.
    """

    def __init__(
        self,
        interests: Interests,
        call: Callable[[Event], Answer],
        runs: Sequence[RunDirectory],
        recorders: Sequence[Recorder],
        metrics: tuple[str, ...],
        policy: Callable[[int], Policy],
    ) -> None:
        self._interests, self._call, self._runs, self._recorders = interests, call, runs, recorders
        self._metrics, self._policy = metrics, policy
        self.stopped_by = ""  # what ended the runs

    def after_step(self, step: int, stride: int, alive: np.ndarray, episodes: Sequence[FinishedEpisode]) -> bool:
        """Report the last `stride` steps and the episodes that ended; return whether to stop."""
        if episodes and self._interests.episodes:
            indices = [episode.seed_index for episode in episodes]
            self._notify("on_episode", step, indices, [(episode,) for episode in episodes])
        due = tuple(interval for interval in self._interests.intervals if step % interval < stride)
        if due and alive.any():
            indices = np.flatnonzero(alive).tolist()
            self._notify("on_step", step, indices, [()] * len(indices), due)
        return bool(self.stopped_by)

    def evaluated(self, step: int, results: Mapping[int, tuple[Policy, Any]]) -> bool:
        """Report an evaluation: each seed's policy and episodes, by seed index; return whether to stop."""
        if results and self._interests.evaluations:
            policies = {index: policy for index, (policy, _) in results.items()}
            self._notify("on_evaluation", step, [*results], [(e,) for _, e in results.values()], policies=policies)
        return bool(self.stopped_by)

    def _notify(
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
                policy_of(index) if self._interests.policies else None,
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
