import errno
import io
import re
import shlex
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from studying import TINY, cell, make_run, write

from csac.cli import main
from csac.studies import commands, refusals
from csac.studies.calibration import Calibration, Cost, predict
from csac.studies.cells import HOME, Cell, Store, write_history
from csac.studies.collected import ROLLOUTS
from csac.studies.job import Ended, Noted, Started, Stopped
from csac.studies.results import Results, Runs, collect
from csac.studies.study import cells_of, read_study


def csac(line):
    return main(shlex.split(line))


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "tiny.toml")


@pytest.fixture
def engine(monkeypatch):
    """What would be run, by the labels that are told, in place of running it."""
    given = []

    def run(jobs, tell, **_):
        given.extend(jobs)
        for job in jobs:
            tell(Started(job.cell.key))
            tell(Ended(job.cell.key, "complete"))

    monkeypatch.setattr(commands, "run_here", run)
    monkeypatch.setattr(commands, "run_in_processes", run)
    return given


def test_list_has_every_study(capsys):
    assert csac("study list") == 0
    out = capsys.readouterr().out
    for name in ("mujoco", "ablation", "efficiency", "robustness", "quadx", "panda", "reference", "smoke"):
        assert re.search(rf"^ {name} ", out, re.MULTILINE)


def test_a_study_is_run_shown_collected_and_not_run_again(capsys, monkeypatch):
    assert csac("study run tiny.toml --engine local --seeds 1 --results out") == 0
    assert "1 cell: 1 complete" in capsys.readouterr().out
    store, (one, other) = Store(), cells_of([read_study("tiny.toml")])
    assert [store.status(each).state for each in (one, other)] == ["complete", "waiting"]
    collected, made = Results("out").record(one), Runs(store).record(one)
    assert collected is not None
    assert made is not None
    assert (collected.seconds, collected.manifest.versions) == (made.seconds, made.manifest.versions)
    assert (collected.interrupted, made.interrupted) == (False, False)
    assert collected.manifest.machine.host == ""
    assert collected.evaluations.tobytes() == made.evaluations.tobytes()
    assert Results("out").record(other) is None
    monkeypatch.setattr(commands, "run_here", lambda jobs, tell: pytest.fail("complete cells are skipped"))
    assert csac("study run tiny.toml --engine local --seeds 1") == 0
    capsys.readouterr()
    for choice in ("", "--directory another/machine --results out"):
        assert csac(f"study show tiny.toml --no-measure {choice}") == 0
        states = re.findall(r" (complete|waiting) ", capsys.readouterr().out)
        assert states == ["complete", "waiting"]
    assert csac("study run tiny.toml --engine local --seeds 1 --directory another/machine --results out") == 0
    assert "1 cell: 1 complete" in capsys.readouterr().out
    assert Results("out").status(one, rollouts=100) is None, "its policy was not tested yet"


def test_a_longer_run_that_was_collected_stands_for_a_shorter_one(tmp_path, monkeypatch):
    whole = TINY.replace("replay_size = 150", "replay_size = 1_000")  # so that the replay has a row for each step
    write(tmp_path / "tiny.toml", whole)
    shorter = write(tmp_path / "shorter.toml", whole.replace("steps = 300", "steps = 200"))
    assert csac("study run tiny.toml --engine local --seeds 1 --results out") == 0
    assert csac("study run shorter.toml --engine local --seeds 1 --results itself") == 0
    (one, _) = cells_of([read_study(shorter)])
    part, itself = Results("out").record(one), Results("itself").record(one)
    assert part is not None
    assert itself is not None
    assert part.evaluations.tobytes() == itself.evaluations.tobytes()
    assert sorted(set(part.evaluations["step"])) == [100, 200]
    assert (part.manifest.steps, part.manifest.steps_done, part.seconds, part.rollouts) == (200, 200, 0.0, None)
    monkeypatch.setattr(commands, "run_here", lambda jobs, tell: pytest.fail("what a longer run has is not run"))
    assert csac("study run shorter.toml --engine local --seeds 1 --directory another/machine --results out") == 0
    assert not Results("out").has(one)
    assert csac("study run shorter.toml --engine local --seeds 1 --results out") == 0, "it has run here, by itself"
    assert Results("out").has(one)
    collected = Results("out").record(one)
    assert collected is not None
    assert (collected.seconds, collected.evaluations.tobytes()) == (itself.seconds, itself.evaluations.tobytes())


