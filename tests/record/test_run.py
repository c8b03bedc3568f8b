import errno
import json
import os
import socket
import tempfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac.deploy.choosing import load
from csac.record import csv_tables
from csac.record import run as record
from csac.record.files import write_atomically
from csac.record.tables import COLUMNS, check_new, read_rows, write_rows
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory, find_runs
from csac.types import InputError

MANIFEST = Manifest(
    task="HalfCheetah-v4",
    algorithm="csac",
    hyperparameters={"discount": 0.99, "hidden": (256, 256)},
    seeds=(0, 1),
    steps=1000,
)


def evaluation(seed: Any = 0, step=5000, episode=0, value: Any = 1.5, length=1000, success=None, **events):
    return {
        "seed": seed,
        "step": step,
        "episode": episode,
        "return": value,
        "length": length,
        "success": success,
        **events,
    }


def everything_in(directory):
    return sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*"))


@pytest.fixture
def run(tmp_path):
    return RunDirectory.create(tmp_path / "run", MANIFEST)


@pytest.fixture
def sealed_directory():
    """An empty directory that this process may read but not write, also where the tests run as root."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o555)
        user = os.geteuid()
        if user == 0:
            os.seteuid(65534)
        yield Path(folder)
        os.seteuid(user)
        os.chmod(folder, 0o755)


# The manifest


def test_a_created_run_opens_again_with_the_same_manifest(run):
    opened = RunDirectory.open(run.path)
    assert opened.manifest == run.manifest
    assert opened.manifest.hyperparameters == {"discount": 0.99, "hidden": [256, 256]}
    assert (opened.manifest.state, opened.manifest.steps_done) == ("running", 0)
    assert json.loads((run.path / "manifest.json").read_text())["schema_version"] == 1
    assert everything_in(run.path) == ["manifest.json"]


def test_numpy_values_and_paths_become_plain_json(tmp_path):
    values: dict[str, Any] = {"steps": np.int64(7), "seeds": tuple(np.arange(2)), "command": Path("csac")}
    run = RunDirectory.create(tmp_path / "run", replace(MANIFEST, **values, failures={1: "x"}))
    written = json.loads((run.path / "manifest.json").read_text())
    assert (written["steps"], written["seeds"], written["command"]) == (7, [0, 1], "csac")
    assert written["failures"] == {"1": "x"}
    assert (run.manifest.seeds, run.manifest.failures) == ((0, 1), {1: "x"})


def test_updates_are_written_and_remembered(run):
    run.update_manifest(state="finished", steps_done=1000)
    assert run.manifest.state == "finished"
    assert RunDirectory.open(run.path).manifest == run.manifest


def test_an_update_that_fails_leaves_the_old_manifest(run, monkeypatch):
    before = (run.path / "manifest.json").read_bytes()

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        run.update_manifest(state="finished")
    assert run.manifest.state == "running"
    assert (run.path / "manifest.json").read_bytes() == before
    assert everything_in(run.path) == ["manifest.json"]


def test_an_atomic_write_is_synced_before_it_takes_the_name(tmp_path, monkeypatch):
    order = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (order.append("sync"), sync(number)))
    monkeypatch.setattr(os, "replace", lambda *paths: (order.append("rename"), replace(*paths)))
    write_atomically(tmp_path / "file", b"new")
    assert order == ["sync", "rename"]
    assert (tmp_path / "file").read_bytes() == b"new"


# Where a run may be created


def test_a_run_can_start_in_a_new_or_an_empty_directory(tmp_path):
    (tmp_path / "empty").mkdir()
    RunDirectory.create(tmp_path / "empty", MANIFEST)
    RunDirectory.create(tmp_path / "deep" / "er", MANIFEST)
    assert len(find_runs(tmp_path)) == 2


def test_a_directory_that_holds_a_run_is_refused_and_kept(run):
    before = (run.path / "manifest.json").read_bytes()
    with pytest.raises(InputError, match=r"already holds a run; resume it, or choose another directory"):
        RunDirectory.create(run.path, replace(MANIFEST, task="Ant-v4"))
    assert (run.path / "manifest.json").read_bytes() == before


def test_a_directory_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="not empty and holds no run"):
        RunDirectory.create(tmp_path, MANIFEST)
    assert everything_in(tmp_path) == ["thesis.tex"]


def test_a_file_is_refused_as_directory_and_as_parent(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file; choose"):
        RunDirectory.create(tmp_path / "file", MANIFEST)
    with pytest.raises(InputError, match=r"cannot write to .*: Not a directory; choose"):
        RunDirectory.create(tmp_path / "file" / "run", MANIFEST)
    assert everything_in(tmp_path) == ["file"]


@pytest.mark.skipif(os.name != "posix", reason="POSIX permissions")
@pytest.mark.parametrize("below", ["", "run", "deep/run"])
def test_a_read_only_directory_is_refused(sealed_directory, below):
    with pytest.raises(InputError, match="Permission denied; choose another directory"):
        RunDirectory.create(sealed_directory / below, MANIFEST)
    assert everything_in(sealed_directory) == []


def test_a_full_disk_leaves_no_trace(tmp_path, monkeypatch):
    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(InputError, match="No space left on device"):
        RunDirectory.create(tmp_path / "deep" / "run", MANIFEST)
    assert everything_in(tmp_path) == []


def test_of_two_runs_racing_for_a_directory_one_is_refused(tmp_path, monkeypatch):
    look = record._refuse_occupied
    looks = []

    def look_then_lose_the_race(path):
        look(path)
        looks.append(path)
        if len(looks) == 1:
            RunDirectory.create(path, replace(MANIFEST, task="winner"))

    monkeypatch.setattr(record, "_refuse_occupied", look_then_lose_the_race)
    with pytest.raises(InputError, match="already holds a run"):
        RunDirectory.create(tmp_path / "run", MANIFEST)
    assert RunDirectory.open(tmp_path / "run").manifest.task == "winner"


def test_what_json_cannot_hold_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match="is a function; use numbers"):
        RunDirectory.create(tmp_path / "run", replace(MANIFEST, environment_arguments={"reward": evaluation}))
    assert everything_in(tmp_path) == []


# Opening and finding


def test_opening_where_there_is_no_run(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"nowhere does not exist; give a run directory"):
        RunDirectory.open(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no run"):
        RunDirectory.open(tmp_path)
    with pytest.raises(InputError, match="holds no run"):
        RunDirectory.open(tmp_path / "file")


def test_a_manifest_of_a_newer_csac_is_not_called_broken(run):
    fields = json.loads((run.path / "manifest.json").read_bytes())
    (run.path / "manifest.json").write_text(json.dumps({**fields, "schema_version": 99}))
    with pytest.raises(InputError, match=r"written by a newer csac: its schema version is 99.*; upgrade csac$"):
        RunDirectory.open(run.path)


@pytest.mark.parametrize("content", [b"", b'{"schema_version": 1, "task": 3}'])
def test_a_broken_manifest_is_named(run, content):
    (run.path / "manifest.json").write_bytes(content)
    with pytest.raises(InputError, match=r"manifest\.json is broken: .*; restore it or train again"):
        RunDirectory.open(run.path)


def test_runs_are_found_below_sorted_without_what_they_hold_or_what_is_not_ours(tmp_path):
    for name in ("b/late", "a", "b/early"):
        RunDirectory.create(tmp_path / name, MANIFEST)
    (tmp_path / "a" / "checkpoint").mkdir()
    (tmp_path / "a" / "checkpoint" / "manifest.json").write_bytes((tmp_path / "a" / "manifest.json").read_bytes())
    (tmp_path / "manifest.json").write_text('{"name": "a web page"}')
    assert [run.path for run in find_runs(tmp_path)] == [tmp_path / name for name in ("a", "b/early", "b/late")]
    assert [run.path for run in find_runs(str(tmp_path / "a"))] == [tmp_path / "a"]


def test_a_damaged_run_is_told_and_what_is_below_it_found(tmp_path):
    for name in ("a", "a/below"):
        RunDirectory.create(tmp_path / name, MANIFEST)
        (tmp_path / name / "evaluations.csv").touch()
    (tmp_path / "a" / "manifest.json").write_bytes(b"")
    told = []
    assert [run.path for run in find_runs(tmp_path, told.append)] == [tmp_path / "a" / "below"]
    assert [str(tmp_path / "a" / "manifest.json") in str(error) for error in told] == [True]


def test_looking_for_runs_where_there_is_no_directory(tmp_path):
    with pytest.raises(InputError, match="there is no directory"):
        find_runs(tmp_path / "nowhere")


@pytest.mark.skipif(os.name != "posix", reason="the limit of names of POSIX")
def test_a_name_that_no_file_can_have_is_refused_in_a_line():
    """Asking whether it is there raised, and that was a traceback."""
    long = "x" * 300
    assert not record.is_run(long)
    for use in (find_runs, RunDirectory.open, load):
        with pytest.raises(InputError, match=long):
            use(long)
    with pytest.raises(InputError, match="File name too long"):
        RunDirectory.create(long, MANIFEST)


@pytest.mark.skipif(record.fcntl is None, reason="a system with locks")
def test_a_file_system_without_locks_is_refused_in_a_line(run, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(record.fcntl, "flock", flock)
    with pytest.raises(InputError, match=r"has no locks \(No locks available\): choose a directory"), run.locked():
        pass


@pytest.mark.skipif(record.fcntl is None, reason="a system with locks")
def test_a_look_whether_a_run_is_locked_keeps_nobody_from_locking_it(run, monkeypatch):
    """It holds the lock for an instant, as `is_locked` does; training was refused then."""
    (run.path / record.LOCK).touch()
    with open(run.path / record.LOCK) as look:
        record.fcntl.flock(look, record.fcntl.LOCK_SH)
        monkeypatch.setattr(record.time, "sleep", lambda _: look.close())
        with run.locked():
            assert record.is_locked(run.path / record.LOCK)


@pytest.mark.skipif(record.fcntl is None, reason="a system with locks")
@pytest.mark.filterwarnings("ignore:os.fork")  # JAX has threads
def test_a_child_that_was_forked_keeps_no_lock(run):
    """A task's helper outlives a run that is killed, and nobody could take that run up."""
    ours, theirs = socket.socketpair()
    with run.locked():
        child = os.fork()
        if not child:
            ours.close()
            theirs.send(b"there")
            theirs.recv(1)  # until the test is over
            os._exit(0)
        theirs.close()
        assert ours.recv(5) == b"there"
        assert record.is_locked(run.path / record.LOCK), "it is still this process's"
    try:
        with run.locked():
            assert os.waitpid(child, os.WNOHANG) == (0, 0)
    finally:
        ours.close()
        os.waitpid(child, 0)


