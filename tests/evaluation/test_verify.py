"""Out of a run: verified against the policy that was trained, in its place only then, and described."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import numpy as np
import probes
import pytest
from gymnasium.spaces import Box
from policies import ALGORITHMS, algorithm_policy

from csac.algorithms import CSAC
from csac.cli import main
from csac.deploy import writing
from csac.deploy.artefact import open_artefact
from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.choosing import load, step_of_policy
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.deploy.writing import write_artefact
from csac.evaluation import verify
from csac.evaluation.evaluator import evaluate
from csac.evaluation.export import ExportOptions, control_rate, export_run, provenance
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory
from csac.tasks.environment import Environment
from csac.tasks.seeds import FRESH_EVALUATION_SEED
from csac.training.train import train
from csac.types import InputError, Layer, PolicyNetwork

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")


class Follow(gymnasium.Env):
    """Five numbers that wander; the reward is how near the actions are to the first three. 0.05 s a step."""

    observation_space = Box(np.array([-1.0] + 4 * [-np.inf]), np.array([1.0] + 4 * [np.inf]), (5,), np.float64)
    action_space = Box(-0.5, 2.0, (3,), np.float32)
    dt = 0.05

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 5), 0
        return self.place.copy(), {}

    def step(self, action):
        self.steps += 1
        reward = -float(np.abs(self.place[:3] - action).sum())
        self.place = np.clip(self.place + 0.1 * self.np_random.normal(size=5), -1.0, 1.0)
        return self.place.copy(), reward, False, self.steps == 20, {}


gymnasium.register("Follow-v0", entry_point=f"{__name__}:Follow") if "Follow-v0" not in gymnasium.registry else None


def make_run(path: Path, algorithm: str = "csac", task: str = "Follow-v0") -> RunDirectory:
    """A finished run of two seeds that has learnt nothing; seed 1 was better at its last evaluation."""
    manifest = Manifest(
        task=task,
        algorithm=algorithm,
        hyperparameters={"batch_size": 8},
        seeds=(0, 1),
        steps=200,
        steps_done=200,
        commit="0123456",
        command="csac train Follow-v0",
        state="finished",
        versions={"csac": "0.1.0"},
    )
    run = RunDirectory.create(path, manifest)
    run.contract.parent.mkdir()
    policy = algorithm_policy(algorithm)
    policy = Policy(policy.network, dataclasses.replace(policy.contract, task=task))
    policy.contract.save(run.contract)
    for seed in (0, 1):
        for which in ("last", "best"):
            policy.save_layers(run.policy(seed, which))
    rows = [
        {"seed": seed, "step": step, "episode": episode, "return": value + episode, "length": 20, "success": None}
        for step, values in ((100, (6.0, 5.0)), (200, (1.0, 3.0)))
        for seed, value in enumerate(values)
        for episode in range(3)
    ]
    run.append("evaluations", rows)
    return run


QUICK = ExportOptions(episodes=2)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(verify, "RANDOM", 60)
    monkeypatch.setattr(verify, "MOST_RECORDED", 40)


def artefact_of(folder: Path, policy: Policy, network: PolicyNetwork | None = None, **fields):
    """An artefact of `network` under the contract of `policy`."""
    folder.mkdir()
    write_artefact(folder, network or policy.network, ArtefactContract(policy.contract, "numpy", **fields))
    return open_artefact(folder)


def nudged(policy: Policy, by: float, actions: int = 1) -> PolicyNetwork:
    """The network with the biases of its first actions moved."""
    layers = policy.network.parameters.actors[0]
    moved = np.where(np.arange(layers[-1].bias.size) < actions, np.float32(by), np.float32(0.0))
    last = Layer(layers[-1].weight, layers[-1].bias + moved)
    return policy.network._replace(parameters=policy.network.parameters._replace(actors=((*layers[:-1], last),)))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_policys_own_artefact_differs_by_rounding(tmp_path, algorithm):
    policy = algorithm_policy(algorithm)
    recorded = np.random.default_rng(0).normal(size=(100, 5)).astype(np.float32)
    results = verify.compare_actions(artefact_of(tmp_path / "a", policy), policy, recorded)
    assert [result.name for result in results] == ["recorded", "random", "10 times as far", "1,000 times as far"]
    assert [result.observations for result in results] == [40, 60, 60, 60]
    assert all(result.largest <= result.allowed for result in results)
    assert results[0].largest < 2e-6


def test_a_difference_above_a_hundred_thousandth_of_the_range_is_refused(tmp_path):
    policy = algorithm_policy("csac")
    recorded = np.random.default_rng(0).normal(size=(100, 5)).astype(np.float32)
    # tanh moves by at most as much as its argument, which is half of the share of the range.
    close = verify.compare_actions(artefact_of(tmp_path / "close", policy, nudged(policy, 1e-5)), policy, recorded)
    assert 1e-6 < close[0].largest < 1e-5
    with pytest.raises(InputError, match="the numpy artefact is not the policy of the run: on recorded observations"):
        verify.compare_actions(artefact_of(tmp_path / "far", policy, nudged(policy, 1e-4)), policy, recorded)


def test_far_away_an_artefact_may_round_as_the_policy_itself_does(tmp_path):
    policy = algorithm_policy("csac")
    result = verify.compare_actions(artefact_of(tmp_path / "a", policy), policy)[-1]
    assert result.name == "1,000 times as far"
    assert result.allowed == max(1e-5, 10 * result.rounding)


def test_of_two_actors_that_are_valued_alike_either_may_be_chosen(tmp_path):
    # One critic for both that sees no action: the values are equal, and which is first is rounding's to say.
    policy = algorithm_policy("sd3")
    actors, critics = policy.network.parameters.actors, policy.network.parameters.critics
    blind = (Layer(critics[0][0].weight * np.repeat([1.0, 0.0], [5, 3])[:, None], critics[0][0].bias), *critics[0][1:])
    near = (*blind[:-1], Layer(blind[-1].weight, blind[-1].bias + np.float32(1e-9)))
    network = policy.network._replace(parameters=policy.network.parameters._replace(critics=(blind, near)))
    policy = Policy(network, policy.contract)
    swapped = network._replace(parameters=network.parameters._replace(actors=actors[::-1], critics=(near, blind)))
    verify.compare_actions(artefact_of(tmp_path / "a", policy, swapped), policy)


def test_guards_that_differ_are_found(tmp_path):
    from csac.deploy.guards import make_guards

    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, "last", np.full(5, -1.0), np.full(5, 1.0), 3, 0.05)
    artefact = artefact_of(tmp_path / "a", policy, guards=chosen)
    results = verify.compare_actions(artefact, policy)
    assert results[-1].name == "broken"
    assert 0.0 < results[0].largest < 1e-5  # the policy's own actions pass, and differ by rounding
    artefact.contract = dataclasses.replace(artefact.contract, guards=dataclasses.replace(chosen, watchdog=4))
    with pytest.raises(InputError, match="is not the policy of the run"):
        verify.compare_actions(artefact, policy)


def test_in_closed_loop_the_episodes_are_those_of_csac_evaluate(tmp_path):
    policy = algorithm_policy("csac")
    policy = Policy(policy.network, dataclasses.replace(policy.contract, task="Follow-v0"))
    recording = verify.record(policy, "Follow-v0", episodes=3)
    expected = evaluate(policy, "Follow-v0", 3, FRESH_EVALUATION_SEED)
    np.testing.assert_array_equal(recording.returns, expected)
    assert recording.observations.shape == (3 * 20, 5)  # and no row of the seven episodes that a batch has room for
    assert recording.observations.any(axis=1).all()
    returns = verify.compare_returns(artefact_of(tmp_path / "a", policy), recording, "Follow-v0")
    np.testing.assert_allclose(returns.artefact, expected, rtol=1e-4)


class Still(gymnasium.Env):
    """Nothing but zeros, for two to five steps."""

    observation_space = Box(-np.inf, np.inf, (5,), np.float64)
    action_space = Box(-0.5, 2.0, (3,), np.float32)

    def __init__(self, farthest: float = 1.0) -> None:
        assert farthest > 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 6))
        return np.zeros(5), {}

    def step(self, action):
        self.left -= 1
        return np.zeros(5), 1.0, self.left == 0, False, {}


gymnasium.register("Still-v0", entry_point=f"{__name__}:Still") if "Still-v0" not in gymnasium.registry else None


def test_observations_that_are_all_zero_are_observations(tmp_path):
    recording = verify.record(algorithm_policy("csac"), "Still-v0", episodes=8)
    assert {*recording.returns} == {2.0, 3.0}  # they do not end together
    # One row for each step that an episode makes, and none once it has ended.
    np.testing.assert_array_equal(recording.observations, np.zeros((int(recording.returns.sum()), 5)))
    make_run(tmp_path / "run", task="Still-v0")
    options = dataclasses.replace(QUICK, fallback="zero", observation_range="recorded")
    assert export(tmp_path / "run", options=options).returns is not None


def test_numbers_that_did_not_vary_have_no_recorded_range(tmp_path):
    make_run(tmp_path / "run", task="Still-v0")
    options = dataclasses.replace(QUICK, fallback="zero", observation_range="recorded", range_margin=0.0)
    exported = export(tmp_path / "run", options=options)
    # A range of zero and nothing else would have the last bit of a sensor make every step bad.
    largest = np.full(5, np.finfo(np.float32).max)
    np.testing.assert_array_equal(exported.contract.guards.observation_low, -largest)
    np.testing.assert_array_equal(exported.contract.guards.observation_high, largest)
    assert exported.notes == ("5 of 5 numbers of the observation did not vary in the episodes and have no range",)
    make_run(tmp_path / "varied")
    assert export(tmp_path / "varied", options=options).notes == ()


def test_infinite_arguments_of_a_task_stand_in_its_contract_as_text(tmp_path):
    def refuse(word: str) -> None:
        raise ValueError(word)

    run = make_run(tmp_path / "run", task="Still-v0")
    arguments = {"farthest": float("inf")}
    run.update_manifest(environment_arguments=arguments, hyperparameters={"bounds": [float("-inf"), 1.0, float("nan")]})
    formats = ("numpy", "onnx") if importlib.util.find_spec("onnxruntime") else ("numpy",)
    options = dataclasses.replace(QUICK, card=True)
    for one in export_run(tmp_path / "run", formats, options=options):
        told = json.loads((one.place / "contract.json").read_text(), parse_constant=refuse)
        assert told["provenance"]["environment_arguments"] == {"farthest": "Infinity"}
        assert told["provenance"]["hyperparameters"] == {"bounds": ["-Infinity", 1.0, "NaN"]}
        assert open_artefact(one.place).contract.provenance["environment_arguments"] == {"farthest": "Infinity"}


def test_returns_that_chance_does_not_explain_are_refused(tmp_path):
    policy = algorithm_policy("csac")
    recording = verify.record(policy, "Follow-v0", episodes=10)
    worse = artefact_of(tmp_path / "a", policy, nudged(policy, 50.0, actions=3))  # always the highest action
    with pytest.raises(InputError, match="in closed loop the numpy artefact is not the policy of the run"):
        verify.compare_returns(worse, recording, "Follow-v0")


def test_chance_is_welchs():
    from scipy import stats

    first, second = np.array([1.0, 2.0, 3.0]), np.array([3.0, 5.0, 7.5])
    expected = stats.ttest_ind(first, second, equal_var=False)[1]
    assert verify.Returns(first, second).chance == pytest.approx(expected, rel=1e-3)
    assert verify.Returns(np.full(3, 100.0), np.full(3, 100.001)).chance == 1.0
    assert verify.Returns(np.full(3, 100.0), np.full(3, 101.0)).chance == 0.0
    assert verify.Returns(np.array([1.0]), np.array([9.0])).chance == 1.0


def test_one_episode_that_is_played_again_and_again_proves_nothing():
    """A chaotic task whose episodes all begin in one state goes another way from the last bit on, in all of them."""
    assert verify.Returns(np.full(3, 100.0), np.full(3, 10.0), starts_alike=True).chance == 1.0
    differing = np.array([100.0, 101.0, 99.0]), np.array([10.0, 11.0, 9.0])  # by noise: these are three
    assert verify.Returns(*differing, starts_alike=True).chance == verify.Returns(*differing).chance < 1e-3
    policy = algorithm_policy("csac")
    assert not verify.record(policy, "Follow-v0", episodes=3).starts_alike


def test_whether_episodes_begin_alike_is_recorded():
    network = algorithm_policy("csac", ((None, (1,)),), (1,)).network
    contract = Contract("Probe-v0", "csac", "relu", "tanh_gaussian", *Environment(probes.ConstantReward).contract_parts)
    assert verify.record(Policy(network, contract), probes.ConstantReward, episodes=3).starts_alike


def export(*arguments, **options):
    return next(export_run(*arguments, **options))


def test_the_contract_says_all_that_whoever_runs_it_has_to_know(tmp_path):
    make_run(tmp_path / "run")
    place = export(tmp_path / "run", options=QUICK).place
    told = json.loads((place / "contract.json").read_text())
    assert place == tmp_path / "run" / "export" / "numpy"
    assert told["observation_parts"] == [{"key": None, "shape": [5]}]
    assert told["observation_low"] == [-1.0, None, None, None, None]
    assert told["action_low"] == [-0.5] * 3
    assert told["control_rate_hz"] == 20.0
    origin = told["provenance"]
    assert (origin["task"], origin["algorithm"], origin["seed"], origin["checkpoint"]) == (
        "Follow-v0",
        "csac",
        1,
        "last",
    )
    assert (origin["steps"], origin["commit"], origin["command"]) == (200, "0123456", "csac train Follow-v0")
    # Three episodes of 3, 4, 5: their mean, and t(2) = 4.303 times 1 / sqrt(3) around it.
    assert (origin["evaluation"]["step"], origin["evaluation"]["mean_return"]) == (200, 4.0)
    assert origin["evaluation"]["standard_deviation"] == 1.0
    assert origin["evaluation"]["interval_95"] == pytest.approx([4 - 4.3027 / 3**0.5, 4 + 4.3027 / 3**0.5], rel=1e-4)
    assert (origin["all_seeds"]["seeds"], origin["all_seeds"]["mean_return"]) == (2, 3.0)
    assert origin["all_seeds"]["interval_95"] is None  # two seeds have none
    assert told["verification"]["returns"]["episodes"] == 2
    assert told["verification"]["largest_difference"] < 1e-5


def test_the_best_policy_of_a_seed_comes_with_its_own_evaluation(tmp_path):
    make_run(tmp_path / "run")
    origin = export(tmp_path / "run", seed=0, which="best", options=QUICK).contract.provenance
    assert (origin["seed"], origin["steps"]) == (0, 100)
    assert origin["evaluation"]["mean_return"] == 7.0


def test_a_policy_is_as_old_as_its_file_says_and_not_as_its_run(tmp_path):
    """After a stop between two evaluations, and a kill: the manifest's count moves at other times than the policies."""
    run = make_run(tmp_path / "run")
    saved = load(run.path, seed=0)
    for path, step in ((run.policy(0), 230), (run.policy(0, "best"), 100)):
        Policy(saved.network, saved.contract, step=step).save_layers(path)
    origin = provenance(run, 0, "last")
    assert (origin["steps"], origin["evaluation"]["step"]) == (230, 200)
    assert step_of_policy(run, 0, "last") == 230
    run.policy(0).write_bytes(run.policy(0, "best").read_bytes())
    for which in ("last", "best"):
        origin = provenance(run, 0, which)
        assert (origin["steps"], origin["evaluation"]["step"], origin["evaluation"]["mean_return"]) == (100, 100, 7.0)


