"""What leaves, in every format: the same actions as the policy of the run, and what only one format has."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest
from artefacts import GUARDED, exported, leave, needs_compiler, observations, together
from policies import ALGORITHMS, DICT_PARTS, algorithm_policy, contract, random_policy

from csac.deploy.artefact import compile_c, open_artefact
from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.c_source import noise_state, quantised
from csac.deploy.contract import Contract
from csac.deploy.guards import make_guards
from csac.deploy.policy import Policy, noise_generator
from csac.deploy.writing import write_artefact
from csac.types import InputError


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
    parts = json.loads((tmp_path / "contract.json").read_text())["observation_parts"]
    assert [part["key"] for part in parts] == ["achieved", "position", "speed"]


def test_a_policy_of_one_layer_leaves_too(tmp_path, format):
    policy = random_policy(contract())
    network = policy.network._replace(
        parameters=policy.network.parameters._replace(actors=(policy.network.parameters.actors[0][:1],))
    )
    layer = network.parameters.actors[0][0]
    layer = layer._replace(weight=layer.weight[:, :2], bias=layer.bias[:2])
    policy = Policy(network._replace(parameters=network.parameters._replace(actors=((layer,),))), policy.contract)
    given = observations(2)
    np.testing.assert_allclose(together(exported(tmp_path, policy, format), given), policy.predict(given)[0], atol=1e-5)


@pytest.mark.parametrize("algorithm", ["csac", "ppo"])
def test_the_same_noise_gives_the_same_sample(tmp_path, format, algorithm):
    policy = algorithm_policy(algorithm)
    artefact, given = exported(tmp_path, policy, format, noise_seed=3), observations(5)
    noise = np.random.default_rng(1).normal(size=(len(given), 3)).astype(np.float32)
    expected = policy.contract.to_environment(policy.act(given, deterministic=False, noise=noise))
    np.testing.assert_allclose(together(artefact, given, noise), expected, atol=2e-5)


@pytest.mark.parametrize("name", ["numpy", "onnx"])
def test_samples_are_drawn_as_the_policy_of_the_run_draws_them(tmp_path, name):
    pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    artefact, given = exported(tmp_path, policy, name, noise_seed=3), observations(5)
    sampling = Policy(policy.network, policy.contract, seed=3)
    expected = sampling.predict(given, deterministic=False)[0]
    np.testing.assert_allclose(together(artefact, given), expected, atol=2e-5)


@needs_compiler
def test_the_noise_of_c_is_pcg32_and_standard_normal(tmp_path):
    policy = algorithm_policy("ppo")
    leave(tmp_path, policy, "c", noise_seed=42)
    source, program = tmp_path / "noise.c", tmp_path / "noise"
    source.write_text(
        '#include <stdio.h>\n#include "policy.h"\nint main(void) { csac_state state = CSAC_INITIAL;\n'
        'for (int i = 0; i < 3; i++) printf("%08x\\n", (unsigned)csac_random(&state));\n'
        'for (int i = 0; i < 100000; i++) printf("%.9g\\n", (double)csac_normal(&state)); return 0; }\n'
    )
    compile_c("-std=c99", "-O2", source, "-o", program, "-lm")
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    # The generator's authors print these for the seed 42 and the stream 54.
    assert lines[:3] == ["a15c02b7", "7b47f409", "ba1d3330"]
    drawn = np.array(lines[3:], float)
    # The standard errors of mean, variance and fourth moment are 0.003, 0.0045 and 0.031.
    assert abs(drawn.mean()) < 0.015
    assert drawn.var() == pytest.approx(1.0, abs=0.02)
    assert (drawn**4).mean() == pytest.approx(3.0, abs=0.15)
    assert abs(np.corrcoef(drawn[:-1], drawn[1:])[0, 1]) < 0.015


def test_the_state_of_the_noise_is_that_of_pcg32s_own_seeding():
    # pcg32_srandom: state 0, a step, plus the seed, a step; a step is state * multiplier + increment.
    multiplier, increment = 6364136223846793005, 109
    state = ((0 * multiplier + increment + 42) * multiplier + increment) % 2**64
    assert noise_state(42) == state


def normals(seed: int) -> Iterator[float]:
    """PCG32's numbers after `seed`, made standard normal two by two (Box and Muller 1958)."""
    state = noise_state(seed)

    def whole() -> int:  # below 2^24
        nonlocal state
        mixed, turn = ((state >> 18 ^ state) >> 27) % 2**32, state >> 59
        state = (state * 6364136223846793005 + 109) % 2**64
        return (mixed >> turn | mixed << -turn % 32) % 2**32 >> 8

    while True:
        radius, angle = (whole() + 1) / 2**24, 2 * math.pi * whole() / 2**24
        yield math.sqrt(-2 * math.log(radius)) * math.cos(angle)


