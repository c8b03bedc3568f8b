"""Out of a run: verified against the policy that was trained, in its place only then, and described."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from artefacts import HAS_COMPILER
from gymnasium.spaces import Box
from manifests import make_set
from policies import algorithm_policy, contract, random_policy

import csac.evaluation.export as exporting
from csac.algorithms import CSAC
from csac.cli import main
from csac.deploy import verify
from csac.deploy.artefact import open_artefact
from csac.deploy.choosing import load
from csac.deploy.policy import Policy
from csac.evaluation.evaluator import evaluate
from csac.evaluation.export import check_returns, control_rate, export_run, provenance
from csac.record.sets import RunSet
from csac.training.train import train
from csac.types import InputError


class Follow(gymnasium.Env):
    """Five numbers that wander; the reward is how near the actions are to the first three. 0.05 s a step."""

    observation_space = Box(-np.inf, np.inf, (5,), np.float64)
    action_space = Box(-0.5, 2.0, (3,), np.float32)
    dt = 0.05

    def __init__(self, reach: float = 1.0) -> None:
        self.reach = min(reach, 1.0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 5), 0
        return self.place.copy(), {}

    def step(self, action):
        self.steps += 1
        reward = -float(np.abs(self.place[:3] - action).sum())
        self.place = np.clip(self.place + 0.1 * self.np_random.normal(size=5), -self.reach, self.reach)
        return self.place.copy(), reward, False, self.steps == 20, {}


gymnasium.register("Follow-v0", entry_point=f"{__name__}:Follow") if "Follow-v0" not in gymnasium.registry else None


def make_run(path: Path, algorithm: str = "csac", task: str = "Follow-v0", **values: Any) -> RunSet:
    """Two finished seeds that have learnt nothing; seed 1 was better at its last evaluation."""
    given = {"task": task, "algorithm": algorithm, "hyperparameters": {"batch_size": 8}, "steps": 200, **values}
    given |= {"commit": "0123456", "command": "csac train Follow-v0", "versions": {"csac": "0.1.0"}}
    runs, policy = make_set(path, (0, 1), **given), algorithm_policy(algorithm)
    for run, returns in zip(runs.runs, ((6.0, 1.0), (5.0, 3.0)), strict=True):
        agreement = dataclasses.replace(policy.contract, task=task)
        Policy(policy.network, agreement, step=200).write(run.policy_file())
        Policy(policy.network, agreement, step=100).write(run.policy_file("best"))
        row = {"seed": run.seed, "length": 20, "success": None}
        rows = [
            {**row, "step": step, "episode": episode, "return": value + episode}
            for step, value in zip((100, 200), returns, strict=True)
            for episode in range(3)
        ]
        run.append("evaluations", rows)
    return runs


@pytest.fixture(autouse=True)
def _few_observations(monkeypatch):
    monkeypatch.setattr(verify, "RANDOM", 60)


def told(place: Path) -> dict:
    def refuse(word: str) -> None:
        raise ValueError(word)

    return json.loads((place / "contract.json").read_text(), parse_constant=refuse)


def test_the_contract_says_all_that_whoever_runs_it_has_to_know(tmp_path):
    run = make_run(tmp_path / "run")
    exported = export_run(run.path, episodes=3)
    fields = told(exported.place)
    assert exported.place == run.path / "export" / "numpy"
    assert fields == exported.fields
    assert fields["observation_parts"] == [{"key": None, "shape": [5]}]
    assert (fields["action_low"], fields["control_rate_hz"]) == ([-0.5] * 3, 20.0)
    origin = fields["provenance"]
    assert [origin[name] for name in ("task", "algorithm", "seed", "checkpoint")] == ["Follow-v0", "csac", 1, "last"]
    assert [origin[name] for name in ("steps", "commit", "command")] == [200, "0123456", "csac train Follow-v0"]
    # Three episodes of 3, 4, 5: their mean, and t(2) = 4.303 times 1 / sqrt(3) around it.
    evaluation = origin["evaluation"]
    assert (evaluation["step"], evaluation["mean_return"], evaluation["standard_deviation"]) == (200, 4.0, 1.0)
    assert evaluation["interval_95"] == pytest.approx([4 - 4.3027 / 3**0.5, 4 + 4.3027 / 3**0.5], rel=1e-4)
    assert origin["all_seeds"] == {"count": 2, "mean_return": 3.0, **{k: origin["all_seeds"][k] for k in SPREAD}}
    assert origin["all_seeds"]["interval_95"] is None  # two seeds have none
    # In closed loop, on the episodes of csac evaluate.
    found, expected = fields["verification"], evaluate(load(run.path, 1), "Follow-v0", 3)
    assert found["returns"]["mean_return"] == pytest.approx(expected.mean(), rel=1e-4)
    assert found["returns_of_the_run"]["mean_return"] == pytest.approx(expected.mean(), rel=1e-4)
    assert found["observations"] == 3 * 20 + 60
    assert 0 < found["largest_difference"] < 1e-5


SPREAD = ("standard_deviation", "interval_95")


def test_the_best_policy_of_a_seed_comes_with_its_own_evaluation(tmp_path):
    run = make_run(tmp_path / "run")
    origin = provenance(run, run.run(0), load(run, 0, "best"), "best")
    assert (origin["seed"], origin["steps"], origin["evaluation"]["mean_return"]) == (0, 100, 7.0)
    stopped = Policy(load(run.path, 0).network, load(run.path, 0).contract, step=230)  # between two evaluations
    origin = provenance(run, run.run(0), stopped, "last")
    assert (origin["steps"], origin["evaluation"]["step"]) == (230, 200)


def test_a_seed_that_failed_says_so_and_counts_in_no_mean(tmp_path):
    run = make_run(
        tmp_path / "run", failures={0: "step 120: its reward is nan"}, perturbations=["action_noise=0.1@100"]
    )
    origin = provenance(run, run.run(1), load(run, 1), "last")
    assert (origin["failure"], origin["all_seeds"]["mean_return"]) == (None, 4.0)  # of seed 1 alone: 3, 4 and 5
    exported = export_run(run.path, seed=0, episodes=1)
    assert exported.fields["provenance"]["failure"] == "step 120: its reward is nan"
    card = export_run(run.path, seed=0, place=tmp_path / "card", episodes=0, card=True).place / "README.md"
    assert "failed** at step 120" in card.read_text()
    failed, perturbed = exported.notes
    assert "seed 0 failed at step 120" in failed
    assert "action_noise=0.1@100" in perturbed
    assert export_run(run.path, seed=1, episodes=0).notes == []  # sound, and not tested on the task at all


def test_weights_that_are_learnt_come_with_what_they_had_become(tmp_path):
    run = make_run(tmp_path / "run", hyperparameters={"entropy_weight": "auto", "relative_entropy_weight": 0.5})
    rows = [(0, 100, 0.4), (0, 200, 0.2)]
    run.run(0).append("metrics", [{"seed": seed, "step": step, "entropy_weight": value} for seed, step, value in rows])
    run.run(0).append("metrics", [{"seed": 0, "step": 200, "score": 1.0}])  # a callback's
    assert provenance(run, run.run(0), load(run, 0), "last")["learnt_weights"] == {"entropy_weight": 0.2}
    assert provenance(run, run.run(0), load(run, 0, "best"), "best")["learnt_weights"] == {"entropy_weight": 0.4}
    card = (export_run(run.path, seed=0, episodes=0, card=True).place / "README.md").read_text()
    assert "| entropy_weight | `auto`, at last 0.2 |" in card
    assert "| relative_entropy_weight | `0.5` |" in card
    run = make_run(tmp_path / "sac", algorithm="sac", hyperparameters={"entropy_weight": "auto"})
    run.run(0).append("metrics", [{"seed": 0, "step": 200, "temperature": 0.3}])
    assert provenance(run, run.run(0), load(run, 0), "last")["learnt_weights"] == {"entropy_weight": 0.3}


def test_a_card_that_may_have_been_edited_is_not_lost(tmp_path):
    run = make_run(tmp_path / "run")
    export_run(run.path, episodes=0, card=True)
    with pytest.raises(InputError, match="--card"):
        export_run(run.path, episodes=0)


def test_infinite_arguments_of_a_task_stand_in_its_contract_as_text(tmp_path):
    infinite = {"environment_arguments": {"reach": float("inf")}, "hyperparameters": {"bounds": [-float("inf")]}}
    run = make_run(tmp_path / "run", **infinite)
    origin = told(export_run(run.path, episodes=1, card=True).place)["provenance"]
    assert origin["environment_arguments"] == {"reach": "Infinity"}
    assert origin["hyperparameters"] == {"bounds": ["-Infinity"]}


def test_nothing_is_left_of_an_artefact_that_is_not_the_policy(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run")
    write = exporting.write_artefact

    def write_another(folder, policy, *rest):
        parameters = policy.network.parameters
        layers = [layer._replace(bias=layer.bias + 0.01) for layer in parameters.actors[0]]
        parameters = parameters._replace(actors=(tuple(layers),))
        write(folder, Policy(policy.network._replace(parameters=parameters), policy.contract), *rest)

    monkeypatch.setattr(exporting, "write_artefact", write_another)
    with pytest.raises(InputError, match="is not the policy of the run"):
        export_run(run.path, episodes=2)
    assert list((run.path / "export").iterdir()) == []


def test_returns_that_chance_does_not_explain_are_refused():
    noise = np.random.default_rng(0).normal(size=(2, 10))
    check_returns(100 + noise[0], 100 + noise[1])
    with pytest.raises(InputError, match="in closed loop the artefact is not the policy of the run"):
        check_returns(100 + noise[0], 90 + noise[1])
    check_returns(np.array([100.0]), np.array([0.0]))
    check_returns(np.full(5, 100.0), np.full(5, 0.0))  # one episode, played again and again


def test_without_episodes_the_task_is_not_made(tmp_path):
    run = make_run(tmp_path / "run", task="no_such_module:Nothing-v0")
    exported = export_run(run.path, episodes=0)
    assert exported.fields["control_rate_hz"] is None
    assert exported.fields["verification"].keys() == {"observations", "largest_difference"}
    with pytest.raises(InputError, match="needs the module no_such_module"):
        export_run(run.path)


def test_a_module_that_nobody_has_named_is_not_run(tmp_path, monkeypatch):
    (tmp_path / "foreign_task.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    run = make_run(tmp_path / "run", task="foreign_task:Any-v0")
    with pytest.raises(InputError, match="--trust-task"):
        export_run(run.path)
    assert not (tmp_path / "ran").exists()


def test_the_control_rate_is_that_of_the_time_step_or_of_the_pictures():
    task = Follow()
    assert control_rate(task) == 20.0
    task.dt = None  # pyright: ignore[reportAttributeAccessIssue]
    assert control_rate(task) is None
    task.metadata = {"render_fps": 30}
    assert control_rate(task) == 30.0
    task.dt = np.float32(0.25)  # pyright: ignore[reportAttributeAccessIssue]
    assert control_rate(task) == 4.0
    repeating = gymnasium.Wrapper(task)
    repeating.dt = 0.2  # pyright: ignore[reportAttributeAccessIssue]
    assert control_rate(repeating) == 5.0


def test_the_card_has_the_header_of_the_hub_and_the_numbers_of_the_run(tmp_path):
    yaml = pytest.importorskip("yaml")
    run = make_run(tmp_path / "run")
    exported = export_run(run.path, fallback="zero", rate_limit=0.5, episodes=2, card=True)
    _, header, text = (exported.place / "README.md").read_text().split("---\n", 2)
    said = yaml.safe_load(header)
    assert {"reinforcement-learning", "csac", "numpy", "Follow-v0"} <= set(said["tags"])
    (result,) = said["model-index"][0]["results"]
    mean = exported.fields["verification"]["returns"]["mean_return"]
    assert result["metrics"][0]["value"].startswith(f"{mean:.2f} +/- ")
    for words in ("csac train Follow-v0", "| batch_size | `8` |", "20 times a second", "a limited change per step"):
        assert words in text


# Where it is put.


def test_an_older_artefact_is_replaced_and_nothing_else(tmp_path):
    run, place = make_run(tmp_path / "run"), tmp_path / "made"
    link = tmp_path / "link"
    link.symlink_to("made")
    export_run(run.path, place=place, episodes=0)
    (place / "__pycache__").mkdir()  # which Python leaves where the loader was imported
    export_run(run.path, place=link, seed=0, episodes=0, card=True)
    assert link.is_symlink()
    assert told(place)["provenance"]["seed"] == 0
    assert {path.name for path in place.iterdir()} == {"contract.json", "policy.py", "policy.safetensors", "README.md"}
    random_policy(contract()).save(tmp_path / "saved")
    (tmp_path / "five").mkdir()
    (tmp_path / "five" / "contract.json").write_text("5")
    (place / "notes.txt").touch()
    for kept in (place, tmp_path / "saved", tmp_path / "five", run.path):
        before = sorted(kept.rglob("*"))
        with pytest.raises(InputError, match="holds something else than an artefact"):
            export_run(run.path, place=kept, episodes=0)
        assert sorted(kept.rglob("*")) == before
    with pytest.raises(InputError, match="cannot write"):
        export_run(run.path, place=place / "notes.txt", episodes=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["five", "link", "made", "run", "saved"]


# As a user types it.


def csac(line: str) -> int:
    return main(shlex.split(line))


def test_a_run_is_trained_exported_and_described(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sizes: dict[str, Any] = {"batch_size": 8, "actor_hidden_sizes": (8,), "critic_hidden_sizes": (8,)}
    algorithm = CSAC(actor_activation="gelu", layer_norm=True, warmup_steps=64, **sizes)
    train(algorithm, "Follow-v0", steps=64, seeds=1, directory="run", evaluation_interval=64, evaluation_episodes=2)
    policy, given = load("run"), np.random.default_rng(0).uniform(-1, 1, 5).astype(np.float32)
    for name in ("numpy", "c") if HAS_COMPILER else ("numpy",):
        assert csac(f"export run --format {name} --episodes 2 --card --fallback last --rate-limit 0.1") == 0
        said = capsys.readouterr().out
        assert f"run/export/{name}" in said
        assert "2 episodes: mean return" in said
        artefact = open_artefact(f"run/export/{name}")
        np.testing.assert_allclose(artefact.act(given), policy.predict(given)[0], atol=1e-5)
        assert {"README.md", "curve.png"} <= {path.name for path in Path("run/export", name).iterdir()}


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("export run --format torch", "--format"),
        ("export run --seed 7", "no seed 7"),
        ("export run --seed worst", "--seed"),
        ("export run --episodes -1", "--episodes -1"),
        ("export run --out run", "run holds something else than an artefact"),
    ],
)
def test_what_is_typed_wrong_is_told_in_one_line(tmp_path, monkeypatch, capsys, line, complaint):
    monkeypatch.chdir(tmp_path)
    make_run(Path("run"))
    assert csac(line) == 2
    said = capsys.readouterr().err
    assert said.startswith("csac: ")
    assert complaint in said
    assert said.count("\n") == 1
    assert not Path("run/export/numpy").exists()