def test_seeds_that_failed_count_in_no_mean_and_end_where_they_failed(tmp_path):
    run = make_run(tmp_path / "run")
    run.update_manifest(failures={0: "step 120: its reward is nan"})
    origin = provenance(RunDirectory.open(run.path), 1, "last")
    assert origin["all_seeds"]["seeds"] == 1
    assert origin["all_seeds"]["mean_return"] == 4.0  # that of seed 1 alone: 3, 4 and 5
    assert origin["steps"] == 200
    assert origin["failure"] is None
    failed = provenance(RunDirectory.open(run.path), 0, "last")
    assert (failed["steps"], failed["failure"]) == (120, "step 120: its reward is nan")
    run.update_manifest(failures={0: "step 120: its reward is nan", 1: "lost"})
    origin = provenance(RunDirectory.open(run.path), 1, "last")
    assert origin["all_seeds"] == {}
    assert origin["steps"] == 200  # nobody says when it was


def test_weights_that_are_learnt_come_with_what_they_had_become(tmp_path):
    run = make_run(tmp_path / "run")
    run.update_manifest(hyperparameters={"entropy_weight": "auto", "relative_entropy_weight": 0.5})
    rows = [(0, 100, 0.4), (1, 100, 0.3), (0, 200, 0.2), (1, 200, 0.1)]
    run.append("metrics", [{"seed": seed, "step": step, "entropy_weight": value} for seed, step, value in rows])

    exported = export(tmp_path / "run", seed=0, which="last", options=dataclasses.replace(QUICK, card=True))

    assert exported.contract.provenance["learnt_weights"] == {"entropy_weight": 0.2}
    assert provenance(RunDirectory.open(run.path), 0, "best")["learnt_weights"] == {"entropy_weight": 0.4}
    card = (exported.place / "README.md").read_text()
    assert "| entropy_weight | `auto`, at last 0.2 |" in card
    assert "| relative_entropy_weight | `0.5` |" in card
    run.update_manifest(hyperparameters={"temperature": "automatic"})  # that of SAC, of which metrics.csv says nothing
    assert provenance(RunDirectory.open(run.path), 0, "last")["learnt_weights"] == {}


