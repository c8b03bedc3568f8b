"""`train`: a set of runs, one seed each, in processes of their own or together; how each fails alone."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import random
import signal
import sys
import types
import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from probes import Probe
from resuming import LEARNERS, SMALL, contents, run

import csac
from csac import InputError
from csac.algorithms import SAC
from csac.processes import cores_to_use
from csac.record.sets import RunSet
from csac.seeds import training_seed
from csac.training.checkpoint import steps_in
from csac.training.program import Program, can_be_sent, choose_groups, programs_of


class Falling(Probe):
    """Raises at its 60th step, but for evaluations."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 60:
            raise RuntimeError("the arm fell off")
        return super().step(action)


class DeadlyToClose(Probe):
    """Kills a process of several that closes it."""

    def close(self):
        if multiprocessing.parent_process():
            os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def apart(tmp_path_factory):
    """Two seeds, each in a process of its own."""
    return run(tmp_path_factory.mktemp("apart") / "set", steps=300, seeds=2, first_seed=3)


def test_a_set_has_a_whole_run_for_each_seed(apart):
    runs = apart
    assert runs.seeds == [3, 4]
    assert sorted(path.name for path in runs.path.iterdir()) == ["curve.png", "seed-3", "seed-4"]
    for one in runs.runs:
        assert {path.name for path in one.path.iterdir()} >= {
            "manifest.json",
            "evaluations.csv",
            "policy",
            "checkpoint",
        }
        assert json.loads((one.path / "manifest.json").read_text())["config"]["seed"] == one.seed
        assert one.manifest.state == "finished"
        assert set(one.evaluations["seed"]) == {one.seed}
    assert len(runs.evaluations) == 2 * 3 * 2
    assert csac.load(runs, seed=4).predict(np.zeros(11, np.float32))[0].shape == (3,)


def test_seeds_in_one_program_equal_seeds_in_processes(tmp_path, apart):
    together = run(tmp_path / "together", steps=300, seeds=2, first_seed=3, seeds_per_process=2)
    assert together.runs[0].manifest.program == (3, 4)
    for one, other in zip(together.runs, apart.runs, strict=True):
        for table in ("evaluations", "episodes", "metrics"):
            ours, theirs = one.rows(table), other.rows(table)
            for name in ours.dtype.names or ():
                np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-3, atol=1e-4)
    assert not np.allclose(apart.runs[0].evaluations["return"], apart.runs[1].evaluations["return"])


def test_evaluating_beside_training_gives_the_same_files(tmp_path):
    beside = run(tmp_path / "beside", steps=300, evaluation_processes=1)
    between = run(tmp_path / "between", steps=300, evaluation_processes=0)
    assert contents(beside.runs[0]) == contents(between.runs[0])


def test_a_failed_seed_keeps_its_checkpoint_and_is_resumed_alone(tmp_path):
    made = []

    def task():
        made.append(0)
        return Falling() if len(made) == 2 else Probe()  # the first one made for training: seed 0's

    given: dict[str, Any] = {"task": task, "checkpoint_interval": 40, "steps": 200}
    with pytest.warns(RuntimeWarning, match="seed 0 failed"):
        runs = run(tmp_path / "set", **given, seeds=3, seeds_per_process=3)
    assert [steps_in(one.checkpoints)[-1] for one in runs.runs] == [40, 200, 200]
    assert list(runs.failures) == [0]
    assert runs.failures[0].startswith("step 60: step raised RuntimeError: the arm fell off")
    assert "Traceback" in (runs.runs[0].path / "log.txt").read_text()
    before = contents(runs.runs[1])
    existing = {one.seed: one for one in runs.runs}
    assert choose_groups(runs.seeds, existing, None, "cpu", "Hopper-v5") == [[1, 2], [0]]
    assert choose_groups(runs.seeds, existing, None, "cpu", task) == [[1, 2]]  # the task cannot be sent to a process
    for one in runs.runs[1:]:  # as if their process had died twice: they go on together
        one.manifest = dataclasses.replace(one.manifest, state="failed")
    assert choose_groups(runs.seeds, existing, None, "cpu", "Hopper-v5") == [[0], [1, 2]]
    run(tmp_path / "set", **given, resume=True)
    runs = RunSet.open(tmp_path / "set")
    assert [one.manifest.state for one in runs.runs] == ["finished"] * 3
    assert [one.manifest.program for one in runs.runs] == [(0,), (0, 1, 2), (0, 1, 2)]
    assert [entry.step for entry in runs.runs[0].manifest.history] == [40]
    assert contents(runs.runs[1]) == before


def test_a_robot_that_is_taken_meanwhile_leaves_its_run_interrupted(tmp_path):
    made = []

    def robot():
        made.append(0)
        if len(made) == 2:
            raise RuntimeError("the robot is in use")
        return Probe()

    with pytest.raises(InputError, match="in use"):
        run(tmp_path / "d", LEARNERS[1], 64, robot)
    assert RunSet.open(tmp_path / "d").runs[0].state == "interrupted"


def test_a_failed_evaluation_ends_nothing(tmp_path):
    made: list[int] = []

    class Once(Probe):
        """Only the environments of training can be stepped."""

        def __init__(self) -> None:
            super().__init__()
            made.append(1)
            self.is_first = len(made) <= 2  # the trial's and training's

        def step(self, action):
            if not self.is_first:
                raise RuntimeError("there is one robot alone")
            return super().step(action)

    runs = run(tmp_path / "set", SAC(**SMALL), task=Once, steps=200, evaluation_episodes=1)
    (one,) = runs.runs
    assert one.manifest.state == "finished"
    assert not len(one.evaluations)
    assert "there is one robot alone" in (one.path / "log.txt").read_text()


