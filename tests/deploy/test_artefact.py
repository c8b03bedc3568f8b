"""What leaves, in every format: the same actions as the policy of the run, the same guards, refused when damaged."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from policies import ALGORITHMS, DICT_PARTS, algorithm_policy, contract, random_layers, random_policy

from csac.deploy import tensors
from csac.deploy.artefact import Artefact, compile_c, header_alone, open_artefact
from csac.deploy.artefact_contract import ArtefactContract, Format, sha256_of
from csac.deploy.c_source import noise_state, quantised
from csac.deploy.contract import Contract
from csac.deploy.guards import NO_GUARDS, Guards, GuardState, guarded, make_guards
from csac.deploy.parameters import to_tensors
from csac.deploy.policy import Policy, noise_generator
from csac.deploy.writing import write_artefact, write_contract
from csac.types import InputError, PolicyParameters

FORMATS: tuple[Format, ...] = ("numpy", "onnx", "c")
HAS_COMPILER = shutil.which("cc") is not None
needs_compiler = pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler here")


@pytest.fixture(params=FORMATS)
def format(request) -> Format:
    if request.param == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    if request.param == "c" and not HAS_COMPILER:
        pytest.skip("no C compiler here")
    return request.param


def leave(folder: Path, policy: Policy, format: Format, **fields) -> Artefact:
    folder.mkdir(exist_ok=True)
    write_artefact(folder, policy.network, ArtefactContract(policy.contract, format, **fields))
    return open_artefact(folder)


def observations(size: int, count: int = 40, seed: int = 0) -> np.ndarray:
    """Around zero, far away, and at the origin."""
    drawn = np.random.default_rng(seed).normal(size=(count, size))
    drawn[count // 2 :] *= 100.0
    drawn[0] = 0.0
    return drawn.astype(np.float32)


def together(artefact: Artefact, given: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
    rows = range(len(given))
    return np.stack([artefact.act(given[row], None if noise is None else noise[row]) for row in rows])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_artefact_takes_the_raw_observation_and_gives_the_environments_action(tmp_path, format, algorithm):
    policy = algorithm_policy(algorithm)
    given = observations(5)
    answers = together(leave(tmp_path, policy, format), given)
    assert answers.dtype == np.float32
    np.testing.assert_allclose(answers, policy.predict(given)[0], atol=2e-5)
    assert answers.min() >= -0.5
    assert answers.max() <= 2.0


def test_a_dict_is_flattened_before_and_an_action_gets_its_shape_after(tmp_path, format):
    policy = algorithm_policy("csac", DICT_PARTS, (2, 3))
    artefact = leave(tmp_path, policy, format)
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
    np.testing.assert_allclose(together(leave(tmp_path, policy, format), given), policy.predict(given)[0], atol=1e-5)


@pytest.mark.parametrize("algorithm", ["csac", "ppo"])
def test_the_same_noise_gives_the_same_sample(tmp_path, format, algorithm):
    policy = algorithm_policy(algorithm)
    artefact, given = leave(tmp_path, policy, format, noise_seed=3), observations(5)
    noise = np.random.default_rng(1).normal(size=(len(given), 3)).astype(np.float32)
    expected = policy.contract.to_environment(policy.act(given, deterministic=False, noise=noise))
    np.testing.assert_allclose(together(artefact, given, noise), expected, atol=2e-5)


@pytest.mark.parametrize("name", ["numpy", "onnx"])
def test_samples_are_drawn_as_the_policy_of_the_run_draws_them(tmp_path, name):
    pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    artefact, given = leave(tmp_path, policy, name, noise_seed=3), observations(5)
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
    artefact, drawn = leave(tmp_path, algorithm_policy(algorithm), "c", noise_seed=3), normals(3)
    observation, actions = np.full(5, 0.1, np.float32), []
    for step in range(10):
        if step == 5:
            artefact.reset()
        actions.append(artefact.act(observation))
        noise = np.array(list(islice(drawn, 3)), np.float32)
        np.testing.assert_allclose(actions[-1], artefact.act(observation, noise), atol=2e-5)
    assert len({tuple(action) for action in actions}) == 10


# Guards: known answers of the definition, then every format against it.

TWO = contract(((None, (2,)),), (2,), low=-1.0, high=3.0)  # a range of 4, its middle 1


def guards(**given) -> Guards:
    return make_guards(TWO, **given)


def run_guards(chosen: Guards, steps: list[tuple[list[float], list[float]]]) -> list[list[float]]:
    state = GuardState()
    return [
        guarded(chosen, state, TWO, np.array(seen, np.float32), np.array(action, np.float32)).tolist()
        for seen, action in steps
    ]


GOOD, NAN, FAR = [0.0, 0.0], [0.0, float("nan")], [5.0, 0.0]


def test_a_bad_observation_gives_the_fallback():
    steps = [(GOOD, [2.0, 2.0]), (NAN, [2.0, 2.0]), (GOOD, [3.0, 3.0]), (GOOD, [float("inf"), 0.0])]
    assert run_guards(guards(fallback="middle"), steps) == [[2, 2], [1, 1], [3, 3], [1, 1]]
    assert run_guards(guards(fallback="zero"), steps) == [[2, 2], [0, 0], [3, 3], [0, 0]]
    assert run_guards(guards(fallback="-1,2.5"), steps) == [[2, 2], [-1, 2.5], [3, 3], [-1, 2.5]]
    assert run_guards(guards(fallback="last"), steps) == [[2, 2], [2, 2], [3, 3], [3, 3]]
    assert run_guards(guards(fallback="last"), steps[1:2]) == [[1, 1]]  # none before: the middle


def test_what_is_out_of_range_is_bad_and_what_is_on_its_edge_is_not():
    chosen = guards(fallback="zero", observation_low=np.array([-5.0, -np.inf]), observation_high=np.array([5.0, 1.0]))
    steps = [(FAR, [2.0, 2.0]), ([5.001, 0.0], [2.0, 2.0]), ([-5.0, -1e30], [2.0, 2.0]), ([0.0, 1.1], [2.0, 2.0])]
    assert run_guards(chosen, steps) == [[2, 2], [0, 0], [2, 2], [0, 0]]


def test_the_watchdog_gives_up_after_so_many_bad_ones_in_a_row_and_stays_so():
    steps = [(NAN, [2.0, 2.0]), (GOOD, [2.0, 2.0]), (NAN, [2.0, 2.0]), (NAN, [2.0, 2.0]), (GOOD, [2.0, 2.0])]
    assert run_guards(guards(fallback="zero", watchdog=2), steps) == [[0, 0], [2, 2], [0, 0], [0, 0], [0, 0]]
    assert run_guards(guards(fallback="zero", watchdog=3), steps)[-1] == [2, 2]


def test_the_rate_limit_is_a_share_of_the_range_and_holds_for_fallbacks_too():
    # A tenth of a range of 4 is 0.4 in a step; the first action is not limited.
    steps = [(GOOD, [3.0, -1.0]), (GOOD, [-1.0, 3.0]), (NAN, [0.0, 0.0]), (GOOD, [2.2, -0.2])]
    limited = run_guards(guards(fallback="zero", rate_limit=0.1), steps)
    np.testing.assert_allclose(limited, [[3, -1], [2.6, -0.6], [2.2, -0.2], [2.2, -0.2]], atol=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fallback": "half"}, "it is zero, middle, last, or numbers"),
        ({"fallback": "1"}, "1 numbers where the task has 2 actions"),
        ({"fallback": "1,4"}, "outside of the action's bounds"),
        ({"fallback": "1,nan"}, "outside of the action's bounds"),
        ({"watchdog": 3}, "need a --fallback"),
        ({"watchdog": 0, "fallback": "zero"}, "at least 1"),
        ({"watchdog": 2**24 + 1, "fallback": "zero"}, "16,777,217 bad observations: give at most 16,777,216"),
        ({"rate_limit": 0.0}, "more than 0, at most 1"),
        ({"rate_limit": float("nan")}, "more than 0, at most 1"),
    ],
)
def test_guards_that_cannot_be_meant_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        guards(**given)


LOW, HIGH = np.full(5, -1.5), np.full(5, 1.5)


@pytest.mark.parametrize(
    "given",
    [
        {"fallback": "zero"},
        {"fallback": "0.25,-0.5,2"},
        {"fallback": "middle", "observation_low": LOW, "observation_high": HIGH},
        {"fallback": "last", "observation_low": LOW, "observation_high": HIGH},
        {"fallback": "middle", "watchdog": 3},
        {"rate_limit": 0.05},
        {"fallback": "last", "observation_low": LOW, "observation_high": HIGH, "watchdog": 4, "rate_limit": 0.02},
    ],
)
def test_every_format_guards_as_defined(tmp_path, format, given):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, **given)
    artefact = leave(tmp_path, policy, format, guards=chosen)
    seen = np.random.default_rng(0).normal(size=(60, 5)).astype(np.float32)
    seen[5::7, 2] = np.nan
    seen[11::13, 0] = np.inf
    seen[30:34, 4] = -np.inf
    expected, state = [], GuardState()
    for row, observation in enumerate(seen):
        if row == 45:
            artefact.reset()
            state = GuardState()
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected.append(guarded(chosen, state, policy.contract, observation, action))
        np.testing.assert_allclose(artefact.act(observation), expected[-1], atol=2e-5)
    assert np.isfinite(expected).all() or chosen.fallback is None


@pytest.mark.parametrize(
    "given", [{"fallback": "0.25,-0.5,2"}, {"fallback": "last"}, {"fallback": "zero", "watchdog": 2}]
)
def test_every_format_takes_no_action_that_is_no_number(tmp_path, format, given):
    """The observation is good, but the first layer overflows, and the second one sums infinities of both signs."""
    policy = algorithm_policy("csac")
    policy.network.parameters.actors[0][0].weight[0] *= 1e6
    chosen, state = make_guards(policy.contract, **given), GuardState()
    artefact = leave(tmp_path, policy, format, guards=chosen)
    good, far = np.zeros(5, np.float32), np.array([3e38, 0, 0, 0, 0], np.float32)
    assert np.isnan(policy.act(far[None])).all()
    for observation in (far, good, far, far, good):
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected = guarded(chosen, state, policy.contract, observation, action)
        np.testing.assert_allclose(artefact.act(observation), expected, atol=2e-5)


@pytest.mark.parametrize("broken", [0, 1])
def test_every_format_falls_back_where_one_of_two_actors_gives_no_number(tmp_path, format, broken):
    policy = algorithm_policy("sd3")
    policy.network.parameters.actors[broken][0].weight[0] *= 1e6
    guards, state = make_guards(policy.contract, fallback="0.25,-0.5,2"), GuardState()
    artefact = leave(tmp_path, policy, format, guards=guards)
    far = np.array([3e38, 0, 0, 0, 0], np.float32)
    action = policy.contract.to_environment(policy.act(far[None])[0])
    expected = guarded(guards, state, policy.contract, far, action)
    np.testing.assert_array_equal(expected, guards.fallback_action)
    np.testing.assert_allclose(artefact.act(far), expected)


@pytest.mark.parametrize(
    "given", [{"fallback": "0.25,-0.5,2"}, {"fallback": "last"}, {"fallback": "0.25,-0.5,2", "rate_limit": 1.0}]
)
def test_an_action_is_the_callers_own(tmp_path, format, given):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, **given)
    artefact, state = leave(tmp_path, policy, format, guards=chosen), GuardState()
    good, bad = np.zeros(5, np.float32), np.full(5, np.nan, np.float32)
    answers = []
    for observation in (good, bad, bad, good, bad):
        action = policy.contract.to_environment(policy.act(observation[None])[0])
        expected = guarded(chosen, state, policy.contract, observation, action)
        answer = artefact.act(observation)
        answers.append(answer.copy())
        np.testing.assert_allclose(answer, expected, atol=2e-5)
        answer *= 100.0  # as a controller may, in place
        expected *= 100.0
    np.testing.assert_array_equal(answers[1], answers[2])
    np.testing.assert_array_equal(answers[1], answers[4])
    if given["fallback"] != "last":
        np.testing.assert_array_equal(answers[1], np.array([0.25, -0.5, 2.0], np.float32))


def test_the_longest_watchdog_trips_in_a_graph_too(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "onnx", guards=make_guards(policy.contract, "zero", watchdog=2**24))
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    good, bad = np.zeros((1, 5), np.float32), np.full((1, 5), np.nan, np.float32)
    state = np.array([[0, 0, 0, 1, 2**24 - 1]], np.float32)  # one bad step before it
    before = session.run(["action"], {"observation": good, "state": state})[0]
    np.testing.assert_allclose(before, policy.predict(good)[0], atol=2e-5)
    _, state = session.run(None, {"observation": bad, "state": state})
    np.testing.assert_array_equal(session.run(["action"], {"observation": good, "state": state})[0], np.zeros((1, 3)))


def test_guards_come_back_out_of_the_contract(tmp_path):
    policy = algorithm_policy("csac")
    chosen = make_guards(policy.contract, "last", LOW, HIGH, 4, 0.02)
    back = leave(tmp_path, policy, "numpy", guards=chosen).contract.guards
    for name, value in vars(chosen).items():
        np.testing.assert_array_equal(getattr(back, name), value)


# What is damaged or foreign is refused in one line.


def test_another_policy_under_this_contract_is_refused(tmp_path, format):
    artefact = leave(tmp_path, algorithm_policy("csac"), format)
    path = tmp_path / artefact.contract.file
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"is not the file that its contract\.json was written for"):
        open_artefact(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match="has no policy"):
        open_artefact(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"artefact_version": 2}, "artefact_version 2 where this csac reads 1"),
        ({"format": "torch"}, "'torch'"),
        ({"guards": {}}, "no 'observation_low'"),
        ({"noise_seed": "x"}, "'x'"),
        ({"noise_seed": -1}, "noise_seed -1"),
        ({"control_rate_hz": 0}, "control_rate_hz 0"),
        ({"control_rate_hz": float("inf")}, "control_rate_hz inf"),
        ({"observation_high": [10**400] * 5}, "too large"),
        ({"observation_low": [0.0]}, "is not 5 numbers"),
        ({"action_low": [0.0]}, "disagree"),
        ({"provenance": []}, "no JSON object"),
    ],
)
def test_a_contract_that_is_none_is_refused(tmp_path, change, message):
    leave(tmp_path, algorithm_policy("csac"), "numpy")
    path = tmp_path / "contract.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message):
        open_artefact(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fallback_action": [0.0, 0.0, 2.5]}, "fallback_action is outside of the action's bounds"),
        ({"largest_change": [0.1, 0.1, -0.1]}, "largest_change is negative"),
        ({"observation_low": [0.0, 2.0, 0.0, 0.0, 0.0]}, "observation bounds of the guards are not in order"),
    ],
)
def test_guards_that_no_export_writes_are_refused(tmp_path, change, message):
    policy = algorithm_policy("csac")
    leave(tmp_path, policy, "numpy", guards=make_guards(policy.contract, **GUARDED))
    path = tmp_path / "contract.json"
    fields = json.loads(path.read_text())
    path.write_text(json.dumps(fields | {"guards": fields["guards"] | change}))
    with pytest.raises(InputError, match=message):
        open_artefact(tmp_path)


def test_a_policy_file_that_cannot_be_read_is_refused_in_one_line(tmp_path, format):
    path = tmp_path / leave(tmp_path, algorithm_policy("csac"), format).contract.file
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=f"{path.name} cannot be read"):
        open_artefact(tmp_path)


@needs_compiler
def test_a_header_with_a_size_that_python_does_not_read_is_refused(tmp_path):
    leave(tmp_path, algorithm_policy("csac"), "c")
    path = tmp_path / "policy.h"
    path.write_text(f"static const float csac_low[{'9' * 5000}] = {{\n" + path.read_text())
    sign(tmp_path)
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


def sign(folder: Path) -> None:
    """Have a folder's contract name the hash of the file that is there now, as somebody else would."""
    path = folder / "contract.json"
    fields = json.loads(path.read_text())
    path.write_text(json.dumps(fields | {"sha256": sha256_of(folder / fields["file"])}))