@needs_compiler
def test_every_format_at_once_each_in_a_folder(tmp_path):
    pytest.importorskip("onnxruntime")
    make_run(tmp_path / "run", "sd3")
    made = list(export_run(tmp_path / "run", ("numpy", "onnx", "c"), place=tmp_path / "out", options=QUICK))
    assert [one.place for one in made] == [tmp_path / "out" / name for name in ("numpy", "onnx", "c")]
    observation = np.linspace(-1, 1, 5)
    actions = [open_artefact(one.place).act(observation) for one in made]
    np.testing.assert_allclose(actions, np.broadcast_to(actions[0], (3, 3)), atol=1e-5)


def test_nothing_is_left_of_an_artefact_that_is_not_the_policy(tmp_path, monkeypatch):
    make_run(tmp_path / "run")
    encode = writing.tensors.encode
    monkeypatch.setattr(
        writing.tensors, "encode", lambda arrays: encode({name: 1.01 * array for name, array in arrays.items()})
    )
    with pytest.raises(InputError, match="is not the policy of the run"):
        export(tmp_path / "run", options=QUICK)
    assert list((tmp_path / "run" / "export").iterdir()) == []


def test_a_range_that_was_recorded_has_its_margin(tmp_path):
    run = make_run(tmp_path / "run")
    options = dataclasses.replace(QUICK, fallback="zero", observation_range="recorded", range_margin=0.25)
    guards = export(tmp_path / "run", options=options).contract.guards
    seen = verify.record(
        Policy.load(run.policy(1), algorithm_policy("csac").contract), "Follow-v0", episodes=2
    ).observations
    least, most = seen.min(axis=0), seen.max(axis=0)
    assert guards.observation_low is not None
    assert guards.observation_high is not None
    np.testing.assert_allclose(guards.observation_low, least - 0.25 * (most - least), rtol=1e-5)
    np.testing.assert_allclose(guards.observation_high, most + 0.25 * (most - least), rtol=1e-5)


