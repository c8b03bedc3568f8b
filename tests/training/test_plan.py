"""What is asked for is checked before anything is made of it, and each option is declared once."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
from typing import Any

import numpy as np
import pytest

from csac import PPO, SAC, train
from csac.algorithms.memory import row_width
from csac.console.progress import Reporter
from csac.record.manifest import Manifest
from csac.training import provenance
from csac.training.footprint import memory_needed
from csac.training.options import Options, PlanOptions, checked_options
from csac.training.plan import Before, Plan, _choose_parts, make_plan
from csac.training.resume import Source
from csac.training.train import _warmup_note
from csac.types import InputError


def test_the_options_of_train_are_those_of_a_plan():
    given = {item.name for item in dataclasses.fields(Plan)} - {"algorithm", "task", "task_name"}
    assert set(PlanOptions.__annotations__) == given
    assert not set(PlanOptions.__annotations__) & inspect.signature(train).parameters.keys()


def test_what_is_not_given_is_as_declared():
    options, others = checked_options({"steps": 30, "groups": None})
    assert options == Options(steps=30)
    assert others == {"groups": None}
    assert (options.labels, Options(first_seed=7, seeds=2).labels) == ([0], [7, 8])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"steps": 0}, "steps must be a whole number of at least 1, not 0"),
        ({"steps": 1e6}, "steps must be a whole number of at least 1, not 1000000.0"),
        ({"steps": 10**300}, "steps must be at most 2,147,483,647, not 1e.300"),
        ({"seeds": True}, "seeds must be a whole number of at least 1, not True"),
        ({"seeds": 10**9}, "seeds must be at most 10,000"),
        ({"first_seed": 2**32}, "first_seed must be at most 4,294,967,295"),  # its streams would be seed 0's
        ({"first_seed": 2**32 - 1, "seeds": 2}, "leaves no labels for 2 seeds"),
        ({"checkpoint_interval": -1}, "checkpoint_interval must be a whole number of 0 or more, not -1"),
        ({"device": "tpu"}, "device must be cpu or gpu, not 'tpu'"),
        ({"step": 5}, "train takes no step: did you mean steps?"),
        ({"zebra": 5}, "train takes no zebra$"),
        ({"total_timesteps": 5}, "train takes no total_timesteps: it is steps here$"),
        ({"env_kwargs": {}}, "train takes no env_kwargs: it is environment_arguments here$"),
        ({"verbose": 1}, "train takes no verbose: none is needed$"),
        ({"n_envs": 4}, "train takes no n_envs: each seed has one environment, and seeds says how many$"),
    ],
)
def test_a_mistake_is_told_in_one_line(given: Any, message):
    with pytest.raises(InputError, match=message):
        checked_options(given)


@pytest.mark.parametrize(
    ("algorithm", "message"),
    [
        ("sac", r"sac is no algorithm with hyperparameters: give SAC\(\)"),
        (SAC, r"SAC is no algorithm with hyperparameters: give SAC\(\)"),
        (None, r"None is no algorithm with hyperparameters: give CSAC\(\)"),
    ],
)
def test_a_name_or_a_class_is_no_algorithm(tmp_path, algorithm: Any, message):
    with pytest.raises(InputError, match=message):
        train(algorithm, "Pendulum-v1", directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"environment_arguments": 3}, "environment_arguments are keyword arguments such as"),
        ({"perturbations": 3}, r"perturbations are a list such as \['friction=1.5@300000'\], not 3"),
        ({"on_evaluation": 3}, "on_evaluation is a function that is called, not 3"),
        ({"events": 3}, r"events are a list of names such as \('collision',\), not 3"),
        ({"reporter": True}, r"reporter is an object such as csac.console.progress.Reporter\(\), not True"),
        ({"reporter": Reporter}, r"reporter is an object such as csac.console.progress.Reporter\(\), not <class"),
        (
            {"discount": 0.9},
            r"train takes no discount: it is a hyperparameter, as in train\(SAC\(discount=...\), ...\)",
        ),
        ({"groups": 2}, "groups must be at most as many as seeds, 1, not 2"),
        ({"stop_when": "never"}, "stop_when is a function that is called, not 'never'"),
        ({"resume": "no"}, "resume is True or False, not 'no'"),
        ({"tensorboard": 1}, "tensorboard is True or False, not 1"),
        ({"wandb": 1}, "wandb is True or False, not 1"),
        ({"wandb": "no"}, "wandb is True or False, not 'no'"),  # a name is a project's
    ],
)
def test_what_is_of_another_kind_is_refused_before_anything_is_made(tmp_path, given: Any, message):
    with pytest.raises(InputError, match=message):
        train(SAC(), "Pendulum-v1", steps=10, directory=tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_an_argument_that_the_task_first_uses_in_a_step_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(InputError, match=r"^Pendulum-v1 does not work with the arguments .*: step raised \w+Error: "):
        train(SAC(), "Pendulum-v1", steps=10, directory=tmp_path / "run", environment_arguments={"g": "a"})
    assert not (tmp_path / "run").exists()


def test_a_run_to_resume_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="resume goes on with the run in `directory`: give one"):
        train(SAC(), "Pendulum-v1", steps=10, resume=True)
    assert not list(tmp_path.iterdir())


def test_a_run_that_goes_on_has_room_for_its_replay_twice():
    """As it was read from the disk, and as JAX has it."""
    plan, spec = make_plan(
        SAC(replay_size=2**20), "Pendulum-v1", {"steps": 2**20}, Before.find(None, False, None), True
    )
    replay, of_seed = 2**20 * row_width(spec) * 4, re.compile(r"1 x (\d+) MiB")
    new, old = (int(of_seed.findall(memory_needed(plan, spec, goes_on))[0]) for goes_on in (False, True))
    assert old - new == pytest.approx(replay / 2**20, abs=1)


def test_an_optimiser_that_keeps_its_moments_in_one_vector_needs_no_more_memory():
    """PPO's are as long as all of its parameters: each was taken for a unit, with a number for every transition."""
    plan, spec = make_plan(PPO(hidden_sizes=(1_024, 1_024)), "Pendulum-v1", {}, Before.find(None, False, None), True)
    (needed,) = re.findall(r"1 x (\d+) MiB", memory_needed(plan, spec))
    parameters = 2 * (1_024 * 1_024 + 1_024 * 4) * 4 / 2**20  # of actor and critic, float32, in MiB
    assert 3 * parameters < int(needed) < 3 * parameters + 4 * 2_048 * (2 * 2_048 + 100) / 2**20


