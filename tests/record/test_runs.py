"""Run directories and sets of them on disk."""

from __future__ import annotations

import multiprocessing
import os
import shutil

import numpy as np
import pytest
from manifests import make_set, manifest

from csac.record.config import RunConfig
from csac.record.manifest import SCHEMA_VERSION, read, written
from csac.record.run import RunDirectory
from csac.record.sets import RunSet, find_sets, new_set_directory
from csac.types import InputError


def row(step: int, value: float, **more: float) -> dict:
    return {"seed": 0, "step": step, "episode": 0, "return": value, "length": 5, "success": None, **more}


def test_a_manifest_is_read_as_it_was_written():
    one = manifest(
        hyperparameters={"batch_size": 8, "hidden_sizes": (8, 8)},
        environment_arguments={"reach": 1.5},
        perturbations=["friction=2@5"],
        program=(0, 1),
        failure="step 3: it broke",
        state="failed",
    )
    assert read(written(one)) == one
    assert one.config.hyperparameters["hidden_sizes"] == [8, 8]


def test_a_strangers_manifest_moves_no_terminal():
    one = manifest(task="\x1b[31mred\x1b]0;\x07 \x9bx", failure="two\nlines \\ ö")
    assert read(written(one)).config.task == "�[31mred�]0;� �x"
    assert read(written(one)).failure == one.failure


def test_a_strangers_folder_and_header_move_no_terminal(tmp_path):
    RunDirectory.create(tmp_path / "run", manifest()).append("evaluations", [{**row(1, 1.0), "\x1b[2J": 1}])
    with pytest.raises(InputError, match=r"x1b\[2J") as told:
        _ = RunDirectory.open(tmp_path / "run").evaluations
    assert "\x1b" not in str(told.value)
    (tmp_path / "run").rename(tmp_path / "\x1b[2J")
    damaged: list[InputError] = []
    assert not find_sets(tmp_path, damaged.append)
    assert len(damaged) == 1
    assert "\x1b" not in str(damaged[0])