def test_a_range_of_bounds_is_the_tasks(tmp_path):
    make_run(tmp_path / "run")
    options = dataclasses.replace(QUICK, fallback="zero", observation_range="bounds")
    guards = export(tmp_path / "run", options=options).contract.guards
    assert guards.observation_low is not None
    assert guards.observation_low[0] == -1.0
    assert guards.observation_low[1] == np.finfo(np.float32).min


def test_a_rate_limit_brings_the_fallback_that_a_range_and_a_watchdog_need(tmp_path):
    make_run(tmp_path / "run")
    options = dataclasses.replace(QUICK, rate_limit=0.1, watchdog=5, observation_range="bounds")
    guards = export(tmp_path / "run", options=options).contract.guards
    assert (guards.fallback, guards.watchdog) == ("last", 5)
    assert guards.observation_low is not None
    assert guards.observation_low[0] == -1.0


def test_without_episodes_the_task_is_not_made(tmp_path):
    make_run(tmp_path / "run", task="no_such_module:Nothing-v0")
    exported = export(tmp_path / "run", options=ExportOptions(episodes=0))
    assert exported.returns is None
    assert exported.contract.observation_low is None
    assert exported.contract.control_rate is None
    with pytest.raises(InputError, match="needs the module no_such_module"):
        export(tmp_path / "run", options=QUICK)


