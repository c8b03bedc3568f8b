"""Evaluation in processes beside training leaves the files of evaluation in line, whatever happens meanwhile."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import probes
import psutil
import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from logs import without_times

from csac.algorithms import SAC
from csac.tasks.seeds import EVALUATION_SEED
from csac.training.scheduler import choose_evaluation_processes
from csac.training.train import resume, train
from csac.types import InputError

LEARNER = SAC(actor_hidden_sizes=(8, 8), critic_hidden_sizes=(8, 8), batch_size=8, warmup_steps=40, replay_size=300)
TIMES = ("created", "process", "history", "commit")  # of the manifest; the code may be committed meanwhile
INSTEAD = "its episodes are run by this one instead"


def run(directory: Path, processes: int | None, task: Any = "Hopper-v4", steps: int = 700, **settings: Any):
    """Train a little and return the evaluations that were told of."""
    settings = {"evaluation_interval": 100, "evaluation_episodes": 2, "checkpoint_interval": 130, **settings}
    told: list[tuple[int, dict[int, float]]] = []
    train(
        LEARNER,
        task,
        steps=steps,
        directory=directory,
        evaluation_processes=processes,
        tensorboard=False,
        on_evaluation=lambda *given: told.append(given),
        **settings,
    )
    return told


def contents(directory: Path) -> dict[str, Any]:
    """Everything in a run directory that two equal runs have alike."""
    files: dict[str, Any] = {
        path.relative_to(directory).as_posix(): without_times(path.read_bytes())
        for path in directory.rglob("*")
        if path.is_file() and path.name not in ("manifest.json", ".lock")
    }
    manifest = json.loads((directory / "manifest.json").read_text())
    return {**files, "manifest.json": {name: value for name, value in manifest.items() if name not in TIMES}}


def without(files: dict[str, Any], line: str) -> dict[str, Any]:
    """The same but for lines of the log, and for the log's size in the checkpoints' lists."""
    kept = b"\n".join(text for text in files["log.txt"].splitlines() if line.encode() not in text)
    return {name: content for name, content in files.items() if not name.endswith(".json")} | {"log.txt": kept}


@pytest.mark.parametrize(
    "settings",
    [
        {"perturbations": ["friction=2@150", "observation_noise=0.05@301"]},
        {"seeds": 2, "evaluation_episodes": 12, "steps": 350},
    ],
    ids=["perturbed", "two seeds, two batches each"],
)
def test_the_files_are_those_of_evaluation_in_line(tmp_path, settings):
    told = [run(tmp_path / str(processes), processes, **settings) for processes in (0, 2)]
    assert told[0] == told[1]
    assert len(told[0]) >= 4
    assert contents(tmp_path / "2") == contents(tmp_path / "0")


def test_groups_in_processes_have_processes_too_and_leave_none(tmp_path):
    for processes in (0, 1):
        run(tmp_path / str(processes), processes, seeds=2, groups=2, steps=300, checkpoint_interval=110)
    assert contents(tmp_path / "1") == contents(tmp_path / "0")
    assert not [child for child in psutil.Process().children(recursive=True) if "spawn_main" in str(child.cmdline())]


class Crash(Exception):
    pass


def test_a_run_that_crashed_goes_on_as_if_it_had_not(tmp_path):
    def crash(step: int, _: Any) -> bool:
        if step == 300:
            raise Crash
        return False

    run(tmp_path / "whole", 0)
    settings: dict[str, Any] = {"evaluation_interval": 100, "evaluation_episodes": 2, "checkpoint_interval": 130}
    with pytest.raises(Crash):
        train(
            LEARNER,
            "Hopper-v4",
            steps=700,
            directory=tmp_path / "run",
            evaluation_processes=1,
            tensorboard=False,
            on_evaluation=crash,
            **settings,
        )
    resumed = resume(tmp_path / "run", evaluation_processes=1)
    assert [entry.step for entry in resumed.manifest.history] == [260]
    assert contents(tmp_path / "run") == contents(tmp_path / "whole")


@pytest.mark.filterwarnings("ignore:seed . of .* failed at:RuntimeWarning")
@pytest.mark.parametrize("most", [0.0, -2.0], ids=["one seed fails", "both fail"])
def test_a_failing_evaluation_stops_its_seed_where_it_would_in_line(tmp_path, most):
    """Their policies differ, so one seed's actions are above 0 sooner. Training goes on until it is known."""
    arguments = {"most": most, "seeds": [EVALUATION_SEED, EVALUATION_SEED + 1]}
    for processes in (0, 1):
        run(tmp_path / str(processes), processes, "probes:Picky-v0", seeds=2, environment_arguments=arguments)
    ours, theirs = contents(tmp_path / "1"), contents(tmp_path / "0")
    failures = ours["manifest.json"]["failures"]
    assert len(failures) == (1 if most == 0.0 else 2)
    assert all("its evaluation failed: evaluation episode 0" in failure for failure in failures.values())
    # A checkpoint holds what the stopped seed did until it was known; no other file does.
    assert {name: ours[name] for name in ours if "checkpoint/" not in name} == {
        name: theirs[name] for name in theirs if "checkpoint/" not in name
    }


