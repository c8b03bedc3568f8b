"""What a task may do in a process that evaluates: all that it may do in the one that trains."""

from __future__ import annotations

import os

import pytest
from helped import Helped, ends_of
from policies import contract, random_policy

from csac.evaluation.evaluator import EPISODES_AT_ONCE, Evaluator
from csac.evaluation.pool import EvaluationPool

POLICY = random_policy(contract(parts=((None, (1,)),)))


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_a_task_may_have_processes_and_ends_them_when_the_pool_is_closed(tmp_path):
    """A daemon may start none; and killed with its environments open, it left their simulators behind."""
    pool = EvaluationPool(Evaluator(Helped, {"folder": str(tmp_path)}, EPISODES_AT_ONCE + 1), processes=2)
    try:
        episodes = pool.run(POLICY)
    finally:
        workers = list(pool._workers)
        pool.close()
    assert [episode.episode_return for episode in episodes] == [1.0] * (EPISODES_AT_ONCE + 1)
    assert [worker.process.exitcode for worker in workers] == [0, 0]
    assert ends_of(tmp_path) == (2, {"-15 -15"})
