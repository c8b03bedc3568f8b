"""The training loop itself, run in this process, with what the seeds learnt at hand."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest.mock import patch

from plans import settings

from csac.training import group, messages

if TYPE_CHECKING:
    import numpy as np

    from csac.types import Algorithm


class Outcome(NamedTuple):
    """`states` and `memories` hold one entry per seed; `messages` is everything that the loop yielded."""

    states: list[Any]
    memories: list[np.ndarray]  # [steps, width] packed transitions, in the order of the steps
    messages: list[messages.GroupMessage]


def run(
    algorithm: Algorithm, task: Any, steps: int, seeds: tuple[int, ...] = (0,), episodes: int = 1, **arguments: Any
) -> Outcome:
    """Train `seeds` together, evaluating at the end alone, and return what there is to look at."""
    learners: list[group.Learner] = []

    class Kept(group.Learner):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            learners.append(self)

    given = settings(algorithm, task, steps, environment_arguments=arguments, evaluation_episodes=episodes)
    with patch.object(group, "Learner", Kept), closing(group.Group(given, seeds)) as made:
        told = list(made.run(lambda: False))
    carries = [learners[0].carry(index) for index in range(len(seeds))]
    return Outcome([carry.state for carry in carries], [carry.memory.rows for carry in carries], told)