def test_what_a_dying_process_takes_along_is_made_in_line(tmp_path):
    arguments = {"seed": EVALUATION_SEED + 1, "spare_first": True}
    for processes in (0, 1):
        run(tmp_path / str(processes), processes, "probes:Deadly-v0", steps=200, environment_arguments=arguments)
    ours, theirs = contents(tmp_path / "1"), contents(tmp_path / "0")
    assert ours["log.txt"].count(INSTEAD.encode()) == 2
    assert b"evaluation: its process was killed by SIGKILL" in ours["log.txt"]
    assert without(ours, INSTEAD) == without(theirs, INSTEAD)
    assert ours["manifest.json"] == theirs["manifest.json"]


def processes_of(directory: Path) -> set[float]:
    """The processes that evaluated; none of them but this one has imported JAX."""
    rows = json.loads((directory / "manifest.json").read_text())
    assert rows["events"] == ["process", "has_jax"]
    lines = (directory / "evaluations.csv").read_text().splitlines()
    told = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    processes = {float(row["process"]) for row in told}
    assert all((float(row["process"]) == os.getpid()) == bool(float(row["has_jax"])) for row in told)
    return processes


@pytest.mark.parametrize(
    ("cores", "task", "settings", "here"),
    [
        (2, "probes:Cases-v0", {}, False),
        (1, "probes:Cases-v0", {}, True),
        (2, lambda **arguments: probes.Cases(**arguments), {}, True),  # cannot be sent to another process
        (2, "probes:Cases-v0", {"stop_when": lambda step, _: step == 200}, True),
        (2, "probes:Cases-v0", {"evaluation_interval": 700}, True),  # training is over by then
    ],
    ids=["a core to spare", "none to spare", "a function", "stop_when", "at the end alone"],
)
def test_processes_are_used_where_they_pay(tmp_path, monkeypatch, cores, task, settings, here):
    monkeypatch.setattr("csac.training.scheduler.usable_cores", lambda: list(range(cores)))
    monkeypatch.setattr("csac.training.scheduler.core_quota", lambda: None)
    told = run(
        tmp_path / "run", None, task, environment_arguments={"tell": True}, events=["process", "has_jax"], **settings
    )
    assert (processes_of(tmp_path / "run") == {os.getpid()}) is here
    if "stop_when" in settings:
        assert told[-1][0] == 200


@pytest.mark.parametrize(
    ("cores", "groups", "episodes", "processes"),
    [
        (2, [[0]], 10, 1),
        (2, [[0], [1]], 10, 0),
        (1, [[0]], 10, 0),
        (16, [[0]], 10, 1),  # there is one batch
        (16, [[0]], 100, 10),
        (16, [[0, 1, 2, 3, 4]], 10, 5),  # a GPU's five seeds
        (16, [[0], [1], [2], [3], [4]], 20, 2),
        (6, [[0], [1], [2], [3], [4]], 10, 1),
    ],
)
def test_processes_are_as_many_as_cores_are_to_spare(monkeypatch, cores, groups, episodes, processes):
    monkeypatch.setattr("csac.training.scheduler.usable_cores", lambda: list(range(cores)))
    monkeypatch.setattr("csac.training.scheduler.core_quota", lambda: None)
    assert choose_evaluation_processes(groups, episodes) == processes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"processes": -1}, "evaluation_processes must be a whole number of 0 or more, not -1"),
        ({"processes": 1, "task": lambda: probes.Endless()}, "which evaluation_processes need"),
        ({"processes": 1, "stop_when": lambda *_: False}, "stop_when is asked before training goes on"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        run(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()