def ppo(schedule):
    changes = {"learning_rate_schedule": schedule}
    return Cell.make("Hopper-v4", "ppo", changes, seed=0, steps=300, evaluation_interval=100, evaluation_episodes=2)


def test_what_no_longer_run_has_is_not_taken_from_one():
    schedules = [ppo(schedule) for schedule in ("linear", "constant")]
    for one in (cell(), cell(seed=1), *schedules):
        seed, state = one.seed, "failed" if one.seed == 1 else "finished"
        failures = {1: "step 290: the actor is not finite"} if state == "failed" else {}
        run = make_run(Store(), one, steps_done=300, state=state, failures=failures)
        rows = [{"seed": seed, "step": step, "episode": 0, "return": 1.0, "length": 9} for step in (100, 200, 300)]
        run.append("evaluations", rows)
        collect(Store(), one, "out")
    results = Results("out")
    assert results.status(cell(steps=200), rollouts=0) == ("complete", 200, "", 0.0)
    assert results.status(cell(steps=200), rollouts=1) is None, "it has no policy of that step to test"
    assert results.status(cell(steps=250), rollouts=0) is None, "it was not evaluated there"
    assert results.status(cell(steps=400), rollouts=0) is None, "it is shorter"
    assert results.status(cell(seed=1, steps=200), rollouts=0) is None, "it failed"
    assert results.status(cell(steps=200, evaluation_episodes=3), rollouts=0) is None, "it is another"
    falling, constant = (results.status(replace(one, steps=200), rollouts=0) for one in schedules)
    assert falling is None, "its learning rate fell more slowly"
    assert constant == ("complete", 200, "", 0.0)


def test_a_report_says_what_is_the_beginning_of_a_longer_run_and_never_counts_it_as_tested(tmp_path):
    shorter = cell(steps=200)
    run = make_run(Store(), replace(shorter, steps=300), steps_done=300, state="finished")
    rows = [{"seed": 0, "step": step, "episode": 0, "return": 1.0, "length": 9} for step in (100, 200, 300)]
    run.append("evaluations", rows)
    collect(Store(), replace(shorter, steps=300), "out")
    text = TINY.replace("steps = 300", "steps = 200")
    write(tmp_path / "shorter.toml", text)
    write(tmp_path / "tested.toml", text.replace("steps = 200", "steps = 200\nrollouts = 2"))

    assert csac("study report shorter.toml --seeds 1 --results out --out shorter") == 0
    assert csac("study report tested.toml --seeds 1 --results out --out tested") == 0

    report, tested = (Path(name, "report.md").read_text() for name in ("shorter", "tested"))
    assert "1 of 1 cell is complete." in report
    assert "SAC, Hopper-v4, seed 0: the beginning of a run of 300 steps" in report
    assert "0 of 1 cell is complete, 1 is not over." in tested


def test_on_a_terminal_where_nothing_is_left_to_run_it_is_said(engine, monkeypatch):
    for one in cells_of([read_study("tiny.toml")]):
        make_run(Store(), one, steps_done=300, state="finished")
    shown = io.StringIO()
    terminal = Console(file=shown, width=100, force_terminal=True, _environ={"TERM": "xterm-256color"})
    monkeypatch.setattr(commands, "make_console", lambda: terminal)
    assert csac("study run tiny.toml") == 0
    assert shown.getvalue().splitlines()[-1] == "2 cells: 2 complete"
    assert not engine


def test_what_a_folder_has_not_collected_is_run(engine):
    assert csac("study run tiny.toml --engine local --results empty") == 0
    assert len(engine) == 2


@pytest.mark.parametrize(
    ("place", "complaint"),
    [("tiny.toml", "cannot write to tiny.toml: "), (HOME.parent, f"--results {HOME.parent} is where the runs")],
)
def test_results_that_cannot_lie_there_are_refused_before_anything_runs(engine, capsys, place, complaint):
    assert csac(f"study run tiny.toml --results {place}") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"csac: {complaint}")
    assert error.count("\n") == 1
    assert not engine


@pytest.mark.parametrize("options", ["", "--engine processes", "--cell 0"])
@pytest.mark.parametrize(
    ("place", "complaint"),
    [
        ("tiny.toml", "tiny.toml is a file; choose another directory"),
        ("tiny.toml/cells", "cannot write to tiny.toml/cells: Not a directory; choose another directory"),
        ("/proc/cells", "cannot write to /proc/cells: No such file or directory; choose another directory"),
    ],
)
def test_a_directory_that_cannot_be_written_is_refused_before_anything_runs(engine, capsys, place, complaint, options):
    assert csac(f"study run tiny.toml --directory {place} {options}") == 2
    assert capsys.readouterr().err == f"csac: {complaint}\n"
    assert not engine