@pytest.fixture
def noon(tmp_path, monkeypatch):
    """One and the same second, in an empty folder."""

    class Noon(record.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2024, 5, 6, 12, 30, 59)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(record, "datetime", Noon)


def test_the_default_directory_is_always_a_fresh_one(noon):
    taken = [RunDirectory.create_by_date("PyFlyt/QuadX-Waypoints-v1", MANIFEST).path for _ in range(3)]
    folder = Path("runs", "PyFlyt-QuadX-Waypoints-v1", MANIFEST.algorithm)
    assert taken == [folder / f"20240506-123059{end}" for end in ("", "-2", "-3")]


def test_of_two_runs_that_begin_in_the_same_second_each_has_a_directory(noon, monkeypatch):
    """The other one takes the name after we saw that it was free."""
    look, others = record._refuse_occupied, []

    def look_and_lose_the_race(path):
        if not others:
            others.append(path)
            RunDirectory.create(path, MANIFEST)
        look(path)

    monkeypatch.setattr(record, "_refuse_occupied", look_and_lose_the_race)
    assert RunDirectory.create_by_date("Hopper-v4", MANIFEST).path == others[0].with_name(f"{others[0].name}-2")


def test_where_no_directory_can_be_made_none_is_looked_for_further(noon):
    Path("runs").touch()
    with pytest.raises(InputError, match="cannot write to runs"):
        RunDirectory.create_by_date("Hopper-v4", MANIFEST)


