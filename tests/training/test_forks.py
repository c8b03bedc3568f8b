"""A scheduler types the same line again: runs that began with others' checkpoints, and folders with more in them."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
from resuming import run

from csac import InputError, resume
from csac.record.sets import RunSet, find_sets
from csac.training.resume import Source


def test_a_fork_that_has_begun_needs_its_source_no_more(tmp_path):
    run(tmp_path / "source", steps=150, perturbations=["gain=0.9@130"])
    line = {"start_from": f"{tmp_path / 'source'}@120", "perturbations": ["gain=1.1@160"], "resume": True}
    fork = run(tmp_path / "fork", steps=180, **line)
    assert fork.config.perturbations == ("gain=1.1@160",)
    shutil.rmtree(tmp_path / "source")
    assert run(tmp_path / "fork", steps=200, **line).steps_done == 200
    with pytest.raises(InputError, match="perturbations"):
        run(tmp_path / "fork", steps=200, **{**line, "perturbations": ["gain=1.2@160"]})


def test_what_lies_beside_the_seeds_is_in_the_way_of_new_runs_alone(tmp_path):
    run(tmp_path / "set", steps=50)
    (tmp_path / "set" / "play.mp4").touch()
    assert run(tmp_path / "set", steps=60, resume=True).steps_done == 60
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "play.mp4").touch()
    with pytest.raises(InputError, match="other is not empty"):
        run(tmp_path / "other", steps=50, resume=True)


def test_a_fork_that_is_killed_while_it_is_made_leaves_no_half_of_one(tmp_path, monkeypatch):
    run(tmp_path / "source", steps=60)
    line: dict[str, Any] = {"start_from": tmp_path / "source", "steps": 90, "resume": True}
    with monkeypatch.context() as patched:
        patched.setattr(Source, "copy_to", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "fork", **line)
    assert not any((tmp_path / "fork").glob("seed-*"))
    assert find_sets(tmp_path / "fork") == []
    assert run(tmp_path / "fork", **line).steps_done == 90


def interrupted(*_):
    raise KeyboardInterrupt


def test_a_run_that_is_in_use_changes_none_of_its_set(tmp_path):
    runs = run(tmp_path / "set", steps=50, seeds=2, seeds_per_process=2)
    with runs.runs[1].locked():
        with pytest.raises(InputError, match="seed-1"):
            resume(tmp_path / "set", steps=60)
        with pytest.raises(InputError, match="seed-1"):
            run(tmp_path / "set", steps=60, seeds=2, resume=True)
    assert [one.config.steps for one in RunSet.open(tmp_path / "set").runs] == [50, 50]