def test_a_directory_that_nobody_may_write_is_refused_only_where_a_cell_is_left(engine, capsys, monkeypatch):
    finished(Store(), cells_of([read_study("tiny.toml")])[0])
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write anywhere
    assert csac("study run tiny.toml --seeds 1") == 0
    assert csac("study run tiny.toml") == 2
    assert capsys.readouterr().err == f"csac: cannot write to {HOME}: Permission denied; choose another directory\n"
    assert not engine


def test_a_cell_that_failed_where_nothing_can_be_written_is_an_exit_code(monkeypatch, capsys):
    def fail(jobs, tell):
        for job in jobs:
            tell(Ended(job.cell.key, "failed", "No space left on device"))

    monkeypatch.setattr(commands, "run_here", fail)
    assert csac("study run tiny.toml --engine local") == 3
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "failed: SAC on Hopper-v4, seed 0: No space left on device",
        "failed: SAC on Hopper-v4, seed 1: No space left on device",
        "2 cells: 2 failed",
    ]


def test_results_that_nobody_may_write_are_refused_before_anything_runs(engine, capsys, monkeypatch):
    Path("out/cells").mkdir(parents=True)
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write anywhere
    assert csac("study run tiny.toml --results out") == 2
    assert capsys.readouterr().err.startswith("csac: cannot write to out: Permission denied; ")
    assert not engine


def test_a_copy_that_fails_ends_no_other_cell(engine, capsys, monkeypatch):
    def full(*_):
        if engine:  # else nothing has been run that could be copied
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(commands, "collect", full)
    assert csac("study run tiny.toml --engine local --results empty") == 3
    assert len(engine) == 2
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not copied to empty: ")]
    assert len(told) == 2
    assert all(line.endswith("No space left on device; the same line copies it") for line in told)


def finished(store, one, rollouts=""):
    """A run that is over, with the rows of its rollouts."""
    run = make_run(store, one, steps_done=300, state="finished")
    run.append("evaluations", [{"seed": one.seed, "step": 300, "episode": 0, "return": 1.0, "length": 9}])
    if rollouts:
        (run.path / ROLLOUTS).write_text(f"seed,step,episode,return,length,success\n{rollouts}")
    return run


def test_rollouts_that_were_made_since_a_cell_was_collected_are_collected(engine, tmp_path):
    write(tmp_path / "tested.toml", TINY.replace("steps = 300", "steps = 300\nrollouts = 1"))
    (one,) = cells_of([read_study("tested.toml")])[:1]
    run = finished(Store(), one)
    collect(Store(), one, "out")
    (run.path / ROLLOUTS).write_text("seed,step,episode,return,length,success\n0,300,0,1,9,\n")
    assert Results("out").status(one, rollouts=1) is None
    assert csac("study run tested.toml --seeds 1 --results out") == 0
    assert Results("out").status(one, rollouts=1) == ("complete", 300, "", 0.0)
    assert not engine


def test_a_failure_here_replaces_nothing_that_another_machine_has_collected(engine, tmp_path):
    write(tmp_path / "tested.toml", TINY.replace("steps = 300", "steps = 300\nrollouts = 1"))
    (one,) = cells_of([read_study("tested.toml")])[:1]
    finished(Store("there"), one)
    collect(Store("there"), one, "out")
    make_run(Store(), one, steps_done=20, state="failed", failures={0: "step 20: the actor is not finite"})
    csac("study run tested.toml --seeds 1 --results out")
    record = Results("out").record(one)
    assert record is not None
    assert not record.failure
    assert len(record.evaluations)


@pytest.mark.parametrize("folder", ["an-older-name", "z-older-name"])
def test_a_cell_that_lies_under_an_older_name_is_collected_there(engine, tmp_path, folder):
    write(tmp_path / "tested.toml", TINY.replace("steps = 300", "steps = 300\nrollouts = 1"))
    (one,) = cells_of([read_study("tested.toml")])[:1]
    run = finished(Store(), one)
    collect(Store(), one, "out")
    older = Path("out/cells", one.name.parent.with_name(folder))
    Path("out/cells", one.name.parent).rename(older)
    (run.path / ROLLOUTS).write_text("seed,step,episode,return,length,success\n0,300,0,1,9,\n")
    assert csac("study run tested.toml --seeds 1 --results out") == 0
    assert Results("out").status(one, rollouts=1) == ("complete", 300, "", 0.0)
    run.update_manifest(state="failed", failures={0: "step 20: the actor is not finite"})
    collect(Store(), one, "out")
    assert Results("out").status(one, rollouts=1) == ("complete", 300, "", 0.0), "a failure replaces nothing"
    assert [path.parent for path in Path("out").rglob("seed-0.json")] == [older]
    assert not engine