def test_a_module_that_nobody_has_named_is_not_run(tmp_path, monkeypatch):
    (tmp_path / "foreign_task.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    make_run(tmp_path / "run", task="foreign_task:Any-v0")
    with pytest.raises(InputError, match="--trust-task"):
        export(tmp_path / "run", options=QUICK)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": "int8"}, "for C alone"),
        ({"observation_range": "recorded"}, "needs a --fallback"),
        ({"observation_range": "recorded", "fallback": "zero", "episodes": 0}, "needs episodes"),
        ({"watchdog": 2}, "need a --fallback"),
        ({"range_margin": -1.0}, "0 or more"),
        ({"range_margin": 0.5}, "give --observation-range recorded with it"),
        ({"range_margin": 0.5, "fallback": "zero", "observation_range": "bounds"}, "range recorded with it"),
        ({"noise_seed": -1}, "from 0 to"),
        ({"fallback": "1,2"}, "2 numbers where the task has 3 actions"),
    ],
)
def test_options_that_cannot_be_are_refused_before_anything_is_done(tmp_path, changes, message):
    make_run(tmp_path / "run")
    with pytest.raises(InputError, match=message):
        export(tmp_path / "run", options=dataclasses.replace(QUICK, **changes))
    assert not (tmp_path / "run" / "export").exists()


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_package_that_is_not_installed_is_missed_before_anything_is_done(tmp_path, monkeypatch, package):
    pytest.importorskip("onnxruntime")
    make_run(tmp_path / "run")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=f"needs the package {package}: pip install"):
        export(tmp_path / "run", ("numpy", "onnx"), options=QUICK)
    assert not (tmp_path / "run" / "export").exists()


