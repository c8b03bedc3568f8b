"""What the options mean."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from manifests import manifest
from shown import make_set
from typed import calls_of, csac, make_runs

import csac.evaluation.export as exporting
import csac.evaluation.play as playing
import csac.training.train as training
from csac.algorithms import ALGORITHMS, CSAC, SAC
from csac.cli.parsing import value_of
from csac.record.config import RunConfig
from csac.record.run import RunDirectory
from csac.training.config import RUN_OPTIONS


def defaults(function):
    return {name: item.default for name, item in inspect.signature(function).parameters.items()}


# What `train` is called with if no option is typed: what is left out in Python.
NOT_TYPED = {"algorithm", "task", "options", "tensorboard", "progress", "command"}
NOT_TYPED |= {"callbacks", "on_evaluation", "stop_when"}
TRAINED = {name: RunConfig.__dataclass_fields__[name].default for name in RUN_OPTIONS}
TRAINED |= {"environment_arguments": {}, "perturbations": None, "events": None, "demonstrations": None}
TRAINED |= {name: value for name, value in defaults(training.train).items() if name not in NOT_TYPED}


def test_train_passes_its_options_on(train_call):
    line = (
        "Hopper-v4 --steps 1e5 --seeds 3 --first-seed 7 --directory some/where --device gpu --seeds-per-process 2 "
        "--evaluation-interval 1_000 --evaluation-episodes 4 --evaluation-processes 3 "
        "--evaluation-environments 2 --events 'fell, slid' "
        "--environments 4 --environment-processes 2 --hindsight 4 --demonstrations seen.npz "
        "--checkpoint-interval 5e3 --keep-checkpoints 0 --resume --wandb --from a@5 "
        "--warmup-steps 2e3 --actor-hidden-sizes 8 9 "
        "--perturb friction=1.5@5e4 --perturb=action-noise=0.1 "
        """--env-kwargs '{"ctrl_cost_weight": 0.5}'"""
    )
    make_set(Path("a"), [[1.0]])
    call = train_call(line)
    command = call.pop("command")
    assert command.startswith("csac train Hopper-v4 --steps 1e5")
    assert command.endswith("""--env-kwargs '{"ctrl_cost_weight": 0.5}'""")
    assert call.pop("algorithm").warmup_steps == 2_000
    assert call == {
        "task": "Hopper-v4",
        "steps": 100_000,
        "seeds": 3,
        "first_seed": 7,
        "device": "gpu",
        "evaluation_interval": 1_000,
        "evaluation_environments": 2,
        "evaluation_episodes": 4,
        "evaluation_seed": 1_000_000,
        "checkpoint_interval": 5_000,
        "keep_checkpoints": 0,
        "environment_arguments": {"ctrl_cost_weight": 0.5},
        "perturbations": ("friction=1.5@5e4", "action-noise=0.1"),
        "events": ("fell", "slid"),
        "directory": Path("some/where"),
        "resume": True,
        "start_from": "a@5",
        "seeds_per_process": 2,
        "evaluation_processes": 3,
        "environments": 4,
        "hindsight": 4,
        "demonstrations": "seen.npz",
        "environment_processes": 2,
        "wandb": True,
    }


def test_train_without_options_uses_the_defaults(train_call):
    command = "csac train Hopper-v4"
    assert train_call("Hopper-v4") == {"algorithm": CSAC(), "task": "Hopper-v4", "command": command, **TRAINED}


@pytest.mark.parametrize(
    ("line", "module", "name", "given"),
    [
        ("resume runs --steps 2e3 --trust-task", training, "resume", {"steps": 2_000}),
        (
            "evaluate runs --seed 1 --checkpoint best --episodes 4 --processes 3 --stochastic --perturb friction=2 "
            "--perturb action_noise=0.1 --trust-task",
            playing,
            "evaluate_run",
            {"seed": 1, "which": "best", "episodes": 4, "processes": 3, "deterministic": False}
            | {"perturbations": ("friction=2", "action_noise=0.1")},
        ),
        (
            "play runs --seed 1 --checkpoint best --episodes 4 --video film.mp4 --perturb friction=2 --trust-task",
            playing,
            "play",
            {"seed": 1, "which": "best", "episodes": 4, "video": Path("film.mp4"), "perturbations": ("friction=2",)},
        ),
        (
            "export runs --seed 1 --checkpoint best --format onnx --out there --fallback middle --rate-limit 0.1 "
            "--episodes 4 --card --trust-task",
            exporting,
            "export_run",
            {"seed": 1, "which": "best", "format": "onnx", "place": Path("there"), "fallback": "middle"}
            | {"rate_limit": 0.1, "episodes": 4, "card": True},
        ),
    ],
)
def test_commands_pass_their_options_on_and_have_the_defaults_of_python(monkeypatch, line, module, name, given):
    fields = {"verification": {"observations": 0, "largest_difference": 0.0}}
    exported = exporting.Exported(Path("there"), {**fields, "provenance": {"seed": 0, "steps": 10_000}}, [])
    results = {"resume": make_runs("runs"), "export_run": exported}
    left_out = defaults(getattr(module, name))
    calls = calls_of(monkeypatch, module, name, results.get(name, ()))
    assert csac(line) == csac(" ".join(line.split()[:2])) == 0
    given = {**given, "directory": Path("runs"), "trust_task": True}
    for call, expected in zip(
        calls, (given, {key: left_out[key] for key in given} | {"directory": Path("runs")}), strict=True
    ):
        call.pop("command", None)
        assert call == expected


@pytest.mark.parametrize(
    ("options", "perturbations"), [("", None), ("--perturb mass=2@70", ("mass=2@70",)), ("--perturb none", ())]
)
def test_a_fork_is_as_its_source_unless_told_otherwise(train_call, options, perturbations):
    config = {"algorithm": "sac", "hyperparameters": {"discount": 0.5}, "evaluation_interval": 10, "evaluation_seed": 3}
    config |= {"evaluation_environments": 0, "checkpoint_interval": 7}
    make_set(Path("source"), [[1.0], [2.0]], steps=500, environment_arguments={"a": 1}, **config)
    call = train_call(f"Hopper-v4 --from source@50 --evaluation-episodes 3 {options}")
    assert call.pop("command")
    assert call == {
        **TRAINED,
        "task": "Hopper-v4",
        "algorithm": SAC(discount=0.5),
        "steps": 500,
        "seeds": 2,
        "evaluation_interval": 10,
        "evaluation_episodes": 3,
        "evaluation_seed": 3,
        "evaluation_environments": 0,
        "checkpoint_interval": 7,
        "environment_arguments": {"a": 1},
        "perturbations": perturbations,
        "start_from": "source@50",
    }


def test_a_fork_that_has_begun_needs_its_source_no_more(train_call):
    """A scheduler types the same line again; meanwhile the source is gone."""
    make_set(Path("source"), [[1.0]], steps=55)
    Path("fork").mkdir()
    assert train_call("Hopper-v4 --from source@5 --directory fork --resume")["steps"] == 55
    RunDirectory.create(Path("fork/seed-4"), manifest(seed=4, steps=77, algorithm="csac"))
    call = train_call("Hopper-v4 --from gone@400 --directory fork --resume")
    assert (call["steps"], call["first_seed"], call["start_from"]) == (77, 4, "gone@400")


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_each_algorithm_brings_its_options(train_call, name):
    assert train_call(f"Hopper-v4 --algorithm {name}")["algorithm"] == ALGORITHMS[name]()
    assert train_call(f"Hopper-v4 --algorithm={name} --discount 0.5")["algorithm"].discount == 0.5


def test_a_preset_depends_on_algorithm_and_task_and_options_win_over_it(train_call):
    quad = "PyFlyt/QuadX-Waypoints-v1"
    assert train_call("Ant-v4 --preset paper")["algorithm"].relative_entropy_weight == 0.5
    assert train_call(f"--preset paper {quad}")["algorithm"].relative_entropy_weight == 0.1
    given = train_call(f"{quad} --preset=paper --relative-entropy-weight 5")["algorithm"]
    assert (given.relative_entropy_weight, given.relative_entropy_estimator) == (5.0, "sampled")
    assert train_call("Ant-v4 --algorithm sac --preset paper")["algorithm"].entropy_weight == 0.2


def test_weights_may_be_learnt_and_numbers_negative(train_call):
    assert train_call("Hopper-v4 --entropy-weight auto")["algorithm"] == CSAC(entropy_weight="auto")
    assert train_call("Hopper-v4 --entropy-weight 0.3")["algorithm"] == CSAC(entropy_weight=0.3)
    assert train_call("Ant-v4 --algorithm sac --target-entropy -3")["algorithm"].target_entropy == -3.0


@pytest.mark.parametrize(
    ("words", "value"), [([], None), (["--x", "b"], "b"), (["--x=b", "--x", "c"], "c"), (["--x"], None), (["x"], None)]
)
def test_the_last_value_of_an_option_counts(words, value):
    assert value_of(words, "--x") == value
