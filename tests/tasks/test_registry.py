"""From names to environments: what is refused, which modules are imported from where, what events may be called."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import probes
import pytest

from csac.tasks import registry
from csac.tasks.environment import Environment
from csac.types import InputError

SUPPORT = Path(__file__).parents[1] / "support"
QUAD, REACH = "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3"


def run_python(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("HalfCheeta-v4", "HalfCheeta-v4: did you mean HalfCheetah-v4"),
        ("halfcheetah-V4", "did you mean HalfCheetah-v4"),
        ("HalfCheetah", "did you mean HalfCheetah-v"),
        ("PandaReach-v2", "did you mean PandaReach-v3"),
        ("quadx-waypoints-v1", f"did you mean {QUAD}"),
        ("Nothing/Like-this-v7", "write module:Id"),
        ("no_such_module:Task-v0", "no_such_module cannot be imported: ModuleNotFoundError"),
        ("./probes.py:ConstantReward-v0", "probes:ConstantReward-v0"),
        ("probes:ConstantRewards-v0", "did you mean probes:ConstantReward-v0"),
        ("probes:Xyzzyxyzzy", "probes registers none of that name"),
        ("CartPole-v1", r"CartPole-v1: the action space is Discrete\(2\)"),
        (lambda: 3, "returned 3"),
        (lambda: sys.exit(7), "could not be made: SystemExit: 7"),
        (probes.Endless(), "a function that makes an environment, not .*Endless"),
        (gymnasium.wrappers.TimeLimit, "TimeLimit could not be made: TypeError"),
    ],
)
def test_a_task_that_cannot_be_made_is_refused_in_one_line(task, message):
    with pytest.raises(InputError, match=message) as refusal:
        Environment(task)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"colour": "red"}, "colour"), ({"where": []}, r"TypeError: unhashable type: 'list' \(test_registry\.py:\d+\)")],
)
def test_a_constructor_that_fails_is_told_with_its_place(arguments, message):
    class Choosy(probes.Failing):
        def __init__(self, where: Any = "step") -> None:
            super().__init__(where=where)
            self.count[where] = 0

    with pytest.raises(InputError, match=f"Choosy could not be made with the arguments.*{message}"):
        Environment(Choosy, arguments)


@pytest.mark.parametrize(
    ("task", "name"),
    [
        ("probes:Endless-v0", "probes:Endless-v0"),
        (probes.Endless, "Endless"),
        (functools.partial(gymnasium.make, "Pendulum-v1"), "Pendulum-v1"),
        (lambda: probes.Endless(), "Endless"),
    ],
)
def test_every_task_has_a_name(task, name):
    assert Environment(task).task_name == name


# Modules


def test_a_module_is_imported_for_its_tasks(tmp_path, monkeypatch):
    (tmp_path / "my_tasks.py").write_text(
        "import gymnasium, probes\ngymnasium.register('Mine-v3', entry_point=probes.Endless, max_episode_steps=2)\n"
    )
    (tmp_path / "broken_tasks.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert Environment("my_tasks:Mine-v3", {"length": 7}).raw.unwrapped.length == 7  # pyright: ignore
    with pytest.raises(InputError, match=r"broken_tasks cannot be imported: ZeroDivisionError.*\(broken_tasks\.py:1\)"):
        Environment("broken_tasks:Task-v0")


SHADOWED = """
import os, sys
os.environ["MUJOCO_GL"] = "disabled"  # as with egl, MuJoCo leaves it to Gymnasium to import GLFW
sys.path = [place for place in sys.path if place]  # as the installed command has it
from csac.cli import main
main(["--version"])
import csac.tasks.environment as environments
environments.Environment("Hopper-v4").close()
import mine_alone
"""


def test_the_working_directory_is_not_searched_for_other_modules(tmp_path):
    (tmp_path / "mine_alone.py").write_text("import gymnasium; gymnasium.register('Mine-v0', 'nowhere:Mine')")
    (tmp_path / "json.py").write_text("raise SystemExit('the json.py of the working directory')")
    (tmp_path / "struct.py").write_text("open('imported', 'w')")  # a Python that a library starts would import it
    ended = run_python(SHADOWED, tmp_path)
    assert not (tmp_path / "imported").exists()
    assert "No module named 'mine_alone'" in ended.stderr


def test_processes_that_are_started_search_it_last_too(tmp_path):
    """Python itself would search it first in them: what lies there by chance would be run."""
    for name in ("random.py", "struct.py"):
        (tmp_path / name).write_text(f"raise SystemExit('the {name} of the working directory')")
    code = """
import sys
sys.path = [place for place in sys.path if place]
from csac.processes import Child
def work(connection): pass
import operator
child = Child(operator.methodcaller("send", ("done", )))
try:
    print(child.connection.recv())
finally:
    child.kill()
"""
    ended = run_python(code, tmp_path)
    assert (ended.stdout, ended.stderr) == ("('done',)\n", "")


# What is not installed


def test_without_the_extra_one_line_says_what_to_install(tmp_path):
    code = """
import sys
from csac.cli import main
sys.modules["mujoco"] = sys.modules["PyFlyt"] = sys.modules["pybullet"] = None
for task in sys.argv[1:]:
    assert main(["train", task]) == 2
"""
    tasks = QUAD, REACH, "HalfCheetah-v4"
    command = [sys.executable, "-c", code, *tasks]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "")
    for line, task in zip(ended.stderr.splitlines(), tasks, strict=True):
        assert line.startswith(f"csac: {task} needs a package that is not installed (")
        assert ('pip install "gymnasium[mujoco]"' if task == "HalfCheetah-v4" else "pip install '.[robots]'") in line
    assert list(tmp_path.iterdir()) == []


def test_another_release_of_a_package_is_said(monkeypatch):
    registry._register_known(QUAD)
    monkeypatch.delitem(gymnasium.registry, QUAD)
    with pytest.raises(InputError, match=r"^the PyFlyt that is installed has no "):
        Environment(QUAD)


# Events


@pytest.mark.parametrize("name", ["a,b", 'a"b', "a b", "a\nb", "", 3, "length", "success_rate", "a#b"])
def test_a_name_that_cannot_be_a_column_is_refused(name):
    with pytest.raises(InputError, match="cannot name an event"):
        registry.check_events([name])


def test_events_are_a_list_of_names():
    registry.check_events(["off_the_rail", "näher", "x.y-z"])
    for given in ("crashed", 5):
        with pytest.raises(InputError, match=f"not {given!r}"):
            registry.check_events(given)  # pyright: ignore[reportArgumentType]
    assert registry.events_of(QUAD, ["collision", "mine"])[-2:] == ("num_targets_reached", "mine")


def test_the_command_finds_modules_of_the_folder_that_it_is_called_in(tmp_path):
    (tmp_path / "mine.py").write_text((SUPPORT / "probes.py").read_text())
    (tmp_path / "json.py").write_text("raise SystemExit('the json.py of the working directory')")
    command = [Path(sys.executable).with_name("csac"), "train", "mine:Nothing-v0"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "no task is called mine:Nothing-v0" in ended.stderr