def test_a_batch_that_does_not_fit_is_refused_with_what_it_needs(tmp_path):
    with pytest.raises(InputError, match=r"needs about [\d,.]+ GiB of memory and [\d.]+ GiB are available"):
        train(SAC(batch_size=10**9, replay_size=2 * 10**9), "Pendulum-v1", steps=100, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_container_s_memory_is_what_is_available(tmp_path, monkeypatch):
    monkeypatch.setattr("csac.training.footprint.memory_left", lambda: 3 * 2**29)
    with pytest.raises(InputError, match=r"and 1\.5 GiB are available"):
        train(SAC(replay_size=2**26), "Pendulum-v1", steps=2**26, directory=tmp_path / "run")


@pytest.mark.parametrize(
    ("algorithm", "steps", "why"),
    [
        (SAC(warmup_steps=100), 99, "since all 99 steps are warm-up (warmup_steps=100)"),
        (SAC(warmup_steps=100, update_interval=500), 499, "since the first update comes after step 500"),
        (PPO(rollout_steps=64, minibatches=4), 63, "since the first update comes after step 64"),
    ],
)
def test_a_run_in_which_nothing_is_learnt_says_so(algorithm, steps, why):
    def notes(steps: int) -> list[str]:
        return _warmup_note(Plan(algorithm=algorithm, task="t", task_name="t", groups=((0,),), steps=steps))

    assert notes(steps) == [f"note: nothing will be learnt, {why}"]
    assert notes(steps + 1) == []


@pytest.mark.parametrize(("device", "parts"), [("cpu", ((0,), (1,), (2,))), ("gpu", ((0, 1, 2),))])
def test_the_seeds_of_a_run_stay_as_they_are_divided_on_its_device_alone(device, parts):
    """A GPU trains all seeds in one program, however many processes a CPU had for them."""
    existing = Manifest(
        task="Hopper-v4", algorithm="sac", steps=100, seeds=(0, 1, 2), groups=((0,), (1,), (2,)), device="cpu"
    )
    assert _choose_parts(None, Options(seeds=3, device=device), existing, True) == parts


def test_a_source_that_no_folder_can_be_called_is_refused_in_a_line():
    for where in ("x" * 300, f"{'x' * 300}@10"):
        with pytest.raises(InputError, match="cannot read"):
            Source.find(where)
    assert Before.find("x" * 300, True, None).existing is None


def test_numpy_numbers_are_numbers():
    assert Options(steps=np.int64(5)).steps == 5  # pyright: ignore[reportArgumentType]


def test_a_commit_is_csac_s_own(tmp_path, monkeypatch):
    """Installed inside of somebody's repository, csac took theirs for its own."""

    def git(*arguments: str) -> str:
        who = ["-c", "user.name=n", "-c", "user.email=e"]
        return subprocess.run(
            ["git", "-C", tmp_path, *who, *arguments], check=True, capture_output=True, text=True
        ).stdout

    module = tmp_path / "provenance.py"
    module.touch()
    monkeypatch.setattr(provenance, "__file__", str(module))
    git("init")
    git("commit", "--allow-empty", "-m", "theirs")
    assert provenance._commit() is None
    git("add", "provenance.py")
    git("commit", "-m", "ours")
    assert provenance._commit() == git("rev-parse", "HEAD").strip()


def test_numbers_that_no_run_can_have_are_refused_with_their_limit():
    with pytest.raises(InputError, match=r"steps must be at most 2,147,483,647, not 2.15e\+09"):
        Options(steps=2**31)
    assert Options(steps=2**31 - 1).steps == 2**31 - 1
    with pytest.raises(InputError, match=r"evaluation_episodes must be at most 1,000,000, not 2e\+09"):
        Options(evaluation_episodes=2_000_000_000)