@needs_compiler
@pytest.mark.parametrize("algorithm", ["csac", "ppo"])
def test_a_controller_in_c_samples_by_itself_and_goes_on_after_a_reset(tmp_path, algorithm):
    artefact, drawn = exported(tmp_path, algorithm_policy(algorithm), "c", noise_seed=3), normals(3)
    observation, actions = np.full(5, 0.1, np.float32), []
    for step in range(10):
        if step == 5:
            artefact.reset()
        actions.append(artefact.act(observation))
        noise = np.array(list(islice(drawn, 3)), np.float32)
        np.testing.assert_allclose(actions[-1], artefact.act(observation, noise), atol=2e-5)
    assert len({tuple(action) for action in actions}) == 10


# NumPy: the loader alone, in a Python that has nothing else.


def test_the_loader_runs_without_csac(tmp_path):
    policy = algorithm_policy("sd3")
    leave(tmp_path / "robot", policy, "numpy")
    code = (
        "import sys, importlib.abc\n"
        "class Refuse(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.split('.')[0] in ('csac', 'jax', 'gymnasium', 'safetensors'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from policy import Policy\n"
        "print(Policy().act([0.1, 0.2, 0.3, 0.4, 0.5]).tolist())\n"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path / "robot", capture_output=True, text=True)
    assert not result.stderr
    expected = policy.predict(np.array([0.1, 0.2, 0.3, 0.4, 0.5]))[0]
    np.testing.assert_allclose(json.loads(result.stdout), expected, atol=1e-5)


def test_the_loader_takes_one_observation_at_a_time(tmp_path):
    """Of several it would give actions and standard deviations in a row."""
    leave(tmp_path, random_policy(contract(((None, (3,)),)), 1), "numpy")
    code = "import numpy, policy; policy.Policy().act(numpy.zeros((4, 3)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert "an observation has the shape (3,), one at a time, not (4, 3)" in result.stderr


def test_the_loader_refuses_another_policys_file(tmp_path):
    leave(tmp_path, algorithm_policy("csac"), "numpy")
    (tmp_path / "policy.safetensors").write_bytes(b"\0" * 100)
    result = subprocess.run([sys.executable, "-c", "import policy; policy.Policy()"], cwd=tmp_path, capture_output=True)
    assert b"policy.safetensors is not the file that contract.json was written for" in result.stderr


def test_a_numpy_artefact_is_a_policy_with_its_contract_for_csac_as_well(tmp_path):
    policy = algorithm_policy("ppo")
    leave(tmp_path, policy, "numpy")
    again = Policy.load(tmp_path / "policy.safetensors", Contract.load(tmp_path / "contract.json"))
    given = observations(5)
    np.testing.assert_array_equal(again.predict(given)[0], policy.predict(given)[0])


# ONNX: what other runtimes see.


def test_the_graph_takes_batches_and_carries_its_contract(tmp_path):
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    policy = algorithm_policy("sd3")
    leave(tmp_path, policy, "onnx", control_rate=20.0)
    import onnxruntime

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
    leave(tmp_path, policy, "onnx", guards=make_guards(policy.contract, "last", watchdog=2))
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    first, bad = np.zeros((1, 5), np.float32), np.full((1, 5), np.nan, np.float32)
    action, state = session.run(None, {"observation": first, "state": np.zeros((1, 5), np.float32)})
    np.testing.assert_array_equal(state, [[*action[0], 1.0, 0.0]])
    repeated, state = session.run(None, {"observation": bad, "state": state})
    np.testing.assert_array_equal(repeated, action)
    np.testing.assert_array_equal(state, [[*action[0], 1.0, 1.0]])


# C: for other compilers, with other numbers.


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler here")
@pytest.mark.parametrize("algorithm", ["csac", "sd3", "ppo"])
def test_the_header_is_cpp_as_well(tmp_path, algorithm):
    policy = algorithm_policy(algorithm)
    noise_seed = None if algorithm == "sd3" else 1
    leave(tmp_path, policy, "c", guards=make_guards(policy.contract, **GUARDED), noise_seed=noise_seed)
    source = tmp_path / "main.cpp"
    source.write_text('#include <cstdio>\n#include "policy.h"\n'
                      'int main() { csac_state s = CSAC_INITIAL; float o[5] = {0.1f, 0.2f, 0.3f, 0.4f, 0.5f}, a[3]; '
                      'csac_step(&s, o, a); csac_reset(&s); csac_policy(o, a); '
                      'for (int i = 0; i < 3; i++) std::printf("%.9g\\n", double(a[i])); return 0; }\n')  # fmt: skip
    flags = ("-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
    compile_c(*flags, source, "-o", tmp_path / "main", program="c++")
    lines = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True).stdout.split()
    expected = policy.predict(np.array([0.1, 0.2, 0.3, 0.4, 0.5]))[0]
    np.testing.assert_allclose(np.array(lines, float), expected, atol=1e-5)


