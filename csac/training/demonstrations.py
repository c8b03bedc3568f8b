"""Demonstrations: the user's own transitions, which a replay buffer starts with, kept as its first replay file."""

from __future__ import annotations

import importlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import safetensors.numpy

from csac.algorithms.memory import pack
from csac.checks import did_you_mean
from csac.deploy.contract import Contract
from csac.record.files import write_atomically
from csac.tasks.failures import message
from csac.training.checkpoint import REPLAY, Facts, facts_of
from csac.types import InputError, Transition

if TYPE_CHECKING:
    import os

    from csac.record.run import RunDirectory
    from csac.tasks.spaces import ContractParts
    from csac.types import Algorithm

DemonstrationData = str | Path | Mapping[str, Any]  # a .npz file, the id of a Minari data set, or arrays by name

REQUIRED = ("observations", "actions", "rewards", "next_observations", "terminations")
OTHER_NAMES = {"terminations": "terminated", "truncations": "truncated"}  # names in `load_checkpoint(run).replay()`
NAMES = (*REQUIRED, *OTHER_NAMES, *OTHER_NAMES.values())
BOUNDS_TOLERANCE = 1e-3  # as a fraction of half an action's range: more than rounding


class Demonstrations(NamedTuple):
    """The content of a run's replay file of transitions, and the facts about it in the configuration."""

    content: bytes
    facts: dict[str, Any]

    @classmethod
    def read(cls, data: DemonstrationData, algorithm: Algorithm, parts: ContractParts) -> Demonstrations:
        """Read transitions for a task with these parts. Raises InputError if they do not fit the task."""
        if (capacity := getattr(algorithm, "replay_size", None)) is None:
            raise InputError(
                f"demonstrations are for algorithms with a replay, and {type(algorithm).__name__} has none"
            )
        contract = Contract(None, "", "relu", "tanh", *parts)
        rows = _rows(*_arrays(data, contract), contract)
        if len(rows) > capacity:
            raise InputError(f"demonstrations has {len(rows):,} transitions and replay_size is {capacity:,}")
        content = safetensors.numpy.save({"rows": rows})
        source = "arrays" if isinstance(data, Mapping) else Path(data).name if _is_file(data) else str(data)
        return cls(content, {"source": source, "transitions": len(rows), **facts_of(content)})

    def write(self, run: RunDirectory) -> None:
        """Write them into a new run. Raises OSError."""
        name = next(iter(files_of(self.facts)))
        (run.checkpoints / REPLAY).mkdir(parents=True, exist_ok=True)
        write_atomically(run.checkpoints / name, self.content)


def are_facts(data: object) -> bool:
    """Return whether these are the facts about demonstrations in a run's configuration."""
    return isinstance(data, dict) and "sha256" in data


def files_of(facts: dict[str, Any]) -> dict[str, Facts]:
    """Return the replay file of the demonstrations, by name; empty if there are none."""
    file_facts = {name: facts[name] for name in ("bytes", "sha256") if facts}
    return {f"{REPLAY}/0-{facts['transitions']}.safetensors": file_facts} if facts else {}


def rows_of(run: RunDirectory) -> np.ndarray:
    """Return the packed transitions [n, width] that a run starts with. Raises InputError if they are lost."""
    ((name, facts),) = files_of(run.config.demonstrations).items()
    path = run.checkpoints / name
    if not path.is_file() or facts_of(content := path.read_bytes()) != facts:
        raise InputError(f"{path} is missing or has changed: train anew, in another directory")
    return safetensors.numpy.load(content)["rows"]


def _arrays(data: DemonstrationData, contract: Contract) -> tuple[dict[str, Any], list[str]]:
    """Return the given arrays under csac's names, and the names that they came with."""
    if isinstance(data, Mapping):
        arrays = dict(data)
    elif _is_file(data):
        arrays = _of_file(Path(data))
    elif isinstance(data, str):
        arrays = _of_minari(data, contract)
    else:
        raise InputError(f"demonstrations is a .npz file, a dict of arrays or a Minari id, not {data!r:.40}")
    for name in arrays:
        if name not in NAMES and (hint := did_you_mean(name, NAMES)):
            raise InputError(f"demonstrations has {name!r}: {hint}")
    return arrays | {name: arrays[other] for name, other in OTHER_NAMES.items() if other in arrays}, list(arrays)