def test_a_damaged_table_of_rollouts_is_made_again_and_ends_no_other_cell(monkeypatch, tmp_path, capsys):
    write(tmp_path / "tested.toml", TINY.replace("steps = 300", "steps = 300\nrollouts = 1"))
    first, second = cells_of([read_study("tested.toml")])
    finished(Store(), first, "0,30\n")
    finished(Store(), second, "1,300,0,1,9,\n")
    given = []

    def fail(jobs, tell, **_):
        given.extend(job.cell.seed for job in jobs)
        tell(Ended(first.key, "failed", "the task is not installed"))

    monkeypatch.setattr(commands, "run_here", fail)
    assert csac("study run tested.toml --engine local --results out") == 3
    assert given == [0]
    assert Results("out").has(second)
    assert "not copied to out: SAC on Hopper-v4, seed 0: " in capsys.readouterr().out


def test_show_counts_as_run_does(engine, capsys):
    one, other = cells_of([read_study("tiny.toml")])
    for each in (one, other):
        finished(Store(), each)
    write_history(Store().path(other), {"failure": "its process was killed by SIGKILL"})
    assert csac("study show tiny.toml --no-measure") == 0
    assert "1 to run, 1 of them not measured" in capsys.readouterr().out
    assert csac("study run tiny.toml") == 3  # the engine here clears nothing
    assert [job.cell for job in engine] == [other]


@pytest.mark.parametrize("option", ["--directory", "--results"])
def test_show_refuses_a_file_and_says_what_does_not_exist(capsys, option):
    assert csac(f"study show tiny.toml --no-measure {option} tiny.toml") == 2
    assert capsys.readouterr().err == "csac: tiny.toml is a file; choose another directory\n"
    assert csac(f"study show tiny.toml --no-measure {option} absent") == 0
    assert capsys.readouterr().out.count("note: absent does not exist, so nothing in it is counted\n") == 1
    Path("absent").mkdir()
    assert csac(f"study show tiny.toml --no-measure {option} absent") == 0
    assert csac("study show tiny.toml --no-measure") == 0
    assert "note: " not in capsys.readouterr().out


def test_a_report_of_nothing_replaces_no_other(capsys):
    assert csac("study report tiny.toml --out out") == 0, "there is none yet"
    finished(Store(), cells_of([read_study("tiny.toml")])[0])
    assert csac("study report tiny.toml --out out") == 0
    before = Path("out/report.md").read_bytes()
    capsys.readouterr()
    assert csac("study report tiny.toml --out out --directory nowhere") == 2
    assert capsys.readouterr().err == (
        "csac: no cell is over yet in nowhere, and a report of that would replace out/report.html: "
        "give another --directory, --results or --out\n"
    )
    assert Path("out/report.md").read_bytes() == before
    assert csac("study report tiny.toml --directory tiny.toml") == 2
    assert capsys.readouterr().err == "csac: tiny.toml is a file; choose another directory\n"


def test_show_says_that_it_measures_before_it_does(engine, monkeypatch, capsys):
    told = []

    def measure(self, cell):
        told.append(capsys.readouterr().out)
        raise RuntimeError("this cell has no environment")

    monkeypatch.setattr(Calibration, "cost", lambda self, cell: None)
    monkeypatch.setattr(Calibration, "measure", measure)
    assert csac("study show tiny.toml") == 0
    assert "--no-measure" in told[0]
    assert "cannot be measured: this cell has no environment" in capsys.readouterr().out


