"""The policy that leaves: known answers, Stable-Baselines3's shapes, files that are refused when damaged."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from manifests import make_set
from policies import DICT_PARTS, contract, random_layers, random_network, random_policy

from csac.deploy import contract as contracts
from csac.deploy.contract import Contract, read_json, sha256_of, write_with_checksum
from csac.deploy.policy import Policy
from csac.record.files import write_atomically
from csac.types import Activation, InputError, Layer, Normaliser, PolicyNetwork, PolicyParameters, Spec


def hand_made(activation: Activation = "relu", log_std_bias=0.0, **settings) -> Policy:
    """Hidden: [x0 - x1, x1 + 1]. Mean: hidden0 + 2 hidden1 - 3. Log std: hidden0 + bias."""
    layers = (
        Layer(np.array([[1.0, 0.0], [-1.0, 1.0]]), np.array([0.0, 1.0])),
        Layer(np.array([[1.0, 1.0], [2.0, 0.0]]), np.array([-3.0, log_std_bias])),
    )
    return Policy(PolicyNetwork(PolicyParameters((layers,)), activation), contract(activation=activation, **settings))


def test_the_deterministic_action_is_the_tanh_of_the_mean():
    # [1, 3]: hidden = relu([-2, 4]) = [0, 4], mean = 0 + 8 - 3 = 5. [2, -1]: hidden = [3, 0], mean = 0.
    actions = hand_made().act(np.array([[1.0, 3.0], [2.0, -1.0]], np.float32))
    np.testing.assert_allclose(actions, [[math.tanh(5.0)], [0.0]], atol=1e-7)
    assert actions.dtype == np.float32


def test_tanh_layers_are_tanh_layers():
    # [0.5, 0]: hidden = tanh([0.5, 1]), mean = tanh(0.5) + 2 tanh(1) - 3.
    mean = math.tanh(0.5) + 2 * math.tanh(1.0) - 3.0
    action = hand_made("tanh").act(np.array([[0.5, 0.0]], np.float32))
    np.testing.assert_allclose(action, [[math.tanh(mean)]], rtol=1e-6)


def test_a_stochastic_action_moves_by_the_clipped_standard_deviation():
    # [2, -1]: hidden = [3, 0], mean = 0, log std = 3 + bias: 1 as it is, 2 after clipping 13, -20 after clipping -47.
    observation, noise = np.array([[2.0, -1.0]], np.float32), np.array([[0.1]], np.float32)
    for bias, log_std in ((-2.0, 1.0), (10.0, 2.0), (-50.0, -20.0)):
        action = hand_made(log_std_bias=bias).act(observation, deterministic=False, noise=noise)
        np.testing.assert_allclose(action, [[math.tanh(0.1 * math.exp(log_std))]], rtol=1e-6)


def test_stochastic_actions_differ():
    policy = random_policy(contract())
    first, second = (policy.predict(np.zeros(2), deterministic=False)[0] for _ in range(2))
    assert first != second


def test_actions_leave_on_the_scale_of_the_environment():
    # The mean is 0 at [2, -1], the middle of the bounds; at [1, 3] it is 5, almost the upper bound.
    policy = hand_made(low=2.0, high=6.0)
    assert policy.predict(np.array([2.0, -1.0]))[0] == pytest.approx([4.0])
    assert policy.predict(np.array([1.0, 3.0]))[0] == pytest.approx([4.0 + 2.0 * math.tanh(5.0)])


BOUND = st.floats(-(2.0**100), 2.0**100, width=32)


@given(st.tuples(BOUND, BOUND).map(sorted), hnp.arrays(np.float32, (3, 1), elements=st.floats(-1, 1, width=32)))
def test_scaled_actions_never_leave_the_bounds(bounds, actions):
    low, high = bounds
    scaled = contract(low=low, high=high).to_environment(actions)
    assert (scaled >= low).all()
    assert (scaled <= high).all()


def test_the_ends_of_the_action_range_are_the_bounds():
    agreement = contract(action_shape=(2, 2), low=-0.1, high=0.7)
    scaled = agreement.to_environment(np.array([-1.0, 1.0, 0.0, -2.0], np.float32))
    np.testing.assert_allclose(scaled, [[-0.1, 0.7], [0.3, -0.1]], rtol=1e-6)


def test_all_that_reset_returns_is_no_observation():
    with pytest.raises(InputError, match=r"all that reset\(\) returns: write observation, info = env\.reset"):
        random_policy(contract(((None, (4,)),), (2,))).predict((np.zeros(4), {}))


@pytest.mark.parametrize("action_shape", [(), (1,), (3,), (2, 3)])
@pytest.mark.parametrize("observation_shape", [(), (1,), (4,), (2, 3)])
def test_predict_has_the_shapes_of_stable_baselines3(observation_shape, action_shape):
    policy = random_policy(contract(((None, observation_shape),), action_shape))
    batch = np.random.default_rng(0).normal(size=(5, *observation_shape))
    single, state = policy.predict(batch[2], state="kept", episode_start=np.ones(1, bool), deterministic=True)
    together, _ = policy.predict(batch)
    assert single.shape == action_shape
    assert together.shape == (5, *action_shape)
    assert single.dtype == together.dtype == np.float32
    assert state == "kept"
    np.testing.assert_allclose(single, together[2], rtol=1e-5, atol=1e-6)


def test_predict_takes_dicts_dicts_of_batches_and_flat_observations():
    policy = random_policy(contract(DICT_PARTS, (2,)))
    observation = {"speed": 0.5, "position": [[0.3, 0.4]], "achieved": [0.1, 0.2]}
    action, _ = policy.predict(observation)
    assert action.shape == (2,)
    batched, _ = policy.predict({key: np.array([value]) for key, value in observation.items()})
    assert batched.shape == (1, 2)
    np.testing.assert_array_equal(batched[0], action)
    np.testing.assert_array_equal(policy.predict(np.array([0.1, 0.2, 0.3, 0.4, 0.5]))[0], action)


@pytest.mark.parametrize(
    ("parts", "observation", "message"),
    [
        (((None, (3,)),), np.zeros(4), r"shape \(4,\); the policy takes \(3,\)"),
        (((None, (3,)),), np.zeros((2, 2, 3)), r"shape \(2, 2, 3\)"),
        ((("a", (3,)), ("b", (2,))), {"a": np.zeros((4, 3)), "b": np.zeros(2)}, "batches of one size"),
        (((None, (3,)),), ["a", "b", "c"], "not an array of numbers"),
        (((None, (3,)),), {"speed": 1.0}, r"the keys \['speed'\]; the policy takes one array"),
        (DICT_PARTS, {"speed": 1.0}, r"the keys \['speed'\]; the policy takes \['achieved', 'position', 'speed'\]"),
        (
            DICT_PARTS,
            {"speed": 1.0, "position": [[1, 2]], "achieved": [1]},
            r"observation\['achieved'\] has shape \(1,\)",
        ),
        (DICT_PARTS, np.zeros(4), "takes a dict of"),
    ],
)
def test_an_observation_of_another_task_is_refused(parts, observation, message):
    with pytest.raises(InputError, match=message):
        random_policy(contract(parts)).predict(observation)


def test_a_word_does_not_choose_between_the_mean_and_a_sample():
    with pytest.raises(InputError, match="deterministic is True or False, not 'no'"):
        random_policy(contract()).predict(np.zeros(2), deterministic="no")  # pyright: ignore[reportArgumentType]


def test_the_policy_keeps_its_own_copy_of_the_layers():
    network, agreement = random_network(Spec(2, 1)), contract()
    policy = Policy(network, agreement)
    before, _ = policy.predict(np.ones(2))
    for layer in network.parameters.actors[0]:
        layer.weight[:] = 0.0
        layer.bias[:] = 0.0
    np.testing.assert_array_equal(policy.predict(np.ones(2))[0], before)


@pytest.mark.parametrize(
    "change",
    [
        {"actors": (random_layers(2, 8, 8),)},
        {"actors": (random_layers(3, 8, 2),)},
        {"actors": ()},
        {"actors": (random_layers(2, 2), random_layers(2, 2))},
        {"normaliser": Normaliser(np.zeros(3), np.ones(3), np.array(1.0))},
    ],
)
def test_layers_that_do_not_fit_are_refused(change):
    network = random_network(Spec(2, 1))
    with pytest.raises(InputError, match="do not take 2 numbers and give 1"):
        Policy(network._replace(parameters=network.parameters._replace(**change)), contract())


def test_a_clipped_gaussian_without_its_spread_is_refused():
    with pytest.raises(InputError, match="do not take 2 numbers and give 1"):
        Policy(PolicyNetwork(PolicyParameters((random_layers(2, 1),)), "tanh", "clipped_gaussian"), CLIPPED)


def clipped_gaussian(log_std: float = 0.0) -> Policy:
    """Inputs: (x - [1, 0]) / [2, 1], clipped to ±3. Mean: input0 + input1."""
    normaliser = Normaliser(np.array([1.0, 0.0]), np.array([2.0, 1.0]), np.array(3.0))
    layer = Layer(np.array([[1.0], [1.0]]), np.zeros(1))
    parameters = PolicyParameters(((layer,),), normaliser=normaliser, log_std=np.full(1, log_std))
    return Policy(PolicyNetwork(parameters, "tanh", "clipped_gaussian"), CLIPPED)


CLIPPED = contract(activation="tanh", head="clipped_gaussian")


def test_a_clipped_gaussian_normalises_and_clips():
    # [2, 0.25]: 0.5 + 0.25. [3, 9]: 1 + 3, the second input clipped to 3, and the action to 1. [-9, 0]: -3, so -1.
    actions = clipped_gaussian().act(np.array([[2.0, 0.25], [3.0, 9.0], [-9.0, 0.0]], np.float32))
    np.testing.assert_allclose(actions, [[0.75], [1.0], [-1.0]], atol=1e-7)


def test_a_clipped_gaussian_adds_its_spread_before_clipping():
    # Mean 0, std 2: noise of 0.25 gives 0.5, noise of -3 gives -6, clipped to -1.
    noise = np.array([[0.25], [-3.0]], np.float32)
    actions = clipped_gaussian(np.log(2.0)).act(np.array([[1.0, 0.0]] * 2, np.float32), False, noise)
    np.testing.assert_allclose(actions, [[0.5], [-1.0]], atol=1e-6)


def two_actors() -> Policy:
    """Actors x0 and -x0, beneath the tanh; critic 0 values x1, critic 1 values half of its action."""
    actors = [(Layer(np.array([[sign], [0.0]]), np.zeros(1)),) for sign in (1.0, -1.0)]
    critics = [(Layer(np.array(weight)[:, None], np.zeros(1)),) for weight in ([0.0, 1.0, 0.0], [0.0, 0.0, 0.5])]
    return Policy(PolicyNetwork(PolicyParameters(tuple(actors), tuple(critics)), head="tanh"), contract(head="tanh"))


def test_of_two_actors_each_row_gets_the_action_valued_more():
    # Values: [1, 0]: 0 against -tanh(1) / 2, so the first actor. [-1, 0]: 0 against tanh(1) / 2, so the second.
    # [0, 0]: 0 against 0, so the first. [1, -9]: -9 against -tanh(1) / 2, so the second.
    observations = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [1.0, -9.0]], np.float32)
    expected = [[math.tanh(1.0)], [math.tanh(1.0)], [0.0], [-math.tanh(1.0)]]
    for deterministic in (True, False):
        np.testing.assert_allclose(two_actors().act(observations, deterministic), expected, atol=1e-7)


@pytest.mark.parametrize("step", [None, 0, 12_345])
@pytest.mark.parametrize("make", [clipped_gaussian, two_actors, hand_made])
def test_a_policy_is_the_same_after_saving_and_loading(tmp_path, make, step):
    policy = Policy(make().network, make().contract, step=step)
    for name in ("one", "other"):
        policy.save(tmp_path / name)
    again = Policy.load(tmp_path / "one" / "policy.safetensors")
    assert again.step == step
    observations, noise = np.random.default_rng(2).normal(size=(7, 2)).astype(np.float32), np.ones((7, 1), np.float32)
    for deterministic in (True, False):
        before, after = (one.act(observations, deterministic, noise) for one in (policy, again))
        np.testing.assert_array_equal(after, before)
    assert again.contract.fields() == policy.contract.fields()
    for file in ("contract.json", "policy.safetensors"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes()


@pytest.mark.parametrize("damage", [lambda whole: whole[:-4], lambda whole: whole[:5], lambda whole: b"x" * 100])
def test_a_damaged_policy_is_refused_even_with_a_checksum_of_its_own(tmp_path, damage):
    path = tmp_path / "policy.safetensors"
    random_policy(contract()).save(tmp_path)
    content = damage(path.read_bytes())
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"policy\.safetensors does not match its checksum"):
        Policy.load(path)
    write_with_checksum(path, content)
    with pytest.raises(InputError, match=r"policy\.safetensors is not a policy of contract\.json"):
        Policy.load(path)


def test_a_policy_of_another_task_is_refused(tmp_path):
    random_policy(contract()).save(tmp_path)
    path = tmp_path / "policy.safetensors"
    write_with_checksum(path, path.read_bytes(), contract(((None, (3,)),)).fields())
    with pytest.raises(InputError, match="do not take 3 numbers"):
        Policy.load(path)


def test_whenever_a_writer_is_killed_its_files_match(tmp_path, monkeypatch):
    """The contract is written first: killed after it, the older policy is still one of its own."""
    path, older = tmp_path / "last.safetensors", random_policy(contract(), 1)
    older.write(path)
    random_policy(contract(), 9).write(tmp_path / "best.safetensors")

    def killed(path: Path, data: bytes) -> None:
        if path.suffix == ".safetensors":
            raise KeyboardInterrupt
        write_atomically(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(contracts, "write_atomically", killed)
        for seed in (2, 3):
            with pytest.raises(KeyboardInterrupt):
                random_policy(contract(), seed).write(path)
    given = np.ones((1, 2), np.float32)
    np.testing.assert_array_equal(Policy.load(path).act(given), older.act(given))
    newer = random_policy(contract(), 4)
    newer.write(path)
    np.testing.assert_array_equal(Policy.load(path).act(given), newer.act(given))
    Policy.load(tmp_path / "best.safetensors")
    checksums = json.loads((tmp_path / "contract.json").read_text())["sha256"]
    assert checksums == {name: sha256_of(tmp_path / name) for name in ("last.safetensors", "best.safetensors")}
    path.write_bytes(older.encode())
    with pytest.raises(InputError, match="does not match its checksum"):
        Policy.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"schema_version": 1},
        {"activation": "swish"},
        {"critic_activation": "swish"},
        {"head": None},
        {"observation_parts": []},
        {"observation_parts": [{"key": None, "shape": [2.5]}]},
        {"observation_parts": [{"key": "b", "shape": [1]}, {"key": "a", "shape": [1]}]},
        {"observation_parts": [{"shape": [2]}]},
        {"action_shape": [2]},
        {"action_low": [float("nan")]},
        {"action_low": [2.0]},
        {"action_low": [-1e300]},
        {"action_high": ["far"]},
    ],
)
def test_a_contract_that_is_not_of_the_schema_is_refused(tmp_path, change):
    path = tmp_path / "contract.json"
    random_policy(contract()).save(tmp_path)
    fields = json.loads(path.read_text())
    path.write_text(json.dumps(fields | change))
    with pytest.raises(InputError, match="not a policy contract"):
        Contract.of_fields(read_json(path), path)


@pytest.mark.parametrize("text", ["", "[]", "{}", "\xff"])
def test_what_is_no_contract_at_all_is_refused(tmp_path, text):
    path = tmp_path / "contract.json"
    path.write_bytes(text.encode("latin1"))
    with pytest.raises(InputError, match=r"contract\.json is not"):
        Contract.of_fields(read_json(path), path)


def test_a_contract_without_a_named_task_is_kept(tmp_path):
    random_policy(replace(contract(), task=None)).save(tmp_path)
    path = tmp_path / "contract.json"
    assert Contract.of_fields(read_json(path), path).task is None


def test_a_policy_needs_numpy_and_safetensors_and_nothing_else(tmp_path):
    """What a robot has: Python, these two and this package."""
    policy = random_policy(contract(DICT_PARTS, (2,)))
    (run,) = make_set(tmp_path / "run", (3,), task="Task-v0", algorithm="csac", steps=9).runs
    policy.write(run.policy_file())
    code = f"""
