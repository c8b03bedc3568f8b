import os
import signal
from contextlib import nullcontext

import pytest
from helped import ends_of
from resuming import Crash, contents
from studying import cell, jobs

from csac.record.run import RunDirectory
from csac.studies import calibration, engines
from csac.studies.cells import Cell, Store, is_final
from csac.studies.engines import run_here, run_in_processes, split_cores
from csac.studies.job import Advanced, Ended, Noted, Started, Stopped
from csac.tasks.seeds import training_seed
from csac.training.interruptions import caught_signals


def outcomes(messages):
    return {message.key: message.outcome for message in messages if isinstance(message, Ended)}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The files of a cell that nothing happened to."""
    (job,) = jobs(tmp_path_factory.mktemp("whole"), cell())
    run_here([job], lambda _: None)
    return contents(job.path)


def test_cells_are_run_to_their_end_and_told(tmp_path):
    changed = cell(
        1, perturbations=("friction=2@150",), events=("fell",), environment_arguments={"healthy_reward": 0.5}
    )
    messages, two = [], jobs(tmp_path, cell(0), changed, keep_checkpoints=False)
    run_here(two, messages.append)
    first, second = (job.cell.key for job in two)
    told = [(type(message), message.key) for message in messages]
    assert told == [(kind, key) for key in (first, second) for kind in (Started, Advanced, Advanced, Advanced, Ended)]
    assert [message.step for message in messages if isinstance(message, Advanced)] == [100, 200, 300] * 2
    store = Store(tmp_path)
    assert [store.status(job.cell).state for job in two] == ["complete", "complete"]
    assert not (two[0].path / "checkpoint").exists()
    assert [Cell.of_run(RunDirectory.open(job.path).manifest) for job in two] == [job.cell for job in two]


def test_a_cell_that_crashed_goes_on_and_leaves_the_same_files(tmp_path, uninterrupted):
    (job,) = jobs(tmp_path, cell())

    def crash(message):
        if isinstance(message, Advanced) and message.step == 200:
            raise Crash

    messages = []
    run_here([job], lambda message: (messages.append(message), crash(message)))
    assert messages[-1] == Ended(job.cell.key, "failed", "Crash")
    assert Store(tmp_path).status(job.cell).reason == "Crash"
    run_here([job], lambda _: None)
    assert contents(job.path) == uninterrupted
    (entry,) = RunDirectory.open(job.path).manifest.history
    assert entry.step == 120
    assert Store(tmp_path).status(job.cell)._replace(seconds=0) == ("complete", 300, "", 0)


def test_a_cell_that_fails_does_not_stop_the_others(tmp_path):
    wrong = jobs(tmp_path, cell(task="Hoppper-v4"), cell(0, "probes:NonFinite-v0"), cell())
    messages = []
    run_here(wrong, messages.append)
    assert list(outcomes(messages).values()) == ["failed", "failed", "complete"]
    store = Store(tmp_path)
    reasons = [store.status(job.cell).reason for job in wrong]
    assert "no task is called Hoppper-v4" in reasons[0]
    assert reasons[1].startswith("step ")
    assert not is_final(wrong[0].path)
    assert is_final(wrong[1].path)


def test_a_cell_that_another_process_has_is_left_to_it(tmp_path):
    (job,) = jobs(tmp_path, cell())
    run_here([job], lambda _: None)
    messages = []
    with RunDirectory.open(job.path).locked():
        run_here([job], messages.append)
    assert outcomes(messages) == {job.cell.key: "elsewhere"}


def test_a_cell_that_another_process_begins_in_the_same_moment_is_left_to_it(tmp_path, monkeypatch):
    """It creates the run between this process's look at the folder and its own creation, and is through with that."""
    (job,) = jobs(tmp_path, cell())
    create = RunDirectory.create

    def second(path, manifest):
        create(path, manifest)
        return create(path, manifest)

    monkeypatch.setattr(RunDirectory, "create", second)
    messages = []
    run_here([job], messages.append)
    assert outcomes(messages) == {job.cell.key: "elsewhere"}
    assert Store(tmp_path).status(job.cell).state != "failed"