@pytest.mark.parametrize("algorithm", ["td3", "sd3"])
def test_what_has_no_spread_cannot_be_sampled(tmp_path, algorithm):
    make_run(tmp_path / "run", algorithm)
    with pytest.raises(InputError, match=f"the policies of {algorithm} have no spread"):
        export(tmp_path / "run", options=dataclasses.replace(QUICK, noise_seed=0))


def test_the_control_rate_is_that_of_the_time_step_or_of_the_pictures():
    task = Follow()
    assert control_rate(task) == 20.0
    task.dt = None  # pyright: ignore[reportAttributeAccessIssue]
    assert control_rate(task) is None
    task.dt = 1e9  # a rate of nothing that six decimals hold
    assert control_rate(task) is None
    task.metadata = {"render_fps": 30}
    assert control_rate(task) == 30.0


# As a user types it.


def csac(line: str) -> int:
    return main(shlex.split(line))


def test_a_run_is_trained_exported_and_described(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    algorithm = CSAC(batch_size=8, actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), warmup_steps=64)
    train(algorithm, "Follow-v0", steps=64, seeds=1, directory="run", evaluation_interval=64, evaluation_episodes=2)
    formats = "numpy,c" if shutil.which("cc") else "numpy"
    assert csac(f"export run --format {formats} --episodes 2 --card --fallback last --rate-limit 0.1 --stochastic") == 0
    told = capsys.readouterr().out
    assert "NumPy: run/export/numpy" in told
    assert "2 episodes: mean return" in told
    policy = Policy.load(
        "run/policy/seed_0.safetensors", artefact_contract := open_artefact("run/export/numpy").contract.policy
    )
    assert artefact_contract.algorithm == "csac"
    given = np.random.default_rng(0).uniform(-1, 1, (10, 5)).astype(np.float32)
    noise = np.zeros(3, np.float32)
    for name in formats.split(","):
        artefact = open_artefact(f"run/export/{name}")
        np.testing.assert_allclose(artefact.act(given[0], noise), policy.predict(given[0])[0], atol=1e-5)
        names = {path.name for path in Path("run/export", name).iterdir()}
        assert {"README.md", "curve.png", "contract.json", artefact.contract.file} <= names


