"""Only modules that somebody here has named are imported: a run directory alone runs nobody's code."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import drawn
import gymnasium
import pytest
from manifests import make_set
from policies import contract, random_policy
from typed import TINY

from csac.cli import main
from csac.tasks import trust
from csac.types import InputError


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A folder with a run whose task is that of a module beside it, and a place for notes that is empty."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder = tmp_path / "downloaded"
    (folder / "package").mkdir(parents=True)
    (folder / "envs" / "robot").mkdir(parents=True)  # a namespace package
    marker = tmp_path / "marker"
    code = f"open({str(marker)!r}, 'w').close()\n" + Path(drawn.__file__).read_text().replace("Drawn", "Stranger")
    (folder / "stranger.py").write_text(code)
    (folder / "package" / "__init__.py").write_text(f"open({str(marker)!r}, 'w')")
    (folder / "package" / "stranger.py").write_text(code)
    (folder / "envs" / "robot" / "stranger.py").write_text(code)

    def make_run(task: str) -> Path:
        path = folder / "run"
        (run,) = make_set(path, task=task, algorithm="csac", steps=9).runs
        random_policy(contract()).write(run.policy_file())
        return path

    return SimpleNamespace(folder=folder, marker=marker, make_run=make_run, state=tmp_path / "state")


def csac(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "csac", *arguments], cwd=folder, capture_output=True, text=True)


def test_untrusted_task_module_is_not_imported(stranger, monkeypatch, capsys):
    monkeypatch.chdir(stranger.folder)
    for module, place, command in (
        ("stranger", "stranger.py", ["evaluate", "run"]),
        ("stranger", "stranger.py", ["play", "run", "--video", "a.mp4"]),
        ("stranger", "stranger.py", ["resume", "run"]),
        ("package.stranger", "package/__init__.py", ["evaluate", "run"]),
        ("envs.robot.stranger", "envs", ["evaluate", "run"]),
    ):
        shutil.rmtree("run", ignore_errors=True)
        stranger.make_run(f"{module}:Stranger-v0")
        assert main(command) == 2
        output, told = capsys.readouterr()
        assert f"run wants to run the code of the module {module} in {stranger.folder / place}" in told
        assert "add --trust-task" in told
        assert (output, told.count("\n")) == ("", 1)
        assert not stranger.marker.exists()


def test_a_task_that_was_trusted_once_is_trusted_where_it_was_found(stranger, monkeypatch, capsys):
    stranger.make_run("stranger:Stranger-v0")
    trusting = csac(stranger.folder, "evaluate", "run", "--episodes", "1", "--trust-task")
    assert trusting.returncode == 0, trusting.stderr
    assert stranger.marker.exists()
    again = csac(stranger.folder, "evaluate", "run", "--episodes", "1")
    assert (again.returncode, again.stdout) == (0, trusting.stdout)
    monkeypatch.chdir(stranger.folder.rename(stranger.folder.with_name("elsewhere")))
    assert main(["evaluate", "run", "--episodes", "1"]) == 2
    assert "add --trust-task" in capsys.readouterr().err


def test_training_records_the_task_module_as_trusted(stranger, monkeypatch):
    """One's own runs stay one command."""
    monkeypatch.chdir(stranger.folder)
    monkeypatch.setattr(sys, "path", [*sys.path, str(stranger.folder)])
    with pytest.raises(InputError, match="add --trust-task"):
        trust.refuse_untrusted("stranger:Stranger-v0", "run")
    line = f"train stranger:Stranger-v0 --steps 9 --evaluation-episodes 1 --directory own {TINY}"
    assert main([*line.split(), "--algorithm", "td3"]) == 0
    del sys.modules["stranger"], gymnasium.registry["Stranger-v0"]
    trust.refuse_untrusted("stranger:Stranger-v0", "run")


@pytest.mark.parametrize("task", ["Hopper-v4", "PyFlyt/QuadX-Hover-v1", "sys:Task-v0", len])
def test_what_imports_nothing_new_is_not_asked_about(task):
    trust.refuse_untrusted(task, "run")


@pytest.mark.parametrize("task", ["nowhere:Task", ":Task-v0:", ".a:Task", "nowhere.at.all:Task"])
def test_what_cannot_be_a_module_is_not_found(task):
    with pytest.raises(InputError, match="which is not found here"):
        trust.refuse_untrusted(task, "run")
    trust.remember(task)


def test_where_nothing_can_be_noted_one_is_asked_each_time(stranger, monkeypatch):
    monkeypatch.syspath_prepend(stranger.folder)
    monkeypatch.setenv("XDG_STATE_HOME", os.devnull)
    trust.refuse_untrusted("stranger:Stranger-v0", "run", trust_task=True)
    with pytest.raises(InputError, match="add --trust-task"):
        trust.refuse_untrusted("stranger:Stranger-v0", "run")
    assert not stranger.marker.exists()


def test_a_note_can_be_read_and_taken_back(stranger, monkeypatch):
    monkeypatch.syspath_prepend(stranger.folder)
    trust.remember("stranger:Stranger-v0")
    (note,) = (stranger.state / "csac" / "trusted_tasks").iterdir()
    assert note.read_text() == f"stranger\n{stranger.folder / 'stranger.py'}\n"
    trust.refuse_untrusted("stranger:Other-v3", "run")
    note.unlink()
    with pytest.raises(InputError, match="add --trust-task"):
        trust.refuse_untrusted("stranger:Other-v3", "run")