@pytest.mark.parametrize("run", [run_here, lambda jobs, tell: run_in_processes(jobs, tell, workers=1)])
def test_a_signal_saves_the_cell_and_leaves_the_rest(tmp_path, uninterrupted, run):
    two, messages = jobs(tmp_path, cell(0), cell(1)), []

    def tell(message):
        messages.append(message)
        if isinstance(message, Advanced) and message.step == 100:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped) as stopped:
        run(two, tell)
    assert stopped.value.signal_number == signal.SIGINT
    assert outcomes(messages) == {two[0].cell.key: "stopped"}
    store = Store(tmp_path)
    assert [store.status(job.cell).state for job in two] == ["partial", "waiting"]
    assert 100 <= store.status(two[0].cell).steps < 300
    run_here(two[:1], lambda _: None)
    assert contents(two[0].path) == uninterrupted


def test_a_cell_that_goes_on_inexactly_says_so_once(tmp_path):
    (job,), messages = jobs(tmp_path, cell(task="Pendulum-v1")), []

    def stop(message):
        messages.append(message)
        if isinstance(message, Advanced) and message.step == 100:  # in the middle of an episode of 200 steps
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped):
        run_here([job], stop)
    assert not any(isinstance(message, Noted) for message in messages)
    messages.clear()
    run_here([job], messages.append)
    told = [message for message in messages if isinstance(message, Noted)]
    assert told == [
        Noted(job.cell.key, "restarts the episode in progress, which the checkpoint could not hold"),
    ]
    assert outcomes(messages) == {job.cell.key: "complete"}


@pytest.mark.parametrize("around", [caught_signals, nullcontext], ids=["its last step", "its test"])
def test_a_signal_that_a_cell_outlives_leaves_the_rest(tmp_path, monkeypatch, around):
    def outlive(job, _):
        with around():
            signal.raise_signal(signal.SIGINT)
        return Ended(job.cell.key, "complete")

    monkeypatch.setattr(engines, "execute", outlive)
    two, messages = jobs(tmp_path, cell(0), cell(1)), []
    with pytest.raises(Stopped) as stopped:
        run_here(two, messages.append)
    assert stopped.value.signal_number == signal.SIGINT
    assert outcomes(messages) == {two[0].cell.key: "complete"}


def test_processes_run_cells_side_by_side_and_outlive_one_that_dies(tmp_path):
    deadly = cell(0, "probes:Deadly-v0", environment_arguments={"seed": training_seed(0, 20)})
    three, messages = jobs(tmp_path, cell(0), deadly, cell(1)), []
    run_in_processes(three, messages.append, workers=2)
    assert outcomes(messages) == {
        three[0].cell.key: "complete",
        deadly.key: "failed",
        three[2].cell.key: "complete",
    }
    assert "killed by SIGKILL" in Store(tmp_path).status(deadly).reason
    assert {type(message) for message in messages[:2]} == {Started}


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_a_task_may_have_processes_in_a_process_that_runs_a_cell(tmp_path):
    """It could where cells are run one after another; a daemon may start none."""
    (tmp_path / "ends").mkdir()
    arguments = {"folder": str(tmp_path / "ends"), "forks": False}
    (job,), messages = jobs(tmp_path / "study", cell(0, "helped:Helped-v0", environment_arguments=arguments)), []
    run_in_processes([job], messages.append, workers=1)
    assert outcomes(messages) == {job.cell.key: "complete"}
    assert ends_of(tmp_path / "ends") == (1, {"-15 -15"})


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_what_a_cell_costs_is_measured_with_the_processes_of_its_task(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "_home", lambda: tmp_path / "home")
    (tmp_path / "ends").mkdir()
    arguments = {"folder": str(tmp_path / "ends"), "forks": False}
    cost = calibration.Calibration().measure(cell(0, "helped:Helped-v0", environment_arguments=arguments))
    assert cost.longest_episode == 1
    assert ends_of(tmp_path / "ends") == (1, {"-15 -15"})


@pytest.mark.parametrize(
    ("workers", "shares"),
    [(None, [[0], [1], [2], [3]]), (1, [[0, 1, 2, 3]]), (2, [[0, 2], [1, 3]]), (3, [[0, 3], [1], [2]]), (5, 5)],
)
def test_workers_share_the_cores(workers, shares):
    split = split_cores([0, 1, 2, 3], workers)
    assert len(split) == shares if isinstance(shares, int) else split == shares