import sys

class Alone:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {{"numpy", "safetensors", "csac"}}:
            raise ImportError(f"{{name}} is not there")

sys.meta_path.insert(0, Alone())
from csac import InputError, Policy, load
policy = load({str(run.path)!r})
action, _ = policy.predict({{"speed": 0.5, "position": [[0.3, 0.4]], "achieved": [0.1, 0.2]}})
policy.save({str(tmp_path / "again")!r})
print(*action.tolist())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    expected, _ = policy.predict({"speed": 0.5, "position": [[0.3, 0.4]], "achieved": [0.1, 0.2]})
    np.testing.assert_array_equal(np.array(done.stdout.split(), np.float32), expected)
    assert (tmp_path / "again" / "policy.safetensors").read_bytes() == run.policy_file().read_bytes()


@given(st.data())
def test_a_changed_file_is_a_policy_or_is_refused_in_one_line(data):
    """Files of strangers: bytes changed, cut out, put in, in any of the two files."""
    policy = random_policy(contract(DICT_PARTS, (2,)))
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, "policy.safetensors"), Path(folder, "contract.json")]
        policy.save(folder)
        file = data.draw(st.sampled_from(files))
        content = file.read_bytes()
        begin = data.draw(st.integers(0, len(content) - 1))
        end = begin + data.draw(st.integers(0, 9))
        file.write_bytes(content[:begin] + data.draw(st.binary(max_size=9)) + content[end:])
        complaint = ""
        try:
            changed = Policy.load(files[0])
            changed.act(np.ones((3, changed.contract.spec.observation_size), np.float32), deterministic=False)
        except InputError as error:
            complaint = str(error)
        assert "\n" not in complaint