def test_the_card_has_the_header_of_the_hub_and_the_numbers_of_the_run(tmp_path):
    yaml = pytest.importorskip("yaml")
    make_run(tmp_path / "run")
    exported = export(tmp_path / "run", options=dataclasses.replace(QUICK, card=True, rate_limit=0.5, fallback="zero"))
    _, header, text = (exported.place / "README.md").read_text().split("---\n", 2)
    told = yaml.safe_load(header)
    assert told["library_name"] == "csac"
    assert {"reinforcement-learning", "csac", "numpy", "Follow-v0"} <= set(told["tags"])
    (result,) = told["model-index"][0]["results"]
    assert result["dataset"]["name"] == "Follow-v0"
    mean = exported.contract.verification["returns"]["mean_return"]
    assert result["metrics"][0]["value"].startswith(f"{mean:.2f} +/- ")
    for words in ("csac train Follow-v0", "| batch_size | `8` |", "20 times a second", "fallback zero, limited change"):
        assert words in text


def test_an_export_says_that_its_seed_failed_and_was_trained_otherwise(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = make_run(Path("run"))
    run.update_manifest(failures={0: "step 120: its reward is nan"}, perturbations=["action_noise=0.1@100"])
    failed = "note: seed 0 failed at step 120: its reward is nan; this is the policy that it has left\n"
    perturbed = "note: not perturbed, unlike its training (action_noise=0.1@100): csac evaluate --perturb tests it so\n"
    assert csac("export run --seed 0 --episodes 1") == 0
    assert capsys.readouterr().out.endswith(failed + perturbed)
    assert csac("export run --seed 1 --no-rollouts") == 0  # sound, and not tested on the task at all
    assert "note:" not in capsys.readouterr().out


@needs_compiler
@pytest.mark.parametrize("broken", ["arm-none-eabi-gcc", "arm-none-eabi-size"])
def test_an_export_does_without_the_size_of_a_target_whose_tools_do_not_work(tmp_path, monkeypatch, broken):
    make_run(tmp_path / "run")
    tools = tmp_path / "tools"
    tools.mkdir()
    # A compiler without the headers of a C library, or this machine's, and a lister that fails.
    compiler = '#!/bin/sh\nfor last; do :; done\n: > "$last"; : > "${last%.o}.su"\n'
    failing = "#!/bin/sh\necho 'fatal error: no newlib here' >&2\nexit 1\n"
    for name, script in (("arm-none-eabi-gcc", compiler), ("arm-none-eabi-size", "#!/bin/sh\n")):
        (tools / name).write_text(failing if name == broken else script)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tools), prepend=":")
    exported = export(tmp_path / "run", ("c",), options=QUICK)
    (note,) = exported.notes
    assert note.startswith(f"no size for Cortex-M4: {broken} ")
    assert note.endswith("fatal error: no newlib here")
    assert "Cortex-M4" not in {size.target for size in exported.sizes}


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("export", "DIR is missing"),
        ("export nowhere", "nowhere does not exist"),
        ("export run --format torch", "no format is called 'torch': choose numpy, onnx, c"),
        ("export run --format numpy,numpy", "give each format once"),
        ("export run --seed 7", "run has no policy of seed 7; it has those of 0, 1"),
        ("export run --seed worst", "--seed worst: give best, or the label of a seed"),
        ("export run --episodes 0", "--episodes 0: give at least 1, or --no-rollouts"),
        ("export run --weights int4", "--weights: 'int4' is not one of"),
        ("export run --out run", "run holds something else than an artefact"),
        ("export run --rate-limit 2", "a rate limit of 2.0"),
        ("export run --noise-seed 0", "--noise-seed 0 is of noise that --stochastic samples with: give both"),
        ("export run --range-margin 0.5", "a range margin widens what the episodes have shown"),
        ("export run --fallback zero --watchdog 16777217", "a watchdog that waits for 16,777,217 bad observations"),
    ],
)
def test_what_is_typed_wrong_is_told_in_one_line(tmp_path, monkeypatch, capsys, line, complaint):
    monkeypatch.chdir(tmp_path)
    make_run(Path("run"))
    assert csac(line) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"csac: {complaint}")
    assert told.count("\n") == 1
