"""Processes beside this one, and what is said of their ends."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import types
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from csac.processes import (
    Child,
    control_groups,
    core_quota,
    end,
    may_be_imported,
    memory_left,
)


def end_as_told(_: Connection, how: str) -> None:
    """What a task may do to the process that it is in."""
    if how == "sys.exit":
        sys.exit(7)
    os.kill(os.getpid(), signal.SIGSEGV)


def test_a_process_that_ended_is_not_said_to_have_been_killed():
    """Its pipe closes before it is gone: who ends it then would find the cause in himself."""
    exits, faults = (Child(end_as_told, how) for how in ("sys.exit", "fault"))
    for child, cause in (
        (exits, "ended by itself with exit code 7"),
        (faults, r"killed by SIGSEGV \(a fault in native"),
    ):
        with pytest.raises(EOFError):
            child.connection.recv()
        assert re.search(cause, child.cause_of_death())
        assert not child.process.is_alive()


def test_a_script_without_a_guard_is_told_so_in_one_line(tmp_path):
    """Each of its processes imports it, and would train anew; they say nothing."""
    script = tmp_path / "script.py"
    script.write_text(
        "from csac import SAC, train\ntrain(SAC(batch_size=8), 'Pendulum-v1', steps=100, seeds=2, directory='run')\n"
    )
    result = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False)
    lines = result.stderr.strip().splitlines()
    assert "InputError: this script starts processes that import it" in lines[-1]
    assert sum(line.startswith("Traceback") for line in lines) == 1
    assert not (tmp_path / "run").exists()  # once mended, the script begins there


@pytest.mark.slow
def test_standard_input_trains_its_own_task_in_one_process_and_any_other_in_several(tmp_path):
    """Python calls what it reads there "<stdin>", which no process finds."""
    text = """
from csac import SAC, train
from gymnasium.envs.classic_control import PendulumEnv
class Mine(PendulumEnv): ...
options = {"steps": 20, "seeds": 2, "evaluation_interval": 0, "progress": False}
for task in (Mine, "Pendulum-v1"):
    runs = train(SAC(batch_size=8), task, **options)
    print(*[(run.manifest.state, len(run.manifest.program)) for run in runs.runs])
"""
    result = subprocess.run(
        [sys.executable, "-"], input=text, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    together, alone = str(("finished", 2)), str(("finished", 1))
    assert result.stdout.splitlines() == [f"{together} {together}", f"{alone} {alone}"], result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("script", "may"),
    [("train()", False), ('if __name__ == "__main__":\n    train()', True), (None, True)],
    ids=["bare", "guarded", "none"],
)
def test_processes_import_a_script_that_has_a_guard(monkeypatch, tmp_path, script, may):
    main = types.ModuleType("__main__")
    if script:
        (tmp_path / "script.py").write_text(script)
        main.__file__ = str(tmp_path / "script.py")
    monkeypatch.setitem(sys.modules, "__main__", main)
    assert may_be_imported() is may


def end_what_a_task_starts(connection: Connection) -> None:
    """Be told to end, in vain; then tell a program and a forked process to, and send how they did."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.raise_signal(number)
    context = multiprocessing.get_context("fork")
    begun = context.Event()
    forked = context.Process(target=lambda: (begun.set(), signal.pause()), daemon=True)
    forked.start()
    begun.wait(30)
    forked.terminate()
    forked.join(30)
    ends: list[int | None] = [forked.exitcode]
    with subprocess.Popen(["sleep", "300"]) as program:
        program.send_signal(signal.SIGINT)  # a Ctrl-C ends nothing before its seed is saved
        program.send_signal(signal.SIGHUP)
        program.terminate()
        try:
            ends.append(program.wait(30))
        except subprocess.TimeoutExpired:
            ends.append(None)
            program.kill()
    forked.kill()
    connection.send(ends)


