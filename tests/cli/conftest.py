"""Commands are typed in a folder of their own."""

from __future__ import annotations

from pathlib import Path

import pytest
from shown import make_set
from typed import SUPPORT, calls_of, csac

import csac.training.train as training


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SUPPORT)


@pytest.fixture
def train_call(monkeypatch):
    """What `csac train` calls `train` with, instead of training."""
    calls = calls_of(monkeypatch, training, "train", make_set(Path("nothing"), [[1.0]]))

    def call(line):
        assert csac(f"train {line}") == 0
        return calls[-1]

    return call
