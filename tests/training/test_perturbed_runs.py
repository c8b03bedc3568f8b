"""Runs that are perturbed, killed, resumed and forked."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import probes
import pytest
from resuming import LEARNERS, contents, run, run_with_copies

from csac.deploy.choosing import load
from csac.evaluation.evaluator import Evaluator
from csac.record.config import RunConfig
from csac.record.manifest import Manifest, Origin
from csac.record.run import RunDirectory
from csac.seeds import EVALUATION_SEED
from csac.tasks.perturbations import perturbations_of, values_at
from csac.training.loop import Loop
from csac.training.program import Program
from csac.training.resume import ResumePoint
from csac.training.train import resume
from csac.training.watch import Watcher
from csac.types import InputError


def model_of(environment: Any) -> Any:
    return environment.raw.unwrapped.model


# In the loop.


class Paused:
    """A loop that is run a few steps at a time."""

    def __init__(self, folder: Path, perturbations: Any, task: Any = "Hopper-v4") -> None:
        config = RunConfig(
            task=task if isinstance(task, str) else "probe",
            steps=400,
            seed=3,
            evaluation_interval=30,
            evaluation_episodes=1,
            checkpoint_interval=0,
            perturbations=tuple(map(str, perturbations_of(perturbations))),
        )
        self.run = RunDirectory.create(folder, Manifest(config=config))
        program = Program((self.run.path,), LEARNERS[0], task, threads=1, tensorboard=False)
        self.loop = Loop(program, [self.run], [ResumePoint(None, [])], Watcher())

    def advance(self, until: int) -> None:
        while self.loop.step < until:
            self.loop._advance()
            if self.loop.step % 30 == 0:
                self.loop._evaluate(self.loop.step)


def test_what_changes_at_a_step_is_what_comes_after_it(tmp_path):
    """In the environments, in the evaluations, and in what is remembered."""
    perturbed = Paused(tmp_path / "perturbed", ["friction=2@30", "observation_noise=0.1@35", "action_noise=0.1@38"])
    plain = Paused(tmp_path / "plain", ())
    own = model_of(plain.loop.environments.environments[0]).geom_friction.copy()
    for one in (perturbed, plain):
        one.advance(30)
    assert perturbed.run.table("evaluations").read_bytes() == plain.run.table("evaluations").read_bytes()
    assert len(plain.run.evaluations) == 1
    training = perturbed.loop.environments.environments[0]
    evaluation = perturbed.loop.evaluations._evaluator._environments[0]
    for environment in (training, evaluation):
        np.testing.assert_array_equal(model_of(environment).geom_friction, own)
    perturbed.advance(31)
    np.testing.assert_array_equal(model_of(training).geom_friction, 2 * own)
    perturbed.advance(60)
    np.testing.assert_array_equal(model_of(evaluation).geom_friction, 2 * own)
    assert evaluation._noise
    assert evaluation._noise._levels == {"observation_noise": 0.1, "action_noise": 0.1}


def test_the_replay_holds_what_the_policy_saw_and_what_it_chose(tmp_path):
    """Endless observes 0: what is not 0 in the replay is noise. The policy's choices are as without action noise."""
    given = ["observation_noise=0.5@12", "action_noise=0.5@15"]
    from_the_beginning = Paused(tmp_path / "beginning", "observation_noise=0.5", probes.Endless)
    assert from_the_beginning.loop._observations[0, 0] != 0  # already the first observation
    noisy = Paused(tmp_path / "noisy", given, probes.Endless)
    for one in (noisy, from_the_beginning):
        one.advance(39)  # the warm-up: actions are drawn, whatever is observed
    rows, others = (one.loop.learner.memory(0, 39).rows[:39] for one in (noisy, from_the_beginning))
    observation, action, next_observation = rows[:, 0], rows[:, 1], rows[:, 3]
    np.testing.assert_array_equal(np.flatnonzero(next_observation), np.arange(12, 39))  # the step that makes 13
    np.testing.assert_array_equal(np.flatnonzero(observation), np.arange(13, 39))
    # The end of an episode, every ten steps: what came is not what the next one begins with.
    same = observation[13:] == next_observation[12:-1]
    np.testing.assert_array_equal(np.flatnonzero(~same) + 13, [20, 30])
    np.testing.assert_array_equal(action, others[:, 1])