# Tables


def test_a_table_without_rows_has_its_columns(run):
    assert run.evaluations.dtype.names == ("seed", "step", "episode", "return", "length", "success")
    assert run.rows("episodes").dtype.names == ("seed", "step", "return", "length")
    assert len(run.rows("metrics")) == 0
    run.append("metrics", [])
    assert not (run.path / "metrics.csv").exists()


def test_rows_are_written_plainly_and_read_back_typed(run):
    run.append("evaluations", [evaluation(success=True, value=np.float32(0.1), collisions=np.int32(2))])
    run.append("evaluations", [evaluation(seed=np.int64(1), value=-1e-20), evaluation(episode=1, value=float("nan"))])
    assert (run.path / "evaluations.csv").read_text() == (
        "seed,step,episode,return,length,success,collisions\n"
        "0,5000,0,0.1,1000,1,2\n"
        "1,5000,0,-1e-20,1000,,\n"
        "0,5000,1,nan,1000,,\n"
    )
    rows = run.evaluations
    assert [rows[name].dtype.kind for name in rows.dtype.names] == list("iiififf")
    np.testing.assert_array_equal(rows["seed"], [0, 1, 0])
    np.testing.assert_array_equal(rows["return"], [0.1, -1e-20, np.nan])
    np.testing.assert_array_equal(rows["success"], [1, np.nan, np.nan])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_every_float_comes_back_exactly_in_its_own_precision(run, kind):
    generator = np.random.default_rng(0)
    values = (generator.normal(size=200) * 10.0 ** generator.integers(-30, 30, size=200)).astype(kind)
    run.append("metrics", [{"seed": 0, "step": 0, "loss": value} for value in values])
    np.testing.assert_array_equal(run.rows("metrics")["loss"].astype(kind), values)


