"""Artefacts are opened as they were left; what is damaged or foreign is refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from artefacts import exported, leave, needs_compiler
from policies import algorithm_policy, contract, random_policy

from csac.deploy.artefact import FILES, open_artefact
from csac.deploy.contract import sha256_of
from csac.deploy.guards import make_guards
from csac.types import InputError


def refused(path: Path, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        open_artefact(path)
    assert "\n" not in str(caught.value)


def sign(folder: Path, name: str) -> None:
    """Have a folder's contract hold the checksum of the file that is there now, as somebody else would."""
    path = folder / "contract.json"
    fields = json.loads(path.read_text())
    fields["sha256"][name] = sha256_of(folder / name)
    path.write_text(json.dumps(fields))


def test_a_flipped_bit_in_any_file_is_refused(tmp_path, format):
    leave(tmp_path, algorithm_policy("csac"), format)
    for name in (FILES[format], "policy.safetensors"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[:-2] + bytes([content[-2] ^ 1]) + content[-1:])
        refused(tmp_path, f"{name} does not match its checksum")
        (tmp_path / name).write_bytes(content)
    open_artefact(tmp_path)
    (tmp_path / FILES[format]).unlink()
    refused(tmp_path, f"{FILES[format]} cannot be read")


@pytest.mark.parametrize(
    "change",
    [
        {"schema_version": 1},
        {"format": "torch"},
        {"format": None},
        {"guards": {}},
        {"guards": {"fallback": [1.0], "repeats_last": False, "largest_change": None}},
        {"control_rate_hz": "often"},
        {"action_low": [0.0]},
        {"sha256": {}},
        {"sha256": None},
    ],
)
def test_a_contract_that_is_none_is_refused(tmp_path, change):
    path = leave(tmp_path, algorithm_policy("csac"), "numpy") / "contract.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    refused(tmp_path, tmp_path.name)


def test_what_is_no_artefact_is_refused(tmp_path):
    refused(tmp_path / "nothing", "is not an artefact")
    refused(tmp_path, "is not an artefact")
    random_policy(contract()).save(tmp_path)
    refused(tmp_path, "holds no artefact")


def test_an_artefact_is_opened_by_a_file_in_it_too(tmp_path, format):
    leave(tmp_path, algorithm_policy("csac"), format)
    assert open_artefact(tmp_path / FILES[format]).fields["format"] == format


def test_a_loader_that_is_not_csacs_is_not_run(tmp_path):
    leave(tmp_path, algorithm_policy("csac"), "numpy")
    (tmp_path / "policy.py").write_text("raise SystemExit('run')\n")
    sign(tmp_path, "policy.py")
    refused(tmp_path, "is not the loader of this csac")


@needs_compiler
def test_a_header_that_is_not_csacs_is_not_compiled(tmp_path):
    path = leave(tmp_path, algorithm_policy("csac"), "c") / "policy.h"
    path.write_text(
        path.read_text().replace("static inline void csac_reset", "int evil;\nstatic inline void csac_reset")
    )
    sign(tmp_path, "policy.h")
    refused(tmp_path, "is not the header of this csac")


@needs_compiler
@pytest.mark.parametrize("field", ["task", "algorithm"])
def test_a_contract_cannot_bring_code_into_its_header(tmp_path, field):
    path = leave(tmp_path, algorithm_policy("csac"), "c") / "contract.json"
    fields, code = json.loads(path.read_text()), "csac */ int evil(void) { return 1; } /*"
    path.write_text(json.dumps(fields | {field: code}))
    header = tmp_path / "policy.h"
    header.write_text(header.read_text().replace(fields[field], code, 1))
    sign(tmp_path, "policy.h")
    refused(tmp_path, "is not the header of this csac")


@needs_compiler
def test_headers_of_the_system_s_that_lie_beside_are_not_compiled(tmp_path):
    leave(tmp_path, algorithm_policy("csac"), "c")
    for header in ("float.h", "math.h", "stdint.h", "time.h"):
        (tmp_path / header).write_text(f"#error a stranger's {header}\n")
    assert np.isfinite(open_artefact(tmp_path).act(np.zeros(5))).all()


def test_an_observation_of_another_size_is_refused(tmp_path, format):
    artefact = exported(tmp_path, algorithm_policy("csac"), format)
    with pytest.raises(InputError, match=r"shape \(4,\); the artefact takes \(5,\)"):
        artefact.act(np.zeros(4))


def test_an_episode_that_begins_resets_the_guards(tmp_path, format):
    policy = algorithm_policy("csac")
    artefact = exported(tmp_path, policy, format, make_guards(policy.contract, rate_limit=0.01))
    first, _ = artefact.predict(np.zeros(5), episode_start=np.ones(1, bool))
    far = np.full(5, 3.0)
    assert np.abs(artefact.predict(far)[0] - first).max() <= 0.0251
    np.testing.assert_allclose(artefact.predict(far, episode_start=True)[0], policy.predict(far)[0], atol=1e-5)