def test_a_killed_cell_is_told_from_where_it_goes_on(engine, capsys):
    (one,) = cells_of([read_study("tiny.toml")])[:1]
    make_run(Store(), one, steps_done=290, last_checkpoint=200)
    csac("study run tiny.toml --seeds 1")
    assert "begins: SAC on Hopper-v4, seed 0, from step 200\n" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["show idle.toml --no-measure", "run idle.toml"])
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("", ["; ".join(f"idle {k} on Hopper-v4" for k in range(5)) + " and 1 more"]),
        ("--algorithms 'idle 3,SAC'", ["idle 3 on Hopper-v4"]),
        ("--algorithms SAC", []),
    ],
)
def test_methods_that_are_all_warm_up_are_told_in_one_line(engine, capsys, tmp_path, command, options, named):
    idle = "[[methods]]\nlabel = 'idle {0}'\nalgorithm = 'td3'\nhyperparameters = {{ warmup_steps = 30{0} }}\n"
    last = idle.format(0).replace("300", "307")  # a warm-up of 300 steps leaves the last one to learn from
    write(tmp_path / "idle.toml", TINY + last + "".join(idle.format(k) for k in range(1, 6)))
    assert csac(f"study {command} {options}") == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert told == [f"note: nothing will be learnt by {one}: all steps come before the first update" for one in named]


def test_what_a_cell_notes_is_told_with_its_name(monkeypatch, capsys):
    def run(jobs, tell):
        tell(Started(jobs[0].cell.key))
        tell(Noted(jobs[0].cell.key, "restarts the episode in progress"))

    monkeypatch.setattr(commands, "run_here", run)
    assert csac("study run tiny.toml --engine local") == 0
    assert "note: SAC on Hopper-v4, seed 0 restarts the episode in progress\n" in capsys.readouterr().out


def test_what_another_machine_has_collected_stays_as_it_is(engine):
    first, second = cells_of([read_study("tiny.toml")])
    for directory, one, value in (("there", first, 1.0), (HOME, first, 2.0), (HOME, second, 3.0)):
        run = make_run(Store(directory), one, steps_done=300, state="finished")
        run.append("evaluations", [{"seed": one.seed, "step": 300, "episode": 0, "return": value, "length": 9}])
    assert csac("study run tiny.toml --seeds 1 --directory there --results out") == 0
    assert csac("study run tiny.toml --results out") == 0
    collected = [Results("out").record(one) for one in (first, second)]
    assert [record and record.evaluations["return"].tolist() for record in collected] == [[1.0], [3.0]]
    assert not engine


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("seed,step,xx\n", "is damaged, as it has no evaluation of step 300: restore it, or remove it and seed-0.json"),
        ("", "is damaged, as it has no evaluation of step 300: restore it, or remove it and seed-0.json"),
        ("seed,step,return\n0,200,1\n", "is damaged, as it has no evaluation of step 300: "),
        ("seed,step,xx\n0,300,1\n", "is damaged, as it has no returns: "),
        (None, "is missing: restore it, or remove seed-0.json too, and the cell is run again\n"),
    ],
)
@pytest.mark.parametrize("command", ["show tiny.toml --no-measure", "run tiny.toml", "report tiny.toml"])
def test_a_collected_table_that_is_damaged_is_not_a_complete_cell(engine, capsys, command, table, complaint):
    (one,) = cells_of([read_study("tiny.toml")])[:1]
    finished(Store("there"), one)
    collect(Store("there"), one, "out")
    path = Path("out/cells", one.name).with_suffix(".csv")
    path.unlink()
    if table is not None:
        path.write_text(table)
    assert csac(f"study {command} --results out") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"csac: {path} {complaint}")
    assert error.count("\n") == 1
    assert not engine


def test_a_cell_that_failed_before_its_first_evaluation_is_collected_and_over(engine):
    (one,) = cells_of([read_study("tiny.toml")])[:1]
    make_run(Store(), one, steps_done=20, state="failed", failures={0: "step 20: the actor is not finite"})
    assert csac("study run tiny.toml --seeds 1 --results out") == 3
    record = Results("out").record(one)
    assert record is not None
    assert record.failure == "step 20: the actor is not finite"
    assert len(record.evaluations) == 0
    assert record.evaluations.dtype.names == ("seed", "step", "episode", "return", "length", "success")
    assert csac("study run tiny.toml --seeds 1 --directory another/machine --results out") == 3
    assert not engine
    # It is repeated once both its directory and its collected files are gone.
    shutil.rmtree(Store().path(one))
    assert csac("study run tiny.toml --seeds 1 --results out") == 3
    assert not engine
    for path in Path("out/cells", one.name.parent).glob("seed-0.*"):
        path.unlink()
    csac("study run tiny.toml --seeds 1 --results out")
    assert [job.cell for job in engine] == [one]