def test_equal_rows_give_equal_bytes_however_they_are_batched(tmp_path):
    rows = [evaluation(step=step, episode=episode, value=step / 7) for step in (1, 2) for episode in range(3)]
    together, apart = (RunDirectory.create(tmp_path / name, MANIFEST) for name in ("together", "apart"))
    together.append("evaluations", rows)
    for row in rows:
        RunDirectory.open(apart.path).append("evaluations", [row])
    assert (together.path / "evaluations.csv").read_bytes() == (apart.path / "evaluations.csv").read_bytes()


def test_a_column_that_the_header_lacks_stops_the_whole_batch(run):
    run.append("metrics", [{"seed": 0, "step": 1, "loss": 0.5}])
    before = (run.path / "metrics.csv").read_bytes()
    with pytest.raises(RuntimeError, match=r"metrics.csv has no column \['entropy'\]"):
        run.append("metrics", [{"seed": 0, "step": 2, "loss": 0.5}, {"seed": 0, "step": 2, "entropy": 0.5}])
    assert (run.path / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("row", "error"),
    [
        ({"step": 1}, "lacks 'seed'"),
        ({"seed": 0, "step": 1, "loss": "high"}, "'high' is not a number"),
        ({"seed": 0, "step": 1, "loss": np.zeros(2)}, "is not a number"),
    ],
)
def test_what_is_no_row_is_not_written(run, row, error):
    with pytest.raises(RuntimeError, match=error):
        run.append("metrics", [{"seed": 0, "step": 0, "loss": 1.0}, row])
    assert len(run.rows("metrics")) == 0