def saved(header: bytes, numbers: bytes = b"") -> bytes:
    return len(header).to_bytes(8, "little") + header + numbers


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (saved(b"[]"), "its header is not a JSON object"),
        (saved(b"{}"), "the policy has no actor"),
        (saved(b"[" * 5000 + b"]" * 5000), "its header is nested too deeply"),
        (saved(b'{"actor.0.0.weight":{"dtype":"F32","data_offsets":[0,"x"],"shape":[1]}}'), "are not sizes"),
        (saved(b'{"actor.0.0.weight":{"data_offsets":[0,4],"shape":[1]}}', bytes(4)), "is not one of an array"),
        (tensors.encode(to_tensors(random_policy(contract()).network.parameters)), "after 5 inputs"),
    ],
)
def test_a_numpy_policy_that_cannot_be_run_is_refused_when_it_is_opened(tmp_path, content, message):
    leave(tmp_path, algorithm_policy("csac"), "numpy")
    (tmp_path / "policy.safetensors").write_bytes(content)
    sign(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        open_artefact(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("foreign", ["more observations", "fewer actions", "a state", "noise", "no guards", "no ONNX"])
def test_another_graph_is_refused_when_it_is_opened(tmp_path, foreign):
    pytest.importorskip("onnxruntime")
    policy = algorithm_policy("csac")
    limited = make_guards(policy.contract, "last")
    leave(tmp_path, policy, "onnx", guards=limited if foreign == "no guards" else NO_GUARDS)
    other, fields = policy, {}
    match foreign:
        case "more observations":
            other = algorithm_policy("csac", ((None, (7,)),))
        case "fewer actions":
            other = algorithm_policy("csac", action_shape=(2,))
        case "a state":
            fields = {"guards": limited}
        case "noise":
            fields = {"noise_seed": 0}
    leave(tmp_path / "other", other, "onnx", **fields)
    content = (tmp_path / "other" / "policy.onnx").read_bytes()
    (tmp_path / "policy.onnx").write_bytes(b"no graph" if foreign == "no ONNX" else content)
    sign(tmp_path)
    expected = "does not take" if foreign == "no ONNX" else "is not the graph of its contract"
    with pytest.raises(InputError, match=expected) as caught:
        open_artefact(tmp_path)
    assert "\n" not in str(caught.value)


def test_what_is_no_artefact_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        open_artefact(tmp_path / "nothing")
    with pytest.raises(InputError, match="holds no artefact"):
        open_artefact(tmp_path)
    contract().save(tmp_path / "contract.json")  # that of a run
    with pytest.raises(InputError, match="no 'artefact_version'"):
        open_artefact(tmp_path)


def test_a_folder_of_artefacts_and_a_run_name_those_below(tmp_path):
    policy, run = random_policy(contract()), tmp_path / "run"
    formats: tuple[Format, ...] = ("numpy", "c")
    for name in formats:
        (run / "export" / name).mkdir(parents=True)
        write_artefact(run / "export" / name, policy.network, ArtefactContract(policy.contract, name))
    (run / "policy").mkdir()
    contract().save(run / "policy" / "contract.json")
    for place in (run, run / "export"):
        with pytest.raises(InputError) as refusal:
            open_artefact(place)
        below = f"{run / 'export' / 'c'} or {run / 'export' / 'numpy'}"
        assert str(refusal.value) == f"{place} holds no artefact itself: give {below}"


def test_an_artefact_is_opened_by_its_file_too_and_by_no_other(tmp_path, format):
    artefact = leave(tmp_path, algorithm_policy("csac"), format)
    assert open_artefact(tmp_path / artefact.contract.file).format == format
    (tmp_path / "other.bin").touch()
    with pytest.raises(InputError, match="is not the artefact in its folder"):
        open_artefact(tmp_path / "other.bin")


def test_a_loader_that_is_not_csacs_is_not_run(tmp_path):
    leave(tmp_path, algorithm_policy("csac"), "numpy")
    (tmp_path / "policy.py").write_text("raise SystemExit('run')\n")
    with pytest.raises(InputError, match="is not the loader of this csac"):
        open_artefact(tmp_path)


@needs_compiler
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_header_that_is_not_csacs_is_not_compiled(tmp_path, algorithm):
    artefact = leave(tmp_path, algorithm_policy(algorithm), "c")
    path = tmp_path / "policy.h"
    text = path.read_text().replace(
        "static inline void csac_reset", "static int evil = 1;\nstatic inline void csac_reset"
    )
    path.write_text(text)
    write_contract(tmp_path, dataclasses.replace(artefact.contract, sha256=sha256_of(path)))
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
def test_a_contract_cannot_bring_code_into_its_header(tmp_path):
    artefact = leave(tmp_path, algorithm_policy("csac"), "c")
    path, task = tmp_path / "policy.h", "Pendulum-v1 */ int evil(void) { return 1; } /*"
    policy = dataclasses.replace(artefact.contract.policy, task=task)
    first, _, rest = path.read_text().partition("\n")
    known = artefact.contract.policy.task or "a task of its own"
    path.write_text(f"{first.replace(known, task)}\n{rest}")
    assert "evil" in path.read_text()
    write_contract(tmp_path, dataclasses.replace(artefact.contract, policy=policy, sha256=sha256_of(path)))
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
@pytest.mark.parametrize("sizes", [(7, 32, 3), (5, (32, 900), 3), (5, (32, 31), 3)])
def test_a_header_whose_layers_do_not_fit_is_not_compiled(tmp_path, sizes):
    """It would read beyond the observation, or beyond what the layer before has written."""
    first, hidden, last = sizes
    given, taken = hidden if isinstance(hidden, tuple) else (hidden, hidden)
    layers = random_layers(first, given) + random_layers(taken, last)
    policy = algorithm_policy("td3")
    network = policy.network._replace(parameters=PolicyParameters((layers,)))
    contract = ArtefactContract(policy.contract, "c")
    write_artefact(tmp_path, network, contract)
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
@pytest.mark.parametrize("size", [10**12, 10**30])
def test_sizes_that_nobody_has_memory_for_are_refused(tmp_path, size):
    artefact = leave(tmp_path, algorithm_policy("ppo"), "c")
    parts = ((None, (size,)),)
    policy = dataclasses.replace(artefact.contract.policy, observation_parts=parts)
    write_contract(tmp_path, dataclasses.replace(artefact.contract, policy=policy))
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
@pytest.mark.parametrize("header", ["float.h", "math.h", "stdint.h", "time.h"])
def test_a_header_of_the_system_s_that_lies_beside_is_not_compiled(tmp_path, monkeypatch, header):
    from csac.deploy.c_size import sizes
    from csac.evaluation import latency

    monkeypatch.setattr(latency, "WARM_UP", 1)
    leave(tmp_path, algorithm_policy("csac"), "c")
    (tmp_path / header).write_text("#error a stranger's\n")
    assert np.isfinite(open_artefact(tmp_path).act(np.zeros(5))).all()
    assert len(latency.measure(tmp_path, calls=3, seconds=0)[0].durations) == 3
    assert isinstance(sizes(tmp_path), list)


@needs_compiler
def test_what_is_compiled_is_what_was_looked_at(tmp_path):
    artefact = leave(tmp_path, algorithm_policy("csac"), "c")
    with header_alone(tmp_path, artefact.contract) as place:
        (tmp_path / "policy.h").write_text("#error exchanged meanwhile\n")
        assert [path.name for path in place.iterdir()] == ["policy.h"]
        assert "csac_step" in (place / "policy.h").read_text()
    with pytest.raises(InputError, match="is not a header of this csac"), header_alone(tmp_path, artefact.contract):
        pass


def test_an_observation_of_another_size_is_refused(tmp_path, format):
    artefact = leave(tmp_path, algorithm_policy("csac"), format)
    with pytest.raises(InputError, match=r"shape \(4,\); the artefact takes \(5,\)"):
        artefact.act(np.zeros(4))


def test_noise_of_another_shape_is_refused(tmp_path, format):
    policy = algorithm_policy("csac")
    artefact, zeros = leave(tmp_path, policy, format, noise_seed=0), np.zeros(5)
    for noise in (np.zeros(1), np.zeros((1, 3)), np.zeros(4)):
        with pytest.raises(InputError, match=r"the noise has shape \(.*\); the artefact takes \(3,\)"):
            artefact.act(zeros, noise)
    expected = policy.contract.to_environment(policy.act(np.zeros((1, 5), np.float32))[0])
    np.testing.assert_allclose(artefact.act(zeros, np.zeros(3, np.float64)), expected, atol=1e-5)


def test_noise_for_a_policy_that_does_not_sample_is_refused(tmp_path, format):
    artefact = leave(tmp_path, algorithm_policy("csac"), format)
    with pytest.raises(InputError, match="exported without --stochastic: it takes no noise"):
        artefact.act(np.zeros(5), np.zeros(3, np.float32))


def test_opening_leaves_nothing_in_the_folder(tmp_path, format):
    artefact = leave(tmp_path, algorithm_policy("csac"), format)
    artefact.act(np.zeros(5))
    extra = {"policy.py"} if format == "numpy" else set()
    assert {path.name for path in tmp_path.iterdir()} == {"contract.json", artefact.contract.file} | extra


@needs_compiler
def test_another_policy_in_one_source_file_is_refused_and_the_same_one_twice_is_not(tmp_path):
    """The second would be left out by its guard, and the first one's actions taken for its own."""
    for name, seed, watchdog in (("walk", 1, 2), ("stand", 2, 2), ("patient", 1, 3)):
        policy = random_policy(contract(), seed)
        leave(tmp_path / name, policy, "c", guards=make_guards(policy.contract, "middle", watchdog=watchdog))
    source = tmp_path / "main.c"
    for second, compiles in (("walk", True), ("stand", False), ("patient", False)):
        source.write_text(f'#include "walk/policy.h"\n#include "{second}/policy.h"\nint main(void) {{ return 0; }}\n')
        done = subprocess.run(["cc", "-c", source, "-o", tmp_path / "main.o"], capture_output=True, text=True)
        assert (done.returncode == 0) == compiles, done.stderr
    assert "another csac policy is in this source file already" in done.stderr


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

GUARDED = {"fallback": "last", "observation_low": LOW, "observation_high": HIGH, "watchdog": 4, "rate_limit": 0.02}


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
    answers = together(leave(tmp_path, policy, "c", weights=weights), given)
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
        leave(tmp_path, algorithm_policy("csac"), "onnx")


# Where it is put.


def test_noise_is_a_stream_of_its_own():
    # What the loader draws without csac.
    sequence = np.random.SeedSequence(3, spawn_key=(0x706F6C69,))
    np.testing.assert_array_equal(
        np.random.default_rng(sequence).standard_normal(4), noise_generator(3).standard_normal(4)
    )