def test_a_manifest_tells_the_command_and_not_where_csac_is(engine, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/home/me/.venv/bin/csac", "study", "run", "tiny.toml"])
    assert csac("study run tiny.toml") == 0
    assert {job.command for job in engine} == {"csac study run tiny.toml"}


def test_one_cell_of_an_array(engine):
    assert csac("study run tiny.toml --cell 1") == 0
    assert [job.cell.seed for job in engine] == [1]


def test_the_one_cell_of_a_job_that_another_process_has_is_not_done(engine, monkeypatch, capsys):
    def left(jobs, tell):
        for job in jobs:
            tell(Ended(job.cell.key, "elsewhere"))

    monkeypatch.setattr(commands, "run_here", left)
    assert csac("study run tiny.toml --cell 1") == 3
    assert "run by another process: " in capsys.readouterr().out
    assert csac("study run tiny.toml --engine local") == 0


@pytest.mark.parametrize("names", ["SAC, 0.2,SAC, automatic", " SAC, 0.2 , SAC, automatic "])
def test_a_method_whose_name_has_a_comma_is_found(engine, names):
    assert csac(f"study run reference --tasks 'Hopper-v4, Walker2d-v4' --algorithms '{names}' --seeds 1") == 0
    assert sorted(str(job.cell.hyperparameters["entropy_weight"]) for job in engine) == ["0.2"] * 2 + ["auto"] * 2
    assert {job.cell.task for job in engine} == {"Hopper-v4", "Walker2d-v4"}


def test_what_is_narrowed_is_run(engine):
    assert csac("study run mujoco --scale 0.1 --tasks Ant-v4,Hopper-v4 --algorithms sac,TD3 --seeds 2") == 0
    assert len(engine) == 2 * 2 * 2
    assert {(job.cell.algorithm, job.cell.task, job.cell.steps) for job in engine} == {
        ("sac", "Ant-v4", 100_000),
        ("td3", "Ant-v4", 100_000),
        ("sac", "Hopper-v4", 200_000),
        ("td3", "Hopper-v4", 200_000),
    }


def test_studies_of_smoke_without_the_task_are_left_out(engine):
    assert csac("study run smoke --tasks PandaReach-v3,PyFlyt/QuadX-Waypoints-v1 --algorithms sac,TD3") == 0
    assert {(job.cell.task, job.cell.algorithm) for job in engine} == {
        (task, algorithm) for task in ("PandaReach-v3", "PyFlyt/QuadX-Waypoints-v1") for algorithm in ("sac", "td3")
    }


def test_rollouts_are_asked_of_the_cells_that_need_them(engine):
    assert csac("study run quadx --algorithms td3 --seeds 1 --scale 0.1") == 0
    assert [job.rollouts for job in engine] == [100]


def test_a_cell_that_fails_is_an_exit_code_and_a_reason(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(commands, "refuse_tasks", lambda jobs: None)  # as where a task is lost meanwhile
    write(tmp_path / "wrong.toml", TINY.replace("Hopper-v4", "nowhere:Hop-v4").replace("seeds = 2", "seeds = 1"))
    assert csac("study run wrong.toml --engine local") == 3
    lines = capsys.readouterr().out.splitlines()
    (told,) = [line for line in lines if line.startswith("failed: ")]
    assert told.startswith("failed: SAC on nowhere:Hop-v4, seed 0: nowhere:Hop-v4: the module nowhere")
    assert lines[-1] == "1 cell: 1 failed"


WRONG_TASKS = [
    (("Hopper-v4", "CartPole-v1"), "CartPole-v1: the action space is Discrete(2)"),
    (("Hopper-v4", "nowhere:Hop-v4"), "nowhere:Hop-v4: the module nowhere cannot be imported: "),
    (("seeds = 2", "seeds = 2\nenvironment_arguments = {gg = 1}"), "Hopper-v4 could not be made with the arguments"),
    (
        ('tasks = ["Hopper-v4"]', 'tasks = ["Pendulum-v1"]\nenvironment_arguments = {g = "a"}'),
        "Pendulum-v1 does not work with the arguments {'g': 'a'}: step raised ",
    ),
    (
        ('tasks = ["Hopper-v4"]', 'tasks = ["Pendulum-v1"]\nconditions = [["friction=2@10"], ["gravity=2@10"]]'),
        "Pendulum-v1 is no MuJoCo task",
    ),
]


@pytest.mark.parametrize("option", ["--engine local", "--engine processes", "--cell 1"])
@pytest.mark.parametrize(("change", "message"), WRONG_TASKS)
def test_a_task_that_cannot_be_made_here_is_refused_before_anything_is_written(
    engine, capsys, tmp_path, change, message, option
):
    write(tmp_path / "tiny.toml", TINY.replace(*change))
    assert csac(f"study run tiny.toml {option} --results out") == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert message in complaint
    assert not engine
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.toml"]


def test_where_one_task_cannot_be_made_it_is_said_how_to_run_the_others(engine, capsys, tmp_path):
    write(tmp_path / "tiny.toml", TINY.replace('"Hopper-v4"', '"Hopper-v4", "nowhere:Hop-v4", "Ant-v4"'))
    assert csac("study run tiny.toml") == 2
    complaint = capsys.readouterr().err
    assert complaint.endswith("No module named 'nowhere' (--tasks Hopper-v4,Ant-v4 runs the others)\n")
    assert csac("study run tiny.toml --tasks Hopper-v4,Ant-v4") == 0
    assert len(engine) == 4


def test_a_task_is_made_once_whatever_its_methods_and_seeds_and_not_for_what_is_final(engine, monkeypatch, tmp_path):
    made = []

    class Noted(refusals.Environment):
        def __init__(self, task, arguments):
            made.append(task)
            super().__init__(task, arguments)

    monkeypatch.setattr(refusals, "Environment", Noted)
    second = '[[methods]]\nalgorithm = "td3"\n'
    write(tmp_path / "tiny.toml", TINY.replace('["Hopper-v4"]', '["Hopper-v4", "Walker2d-v4"]') + second)
    for one in cells_of([read_study("tiny.toml")]):
        if one.task == "Hopper-v4":
            finished(Store(), one)
    assert csac("study run tiny.toml") == 0
    assert made == ["Walker2d-v4"]
    assert csac("study show tiny.toml --no-measure") == 0
    assert csac("study report tiny.toml --out report") == 0
    assert made == ["Walker2d-v4"]


def test_a_task_that_ray_s_nodes_may_have_is_not_looked_for_here(monkeypatch, tmp_path):
    write(tmp_path / "far.toml", TINY.replace("Hopper-v4", "nowhere:Hop-v4"))
    given = []
    monkeypatch.setattr("csac.studies.cluster.run_on_ray", lambda jobs, tell, **_: given.extend(jobs))
    assert csac("study run far.toml --engine ray") == 0
    assert len(given) == 2


@pytest.mark.parametrize("name", ["local", "processes"])
def test_a_device_that_there_is_not_is_refused_before_anything_is_written(engine, capsys, tmp_path, monkeypatch, name):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert csac(f"study run tiny.toml --engine {name} --device gpu") == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert "choose the cpu" in complaint or "train on the gpu in a new one" in complaint
    assert not engine
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.toml"]


def test_a_signal_is_an_exit_code_and_the_line_to_type(monkeypatch, capsys):
    def run(jobs, tell):
        raise Stopped(signal.SIGINT)

    monkeypatch.setattr(commands, "run_here", run)
    monkeypatch.setattr("sys.argv", ["csac", "study", "run", "tiny.toml", "--engine", "local"])
    assert csac("study run tiny.toml --engine local") == 130
    assert capsys.readouterr().err.endswith("csac study run tiny.toml --engine local\n")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("study rnu mujoco", "no study command is called 'rnu'; did you mean run? (csac study --help)"),
        ("study run mojoco", "no study is called 'mojoco'; did you mean mujoco?"),
        ("study run tiny.toml --cell 2", "--cell counts from 0 to 1, not 2"),
        ("study run tiny.toml --seeds 0", "csac: --seeds must be at least 1, not 0"),
        ("study show mujoco --seeds 5_000_000_000", "the last seed would be 4,999,999,999: seeds are below"),
        (
            "study report mujoco --seeds 1_000_000_000",
            "mujoco would have 24,000,000,000 cells, and 100,000 is the most",
        ),
        ("study run tiny.toml --workers 0", "--workers must be at least 1, not 0"),
        ("study run tiny.toml --engine local --workers 2", "leave out --workers"),
        ("study run tiny.toml --engine ray --workers 3", "leave out --workers"),
        ("study run tiny.toml --address 10.0.0.1:6379", "--address is for Ray: add --engine ray"),
        ("study run tiny.toml --engine local --cell-cores 2", "--cell-cores is for Ray"),
        ("study run tiny.toml --cell-gpus 0.2 --device gpu", "--cell-gpus is for Ray"),
        ("study run tiny.toml --cell-memory 2", "--cell-memory is for Ray"),
        ("study run tiny.toml --engine ray --cell-cores 0", "--cell-cores is at least 1"),
        ("study run tiny.toml --scale 2", "scale is a share of the steps"),
        ("study run tiny.toml --tasks Ant-v4", "tiny: no task 'Ant-v4': there is Hopper-v4"),
        (
            "study run reference --algorithms ppo",
            "'ppo': there is sac, 'SAC, 0.2', 'SAC, automatic', csac, 'CSAC, paper'",
        ),
        ("study run smoke --tasks Swimmer-v4", "no task 'Swimmer-v4'"),
        (
            "study run smoke --tasks Hopper-v4 --algorithms 'CSAC (paper), tau 0.5'",
            "none has such a method on such a task",
        ),
        ("study run tiny.toml --engine kubernetes", "'kubernetes' is not one of"),
    ],
)
def test_mistakes_are_told_in_one_line(capsys, tmp_path, line, message):
    assert csac(line) == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert message in complaint
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.toml"]


