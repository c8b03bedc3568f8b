"""Artefacts are opened as they were left; what is damaged or foreign is refused in one line."""

from __future__ import annotations

import dataclasses
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from artefacts import GUARDED, exported, leave, needs_compiler
from policies import ALGORITHMS, algorithm_policy, contract, random_layers, random_policy

from csac.deploy import c_size, tensors
from csac.deploy.artefact import compile_c, header_alone, open_artefact
from csac.deploy.artefact_contract import ArtefactContract, Format, sha256_of
from csac.deploy.guards import NO_GUARDS, make_guards
from csac.deploy.parameters import to_tensors
from csac.deploy.writing import write_artefact, write_contract
from csac.types import InputError, PolicyParameters


def test_another_policy_under_this_contract_is_refused(tmp_path, format):
    path = tmp_path / leave(tmp_path, algorithm_policy("csac"), format).file
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
    path = tmp_path / leave(tmp_path, algorithm_policy("csac"), format).file
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
    contract = leave(tmp_path, algorithm_policy("csac"), format)
    assert open_artefact(tmp_path / contract.file).format == format
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
    contract = leave(tmp_path, algorithm_policy(algorithm), "c")
    path = tmp_path / "policy.h"
    text = path.read_text().replace(
        "static inline void csac_reset", "static int evil = 1;\nstatic inline void csac_reset"
    )
    path.write_text(text)
    write_contract(tmp_path, dataclasses.replace(contract, sha256=sha256_of(path)))
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
def test_a_contract_cannot_bring_code_into_its_header(tmp_path):
    contract = leave(tmp_path, algorithm_policy("csac"), "c")
    path, task = tmp_path / "policy.h", "Pendulum-v1 */ int evil(void) { return 1; } /*"
    policy = dataclasses.replace(contract.policy, task=task)
    first, _, rest = path.read_text().partition("\n")
    known = contract.policy.task or "a task of its own"
    path.write_text(f"{first.replace(known, task)}\n{rest}")
    assert "evil" in path.read_text()
    write_contract(tmp_path, dataclasses.replace(contract, policy=policy, sha256=sha256_of(path)))
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
    contract = leave(tmp_path, algorithm_policy("ppo"), "c")
    parts = ((None, (size,)),)
    policy = dataclasses.replace(contract.policy, observation_parts=parts)
    write_contract(tmp_path, dataclasses.replace(contract, policy=policy))
    with pytest.raises(InputError, match="is not a header of this csac"):
        open_artefact(tmp_path)


@needs_compiler
def test_headers_of_the_system_s_that_lie_beside_are_not_compiled(tmp_path, monkeypatch):
    from csac.deploy.c_size import sizes
    from csac.evaluation import latency

    monkeypatch.setattr(latency, "WARM_UP", 1)
    leave(tmp_path, algorithm_policy("csac"), "c")
    for header in ("float.h", "math.h", "stdint.h", "time.h"):
        (tmp_path / header).write_text(f"#error a stranger's {header}\n")
    assert np.isfinite(open_artefact(tmp_path).act(np.zeros(5))).all()
    assert len(latency.measure(tmp_path, calls=3, seconds=0)[0].durations) == 3
    assert isinstance(sizes(tmp_path), list)


@needs_compiler
def test_what_does_not_compile_is_named(tmp_path):
    source, header = tmp_path / "latency.c", tmp_path / "policy.h"
    source.write_text('#include "policy.h"\nint two(void) { return missing; }\n')
    header.write_text("int one(void);\n")
    with pytest.raises(InputError, match=r"cc does not compile latency\.c: .*missing"):
        compile_c("-c", source, "-o", tmp_path / "made.o")
    with pytest.raises(InputError, match=r"cc does not compile latency\.c: .*no-such-option"):
        compile_c("-c", "--no-such-option", source, "-o", tmp_path / "made.o")
    header.write_text("#error not today\n")
    with pytest.raises(InputError, match=r"cc does not compile policy\.h: .*not today"):
        compile_c("-c", source, "-o", tmp_path / "made.o")


@needs_compiler
def test_sections_of_other_names_have_no_size(tmp_path, monkeypatch):
    """As on macOS, where an object has `__text` and `__const`: nothing known is not nothing at all."""
    lister, told = tmp_path / "size", []
    lister.write_text("#!/bin/sh\necho 'section size addr'\necho '__text 345 0'\necho '__const 4567 345'\n")
    lister.chmod(0o755)
    monkeypatch.setattr(c_size, "TARGETS", {"this machine": ("cc", str(lister), ())})
    leave(tmp_path / "made", algorithm_policy("csac"), "c")
    assert c_size.sizes(tmp_path / "made", told.append) == []
    assert told == [f"no size for this machine: {lister} lists none of the sections text, rodata, data, bss"]


@needs_compiler
def test_what_is_compiled_is_what_was_looked_at(tmp_path):
    contract = leave(tmp_path, algorithm_policy("csac"), "c")
    with header_alone(tmp_path, contract) as place:
        (tmp_path / "policy.h").write_text("#error exchanged meanwhile\n")
        assert [path.name for path in place.iterdir()] == ["policy.h"]
        assert "csac_step" in (place / "policy.h").read_text()
    with pytest.raises(InputError, match="is not a header of this csac"), header_alone(tmp_path, contract):
        pass


def test_an_observation_of_another_size_is_refused(tmp_path, format):
    artefact = exported(tmp_path, algorithm_policy("csac"), format)
    with pytest.raises(InputError, match=r"shape \(4,\); the artefact takes \(5,\)"):
        artefact.act(np.zeros(4))


def test_noise_of_another_shape_is_refused(tmp_path, format):
    policy = algorithm_policy("csac")
    artefact, zeros = exported(tmp_path, policy, format, noise_seed=0), np.zeros(5)
    for noise in (np.zeros(1), np.zeros((1, 3)), np.zeros(4)):
        with pytest.raises(InputError, match=r"the noise has shape \(.*\); the artefact takes \(3,\)"):
            artefact.act(zeros, noise)
    expected = policy.contract.to_environment(policy.act(np.zeros((1, 5), np.float32))[0])
    np.testing.assert_allclose(artefact.act(zeros, np.zeros(3, np.float64)), expected, atol=1e-5)


def test_noise_for_a_policy_that_does_not_sample_is_refused(tmp_path, format):
    artefact = exported(tmp_path, algorithm_policy("csac"), format)
    with pytest.raises(InputError, match="exported without --stochastic: it takes no noise"):
        artefact.act(np.zeros(5), np.zeros(3, np.float32))


def test_opening_leaves_nothing_in_the_folder(tmp_path, format):
    artefact = exported(tmp_path, algorithm_policy("csac"), format)
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
