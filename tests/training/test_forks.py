"""A scheduler types the same line again: runs that began with others' checkpoints, and folders with more in them."""

from __future__ import annotations

import shutil

import pytest
from resuming import run

from csac import InputError


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
