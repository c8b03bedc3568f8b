"""Evaluation in processes: the numbers of one, whatever fails or dies."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import probes
import psutil
import pytest
from gymnasium.envs.registration import EnvSpec
from helped import Forking, Helped, end_forks, ends_of
from played import policy_for, run_of_task
from policies import contract, random_policy

from csac.evaluation.evaluator import EPISODES_AT_ONCE, EvaluationFailure, Evaluator
from csac.evaluation.play import evaluate_run
from csac.evaluation.pool import EvaluationPool, EvaluationStopped, choose_processes
from csac.seeds import EVALUATION_SEED
from csac.types import InputError

SUPPORT = Path(__file__).parents[1] / "support"
POLICY = random_policy(contract(parts=((None, (1,)),)))
TWO_BATCHES = EPISODES_AT_ONCE + 1


@pytest.fixture(autouse=True)
def _probes_are_found(monkeypatch):
    monkeypatch.syspath_prepend(SUPPORT)  # by spawned processes as well, which are given the path
    monkeypatch.setenv("PYTHONPATH", str(SUPPORT))


@pytest.fixture
def pool_of():
    """What makes pools, each of two processes, and closes them."""
    pools: list[EvaluationPool] = []

    def make(*arguments, **options) -> EvaluationPool:
        pools.append(EvaluationPool(Evaluator(*arguments, **options), processes=2))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close()


def test_the_numbers_do_not_depend_on_the_processes(pool_of):
    deterministic = False
    policies = [policy_for("Hopper-v4", width=256, seed=seed) for seed in (0, 1)]
    counts = [[], []]
    alone = Evaluator("Hopper-v4", episodes=TWO_BATCHES)
    expected = alone.begin(policies, deterministic, lambda *count: counts[0].append(count)).results()
    pool = pool_of("Hopper-v4", episodes=TWO_BATCHES)
    pending = pool.begin(policies, deterministic, lambda *count: counts[1].append(count))
    while not pending.is_over:
        time.sleep(0.05)
    assert pending.results() == expected == [alone.run(policy, deterministic) for policy in policies]
    assert pool.begin(policies[1:], deterministic).results() == expected[1:]
    assert pending.notes == []
    for told in counts:
        assert told == sorted(told)
        assert told[-1] == (2 * TWO_BATCHES, 2 * TWO_BATCHES)


def test_perturbed_episodes_do_not_depend_on_the_processes_either(tmp_path):
    run_of_task(tmp_path / "run", "Hopper-v4")
    options = {"episodes": TWO_BATCHES, "perturbations": "gravity=0.5"}
    perturbed = [dict(evaluate_run(tmp_path / "run", processes=processes, **options)) for processes in (1, 2)]
    assert perturbed[0] == perturbed[1]
    assert perturbed[0] != dict(evaluate_run(tmp_path / "run", episodes=TWO_BATCHES, processes=1))


def test_workers_are_several_and_stay_and_import_no_jax(pool_of):
    pool = pool_of("probes:Cases-v0", {"tell": True}, 4 * EPISODES_AT_ONCE, events=("process", "has_jax"))
    processes = []
    for _ in range(2):
        (episodes,) = pool.begin([policy_for("probes:Cases-v0")]).results()
        assert {episode.events["has_jax"] for episode in episodes} == {False}
        processes.append({episode.events["process"] for episode in episodes})
    assert processes[0] == processes[1]
    assert os.getpid() not in processes[0]
    assert len(processes[0]) == 2


def begun(how: str, *arguments, **options):
    evaluator = Evaluator(*arguments, **options)
    return evaluator if how == "alone" else EvaluationPool(evaluator, processes=2)


@pytest.mark.parametrize("how", ["alone", "pool"])
def test_a_policy_that_fails_does_so_in_its_place(how):
    arguments = {"most": 0.5, "seeds": [EVALUATION_SEED + 2, EVALUATION_SEED + EPISODES_AT_ONCE]}
    evaluating = begun(how, "probes:Picky-v0", arguments, TWO_BATCHES)
    calm, wild, other = (random_policy(contract(parts=((None, (1,)),), low=-most, high=most)) for most in (0.1, 1, 9))
    wild.network.parameters.actors[0][-1].bias[0] = 9.0
    results = evaluating.begin([calm, wild, other, calm]).results()
    evaluating.close()
    assert results[0] == results[3]
    assert isinstance(results[0], list)
    assert len(results[0]) == TWO_BATCHES
    assert [isinstance(result, EvaluationFailure) for result in results] == [False, True, True, False]
    assert "evaluation episode 2, reset with seed 1000002, at step 0: step raised RuntimeError" in str(results[1])
    assert "action[0]" in str(results[2])  # beyond the task's bounds


def test_what_another_process_cannot_make_is_run_here(pool_of, monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "Here-v0", EnvSpec("Here-v0", lambda **_: probes.Endless()))
    pending = pool_of("Here-v0", {}, TWO_BATCHES).begin([POLICY])
    assert pending.results() == [Evaluator("Here-v0", {}, TWO_BATCHES).run(POLICY)]
    assert len(pending.notes) == 2
    assert all("Here-v0" in note for note in pending.notes)


def test_what_a_dying_process_takes_along_is_made_here(pool_of):
    arguments = {"seed": EVALUATION_SEED + EPISODES_AT_ONCE, "spare_first": True}
    pool = pool_of("probes:Deadly-v0", arguments, TWO_BATCHES)
    expected = Evaluator("probes:Deadly-v0", arguments, TWO_BATCHES).run(POLICY)
    for _ in range(2):  # another process takes its place
        pending = pool.begin([POLICY, POLICY])
        assert pending.results() == [expected, expected]
        assert len(pending.notes) == 2
        assert all("its process was killed by SIGKILL" in note for note in pending.notes)


def test_what_holds_a_dead_process_s_pipe_open_keeps_nobody_waiting(tmp_path, pool_of):
    (episodes,) = pool_of(Forking, {"folder": str(tmp_path)}, TWO_BATCHES).begin([POLICY]).results()
    assert (len(episodes), end_forks(tmp_path)) == (TWO_BATCHES, 2)


@pytest.mark.parametrize("how", ["alone", "pool"])
def test_an_evaluation_is_stopped_between_steps(how):
    evaluating = begun(how, probes.Endless, {"length": 10**9}, 1)
    asked = []

    def should_stop() -> bool:
        asked.append(True)
        return len(asked) == 2

    with pytest.raises(EvaluationStopped):
        evaluating.begin([POLICY]).results(should_stop)
    evaluating.close()
    assert len(asked) == 2


def test_processes_are_chosen_by_the_work_and_at_least_one_is_asked_for(monkeypatch):
    monkeypatch.setattr("csac.processes.usable_cores", lambda: [0, 1, 2])
    assert choose_processes(Evaluator("probes:Cases-v0", episodes=EPISODES_AT_ONCE), 1) == 1
    for quota, most in ((None, 3), (2, 2)):
        monkeypatch.setattr("csac.processes.core_quota", lambda quota=quota: quota)
        assert choose_processes(Evaluator("probes:Cases-v0", episodes=1000), 5) == most
    with pytest.raises(InputError, match="processes must be a whole number of 1 or more, not 0"):
        EvaluationPool(Evaluator("probes:Cases-v0"), processes=0)


def test_a_task_may_have_processes_and_ends_them_when_the_pool_is_closed(tmp_path, pool_of):
    """A daemon may start none; and killed with its environments open, it left their simulators behind."""
    pool = pool_of(Helped, {"folder": str(tmp_path)}, TWO_BATCHES)
    (episodes,) = pool.begin([POLICY]).results()
    workers = list(pool._workers)
    pool.close()
    assert [episode.episode_return for episode in episodes] == [1.0] * TWO_BATCHES
    assert [worker.process.exitcode for worker in workers] == [0, 0]
    assert ends_of(tmp_path) == (2, {"-15 -15"})


@pytest.mark.slow
def test_control_c_ends_an_evaluation_and_its_processes(tmp_path):
    run_of_task(tmp_path / "run", "probes:Endless-v0", arguments={"length": 10**9})
    line = f"evaluate {tmp_path / 'run'} --episodes 40 --processes 2 --trust-task"
    process = subprocess.Popen(
        [sys.executable, "-m", "csac", *shlex.split(line)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    workers: list[psutil.Process] = []
    while len(workers) < 2 and process.poll() is None:
        children = psutil.Process(process.pid).children()
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    output = process.communicate()
    assert (process.returncode, output) == (130, (b"", b""))
    assert not any(worker.is_running() for worker in workers)