@pytest.mark.parametrize("kept", range(len(b"seed,step,loss\n0,1,0.5\n")))
def test_a_line_cut_by_a_crash_is_left_out_and_then_overwritten(run, kept):
    rows = [{"seed": 0, "step": 1, "loss": 0.5}, {"seed": 1, "step": 1, "loss": 0.25}]
    run.append("metrics", rows[:1])
    file = run.path / "metrics.csv"
    file.write_bytes(file.read_bytes()[:kept])
    assert len(run.rows("metrics")) == 0
    run.append("metrics", rows)
    assert run.rows("metrics").tolist() == [(0, 1, 0.5), (1, 1, 0.25)]


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("a,b\n1,2\n", "not a table of a run"),
        ("seed,step,step\n1,2,3\n", "not a table of a run"),
        ("\n1,2\n", "not a table of a run"),
        ("seed,step\n1,2\n1\n", "line 3: 1 cells instead of 2"),
        ("seed,step\n1,x\n", "damaged .*'x'"),
        ("seed,step,loss\n1,1,low\n", "damaged .*'low'"),
        ("seed,step\n,1\n", "damaged"),
        (f"seed,step\n1,{10**30}\n", "damaged"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, content, error):
    (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(InputError, match=error):
        read_rows(tmp_path / "metrics.csv")


def test_what_is_no_table_at_all_is_refused(tmp_path):
    (tmp_path / "picture.csv").write_bytes(b"\x89PNG\xff\n")
    with pytest.raises(InputError, match="not a text file"):
        read_rows(tmp_path / "picture.csv")
    with pytest.raises(InputError, match="No such file"):
        read_rows(tmp_path / "none.csv")


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe1,2\n",
        b"seed,step\n0,99999999999999999999\n",
        b"seed,step\n0," + b"9" * 5_000 + b"\n",
        b"seed,step\n0," + b"x" * 140_000 + b"\n",
        b"seed,step,return\n0,1," + b"x" * 100_000 + b"\n",
        b"\n\nseed,step\n0,1\n",
        b"# mine\nseed,step\n0,1\n",
        b"seed,step," + b"x" * 100_000 + b",\n0,1\n",
        b"seed,step,\n0,1,2\n",
        b"seed,step,return\n0,1,1_0\n" + b"0,\x001,2\n",
    ],
)
def test_a_table_of_anything_else_is_refused_in_one_short_line(tmp_path, content):
    (tmp_path / "evaluations.csv").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_rows(tmp_path / "evaluations.csv")
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


def test_no_row_is_added_to_what_is_no_table(run):
    for content in (b"\xff\xfe\n", b"x" * 140_000 + b"\n"):
        (run.path / "episodes.csv").write_bytes(content)
        with pytest.raises(InputError, match="its first line is no header"):
            run.append("episodes", [{"seed": 0, "step": 1, "return": 1.0, "length": 1}])
        assert (run.path / "episodes.csv").read_bytes() == content


@pytest.mark.parametrize(
    ("name", "reason"), [("x" * 251 + ".csv", "File name too long"), ("file/table.csv", "Not a directory")]
)
def test_a_table_that_cannot_be_is_refused_at_once_and_told_in_one_line(tmp_path, name, reason):
    (tmp_path / "file").touch()
    path = tmp_path / name
    with pytest.raises(InputError) as caught:
        check_new(path)
    assert str(caught.value) == f"cannot write {path}: {reason}; choose another place or name"
    with pytest.raises(InputError) as caught:
        write_rows(path, COLUMNS["evaluations"], [evaluation()])
    assert str(caught.value) == f"cannot write {path}: {reason}; choose another place"


def test_two_writers_of_one_process_number_do_not_meet(tmp_path, monkeypatch):
    path, append, asides = tmp_path / "rows.csv", csv_tables.append_rows, []

    def meet(aside, *given):
        append(aside, *given)
        asides.append(aside)
        if len(asides) == 1:  # before it is whole, another one, of another container, begins and ends
            write_rows(path, COLUMNS["evaluations"], [evaluation(), evaluation()])
            assert len(read_rows(path)) == 2

    monkeypatch.setattr(csv_tables, "append_rows", meet)
    write_rows(path, COLUMNS["evaluations"], [evaluation()])
    assert len(read_rows(path)) == 1
    assert len(set(asides)) == 2
    assert list(tmp_path.iterdir()) == [path]


def test_log_lines_follow_each_other(run):
    run.log("first")
    run.log("second\n")
    lines = (run.path / "log.txt").read_text().splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["first", "second"]
    moments = [datetime.fromisoformat(line.split(" ")[0]) for line in lines]
    assert moments[0] >= datetime.fromisoformat(run.manifest.created)
    assert moments[1] >= moments[0]
