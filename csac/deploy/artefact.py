"""Write a policy as an artefact in any format, open an artefact, and run it as its user does.

Its folder holds `policy.safetensors`, the file that runs it (`policy.py`, `policy.onnx` or `policy.h`), and
`contract.json`: the policy's contract with the checksums of these files, the guards, and the policy's provenance.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from csac.checks import check_path
from csac.deploy import c, onnx
from csac.deploy.contract import CONTRACT, Contract, check_checksum, read_file, read_json, write_with_checksum
from csac.deploy.guards import Guards
from csac.deploy.policy import POLICY, Policy
from csac.deploy.templates import FOLDER
from csac.deploy.templates.policy import Policy as Loader
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

Format = Literal["numpy", "onnx", "c"]

_LOADER = FOLDER / "policy.py"  # runs any policy with NumPy alone; copied next to policy.safetensors
FILES: dict[str, str] = {"numpy": "policy.py", "onnx": "policy.onnx", "c": "policy.h"}


@dataclass(eq=False, repr=False)
class Artefact:
    """An exported policy, as opened by `open_artefact`.

    `fields` is the content of its `contract.json`; `runner` computes its actions.
    """

    fields: dict[str, Any]
    contract: Contract
    guards: Guards
    runner: Loader | onnx.Session | c.Library

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, float32 [action], on the environment's scale, for a flat observation [observation]."""
        observation = np.ascontiguousarray(observation, np.float32)
        if observation.shape != (size := (self.contract.spec.observation_size,)):
            raise InputError(f"the observation has shape {observation.shape}; the artefact takes {size}")
        return self.runner.act(observation)

    def reset(self) -> None:
        """Begin an episode: the guards forget the previous action."""
        self.runner.reset()

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action for one of the environment's observations, [*action_shape], and `state` unchanged.

        The signature is that of Stable-Baselines3; the action is always deterministic.
        """
        if episode_start is not None and np.any(episode_start):
            self.reset()
        return self.act(self.contract.flatten(observation)).reshape(self.contract.action_shape), state


def write_artefact(folder: Path, policy: Policy, format: Format, guards: Guards, facts: Mapping[str, Any]) -> None:
    """Write an artefact into an empty folder. `facts` are additional fields of its `contract.json`."""
    fields = {
        **policy.contract.fields(),
        "observation_size": policy.contract.spec.observation_size,
        "format": format,
        "guards": guards.fields(),
        **_as_json({"control_rate_hz": None, **facts}),
    }
    match format:
        case "numpy":
            content = _LOADER.read_bytes()
        case "onnx":
            content = onnx.model(policy, guards, fields)
        case "c":
            content = c.header(policy, guards, fields["control_rate_hz"]).encode()
    write_with_checksum(folder / POLICY, policy.encode(), fields)
    write_with_checksum(folder / FILES[format], content)


def open_artefact(path: str | Path, optimise: bool = False) -> Artefact:
    """Open an artefact, given its folder or a file in it. `optimise` compiles C code for this machine's processor.

    Only csac's own code is run: a loader or header that differs from what this version of csac writes is refused.

    Raises InputError for a damaged or foreign artefact, or if ONNX Runtime or the C compiler that it needs is missing.
    """
    check_path("the folder of an artefact", path)
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    if not path.exists() or not (folder / CONTRACT).exists():
        raise InputError(f"{path} is not an artefact: give a folder that csac export has written")
    fields = read_json(folder / CONTRACT)
    contract = Contract.of_fields(fields, folder / CONTRACT)
    try:
        name, guards = FILES[fields["format"]], Guards.of_fields(fields["guards"], contract)
        control_rate = fields["control_rate_hz"] and float(fields["control_rate_hz"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder} holds no artefact of csac (no {error}): export it again") from error
    check_checksum(folder / name, fields)
    policy = Policy.load(folder / POLICY)
    match fields["format"]:
        case "numpy":
            if read_file(folder / name) != _LOADER.read_bytes():
                raise InputError(
                    f"{folder / name} is not the loader of this csac, which runs no other code: export it again"
                )
            runner = Loader(folder)
        case "onnx":
            runner = onnx.Session(folder / name, policy, guards)
        case _:
            runner = c.Library(folder / name, policy, guards, control_rate, optimise)
    return Artefact(fields, contract, guards, runner)


def _as_json(value: Any) -> Any:
    """Return a value with the strings `Infinity`, `-Infinity` or `NaN` for numbers that JSON cannot represent."""
    match value:
        case dict():
            return {name: _as_json(item) for name, item in value.items()}
        case list() | tuple():
            return [_as_json(item) for item in value]
        case float() if not math.isfinite(value):
            return json.dumps(value)
    return value
