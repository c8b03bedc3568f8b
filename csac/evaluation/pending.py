"""An evaluation that was begun and whose results are asked for later: the same for one process and for several."""

from __future__ import annotations

from typing import TYPE_CHECKING

from csac.evaluation.episode import EvaluationEpisode, EvaluationFailure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.deploy.policy import Policy
    from csac.evaluation.evaluator import Evaluator

    # A policy, the number of a batch's first episode, whether deterministic, how the task is perturbed.
    Work = tuple[Policy, int, bool, dict[str, float]]
    OnProgress = Callable[[int, int], None]  # episodes done, episodes in all

Batch = tuple[int, int]  # which policy, number of the first episode
Result = list[EvaluationEpisode] | EvaluationFailure


class EvaluationStopped(Exception):
    """An evaluation ended early, since `should_stop` said so."""


class Pending:
    """An evaluation of several policies that was begun; this one runs when its results are asked for.

    `notes` are lines on what happened to it that changes none of its numbers.
    """

    def __init__(
        self, evaluator: Evaluator, policies: Sequence[Policy], deterministic: bool, on_progress: OnProgress | None
    ) -> None:
        self.notes: list[str] = []
        self._evaluator, self._policies, self._deterministic = evaluator, policies, deterministic
        self._perturbed, self._on_progress = dict(evaluator.perturbed), on_progress
        self._answers: dict[Batch, Result] = {}

    @property
    def is_over(self) -> bool:
        """Whether the results need not be waited for. Does not wait."""
        return True

    def results(self, should_stop: Callable[[], bool] | None = None) -> list[Result]:
        """Return each policy's episodes in order, or its first failure, which does not end the others. Waits.

        Raises:
            EvaluationStopped: `should_stop` said so; it is asked before each step.
        """
        for batch in self._evaluator.batches(len(self._policies)):
            if batch not in self._answers and not self._is_spared(batch):
                self._take(batch, self._evaluator.answer(*self._work(batch), should_stop))
        return [self._result(index) for index in range(len(self._policies))]

    def _take(self, batch: Batch, answer: Result) -> None:
        self._answers[batch] = answer
        if self._on_progress:
            done = sum(len(given) for given in self._answers.values() if isinstance(given, list))
            self._on_progress(done, len(self._policies) * self._evaluator.episodes)

    def _work(self, batch: Batch) -> Work:
        index, first = batch
        return self._policies[index], first, self._deterministic, self._perturbed

    def _is_spared(self, batch: Batch) -> bool:
        """Whether an earlier batch of the same policy has failed."""
        failed = (other for other, answer in self._answers.items() if isinstance(answer, EvaluationFailure))
        return any(other[0] == batch[0] and other < batch for other in failed)

    def _result(self, index: int) -> Result:
        episodes = []
        for batch in sorted(batch for batch in self._answers if batch[0] == index):
            answer = self._answers[batch]
            if isinstance(answer, EvaluationFailure):
                return answer
            episodes += answer
        return episodes
