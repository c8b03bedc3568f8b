"""What is written is read back the same; what is not of its type is refused in one line, whatever it is."""

from __future__ import annotations

import dataclasses
import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac.record.manifest import (
    Continuation,
    EvaluationPlan,
    Machine,
    Manifest,
    Origin,
    as_kept,
    differences,
    read,
    written,
)
from csac.types import InputError

FULL = Manifest(
    task="HalfCheetah-v4",
    environment_arguments={"reset_noise_scale": 0.1},
    perturbations=("friction=1.5@300000",),
    algorithm="csac",
    hyperparameters={"discount": 0.99, "actor_hidden_sizes": [256, 256]},
    seeds=(3, 4),
    groups=((3,), (4,)),
    steps=1_000,
    evaluation=EvaluationPlan(500, 2),
    machine=Machine("a processor", 2, "a host"),
    failures={4: "step 7: reward is nan"},
    forked_from=Origin("runs/first", 300, ("discount is 0.9, not 0.99",)),
    history=(Continuation("2026-01-01T00:00:00+00:00", 300, True, previous={"steps": 300}),),
)


def test_what_is_written_is_read_back():
    assert read(written(FULL)) == FULL


def test_an_older_manifest_gets_what_it_did():
    older = json.loads(written(FULL))
    for name in ("events", "perturbations", "forked_from", "checkpoints", "last_checkpoint"):
        del older[name]
    manifest = read(json.dumps(older).encode())
    assert (manifest.events, manifest.perturbations, manifest.forked_from) == ((), (), None)
    assert (manifest.checkpoints.keep, manifest.last_checkpoint) == (2, 0)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "it is not JSON"),
        (b'{"task": ', "it is not JSON"),
        (b"\xff\xfe", "it is not JSON"),
        (b"[" * 100_000, "it is not JSON"),
        (b"[]", "it is not a JSON object"),
        (b"{}", "schema version is None"),
        (b'{"schema_version": 2}', "schema version is 2, and this csac reads 1"),
        (b'{"schema_version": true}', "schema version is True"),
        (written(FULL).replace(b'"HalfCheetah-v4"', b"3"), "'task' is 3, not a text"),
        (written(FULL).replace(b'"algorithm"', b'"algorithms"'), "'algorithm' is missing"),
        (b'{"schema_version": 1, "task": "t"}', "'environment_arguments' is missing"),
    ],
)
def test_what_is_no_manifest_is_refused(content, problem):
    with pytest.raises(InputError, match=problem):
        read(content)


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        ("steps", 1.5, "'steps' is 1.5, not a whole number"),
        ("steps", True, "'steps' is True, not a whole number"),
        ("steps", 0, "steps are 0 with 0 done"),
        ("steps", 10**300, "steps are 1000"),
        ("seeds", [], "seeds are"),
        ("seeds", [2**32], "seeds are"),
        ("seeds", "01", "'seeds' is '01', not a list"),
        ("seeds", [[0]], r"'seeds' is \[0\], not a whole number"),
        ("evaluation.interval", 0, "interval or episodes below 1"),
        ("evaluation", None, "'evaluation' is None, not a JSON object"),
        ("state", "sleeping", "'state' is 'sleeping', not one of running, finished, failed, interrupted"),
        ("failures", {"one": "x"}, "'failures' has the key 'one', not a number"),
        ("failures", {"\u00b2": "x"}, "'failures' has the key"),
        ("history", [{"step": 3}], "'history.resumed' is missing"),
        ("device", "tpu", "'device' is 'tpu', not one of cpu, gpu"),
    ],
)
def test_what_is_not_of_its_type_is_named(path, value, problem):
    fields = json.loads(written(FULL))
    *above, name = path.split(".")
    place = fields
    for step in above:
        place = place[step]
    place[name] = value
    with pytest.raises(InputError, match=problem):
        read(json.dumps(fields).encode())


def test_no_changed_manifest_gives_another_error():
    """A value anywhere in it becomes something else: it is refused, or it is of the right type."""
    generator = random.Random(0)
    values: list[Any] = [None, True, -1, 0, 1.5, 10**30, "", "x", [], [None], {}, {"a": 1}, [[1]], "9" * 5_000]
    for _ in range(1_500):
        fields = json.loads(written(FULL))
        change(fields, generator, generator.choice(values))
        manifest = outcome_of(json.dumps(fields).encode())
        if isinstance(manifest, Manifest):
            assert read(written(manifest)) == manifest
        else:
            assert "\n" not in manifest
            assert len(manifest) < 300


def outcome_of(content: bytes) -> Manifest | str:
    try:
        return read(content)
    except InputError as error:
        return str(error)


def change(place: Any, generator: random.Random, value: Any) -> None:
    keys = list(place) if isinstance(place, dict) else list(range(len(place)))
    key = generator.choice(keys)
    if isinstance(place[key], dict | list) and place[key] and generator.random() < 0.6:
        change(place[key], generator, value)
    elif isinstance(place, dict) and generator.random() < 0.2:
        del place[key]
    else:
        place[key] = value


def test_differences_are_told_by_name():
    changed = dataclasses.replace(FULL, steps=2_000, evaluation=EvaluationPlan(500, 3))
    ours, theirs = (json.loads(written(manifest)) for manifest in (FULL, changed))
    assert differences(ours, theirs) == ["evaluation.episodes is 2, not 3", "steps is 1000, not 2000"]


def test_what_is_wanted_is_compared_as_it_would_be_kept():
    arguments = {
        "target": np.array([1.0, math.nan]),
        "grid": ((1, 2), (3, 4)),
        "model": Path("a/model.xml"),
        "weights": {1: np.float32(0.1)},
        "parts": [{"limit": math.nan}],
    }
    wanted = dataclasses.replace(FULL, environment_arguments=arguments)
    before, now = read(written(wanted)), as_kept(wanted)
    assert differences(vars(before), vars(now)) == []
    other = as_kept(dataclasses.replace(wanted, environment_arguments={**arguments, "grid": ((1, 2), (3, 5))}))
    told = differences(before.environment_arguments, other.environment_arguments)
    assert told == ["grid is [[1, 2], [3, 4]], not [[1, 2], [3, 5]]"]
