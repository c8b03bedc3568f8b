"""What an artefact says of itself: contract.json beside a policy that has left its run."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from csac.deploy.contract import FLOAT32_MAX, Contract, read_file, read_json
from csac.deploy.guards import NO_GUARDS, Guards
from csac.record.config import SEED_LIMIT
from csac.types import InputError

if TYPE_CHECKING:
    from pathlib import Path

Format = Literal["numpy", "onnx", "c"]
Weights = Literal["float32", "float16", "int8"]

ARTEFACT_VERSION = 1
CONTRACT = "contract.json"
POLICY_FILES: dict[str, str] = {"numpy": "policy.safetensors", "onnx": "policy.onnx", "c": "policy.h"}


@dataclass(frozen=True, eq=False)
class ArtefactContract:
    """A `Contract` and all else that whoever runs an artefact has to know.

    `observation_low` and `observation_high` [observation] are the task's own bounds, infinite where it has none, and
    None where nobody has asked the task. `control_rate` is how many actions the task takes a second, `noise_seed` what
    sampled actions are drawn by (None: the deterministic policy). `provenance` says where the policy comes from and
    `verification` what was found when it was exported; both are for people: an infinite number in them leaves as text.
    """

    policy: Contract
    format: Format
    weights: Weights = "float32"
    sha256: str = ""
    observation_low: np.ndarray | None = None
    observation_high: np.ndarray | None = None
    control_rate: float | None = None
    noise_seed: int | None = None
    guards: Guards = NO_GUARDS
    provenance: dict[str, Any] = field(default_factory=dict)
    verification: dict[str, Any] = field(default_factory=dict)

    @property
    def file(self) -> str:
        """The name of the policy's file."""
        return POLICY_FILES[self.format]

    def fields(self) -> dict[str, Any]:
        """Return what its JSON holds: all that a run's contract has, and more."""
        return {
            "artefact_version": ARTEFACT_VERSION,
            "format": self.format,
            "file": self.file,
            "sha256": self.sha256,
            "weights": self.weights,
            **self.policy.fields(),
            "observation_size": self.policy.spec.observation_size,
            "observation_low": _bounds(self.observation_low),
            "observation_high": _bounds(self.observation_high),
            "control_rate_hz": self.control_rate,
            "noise_seed": self.noise_seed,
            "guards": self.guards.fields(),
            "provenance": _as_json(self.provenance),
            "verification": _as_json(self.verification),
        }

    def text(self) -> str:
        """Return its JSON."""
        return json.dumps(self.fields(), indent=2, allow_nan=False) + "\n"

    @staticmethod
    def load(folder: Path) -> ArtefactContract:
        """Read the contract of the artefact in a folder.

        Raises:
            InputError: no contract there, or a damaged one; a policy file that cannot be read, or is not the one it was
                written for.
        """
        path = folder / CONTRACT
        if not path.exists():
            if below := artefacts_below(folder):
                raise InputError(f"{folder} holds no artefact itself: give {' or '.join(map(str, below))}")
            raise InputError(f"{folder} holds no artefact: there is no {CONTRACT} (csac export writes one)")
        fields = read_json(path)
        policy = Contract.of_fields(fields, path)
        try:
            contract = _artefact_contract(fields, policy)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else error
            raise InputError(f"{path} is not the contract of an artefact ({reason}): export it again") from error
        file = folder / contract.file
        if not file.exists():
            raise InputError(f"{folder} has no {contract.file}, which its {CONTRACT} is for: export it again")
        if sha256_of(file) != contract.sha256:
            raise InputError(f"{file} is not the file that its {CONTRACT} was written for: export it again")
        return contract


def is_artefact(folder: Path) -> bool:
    """Whether the contract of an artefact lies in a folder, sound or not; that of a run's policies is none."""
    try:
        fields = read_json(folder / CONTRACT)
    except InputError:
        return False
    return isinstance(fields, dict) and "artefact_version" in fields


def artefacts_below(folder: Path) -> list[Path]:
    """Return the folders of artefacts in a folder of several, or in a run's own, in the order of their names."""
    places = sorted(path.parent for pattern in ("*", "export/*") for path in folder.glob(f"{pattern}/{CONTRACT}"))
    return [place for place in places if is_artefact(place)]


def _as_json(value: Any) -> Any:
    """Return a value with the text `Infinity`, `-Infinity` or `NaN` for numbers that JSON has no word for."""
    match value:
        case dict():
            return {name: _as_json(item) for name, item in value.items()}
        case list() | tuple():
            return [_as_json(item) for item in value]
        case float() if not math.isfinite(value):
            return json.dumps(value)
    return value


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits. Raises InputError where it cannot be read."""
    return hashlib.sha256(read_file(path)).hexdigest()


def _artefact_contract(fields: Any, policy: Contract) -> ArtefactContract:
    version, seed, rate = fields["artefact_version"], fields["noise_seed"], fields["control_rate_hz"]
    if version != ARTEFACT_VERSION:
        raise ValueError(f"artefact_version {version!r} where this csac reads {ARTEFACT_VERSION}")
    if fields["format"] not in get_args(Format) or fields["weights"] not in get_args(Weights):
        raise ValueError(f"format {fields['format']!r} or weights {fields['weights']!r} are not known")
    if seed is not None and not (type(seed) is int and 0 <= seed < SEED_LIMIT):
        raise ValueError(f"noise_seed {seed!r:.40} is no seed")
    if rate is not None and not (type(rate) in (int, float) and 0 < rate <= FLOAT32_MAX):
        raise ValueError(f"control_rate_hz {rate!r:.40} is no rate")
    if not isinstance(fields["provenance"], dict) or not isinstance(fields["verification"], dict):
        raise TypeError("provenance or verification is no JSON object")
    low, high = (_read_bounds(fields[f"observation_{end}"], end, policy) for end in ("low", "high"))
    return ArtefactContract(
        policy,
        fields["format"],
        fields["weights"],
        fields["sha256"],
        low,
        high,
        rate,
        seed,
        Guards.of_fields(fields["guards"], policy),
        fields["provenance"],
        fields["verification"],
    )


def _bounds(bounds: np.ndarray | None) -> list[float | None] | None:
    """Return bounds as JSON can hold them: null where there is none."""
    return None if bounds is None else [float(bound) if np.isfinite(bound) else None for bound in bounds]


def _read_bounds(given: Any, end: str, policy: Contract) -> np.ndarray | None:
    if given is None:
        return None
    infinite = -np.inf if end == "low" else np.inf
    bounds = np.array([infinite if bound is None else bound for bound in given], np.float64)
    if bounds.shape != (policy.spec.observation_size,):
        raise ValueError(f"observation_{end} is not {policy.spec.observation_size} numbers")
    return bounds