@pytest.mark.parametrize("compiler", ["cc", "arm-none-eabi-gcc"])
@pytest.mark.parametrize("weights", ["float32", "float16", "int8"])
def test_the_header_compiles_without_a_warning_and_says_its_size(tmp_path, compiler, weights):
    from csac.deploy.c_size import TARGETS, sizes

    target = next(name for name, (program, _, _) in TARGETS.items() if program == compiler)
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} here")
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "c", weights=weights, guards=make_guards(policy.contract, **GUARDED))
    size = {size.target: size for size in sizes(tmp_path)}[target]
    # 5 * 32 + 32 * 21 + 21 * 3 weights of 4, 2 or 1 bytes; biases and scales in float32; then bounds, some in the code.
    count, floats = 5 * 32 + 32 * 21 + 21 * 3, 112 if weights == "int8" else 56
    least = count * {"float32": 4, "float16": 2, "int8": 1}[weights] + 4 * floats
    assert least <= size.constants <= least + 300
    assert size.data == 0
    assert 200 < size.stack < 2000
    assert 200 < size.code < 10_000


@needs_compiler
@pytest.mark.parametrize(("weights", "error"), [("float16", 2e-3), ("int8", 0.05)])
@pytest.mark.parametrize("algorithm", ["csac", "td3", "ppo"])
def test_smaller_weights_cost_little(tmp_path, algorithm, weights, error):
    policy = algorithm_policy(algorithm)
    given = np.random.default_rng(0).normal(size=(50, 5)).astype(np.float32)
    answers = together(exported(tmp_path, policy, "c", weights=weights), given)
    difference = np.abs(answers - policy.predict(given)[0]).max() / 2.5
    assert 1e-6 < difference < error


@needs_compiler
def test_half_precision_is_read_as_numpy_reads_it(tmp_path):
    # As weights of the mean, one by one: the largest, the smallest normal, below it, one, minus a third, zero.
    halves = np.array([65504, 6.104e-5, 3e-6, 1.0, -1 / 3, 0.0], np.float16)
    leave(tmp_path, algorithm_policy("csac"), "c", weights="float16")
    source, program = tmp_path / "half.c", tmp_path / "half"
    numbers = ", ".join(str(bits) for bits in halves.view(np.uint16))
    source.write_text(
        '#include <stdio.h>\n#include "policy.h"\nint main(void) { uint16_t halves[] = {'
        + numbers
        + '};\nfor (int i = 0; i < 6; i++) printf("%.9g\\n", (double)csac_weight(halves[i])); return 0; }\n'
    )
    compile_c("-std=c99", source, "-o", program, "-lm")
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    np.testing.assert_array_equal(np.array(lines, np.float32), halves.astype(np.float32))


def test_whole_numbers_and_their_scale_give_the_weights_back():
    weight = np.array([[1.0, 0.0, -0.1], [-0.5, 0.0, 0.2]], np.float32)
    whole, scale = quantised(weight)
    np.testing.assert_array_equal(whole, [[127, 0, -64], [-64, 0, 127]])
    np.testing.assert_allclose(whole * scale, weight, atol=0.5 / 127)


@needs_compiler
def test_weights_that_half_precision_cannot_hold_are_refused(tmp_path):
    policy = algorithm_policy("csac")
    policy.network.parameters.actors[0][0].weight[0, 0] = 1e5
    with pytest.raises(InputError, match="too large for float16"):
        leave(tmp_path, policy, "c", weights="float16")


@needs_compiler
def test_fast_mathematics_that_would_take_the_guards_away_is_refused(tmp_path):
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "c", guards=make_guards(policy.contract, "zero"))
    (tmp_path / "main.c").write_text('#include "policy.h"\n')
    with pytest.raises(InputError, match="without -ffast-math"):
        compile_c("-ffast-math", "-c", tmp_path / "main.c", "-o", tmp_path / "main.o")


def test_without_a_compiler_it_is_said_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "made").mkdir()
    policy = algorithm_policy("csac")
    write_artefact(tmp_path / "made", policy.network, ArtefactContract(policy.contract, "c"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="needs a C compiler, and cc is not found here"):
        open_artefact(tmp_path / "made")


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_without_onnx_it_is_said_what_to_install(tmp_path, monkeypatch, package):
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"pip install '\.\[onnx\]' in a clone of csac"):
        exported(tmp_path, algorithm_policy("csac"), "onnx")


# Where it is put.


def test_noise_is_a_stream_of_its_own():
    # What the loader draws without csac.
    sequence = np.random.SeedSequence(3, spawn_key=(0x706F6C69,))
    np.testing.assert_array_equal(
        np.random.default_rng(sequence).standard_normal(4), noise_generator(3).standard_normal(4)
    )
