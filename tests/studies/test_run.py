"""Running a study: what is trained, what is left alone, and what remains of it."""

import signal
from pathlib import Path

import pytest
from studying import TINY, tiny_study, write_run

from csac.cli import main
from csac.console.tables import make_console
from csac.record.run import RunDirectory
from csac.record.sets import RunSet
from csac.studies import run as module
from csac.studies.run import Execution, run_study
from csac.types import InputError


@pytest.fixture
def supervised(monkeypatch):
    """The programs that would have been trained; each is finished at once."""
    found = []

    def supervise(programs, watcher_of, should_stop, workers, turns):
        found.append((list(programs), workers, turns))
        for program in programs:
            run = RunDirectory.open(program.directories[0])
            run.update_manifest(state="finished", steps_done=run.config.steps, process=1)
            watcher_of(program).progress({run.seed: run.config.steps})

    monkeypatch.setattr(module, "supervise", supervise)
    return found


def test_each_run_is_a_program_of_its_own(tmp_path, supervised, monkeypatch, capsys):
    monkeypatch.setattr(module, "cores_to_use", lambda: 4)
    runs = tiny_study(tmp_path).runs()
    assert run_study(runs, tmp_path / "runs", Execution(workers=2, command="csac study"), make_console()) is None
    ((programs, workers, turns),) = supervised
    assert [program.directories for program in programs] == [(tmp_path / "runs" / run.folder,) for run in runs]
    assert {(program.threads, program.command) for program in programs} == {(2, "csac study")}
    assert (workers, turns) == (2, 2)
    assert RunDirectory.open(programs[0].directories[0]).config == runs[0].config
    assert "4 of 4: csac on Pendulum-v1, seed 1: finished" in capsys.readouterr().out


def test_what_is_over_is_left_alone_and_the_rest_goes_on(tmp_path, supervised):
    one, two, three, four = tiny_study(tmp_path).runs()
    write_run(tmp_path / one.folder, one.config)
    write_run(tmp_path / two.folder, two.config, state="failed")
    write_run(tmp_path / three.folder, three.config, state="interrupted", points=4)
    assert RunDirectory.open(tmp_path / three.folder).state == "interrupted"
    run_study([one, two, three, four], tmp_path, Execution(), make_console())
    ((programs, _, _),) = supervised
    assert [program.directories[0] for program in programs] == [tmp_path / three.folder, tmp_path / four.folder]
    assert programs[0].threads == 1  # as it began


def test_what_another_process_trains_is_left_to_it(tmp_path, supervised, capsys):
    one, two, *_ = tiny_study(tmp_path).runs()
    write_run(tmp_path / one.folder, one.config, state="running", points=4)
    with RunDirectory.open(tmp_path / one.folder).locked():
        run_study([one, two], tmp_path, Execution(), make_console())
    ((programs, _, _),) = supervised
    assert [program.directories[0] for program in programs] == [tmp_path / two.folder]
    assert "another process trains it" in capsys.readouterr().out


def test_more_steps_later_go_on(tmp_path, supervised):
    (run, *_) = tiny_study(tmp_path).runs()
    (longer, *_) = tiny_study(tmp_path, steps=2_000).runs()
    write_run(tmp_path / run.folder, run.config, points=0)
    run_study([longer], tmp_path, Execution(), make_console())
    assert RunDirectory.open(tmp_path / run.folder).config.steps == 2_000
    assert longer.is_over(tmp_path)


def test_a_longer_study_that_is_stopped_at_once_has_its_runs_before_it(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "supervise", lambda *arguments: None)
    (run, *_), (longer, *_) = tiny_study(tmp_path).runs(), tiny_study(tmp_path, steps=2_000).runs()
    write_run(tmp_path / run.folder, run.config, points=0)
    (tmp_path / run.folder / "checkpoint").mkdir()
    run_study([longer], tmp_path, Execution(), make_console())
    assert not longer.is_over(tmp_path)
    assert (tmp_path / run.folder / "checkpoint").exists()


def test_a_study_of_several_environments_records_and_shows_them(tmp_path, supervised, capsys):
    path = tmp_path / "several.toml"
    path.write_text(f"environments = 4\n{TINY}")
    words = [str(path), "--scale", "0.33", "--directory", str(tmp_path / "runs")]
    assert main(["study", "run", *words]) == 0
    config = RunDirectory.open(supervised[0][0][0].directories[0]).config
    assert (config.environments, config.steps) == (4, 328)
    assert main(["study", "show", *words]) == 0
    assert "sac on Pendulum-v1, 4 environments, seed 0" in capsys.readouterr().out