@pytest.mark.parametrize("name", ["log.txt", ".lock", "checkpoint", "checkpoint/replay"])
def test_a_strangers_link_is_not_followed(tmp_path, name):
    run = RunDirectory.create(tmp_path / "run", manifest())
    link = run.path / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path)
    with pytest.raises(InputError, match=f"{name} is a link"), run.locked():
        raise AssertionError


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"", "JSON"),
        (b"[]", "JSON"),
        (written(manifest()).replace(b'"steps_done": 100', b'"steps_done": "many"'), "steps_done"),
        (written(manifest()).replace(b'"seed": 0', b'"seed": -1'), "seed"),
        (written(manifest()).replace(b'"state": "finished"', b'"state": "bored"'), "state"),
        (written(manifest()).replace(b'"task": ', b'"tusk": '), "config.task"),
        (written(manifest()).replace(b'"schema_version": %d' % SCHEMA_VERSION, b'"schema_version": 99'), "99"),
    ],
)
def test_what_is_no_manifest_is_refused_with_the_name_of_what_is_wrong(tmp_path, content, name):
    run = RunDirectory.create(tmp_path / "run", manifest())
    (run.path / "manifest.json").write_bytes(content)
    with pytest.raises(InputError, match=name) as error:
        RunDirectory.open(run.path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"steps": 0}, "steps"),
        ({"steps": 2**31}, "steps"),
        ({"seed": 2**32}, "seed"),
        ({"evaluation_interval": -1}, "evaluation_interval"),
        ({"device": "tpu"}, "device"),
        ({"environment_arguments": {"where": np.zeros(3)}}, "environment_arguments"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(values, name):
    with pytest.raises(InputError, match=name):
        RunConfig(task="Hopper-v4", **values)


def test_cuda_is_a_gpu():
    assert RunConfig(task="Hopper-v4", device="cuda").device == "gpu"  # pyright: ignore[reportArgumentType]


def test_a_directory_with_anything_in_it_is_left_alone(tmp_path):
    RunDirectory.create(tmp_path / "run", manifest())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("")
    for name in ("run", "other", "file"):
        with pytest.raises(InputError, match=name):
            RunDirectory.create(tmp_path / name, manifest())
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == ["thesis.tex"]


def _hold(path, ready, done):
    with RunDirectory.open(path).locked():
        ready.set()
        done.wait(60)


def test_one_process_at_a_time_writes_to_a_run(tmp_path):
    run = RunDirectory.create(tmp_path / "run", manifest(state="running", process=1))
    assert run.state == "killed"
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    holder = context.Process(target=_hold, args=(run.path, ready, done))
    holder.start()
    assert ready.wait(60)
    assert run.state == "running"
    with pytest.raises(InputError, match=f"process {holder.pid}"), run.locked():
        raise AssertionError
    done.set()
    holder.join()
    with run.locked():
        assert (run.path / ".lock").read_text() == f"{os.getpid()}\n"


def test_a_set_has_the_rows_of_its_runs_and_leaves_out_those_that_failed(tmp_path):
    runs = make_set(tmp_path / "set", (3, 1), {3: "step 7: it broke"})
    for run, value in zip(runs.runs, (1.0, 2.0), strict=True):
        run.append("evaluations", [{**row(10, value), "seed": run.seed}])
    assert runs.seeds == [1, 3]
    assert runs.evaluations["return"].tolist() == [1.0, 2.0]
    assert runs.sound_evaluations["seed"].tolist() == [1]
    assert runs.failures == {3: "step 7: it broke"}
    assert runs.state == "failed"
    assert os.fspath(runs) == str(tmp_path / "set")
    with pytest.raises(InputError, match="no seed 2"):
        runs.run(2)


def test_a_copy_of_a_seed_is_none_of_the_set(tmp_path):
    make_set(tmp_path / "set", (0, 1))
    shutil.copytree(tmp_path / "set" / "seed-0", tmp_path / "set" / "seed-0.bak")
    assert [run.path.name for run in RunSet.open(tmp_path / "set").runs] == ["seed-0", "seed-1"]


def test_runs_with_other_columns_share_those_that_all_have(tmp_path):
    runs = make_set(tmp_path / "set", (0, 1))
    runs.runs[0].append("evaluations", [row(10, 1.0, crash=1.0)])
    runs.runs[1].append("evaluations", [{**row(10, 2.0), "seed": 1}])
    assert runs.evaluations.dtype.names == ("seed", "step", "episode", "return", "length", "success")


def test_sets_are_found_below_a_directory_and_damaged_ones_told(tmp_path):
    make_set(tmp_path / "a" / "set", (0, 1))
    RunDirectory.create(tmp_path / "alone", manifest())
    broken = RunDirectory.create(tmp_path / "broken", manifest())
    broken.append("evaluations", [row(1, 1.0)])
    (broken.path / "manifest.json").write_text("{")
    told: list[InputError] = []
    found = find_sets(tmp_path, told.append)
    assert [(runs.path.name, runs.seeds) for runs in found] == [("set", [0, 1]), ("alone", [0])]
    assert len(told) == 1


@pytest.mark.parametrize("name", ["nowhere", "empty", "older"])
def test_where_there_is_no_run_a_line_says_so(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "older" / "policy").mkdir(parents=True)
    with pytest.raises(InputError, match=name):
        RunSet.open(tmp_path / name)


def test_the_default_directory_is_new(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = new_set_directory("PyFlyt/QuadX-Waypoints-v1", "csac")
    first.mkdir(parents=True)
    assert first.parent == tmp_path / "runs" / "PyFlyt-QuadX-Waypoints-v1" / "csac"
    assert new_set_directory("PyFlyt/QuadX-Waypoints-v1", "csac") != first
