"""Checkpoints that someone changed and signed anew: each is refused as an InputError, or the run goes on as it can."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import plans
import pytest
import safetensors.numpy
import trainer  # noqa: F401  (its cache of compiled programs)
from resuming import SMALL, run

from csac.algorithms import SAC
from csac.record.run import RunDirectory
from csac.tasks.perturbations import perturbations_of
from csac.training import messages
from csac.training.checkpoint import FOLDER, Checkpoint, taken_back
from csac.training.group import Group
from csac.training.resume import roll_back
from csac.types import InputError

LEARNER = SAC(**SMALL)
STEP = 130
NOISE = ["action_noise=0.1@50"]
# In place of each value that JSON can hold.
OTHERS: tuple[Any, ...] = (
    None,
    True,
    -1,
    0.5,
    10**30,
    float("nan"),
    "",
    "²",
    "../x",
    [],
    [[]],
    {},
    {"x": 1},
)

Path_ = tuple[Any, ...]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two seeds, one with an episode in progress that can be saved."""
    path = tmp_path_factory.mktemp("forged") / "run"
    return run(path, LEARNER, STEP, seeds=2, perturbations=NOISE).path


@pytest.fixture(scope="module")
def group(trained):
    """One group for all: what it takes back is tried in place of what it holds."""
    options = {"evaluation_interval": 1000, "perturbations": perturbations_of(NOISE)}
    return Group(plans.settings(LEARNER, "Hopper-v4", 400, trained / FOLDER, STEP, **options), [0, 1])


def places(value: Any, path: Path_ = ()) -> Iterator[Path_]:
    """Every place in nested JSON."""
    if path:
        yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


def changed(value: Any, path: Path_, other: Any) -> Any:
    """The same with another value at one place; without that place where `other` is Ellipsis."""
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    if other is ...:
        del inner[path[-1]]
    else:
        inner[path[-1]] = other
    return copy


def forgeries(value: Any, seed: int, number: int) -> list[tuple[Path_, Any]]:
    """Some of all the changes that can be made to a value, drawn anew for each seed."""
    all_of_them = [(path, other) for path in places(value) for other in (..., *OTHERS)]
    chosen = np.random.default_rng(seed).permutation(len(all_of_them))[:number]
    return [all_of_them[i] for i in chosen]


def sign(folder: Path, fields: dict[str, Any]) -> None:
    text = json.dumps(fields, sort_keys=True).encode()
    (folder / f"step_{STEP}.json").write_text(json.dumps({**fields, "sha256": hashlib.sha256(text).hexdigest()}))


def fields_of(folder: Path) -> dict[str, Any]:
    fields = json.loads((folder / f"step_{STEP}.json").read_text())
    del fields["sha256"]
    return fields


def test_a_forged_list_is_refused_or_leads_back(tmp_path, trained):
    fields = fields_of(trained / FOLDER)
    for path, other in forgeries(fields, seed=0, number=40):
        copy = Path(shutil.copytree(trained, tmp_path / "copy"))
        sign(copy / FOLDER, changed(fields, path, other))
        with suppress(InputError):
            point = roll_back(RunDirectory.open(copy))
            assert point.step in (120, STEP)
            checkpoint = Checkpoint.open(copy / FOLDER, point.step)
            checkpoint.memory(0, np.zeros((150, 29), np.float32))
        shutil.rmtree(copy)


def test_a_forged_seed_is_refused_or_goes_on(tmp_path, trained, group):
    folder, fields = trained / FOLDER, fields_of(trained / FOLDER)
    name = f"step_{STEP}.seed_1.safetensors"
    original = (folder / name).read_bytes()
    saved = Checkpoint.open(folder, STEP).seed(1)
    for path, other in forgeries(saved.values, seed=0, number=60):
        write_seed(folder, fields, name, saved.arrays, changed(saved.values, path, other))
        check_refused_or_goes_on(folder, group)
    (folder / name).write_bytes(original)
    sign(folder, fields)


def write_seed(folder: Path, fields: dict[str, Any], name: str, arrays: dict[str, np.ndarray], values: Any) -> None:
    metadata = {"saved": json.dumps({"values": values, "transitions": [0, STEP]})}
    content = safetensors.numpy.save(arrays, metadata=metadata)
    (folder / name).write_bytes(content)
    facts = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    sign(folder, changed(fields, ("files", name), facts))


def check_refused_or_goes_on(folder: Path, group: Group) -> None:
    """Going on may fail its seed, in one line too."""
    environments = group.environments
    group.step = STEP
    environments.alive[:], environments._running, environments._failures = True, [0, 1], []
    with suppress(InputError):
        checkpoint = Checkpoint.open(folder, STEP)
        with taken_back(checkpoint):
            group._go_on(checkpoint)
        for message in group.run(lambda: group.step == STEP + 30):
            assert not isinstance(message, messages.Failed) or "\n" not in message.reason