# Whole runs. Evaluations every 100 steps, checkpoints every 100.

GIVEN = ("friction=2@200", "observation_noise=0.05@200", "mass=1.5@250", "action_noise=0.1@250", "friction=1@430")
LONG: dict[str, Any] = {"checkpoint_interval": 100, "keep_checkpoints": 0, "evaluation_interval": 50}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run without perturbations, with every checkpoint."""
    return run(tmp_path_factory.mktemp("plain") / "run", **LONG)


@pytest.fixture(scope="module")
def perturbed(tmp_path_factory):
    """The same with them, and copies of what a kill at steps 250 and 500 would have left."""
    return run_with_copies(tmp_path_factory.mktemp("perturbed") / "run", 250, 500, perturbations=GIVEN, **LONG)


def test_a_run_says_what_it_was_perturbed_by(perturbed):
    assert perturbed.config.perturbations == GIVEN
    log = [line.partition(" ")[2] for line in (perturbed.runs[0].path / "log.txt").read_text().splitlines()]
    assert [line for line in log if line.startswith("perturbed")] == [
        "perturbed from step 201 on: friction x 2, observation noise 0.05",
        "perturbed from step 251 on: mass x 1.5, action noise 0.1",
        "perturbed from step 431 on: friction x 1",
    ]


def test_evaluations_meet_the_perturbed_task(perturbed):
    rows = perturbed.evaluations
    evaluator = Evaluator("Hopper-v4", None, 2, EVALUATION_SEED)
    evaluator.perturb(values_at(perturbations_of(GIVEN), 500))
    episodes = evaluator.run(load(perturbed.path, 0))
    assert [episode.episode_return for episode in episodes] == rows["return"][rows["step"] == 500].tolist()


@pytest.mark.parametrize(("killed", "checkpoint"), [(250, 200), (500, 400)])
def test_a_perturbed_run_that_was_killed_resumes_and_leaves_the_same_files(tmp_path, perturbed, killed, checkpoint):
    """From checkpoints at the very step of a perturbation, and between two."""
    shutil.copytree(f"{perturbed.path}-{killed}", tmp_path / "run")
    finished = resume(tmp_path / "run")
    assert finished.runs[0].manifest.history[0].step == checkpoint
    assert contents(finished.runs[0]) == contents(perturbed.runs[0])
    assert (tmp_path / "run" / "curve.png").read_bytes() == (perturbed.path / "curve.png").read_bytes()


def test_a_fork_that_is_perturbed_equals_a_run_that_was_from_the_start(tmp_path, plain, perturbed):
    forked = run(tmp_path / "run", start_from=f"{plain.path}@200", perturbations=GIVEN, **LONG)
    assert contents(forked.runs[0]) == contents(perturbed.runs[0])
    assert forked.config.perturbations == GIVEN
    changes = (f"perturbations is [], not {list(GIVEN)!r}",)
    assert forked.runs[0].manifest.forked_from == Origin(str(plain.runs[0].path), 200, changes)


def test_a_fork_of_a_perturbed_run_keeps_what_had_happened(tmp_path, perturbed):
    """The last one, at 430, is still to come at 300, and comes unless the fork is given others."""
    whole = run(tmp_path / "same", start_from=f"{perturbed.path}@300", **LONG)
    assert contents(whole.runs[0]) == contents(perturbed.runs[0])
    other = run(tmp_path / "other", start_from=f"{perturbed.path}@300", perturbations=(), **LONG)
    assert other.config.perturbations == GIVEN[:4]
    rows, before = other.evaluations, perturbed.evaluations
    np.testing.assert_array_equal(rows["return"][rows["step"] <= 400], before["return"][before["step"] <= 400])
    assert contents(other.runs[0])["evaluations.csv"] != contents(perturbed.runs[0])["evaluations.csv"]
    again = run(tmp_path / "other", start_from=f"{perturbed.path}@300", resume=True, **LONG)
    assert again.config.perturbations == other.config.perturbations
    with pytest.raises(InputError, match=r"friction=1@430 .*the run ends at step 400"):
        run(tmp_path / "short", start_from=f"{perturbed.path}@300", steps=400)
