import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from csac import presets
from csac.algorithms import ALGORITHMS
from csac.types import InputError

RESULTS = Path(__file__).parents[1] / "results"
PAPER_TABLE = {
    "actor_learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
    "actor_hidden_sizes": (256, 256),
    "critic_hidden_sizes": (256, 256),
    "target_rate": 0.005,
    "batch_size": 256,
    "replay_size": 1_000_000,
    "warmup_steps": 10_000,
    "discount": 0.99,
}


PAPER_OWN = {
    "csac": {
        "entropy_weight": 0.2,
        "reference_policy": "periodic",
        "reference_period": 1,
        "relative_entropy_estimator": "sampled",
    },
    "sac": {"entropy_weight": 0.2},
    "td3": {"exploration_std": 0.1, "target_noise": 0.2, "target_noise_clip": 0.5, "policy_delay": 2},
    "sd3": {
        "actor_learning_rate": 1e-3,
        "critic_learning_rate": 1e-3,
        "noise_samples": 50,
        "importance_sampling": False,
    },
}


@pytest.mark.parametrize(("algorithm", "own"), PAPER_OWN.items(), ids=PAPER_OWN)
def test_paper_gives_the_papers_table(algorithm, own):
    given = presets.hyperparameters("paper", algorithm, "Walker2d-v4")
    assert {name: given[name] for name in PAPER_TABLE | own} == PAPER_TABLE | own


@pytest.mark.parametrize(
    ("preset", "algorithm"), [*(("paper", name) for name in sorted(ALGORITHMS)), ("strong", "csac"), ("strong", "sac")]
)
def test_an_algorithm_takes_what_its_preset_gives(preset, algorithm):
    given = presets.hyperparameters(preset, algorithm, "Walker2d-v4")

    made = ALGORITHMS[algorithm](**given)

    assert {name: value for name, value in dataclasses.asdict(made).items() if name in given} == given


@pytest.mark.parametrize(
    ("task", "tau", "beta"),
    [
        ("Ant-v4", 0.5, 0.001),
        ("HalfCheetah-v4", 0.5, 0.005),
        ("Hopper-v4", 0.5, 0.05),
        ("Walker2d-v4", 0.5, 0.1),
        ("Walker2d-v5", 0.5, 0.1),
        ("PandaReach-v3", 0.5, 0.05),
        ("PyFlyt/QuadX-Waypoints-v1", 0.1, 0.05),
        ("PyFlyt.gym_envs:PyFlyt/QuadX-Waypoints-v1", 0.1, 0.05),
    ],
)
def test_papers_tau_and_beta_depend_on_the_task(task, tau, beta):
    assert presets.hyperparameters("paper", "csac", task)["relative_entropy_weight"] == tau
    assert presets.hyperparameters("paper", "sd3", task)["inverse_temperature"] == beta


def test_paper_ppo_has_the_papers_table_and_parls_example_which_are_the_defaults():
    given = presets.hyperparameters("paper", "ppo", "HalfCheetah-v4")

    assert (given["learning_rate"], given["hidden_sizes"], given["discount"]) == (3e-4, (64, 64), 0.99)
    assert (given["rollout_steps"], given["minibatches"], given["epochs"]) == (2048, 32, 10)
    assert (given["clip_range"], given["trace_decay"], given["value_loss_weight"]) == (0.2, 0.95, 0.5)
    assert (given["max_gradient_norm"], given["adam_epsilon"]) == (0.5, 1e-5)
    assert given["learning_rate_schedule"] == "linear"
    assert given == dataclasses.asdict(ALGORITHMS["ppo"]())


def measured(question: str, config: str) -> dict[str, Any]:
    """The hyperparameters of runs that a question keeps, but for the names of former versions."""
    configs = json.loads((RESULTS / question / "configs.json").read_text())
    former = {"temperature", "temperature_learning_rate", "target_relative_entropy"}
    former |= {"critic_reference", "critic_unit_weights"}
    return {name: value for name, value in configs[config]["hyperparameters"].items() if name not in former}


def as_json(algorithm: Any) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(algorithm)))


@pytest.mark.parametrize(("algorithm", "runs"), [("csac", "csac-two-steps-bounded"), ("sac", "two-steps")])
def test_strong_is_what_was_measured(algorithm, runs):
    strong = as_json(ALGORITHMS[algorithm](**presets.hyperparameters("strong", algorithm, "Ant-v4")))
    values = measured("strong", runs)
    values.pop("reference_rate", None)  # that of an average, which CSAC's reference is not here
    assert {name: strong[name] for name in values} == values


def test_the_default_of_csac_is_what_was_measured():
    default, values = as_json(ALGORITHMS["csac"]()), measured("reference", "csac-average-0.05")
    assert {name: default[name] for name in values} == values


@pytest.mark.parametrize(("algorithm", "unused"), [("csac", {"reference_rate"}), ("sac", set())])
def test_strong_names_all_that_a_later_default_could_change(algorithm, unused):
    given = presets.hyperparameters("strong", algorithm, "Ant-v4")

    assert {item.name for item in dataclasses.fields(ALGORITHMS[algorithm])} - set(given) == unused


def test_changing_what_was_given_changes_no_preset():
    presets.hyperparameters("paper", "csac", "Ant-v4")["discount"] = 0.0

    assert presets.hyperparameters("paper", "csac", "Ant-v4")["discount"] == 0.99


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("papre", "csac", "Ant-v4"), "no preset is called 'papre': choose paper or strong"),
        (("paper", "dqn", "Ant-v4"), "'paper' has no 'dqn': it has csac and sac"),
        (("strong", "td3", "Ant-v4"), "'strong' has no 'td3': it has csac and sac"),
        (("paper", "csac", None), "task is a Gymnasium id such as 'Hopper-v4', not None"),
    ],
)
def test_what_no_preset_has_is_named(given: Any, told):
    with pytest.raises(InputError, match=told):
        presets.hyperparameters(*given)
