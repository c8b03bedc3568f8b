"""What the options mean."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest
from typed import NOTHING, calls_of, csac, make_run

import csac.evaluation.export as exporting
import csac.evaluation.play as playing
import csac.training.train as training
from csac.algorithms import ALGORITHMS, CSAC, SAC
from csac.arguments import peek
from csac.record.manifest import EvaluationPlan
from csac.record.run import RunDirectory
from csac.training.checkpoint import Checkpoint
from csac.training.plan import algorithm_of
from csac.training.resume import Source


def test_train_passes_its_options_on(train_call):
    call = train_call(
        "Hopper-v4 --steps 1e5 --seeds 3 --first-seed 7 --directory some/where --device gpu --groups 2 "
        "--evaluation-interval 1_000 --evaluation-episodes 4 --evaluation-processes 3 "
        "--checkpoint-interval 5e3 --keep-checkpoints 0 --resume --wandb "
        "--warmup-steps 2e3 --actor-hidden-sizes 8 9 "
        "--perturb friction=1.5@5e4 --perturb=action-noise=0.1 "
        """--env-kwargs '{"ctrl_cost_weight": 0.5}'"""
    )

    assert call["task"] == "Hopper-v4"
    assert call["algorithm"] == CSAC(warmup_steps=2000, actor_hidden_sizes=(8, 9))
    assert call["directory"] == Path("some/where")
    assert call["environment_arguments"] == {"ctrl_cost_weight": 0.5}
    assert call["perturbations"] == ("friction=1.5@5e4", "action-noise=0.1")
    assert call["command"].startswith("csac train Hopper-v4 --steps 1e5")
    assert call["command"].endswith("""--env-kwargs '{"ctrl_cost_weight": 0.5}'""")
    numbers = {name: call[name] for name in call if isinstance(call[name], int)}
    assert numbers == {
        "steps": 100_000,
        "seeds": 3,
        "first_seed": 7,
        "groups": 2,
        "evaluation_interval": 1000,
        "evaluation_episodes": 4,
        "evaluation_processes": 3,
        "checkpoint_interval": 5000,
        "keep_checkpoints": 0,
        "resume": True,
        "wandb": True,
    }
    assert call["start_from"] is None


def test_resume_passes_its_options_on(monkeypatch):
    calls = calls_of(monkeypatch, training, "resume", RunDirectory(Path("run"), replace(NOTHING, state="finished")))
    line = "resume some/run --steps 2e3 --trust-task"
    assert csac(line) == csac("resume some/run") == 0
    told = {"directory": Path("some/run"), "evaluation_processes": None}
    assert calls == [
        {**told, "steps": 2_000, "trust_task": True, "command": f"csac {line}"},
        {**told, "steps": None, "trust_task": False, "command": "csac resume some/run"},
    ]


def test_evaluate_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    calls = calls_of(monkeypatch, playing, "evaluate_run")
    line = "evaluate run --seed 1 --checkpoint best --episodes 4 --processes 3 --stochastic"
    assert csac(f"{line} --perturb friction=2 --perturb action_noise=0.1 --trust-task") == 0
    assert csac("evaluate run") == 0
    assert calls == [
        {
            "directory": Path("run"),
            "seed": 1,
            "episodes": 4,
            "deterministic": False,
            "perturbations": ("friction=2", "action_noise=0.1"),
            "processes": 3,
            "trust_task": True,
            "which": "best",
        },
        {
            "directory": Path("run"),
            "seed": None,
            "episodes": 10,
            "deterministic": True,
            "perturbations": (),
            "processes": None,
            "trust_task": False,
            "which": "last",
        },
    ]


def test_play_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    calls = calls_of(monkeypatch, playing, "play")
    line = "play run --seed 1 --checkpoint best --episodes 4 --video film.mp4 --perturb friction=2 --trust-task"
    assert csac(line) == csac("play run") == 0
    assert calls == [
        {
            "directory": Path("run"),
            "seed": 1,
            "episodes": 4,
            "video": Path("film.mp4"),
            "perturbations": ("friction=2",),
            "trust_task": True,
            "which": "best",
        },
        {
            "directory": Path("run"),
            "seed": None,
            "episodes": 1,
            "video": None,
            "perturbations": (),
            "trust_task": False,
            "which": "last",
        },
    ]


def test_export_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    exported = exporting.Exported(Path("there"), {"verification": {"observations": 1, "largest_difference": 0.0}}, [])
    calls = calls_of(monkeypatch, exporting, "export_run", exported)
    line = "export run --seed 1 --checkpoint best --format onnx --out there --fallback middle "
    line += "--rate-limit 0.1 --episodes 4 --card --trust-task"
    assert csac(line) == csac("export run") == 0
    assert calls == [
        {
            "directory": Path("run"),
            "format": "onnx",
            "seed": 1,
            "which": "best",
            "place": Path("there"),
            "fallback": "middle",
            "rate_limit": 0.1,
            "episodes": 4,
            "card": True,
            "trust_task": True,
        },
        {
            "directory": Path("run"),
            "format": "numpy",
            "seed": None,
            "which": "last",
            "place": None,
            "fallback": None,
            "rate_limit": None,
            "episodes": 10,
            "card": False,
            "trust_task": False,
        },
    ]


def test_train_without_options_uses_the_defaults(train_call):
    call = train_call("Hopper-v4")

    assert call["algorithm"] == CSAC()
    assert (call["steps"], call["seeds"], call["groups"], call["directory"]) == (1_000_000, 1, None, None)
    assert "preset" not in call
    assert (call["resume"], call["start_from"], call["perturbations"]) == (False, None, None)
    assert (call["checkpoint_interval"], call["keep_checkpoints"]) == (50_000, 2)
    assert call["evaluation_processes"] is None


@pytest.mark.parametrize(
    ("options", "perturbations"),
    [
        ("", None),  # as planned there
        ("--perturb mass=2@70", ("mass=2@70",)),
        ("--perturb none", ()),
    ],
)
def test_a_fork_is_perturbed_as_its_source_unless_told_otherwise(train_call, monkeypatch, options, perturbations):
    source = make_run("source", "Hopper-v4", 11, [-1.0] * 3, [1.0] * 3)
    evaluation = EvaluationPlan(10, 1, 3_000_000)
    source.update_manifest(perturbations=["friction=2@60"], evaluation=evaluation, environment_arguments={})
    monkeypatch.setattr(Source, "find", lambda where: Source(source, Checkpoint(Path("none"), 50, {}, {})))

    call = train_call(f"Hopper-v4 --from source@50 {options}")

    assert call["perturbations"] == perturbations
    assert call["start_from"] == "source@50"
    assert call["evaluation_seed"] == 3_000_000  # which no option tells


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_each_algorithm_brings_its_options(train_call, name):
    assert train_call(f"Hopper-v4 --algorithm {name}")["algorithm"] == ALGORITHMS[name]()
    assert train_call(f"Hopper-v4 --algorithm={name} --discount 0.5")["algorithm"].discount == 0.5


def test_a_preset_depends_on_the_task_and_options_win_over_it(train_call):
    quad = "PyFlyt/QuadX-Waypoints-v1"

    assert train_call("Ant-v4 --preset paper")["algorithm"].relative_entropy_weight == 0.5
    assert train_call(f"--preset paper {quad}")["algorithm"].relative_entropy_weight == 0.1
    given = train_call(f"{quad} --preset=paper --relative-entropy-weight 5")
    assert given["algorithm"].relative_entropy_weight == 5.0
    assert given["algorithm"].reference_period == 1


def test_a_preset_is_the_algorithms_own(train_call):
    algorithm = train_call("Ant-v4 --algorithm sac --preset paper")["algorithm"]

    assert algorithm == SAC(entropy_weight=0.2)


def test_weights_that_adapt_come_back_from_the_manifest(train_call):
    line = (
        "Hopper-v4 --reference-policy periodic --entropy-weight auto --relative-entropy-weight auto "
        "--target-relative-entropy 0.02"
    )
    algorithm = train_call(line)["algorithm"]
    assert algorithm == CSAC(
        entropy_weight="auto",
        relative_entropy_weight="auto",
        reference_policy="periodic",
        target_relative_entropy=0.02,
    )
    assert train_call("Hopper-v4 --entropy-weight 0.3")["algorithm"] == CSAC(entropy_weight=0.3)

    told = replace(NOTHING, hyperparameters=asdict(algorithm))
    RunDirectory.create(Path("adaptive"), told)
    assert algorithm_of(RunDirectory.open("adaptive").manifest) == algorithm


def test_negative_numbers_are_values(train_call):
    assert train_call("Ant-v4 --algorithm sac --target-entropy -3")["algorithm"].target_entropy == -3.0


@pytest.mark.parametrize(
    ("arguments", "value"), [([], "a"), (["--x", "b"], "b"), (["--x=b", "--x", "c"], "c"), (["--x"], "a"), (["x"], "a")]
)
def test_peeking_finds_the_last_value(arguments, value):
    assert peek(arguments, "--x", "a") == value
