"""`resume=True` with `start_from`, as a scheduler repeats one command, and folders with other files."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
from resuming import run

from csac import InputError, resume
from csac.record.sets import RunSet, find_sets
from csac.training.resume import Source

TWO: dict[str, Any] = {"seeds": 2, "seeds_per_process": 2, "perturbations": ["gain=0.9@25"], "checkpoint_interval": 20}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return run(tmp_path_factory.mktemp("made") / "set", steps=30, **TWO).path


@pytest.fixture
def source(tmp_path, made):
    """A set of two seeds, with checkpoints at steps 20 and 30."""
    return shutil.copytree(made, tmp_path / "source")


def test_a_fork_that_has_begun_resumes_without_its_source(tmp_path, source):
    line: dict[str, Any] = {"start_from": f"{source}@20", "perturbations": ["gain=1.1@35"], "resume": True}
    assert run(tmp_path / "fork", steps=40, **line).config.perturbations == ("gain=1.1@35",)
    shutil.rmtree(source)
    assert run(tmp_path / "fork", steps=50, **line).steps_done == 50
    with pytest.raises(InputError, match="perturbations"):
        run(tmp_path / "fork", steps=50, **{**line, "perturbations": ["gain=1.2@35"]})


def test_other_files_in_a_folder_prevent_new_runs_but_no_resume(tmp_path, source):
    (source / "play.mp4").touch()
    assert run(source, steps=32, resume=True, **TWO).steps_done == 32
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "play.mp4").touch()
    with pytest.raises(InputError, match="other is not empty"):
        run(tmp_path / "other", steps=32, resume=True)


def test_a_fork_that_is_interrupted_while_it_is_made_leaves_no_run(tmp_path, monkeypatch, source):
    line: dict[str, Any] = {"start_from": source, "steps": 32, "resume": True}

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Source, "copy_to", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "fork", **line)
    assert not any((tmp_path / "fork").glob("seed-*"))
    assert find_sets(tmp_path / "fork") == []
    assert run(tmp_path / "fork", **line).steps_done == 32


def test_a_run_in_use_leaves_its_whole_set_unchanged(source):
    with RunSet.open(source).runs[1].locked():
        with pytest.raises(InputError, match="seed-1"):
            resume(source, steps=60)
        with pytest.raises(InputError, match="seed-1"):
            run(source, steps=60, resume=True, **TWO)
    assert [one.config.steps for one in RunSet.open(source).runs] == [30, 30]
