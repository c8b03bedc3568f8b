"""What a run is, as JSON keeps it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac.record.config import as_json
from csac.types import InputError


@dataclass
class Options:
    size: int = 3


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({}, {}),
        ({"size": (3, 4), "depth": [1, {"a": None}]}, {"size": [3, 4], "depth": [1, {"a": None}]}),
        ({"g": np.float64(9.5), "n": np.int64(3), "on": np.bool_(True)}, {"g": 9.5, "n": 3, "on": True}),
    ],
)
def test_arguments_are_what_json_keeps(given, kept):
    arguments = as_json("environment_arguments", given)
    assert arguments == kept == json.loads(json.dumps(arguments))
    assert not any(isinstance(value, np.generic) for value in arguments.values())


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"levels": {1: 2.0}}, "keys must be texts"),
        ({"mean": np.zeros(2)}, "ndarray"),
        ({"file": Path("here")}, "PosixPath"),
        ({"options": [Options()]}, "Options"),
        (["g"], "keyword arguments"),
    ],
)
def test_arguments_that_json_would_change_are_refused(given: Any, why):
    with pytest.raises(InputError, match=f"environment_arguments .*{why}") as refusal:
        as_json("environment_arguments", given)
    assert "\n" not in str(refusal.value)
