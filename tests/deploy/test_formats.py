"""What leaves, in every format: the same actions as the policy of the run, and what only one format has."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from artefacts import exported, leave, needs_compiler, observations, together
from policies import ALGORITHMS, DICT_PARTS, algorithm_policy, contract, random_layers, random_policy, with_hidden

from csac.deploy.artefact import open_artefact
from csac.deploy.c import compile_c
from csac.deploy.choosing import load
from csac.deploy.guards import make_guards
from csac.deploy.policy import Policy
from csac.deploy.verify import compare_actions
from csac.types import InputError, PolicyParameters


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_artefact_takes_the_raw_observation_and_gives_the_environments_action(tmp_path, format, algorithm):
    policy = algorithm_policy(algorithm)
    given = observations(5)
    answers = together(exported(tmp_path, policy, format), given)
    assert answers.dtype == np.float32
    np.testing.assert_allclose(answers, policy.predict(given)[0], atol=2e-5)
    assert answers.min() >= -0.5
    assert answers.max() <= 2.0


def test_a_dict_is_flattened_before_and_an_action_gets_its_shape_after(tmp_path, format):
    policy = algorithm_policy("csac", DICT_PARTS, (2, 3))
    artefact = exported(tmp_path, policy, format)
    observation = {"speed": 0.5, "position": [[0.3, 0.4]], "achieved": [0.1, 0.2]}
    expected = policy.predict(observation)[0]
    np.testing.assert_allclose(artefact.predict(observation)[0], expected, atol=1e-5)
    np.testing.assert_allclose(artefact.act(np.array([0.1, 0.2, 0.3, 0.4, 0.5])), expected.reshape(-1), atol=1e-5)


HIDDEN = [("relu", "tanh"), ("elu", "silu"), ("gelu", "elu")]  # of the actors and of the critics


@pytest.mark.parametrize("kinds", HIDDEN, ids="-".join)
def test_activations_and_layer_norm_leave_with_the_policy(tmp_path, format, kinds):
    policy, plain = with_hidden(algorithm_policy("sd3"), *kinds), algorithm_policy("sd3")
    artefact = exported(tmp_path, policy, format)
    assert compare_actions(artefact, policy).observations > 900
    given = observations(5)
    assert np.abs(policy.predict(given)[0] - plain.predict(given)[0]).max() > 0.1
    again = load(tmp_path)
    np.testing.assert_array_equal(again.predict(given)[0], policy.predict(given)[0])


def test_a_contract_of_before_has_critics_with_relu(tmp_path):
    policy = algorithm_policy("sd3")
    leave(tmp_path, policy, "numpy")
    assert "critic_activation" not in json.loads((tmp_path / "contract.json").read_text())
    assert load(tmp_path).contract.critic_activation == "relu"


def test_a_policy_of_one_layer_leaves_too(tmp_path, format):
    policy = random_policy(contract())
    parameters = PolicyParameters((random_layers(2, 2),))
    policy = Policy(policy.network._replace(parameters=parameters), policy.contract)
    given = observations(2)
    np.testing.assert_allclose(together(exported(tmp_path, policy, format), given), policy.predict(given)[0], atol=1e-5)


def test_every_artefact_is_a_saved_policy_as_well(tmp_path, format):
    policy = algorithm_policy("ppo")
    again = load(leave(tmp_path, policy, format))
    given, noise = observations(5), np.ones((40, 3), np.float32)
    np.testing.assert_array_equal(again.act(given, False, noise), policy.act(given, False, noise))


# NumPy: the loader alone, in a Python that has nothing else.


def run_loader(folder, code: str) -> subprocess.CompletedProcess[str]:
    refuse = (
        "import sys, importlib.abc\n"
        "class Refuse(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.split('.')[0] in ('csac', 'jax', 'gymnasium', 'safetensors'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from policy import Policy\n"
    )
    return subprocess.run([sys.executable, "-c", refuse + code], cwd=folder, capture_output=True, text=True)


def test_the_loader_refuses_a_flipped_bit_another_policy_and_a_batch(tmp_path):
    folder = leave(tmp_path / "one", algorithm_policy("csac"), "numpy")
    assert "has the shape (5,), one at a time, not (2, 5)" in run_loader(folder, "Policy().act([[0] * 5] * 2)").stderr
    other = leave(tmp_path / "other", random_policy(contract()), "numpy") / "policy.safetensors"
    flipped = bytearray((folder / "policy.safetensors").read_bytes())
    flipped[-1] ^= 1
    for content in (bytes(flipped), other.read_bytes()):
        (folder / "policy.safetensors").write_bytes(content)
        assert "policy.safetensors does not match its checksum" in run_loader(folder, "Policy()").stderr


# ONNX: what other runtimes see.


def test_the_graph_takes_batches_and_carries_its_contract(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    policy = algorithm_policy("sd3")
    leave(tmp_path, policy, "onnx", control_rate_hz=20.0)
    model = onnx.load(tmp_path / "policy.onnx")
    assert {node.domain for node in model.graph.node} == {""}  # no custom operators
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    given = observations(5)
    actions = np.asarray(session.run(["action"], {"observation": given})[0])
    np.testing.assert_allclose(actions, policy.predict(given)[0], atol=2e-5)
    told = json.loads(session.get_modelmeta().custom_metadata_map["contract"])
    assert told["control_rate_hz"] == 20.0
    assert told["action_high"] == [2.0, 2.0, 2.0]


def test_the_state_of_a_guarded_graph_is_an_input_and_zeros_begin(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "onnx", make_guards(policy.contract, "last"))
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    first, bad = np.zeros((1, 5), np.float32), np.full((1, 5), np.nan, np.float32)
    action, state = session.run(None, {"observation": first, "state": np.zeros((1, 4), np.float32)})
    np.testing.assert_array_equal(state, [[*action[0], 1.0]])
    repeated, state = session.run(None, {"observation": bad, "state": state})
    np.testing.assert_array_equal(repeated, action)
    np.testing.assert_array_equal(state, [[*action[0], 1.0]])


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_without_onnx_it_is_said_what_to_install(tmp_path, monkeypatch, package):
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=f"needs the package {package}"):
        exported(tmp_path, algorithm_policy("csac"), "onnx")


# C: for other compilers.


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler here")
@pytest.mark.parametrize("algorithm", ["sd3", "ppo"])
def test_the_header_is_cpp_as_well(tmp_path, algorithm):
    policy = algorithm_policy(algorithm)
    leave(tmp_path, policy, "c", make_guards(policy.contract, "last", 0.02))
    source = tmp_path / "main.cpp"
    source.write_text('#include <cstdio>\n#include "policy.h"\n'
                      'int main() { csac_state s = CSAC_INITIAL; float o[5] = {0.1f, 0.2f, 0.3f, 0.4f, 0.5f}, a[3]; '
                      'csac_step(&s, o, a); csac_reset(&s); csac_policy(o, a); '
                      'for (int i = 0; i < 3; i++) std::printf("%.9g\\n", double(a[i])); return 0; }\n')  # fmt: skip
    flags = ("-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
    subprocess.run(["c++", *flags, source, "-o", tmp_path / "main"], check=True)
    lines = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True).stdout.split()
    expected = policy.predict(np.array([0.1, 0.2, 0.3, 0.4, 0.5]))[0]
    np.testing.assert_allclose(np.array(lines, float), expected, atol=1e-5)


@needs_compiler
def test_what_would_be_wrong_does_not_compile(tmp_path):
    """Two policies in one source file, and mathematics without NaN that takes the guard away."""
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "c", make_guards(policy.contract, "zero"))
    source, made = tmp_path / "main.c", tmp_path / "main.o"
    source.write_text('#include "policy.h"\n')
    compile_c("-c", source, "-o", made)
    with pytest.raises(InputError, match="without -ffast-math"):
        compile_c("-ffast-math", "-c", source, "-o", made)
    source.write_text('#include "policy.h"\n#include "policy.h"\n')
    with pytest.raises(InputError, match="is in this source file already"):
        compile_c("-c", source, "-o", made)


def test_without_a_compiler_it_is_said_in_one_line(tmp_path, monkeypatch):
    leave(tmp_path, algorithm_policy("csac"), "c")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="cc is not found"):
        open_artefact(tmp_path)