# What a cell will take.


def test_a_prediction_is_warm_up_learning_and_evaluation():
    one = cell(steps=10_000, evaluation_interval=1_000, evaluation_episodes=10, hyperparameters={"warmup_steps": 2_000})
    cost = Cost(learning=0.01, evaluating=0.001, longest_episode=100, transition_size=20)
    # 8,000 steps that learn, 2,000 that do not, ten evaluations of ten episodes of 100 steps, and ten seconds to start.
    assert predict(one, cost).seconds == pytest.approx(80 + 2 + 10 + 10)
    # From step 5,000 on: half of the steps, all of them learning, and half of the evaluations.
    assert predict(one, cost, done=5_000).seconds == pytest.approx(50 + 5 + 10)
    assert predict(one, cost).disk == 150 * 20 * 4  # its replay
    # Once it is trained, only the rollouts are left.
    assert predict(one, cost, done=10_000, rollouts=50).seconds == pytest.approx(5 + 10)


def test_show_counts_the_rollouts_and_is_as_long_as_the_longest_cell(monkeypatch, tmp_path, capsys):
    write(tmp_path / "tested.toml", TINY.replace("seeds = 2\nsteps = 300", "seeds = 3\nsteps = 300\nrollouts = 1000"))
    cost = Cost(learning=0.0, evaluating=0.001, longest_episode=3_600, transition_size=20)
    monkeypatch.setattr(Calibration, "cost", lambda self, cell: cost)
    monkeypatch.setattr(commands, "usable_cores", lambda: [0, 1])
    tested, untested, _ = cells_of([read_study("tested.toml")])
    finished(Store(), tested, "0,300,0,1,9,\n" * 1000)
    write_history(Store().path(tested), {"failure": "its process was killed by SIGKILL"})
    finished(Store(), untested)
    assert csac("study show tested.toml") == 0
    out = capsys.readouterr().out
    # 3,600 s for the rollouts of a policy, 3.6 s for an evaluation's episode, ten seconds to start.
    assert re.findall(r"about (10 s|1 h) ", out.partition("to run")[0]) == ["10 s", "1 h", "1 h"]
    assert "3 to run: about 2 h of one core, about 1 h with 2 at once; " in out
    assert csac("study show tested.toml --seeds 2") == 0
    assert "2 to run: about 1 h of one core, about 1 h with 2 at once; " in capsys.readouterr().out


def test_a_kind_is_measured_once_whatever_its_weights(monkeypatch):
    monkeypatch.setattr("os.getloadavg", lambda: (0.0, 0.0, 0.0))
    one = cell(task="Pendulum-v1")
    assert Calibration().cost(one) is None
    cost = Calibration().measure(one)
    assert cost.evaluating > 0 <= cost.learning  # a difference of two times, which a busy machine can make nothing of
    assert (cost.longest_episode, cost.transition_size) == (200, 3 + 1 + 3 + 3)
    other = cell(task="Pendulum-v1", seed=3, steps=999, hyperparameters={"discount": 0.9})
    assert Calibration().cost(other) == cost
    assert Calibration().cost(cell(task="Pendulum-v1", hyperparameters={"batch_size": 16})) is None


def test_what_cannot_be_measured_is_told():
    with pytest.raises(RuntimeError, match="no task is called Pendulm-v1"):
        Calibration().measure(cell(task="Pendulm-v1"))