def _is_file(data: str | os.PathLike[str]) -> bool:
    return isinstance(data, Path) or (isinstance(data, str) and data.endswith(".npz"))


def _of_file(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except OSError as error:
        raise InputError(f"demonstrations: cannot read {path}: {error.strerror or error}") from None
    except (ValueError, AttributeError, TypeError, EOFError, zipfile.BadZipFile):
        raise InputError(f"demonstrations: {path} is no .npz file of arrays of numbers") from None


def _of_minari(name: str, contract: Contract) -> dict[str, Any]:
    try:
        minari = importlib.import_module("minari")
    except ImportError:
        hint = "is no .npz file; if it is a Minari data set, install what reads it: pip install 'minari[hdf5]'"
        raise InputError(f"demonstrations: {name!r} {hint}") from None
    try:
        episodes = list(minari.load_dataset(name, download=True).iterate_episodes())
        observations = [contract.flatten(episode.observations) for episode in episodes]  # one more than actions
        fields = ("actions", "rewards", "terminations", "truncations")
        arrays = {name: np.concatenate([getattr(episode, name) for episode in episodes]) for name in fields}
        arrays["observations"] = np.concatenate([one[:-1] for one in observations])
        arrays["next_observations"] = np.concatenate([one[1:] for one in observations])
    except Exception as error:
        raise InputError(f"demonstrations: Minari cannot give {name!r}: {message(error)}") from None
    return arrays


def _rows(arrays: dict[str, Any], names: list[str], contract: Contract) -> np.ndarray:
    """Return packed transitions [n, width], actions in [-1, 1]."""
    if missing := [name for name in REQUIRED if name not in arrays]:
        raise InputError(f"demonstrations lacks {', '.join(missing)}: it has {', '.join(map(str, names)) or 'nothing'}")
    spec, bounds = contract.spec, contract.bounds
    rewards = arrays["rewards"]
    number = len(rewards) if hasattr(rewards, "__len__") and getattr(rewards, "shape", True) else 0  # () is a number
    if not number:
        raise InputError("demonstrations has no transitions")

    def field(name: str, size: int) -> np.ndarray:
        try:
            with np.errstate(over="ignore"):  # an overflow becomes infinite, which is refused
                value = contract.flatten(arrays[name]) if "observations" in name else arrays[name]
                flat = np.asarray(value, np.float32)
        except (InputError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"demonstrations: {name}: {message(error)}") from None
        if flat.shape[:1] != (number,) or flat.size != number * size:
            wanted = (number, size)[: 1 + (size > 1 or flat.ndim > 1)]
            raise InputError(f"demonstrations: {name} has shape {flat.shape}, not {wanted} as for {number:,} rewards")
        if not np.isfinite(flat).all():
            raise InputError(f"demonstrations: {name} holds what is not finite")
        return flat.reshape(number, size)

    actions = bounds.unscale(field("actions", spec.action_size))
    if (beyond := float(np.abs(actions).max())) > 1 + BOUNDS_TOLERANCE:
        problem = f"at {beyond:.3g} times the task's bounds: give them on its own scale, clipped to its bounds"
        raise InputError(f"demonstrations: actions are {problem}")
    arrays = {"truncations": np.zeros(number), **arrays}
    ends = [field(name, 1)[:, 0] for name in ("terminations", "truncations")]
    if not np.isin(ends, (0.0, 1.0)).all():
        raise InputError("demonstrations: terminations and truncations are 0 or 1")
    observations, following = (field(name, spec.observation_size) for name in ("observations", "next_observations"))
    return pack(Transition(observations, np.clip(actions, -1, 1), field("rewards", 1)[:, 0], following, *ends))