def test_a_worker_outlives_what_ends_what_its_task_starts():
    """They were blocked, and so in the task's simulator too: to end it was to wait for it for ever."""
    worker = Child(end_what_a_task_starts)
    assert worker.connection.recv() == [-signal.SIGTERM, -signal.SIGTERM]
    end([worker], 30)
    assert worker.process.exitcode == 0


def say_when_it_is_over(connection: Connection, path: Path) -> None:
    connection.send("there")
    try:
        connection.recv()
    except EOFError:
        path.write_text("closed")


def stay(connection: Connection) -> None:
    connection.send("there")
    while True:
        signal.pause()


def test_who_is_to_end_has_a_moment_and_no_more(tmp_path):
    closing, staying = Child(say_when_it_is_over, tmp_path / "said"), Child(stay)
    assert [child.connection.recv() for child in (closing, staying)] == ["there", "there"]
    end([closing], 30)
    end([staying], 0)
    assert [child.process.exitcode for child in (closing, staying)] == [0, -signal.SIGKILL]
    assert (tmp_path / "said").read_text() == "closed"


FORGETFUL = """
import signal
from csac.processes import Child

def work(connection):
    connection.send("there")
    while True:
        signal.pause()

if __name__ == "__main__":
    child = Child(work)
    print(child.connection.recv())
"""


def test_an_interpreter_that_ends_waits_for_no_process_that_was_forgotten(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(FORGETFUL)
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "there\n", "")


WITH_A_CHILD = """
import os, signal
from csac.processes import Child

def work(connection):
    print(os.getpid(), flush=True)
    signal.pause()

if __name__ == "__main__":
    Child(work).process.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux ends a process with its parent")
def test_a_process_dies_with_its_parent(tmp_path):
    """Alive, it would write into a run that another process has taken over."""
    script = tmp_path / "script.py"
    script.write_text(WITH_A_CHILD)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
        try:
            parent.communicate(timeout=30)  # until nobody holds the other end of the pipe any more
        except subprocess.TimeoutExpired:
            os.kill(child, signal.SIGKILL)
            pytest.fail("the child outlived its parent")


def within(monkeypatch: pytest.MonkeyPatch, groups: list[Path]) -> None:
    monkeypatch.setattr("csac.processes.control_groups", lambda: groups)


def limited(folder: Path, **files: str) -> Path:
    """A control group with these files, `cpu_max` for cpu.max."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("text", "cores"), [("200000 100000\n", 2), ("150000 100000", 2), ("1000 100000", 1), ("max 100000\n", None)]
)
def test_a_container_s_share_of_its_processors(tmp_path, monkeypatch, text, cores):
    within(monkeypatch, [limited(tmp_path, cpu_max=text)])
    assert core_quota() == cores


def test_the_tightest_of_the_limits_around_a_process_holds(tmp_path, monkeypatch):
    inner = limited(tmp_path / "job", cpu_max="400000 100000", memory_max="500", memory_current="100", memory_stat="")
    outer = limited(tmp_path, cpu_max="300000 100000", memory_max="max", memory_current="7", memory_stat="")
    (tmp_path / "listed").write_text("4:memory:/other\n0::/job\n")
    groups = control_groups(tmp_path / "listed", tmp_path)
    assert groups == [inner, outer]
    within(monkeypatch, groups)
    assert (core_quota(), memory_left()) == (3, 400)


def test_what_was_only_read_from_files_counts_as_free(tmp_path, monkeypatch):
    files = {"memory_max": "1000", "memory_current": "900", "memory_stat": "anon 200\ninactive_file 600\n"}
    within(monkeypatch, [limited(tmp_path, **files)])
    assert memory_left() == 700


def test_where_there_are_no_control_groups_nothing_is_limited(tmp_path, monkeypatch):
    assert control_groups(tmp_path / "none", tmp_path) == []
    within(monkeypatch, [tmp_path])
    assert (core_quota(), memory_left()) == (None, None)