@pytest.mark.parametrize("change", [{"evaluation_interval": 300}, {"steps": 500}])
def test_runs_of_another_study_are_refused(tmp_path, supervised, change):
    (run, *_) = tiny_study(tmp_path).runs()
    write_run(tmp_path / run.folder, run.config)
    (other, *_) = tiny_study(tmp_path, **change).runs()
    with pytest.raises(InputError, match=next(iter(change))):
        run_study([other], tmp_path, Execution(), make_console())
    assert not supervised


def test_a_task_that_cannot_be_made_is_told_before_anything_is_written(tmp_path, supervised):
    runs = tiny_study(tmp_path, tasks=["Pendulum-v1", "Pendlum-v1"]).runs()
    with pytest.raises(InputError, match="Pendlum-v1"):
        run_study(runs, tmp_path / "runs", Execution(), make_console())
    assert not (tmp_path / "runs").exists()


def test_checkpoints_of_finished_runs_are_removed(tmp_path, supervised):
    kept, removed = tiny_study(tmp_path).runs()[:2]
    for run in (kept, removed):
        write_run(tmp_path / run.folder, run.config, state="interrupted", points=4)
        (tmp_path / run.folder / "checkpoint").mkdir()
    run_study([kept], tmp_path, Execution(keep_checkpoints=True), make_console())
    run_study([removed], tmp_path, Execution(), make_console())
    assert (tmp_path / kept.folder / "checkpoint").exists()
    assert not (tmp_path / removed.folder / "checkpoint").exists()


def test_a_signal_ends_a_study_and_the_same_line_goes_on(tmp_path, monkeypatch, capsys):
    path = write_study(tmp_path)
    monkeypatch.setattr(module, "supervise", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert main(["study", "run", str(path), "--directory", str(tmp_path / "runs")]) == 143
    assert "every run is saved" in capsys.readouterr().err
    assert main(["study", "show", str(path), "--directory", str(tmp_path / "runs")]) == 0
    assert "4 waiting" in capsys.readouterr().out


def test_a_failed_run_is_exit_code_3(tmp_path, supervised, capsys):
    path, runs = write_study(tmp_path), tiny_study(tmp_path).runs()
    for run in runs:
        write_run(tmp_path / run.folder, run.config, state="failed" if run is runs[0] else "finished")
    assert main(["study", "run", str(path), "--directory", str(tmp_path)]) == 3
    assert "sac on Pendulum-v1, seed 0 failed at step 5: reward is not finite" in capsys.readouterr().out
    assert main(["study", "run", str(path), "--directory", str(tmp_path), "--cell", "1"]) == 0


def test_show_says_how_long_such_runs_took(tmp_path, capsys):
    path, (run, *_) = write_study(tmp_path), tiny_study(tmp_path).runs()
    made = write_run(tmp_path / run.folder, run.config)
    lines = [f"2026-01-01T00:0{minute}:00+00:00 step {100 * minute}: mean return 1.0" for minute in range(1, 9)]
    (made.path / "log.txt").write_text("\n".join(lines))  # a minute for 100 steps, of 1,000
    assert main(["study", "show", str(path), "--directory", str(tmp_path)]) == 0
    assert "about 10 min" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--workers", "0"], "--workers"),
        (["--workers", "2", "--engine", "local"], "--workers"),
        (["--workers", "2", "--cell", "0"], "--workers"),
        (["--cell-cores", "2"], "--cell-cores"),
        (["--cell-memory", "-1", "--engine", "ray"], "--cell-memory"),
        (["--cell", "4"], "--cell"),
        (["--scale", "0"], "scale"),
        (["--seeds", "0"], "seeds"),
        (["--tasks", "Pendulum-v2"], "Pendulum-v2"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(tmp_path, supervised, capsys, options, named):
    path = write_study(tmp_path)
    assert main(["study", "run", str(path), "--directory", str(tmp_path / "runs"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line
    assert not (tmp_path / "runs").exists()


def test_the_studies_are_listed(capsys):
    assert main(["study", "list"]) == 0
    assert "mujoco" in capsys.readouterr().out


def test_a_study_from_its_beginning_to_its_report(tmp_path, capsys):
    """Two real runs, of which every other command knows."""
    path, runs = write_study(tmp_path), tmp_path / "runs"
    words = [str(path), "--seeds", "1", "--directory", str(runs)]
    assert main(["study", "run", *words]) == 0
    assert RunSet.open(runs / "sac" / "Pendulum-v1").state == "finished"
    assert main(["study", "run", *words]) == 0
    assert main(["study", "report", *words]) == 0
    assert "<h2>Learning curves</h2>" in (runs / "report.html").read_text()
    assert main(["evaluate", str(runs / "csac" / "Pendulum-v1"), "--episodes", "1"]) == 0
    assert "2 finished" in capsys.readouterr().out


def write_study(folder: Path) -> Path:
    path = folder / "tiny.toml"
    path.write_text(TINY)
    return path
