"""Commands are typed in a folder of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typed import NOTHING, SUPPORT, csac

import csac.training.train as training
from csac.record.run import RunDirectory


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SUPPORT)


@pytest.fixture
def train_call(monkeypatch):
    """What `csac train` calls `train` with, instead of training."""
    calls = []

    def train(algorithm, task, **options):
        calls.append({"algorithm": algorithm, "task": task, **options})
        return RunDirectory(Path("run"), replace(NOTHING, state="finished"))

    monkeypatch.setattr(training, "train", train)

    def call(line):
        assert csac(f"train {line}") == 0
        return calls[-1]

    return call