def test_without_evaluations_a_run_leaves_its_policy(tmp_path):
    runs = run(tmp_path / "set", steps=200, evaluation_interval=0)
    assert not len(runs.evaluations)
    assert csac.load(runs).step == 200


def test_learning_that_diverges_fails_its_seed(tmp_path):
    algorithm = SAC(**{**SMALL, "critic_learning_rate": 1e30, "actor_learning_rate": 1e30})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = run(tmp_path / "set", algorithm, steps=1_000)
    assert "not finite" in runs.failures[0]


def test_callbacks_hear_of_each_evaluation_and_may_end_a_run_early(tmp_path):
    heard: list[tuple[int, list[int]]] = []
    runs = run(
        tmp_path / "set",
        steps=500,
        on_evaluation=lambda step, returns: heard.append((step, list(returns))),
        stop_when=lambda step, returns: step >= 200,
    )
    assert heard == [(100, [0]), (200, [0])]
    assert runs.runs[0].manifest.state == "finished"
    assert runs.runs[0].manifest.steps_done == 200


def test_stop_when_is_asked_by_processes_too(tmp_path):
    runs = run(tmp_path / "set", steps=1_500, seeds=2, stop_when=lambda step, returns: step >= 200)
    assert all(one.evaluations["step"].max() == 200 for one in runs.runs)


def test_a_process_that_dies_once_its_run_was_ended_changes_nothing(tmp_path):
    settings: Any = {"task": DeadlyToClose, "steps": 1_500, "seeds": 2, "evaluation_environments": 0}
    runs = run(tmp_path / "set", SAC(**SMALL), stop_when=lambda step, returns: step >= 200, **settings)
    assert not runs.failures
    assert [(one.manifest.state, one.manifest.steps_done < 1_500) for one in runs.runs] == [("finished", True)] * 2


def test_seeds_that_are_over_have_no_share_of_the_cores(apart):
    existing = {one.seed: one for one in apart.runs}
    directories = [*([one.path] for one in apart.runs), [apart.path / "seed-5"]]
    programs = programs_of(Program((), LEARNERS[0], "Hopper-v4", 1), directories, existing, apart.config)
    assert programs[-1].threads == cores_to_use()


def test_a_dead_seed_without_checkpoints_fails_alone(tmp_path):
    task = {"task": "probes:Deadly-v0", "environment_arguments": {"seed": training_seed(1, 60)}}
    runs = run(tmp_path / "set", LEARNERS[1], steps=300, seeds=2, checkpoint_interval=0, **task)
    assert "SIGKILL" in runs.failures[1]
    assert runs.run(0).manifest.steps_done == 300


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"evaluation_episodes": 0}, "evaluation_episodes"),
        ({"batch_size": 3}, "batch_size"),
        ({"resume": "no"}, "resume"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(tmp_path, options, name):
    with pytest.raises(InputError, match=name) as error:
        run(tmp_path / "set", **{"steps": 200, **options})
    assert "\n" not in str(error.value)
    assert not (tmp_path / "set").exists()


def test_the_callers_generators_are_as_before(tmp_path):
    before = random.getstate(), repr(np.random.get_state())
    run(tmp_path / "set", steps=30)
    assert (random.getstate(), repr(np.random.get_state())) == before


def test_what_is_there_already_is_not_overwritten(tmp_path):
    runs = run(tmp_path / "set", steps=200)
    before = contents(runs.runs[0])
    with pytest.raises(InputError, match="already holds a run"):
        run(tmp_path / "set", steps=200)
    assert contents(runs.runs[0]) == before
    assert run(tmp_path / "set", steps=200, first_seed=1).seeds == [1]
    with pytest.raises(InputError, match="evaluation_episodes"):
        run(tmp_path / "set", steps=200, first_seed=2, evaluation_episodes=3)  # a set is of one configuration
    assert RunSet.open(tmp_path / "set").seeds == [0, 1]


def test_without_a_directory_each_call_makes_a_new_one_whose_policies_are_at_hand(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one, other = (run(None, steps=200) for _ in range(2))
    assert one.path != other.path
    observation = np.zeros(11, np.float32)
    ours, theirs = one.policy().predict(observation), csac.load(other, 0).predict(observation)
    np.testing.assert_array_equal(ours[0], theirs[0])
    with pytest.raises(InputError, match="no seed 7"):
        one.policy(7)


def test_what_a_notebook_defines_is_not_sent_to_a_process(monkeypatch):
    notebook: Any = types.ModuleType("__main__")
    exec("class Cell: ...", notebook.__dict__)
    monkeypatch.setitem(sys.modules, "__main__", notebook)
    monkeypatch.setitem(gymnasium.registry, "Cell-v0", EnvSpec("Cell-v0", notebook.Cell))
    tasks: list[Any] = [notebook.Cell, partial(notebook.Cell), "Cell-v0", lambda: None]
    assert not any(map(can_be_sent, tasks))
    assert can_be_sent("Pendulum-v1")
    notebook.__file__ = __file__
    assert can_be_sent(notebook.Cell)


def test_a_task_that_changes_the_working_directory_moves_no_file(tmp_path, monkeypatch):
    class Wandering(Probe):
        def reset(self, *, seed=None, options=None):
            os.chdir("/")
            return super().reset(seed=seed, options=options)

    monkeypatch.chdir(tmp_path)
    runs = run("set", SAC(**SMALL), task=Wandering, steps=200, evaluation_episodes=1)  # pyright: ignore[reportArgumentType]
    assert runs.runs[0].path == tmp_path / "set" / "seed-0"
    assert runs.runs[0].manifest.state == "finished"
