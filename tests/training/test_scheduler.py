"""When a group says what, and what a scheduler makes of the ends of its processes."""

from __future__ import annotations

import errno
import multiprocessing
import os
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import plans
import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from helped import Helped, ends_of
from resuming import SMALL, run

from csac.algorithms import CSAC, SAC
from csac.training import scheduler as scheduler_module
from csac.training.checkpoint import Checkpoints, Damaged
from csac.training.messages import (
    Boundary,
    Ended,
    GroupCrashed,
    GroupMessage,
    GroupRestarted,
    Noted,
    NotSaved,
    Refused,
    Saved,
)
from csac.training.scheduler import _Scheduler
from csac.training.train import Watchers


@pytest.mark.parametrize(("quota", "groups", "processes"), [(None, 20, 3), (1, 4, 0), (4, 16, 1)])
def test_a_container_s_share_of_the_processors_decides_how_many_processes_there_are(
    monkeypatch, quota, groups, processes
):
    monkeypatch.setattr(scheduler_module, "usable_cores", lambda: list(range(8)))
    monkeypatch.setattr(scheduler_module, "core_quota", lambda: quota)
    assert scheduler_module.choose_groups(20, "cpu") == groups
    assert scheduler_module.choose_evaluation_processes([[0], [1]], 1000) == processes


@pytest.mark.parametrize(
    ("cores", "seeds", "groups"),
    [(16, 1, 1), (16, 9, 1), (16, 10, 2), (16, 19, 3), (16, 25, 4), (64, 100, 4), (4, 25, 2), (1, 25, 1)],
)
def test_a_few_groups_of_several_seeds_share_a_gpu(monkeypatch, cores, seeds, groups):
    monkeypatch.setattr(scheduler_module, "usable_cores", lambda: list(range(cores)))
    monkeypatch.setattr(scheduler_module, "core_quota", lambda: None)
    assert scheduler_module.choose_groups(seeds, "gpu") == groups
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "true")  # the first process takes what others would need
    assert scheduler_module.choose_groups(seeds, "gpu") == 1


@pytest.mark.parametrize("interval", [100, 130])
def test_a_run_that_has_enough_ends_at_that_very_step(tmp_path, interval):
    """Evaluations between the steps where a group can be saved were told of up to 250 steps later."""
    told: list[int] = []

    def enough(step: int, _: Any) -> bool:
        told.append(step)
        return step == 2 * interval

    finished = run(tmp_path / "run", SAC(**SMALL), 500, "Pendulum-v1", evaluation_interval=interval, stop_when=enough)
    assert told == [interval, 2 * interval]
    assert (finished.manifest.steps_done, finished.manifest.state) == (2 * interval, "finished")


def test_a_run_that_had_enough_goes_on_only_where_more_is_asked(tmp_path):
    told: list[int] = []

    def enough_after(steps: int) -> Callable[[int, dict[int, float]], bool]:
        def enough(step: int, returns: dict[int, float]) -> bool:
            told.append(step)
            assert list(returns) == [0]
            return step >= steps

        return enough

    def again(stop_when: Any) -> tuple[int, int]:
        finished = run(tmp_path / "run", SAC(**SMALL), 500, "Pendulum-v1", stop_when=stop_when, **settings)
        return finished.manifest.steps_done, len(finished.manifest.history)

    settings: dict[str, Any] = {"evaluation_interval": 100, "resume": True}
    assert again(enough_after(200)) == (200, 0)
    assert again(enough_after(200)) == (200, 0)
    assert again(enough_after(300)) == (300, 1)
    assert again(None) == (500, 2)
    assert told == [100, 200, 200, 200, 300]


def test_a_damaged_table_is_not_asked_whether_it_is_enough(tmp_path):
    finished = run(tmp_path / "run", SAC(**SMALL), 200, "Pendulum-v1", evaluation_interval=100)
    watchers = Watchers(None, False, False, None, lambda step, returns: True, [])
    assert watchers.had_enough(finished)
    (finished.path / "evaluations.csv").write_bytes(b"\xff\xfe")
    assert not watchers.had_enough(finished)


class SlowWorkers:
    """Workers that make their turns at once, on a clock of their own: each turn takes so many seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
        self.clock, self.cores, self.cores_of = 0.0, [], defaultdict(list)
        machine, clock = self, SimpleNamespace(monotonic=lambda: self.clock)

        class Worker:
            def __init__(self, settings: Any, seeds: Any) -> None:
                self.connection, self.seeds, self.cores = self, seeds, None
                self.over = self.is_starting = False
                self.step = self.saved = self.made = 0
                self.answers: deque[Any] = deque()

            def tell(self, order: Any) -> None:
                if order == "save":
                    self.answers.append(Saved(self.made, {}, {}))
                elif order == "stop":
                    self.answers.append(Ended(self.made, {}))
                else:
                    self.made += 250
                    machine.cores.append(order)
                    machine.cores_of[self.seeds[0]].append(order)
                    machine.clock += seconds
                    self.answers.append(Boundary(self.made))

            def recv(self) -> Any:
                return self.answers.popleft()

            def kill(self) -> None:
                pass

        monkeypatch.setattr(scheduler_module, "time", clock)
        monkeypatch.setattr(scheduler_module, "_Worker", Worker)
        monkeypatch.setattr(scheduler_module, "end", lambda workers, _: None)
        monkeypatch.setattr(scheduler_module, "usable_cores", lambda: [0, 1])
        monkeypatch.setattr(
            scheduler_module, "wait", lambda all_of_them, timeout: [w for w in all_of_them if w.answers]
        )


def test_a_slow_run_stops_where_all_groups_were_saved(tmp_path, monkeypatch):
    """The clock asked for a checkpoint while the run stopped, at a step that the faster group had left behind."""
    SlowWorkers(monkeypatch, seconds=700.0)
    settings = plans.settings(SAC(), "Hopper-v4", 100_000, tmp_path, checkpoint_interval=50_000)
    scheduler: Any = scheduler_module._Scheduler(settings, [[0], [1]], lambda: True, None, lambda: True)
    scheduler.workers[0].step = scheduler.workers[0].made = 1_250  # as far ahead as a group may be
    told = [(group, message) for group, message in scheduler.run()]
    assert {(group, message.step) for group, message in told if isinstance(message, Saved)} == {(0, 1_250), (1, 1_250)}
    assert {(group, message.step) for group, message in told if isinstance(message, Ended)} == {(0, 1_250), (1, 1_250)}


def test_a_stop_comes_after_the_step_at_which_a_seed_ahead_has_failed(tmp_path, monkeypatch):
    """Saved before it, the others were no checkpoint, since the files of the seed that was sound then were missing."""
    SlowWorkers(monkeypatch, seconds=1.0)
    settings = plans.settings(SAC(), "Hopper-v4", 100_000, tmp_path, checkpoint_interval=50_000)
    scheduler: Any = _Scheduler(settings, [[0], [1]], lambda: True, None, lambda: True)
    failed, other = scheduler.workers
    failed.answers.append(Ended(51_900, {}))
    failed.step, other.step, other.saved, other.made = 51_750, 51_000, 50_000, 51_000
    scheduler.waiting = [other]
    scheduler._receive(0, failed)
    saved = [(group, message.step) for group, message in scheduler.run() if isinstance(message, Saved)]
    assert saved == [(1, 52_000)]


def test_what_is_left_of_several_groups_keeps_its_number_of_cores(tmp_path, monkeypatch):
    """A seed whose fellow had failed had all cores after a resume, and so other last bits than without one."""
    workers = SlowWorkers(monkeypatch, seconds=1.0)
    settings = plans.settings(SAC(), "Hopper-v4", 250, tmp_path, checkpoint_interval=250)
    settings = settings._replace(plan=replace(settings.plan, groups=((0,), (1,))))
    told = [message for _, message in scheduler_module.run_groups(settings, [[0]], lambda: False)]
    assert (told[-1], workers.cores) == (Ended(250, {}), [[0]])


@pytest.mark.parametrize("left", [[0, 1, 2], [1], [1, 2], [0, 2]])
def test_each_group_keeps_its_cores_whichever_are_left_and_whoever_is_first(tmp_path, monkeypatch, left):
    """Of five cores one group has one and two have two; a resume without a seed that had failed handed them on."""
    workers = SlowWorkers(monkeypatch, seconds=1.0)
    monkeypatch.setattr(scheduler_module, "usable_cores", lambda: [0, 1, 2, 3, 4])
    settings = plans.settings(SAC(), "Hopper-v4", 1_000, tmp_path, checkpoint_interval=500)
    settings = settings._replace(plan=replace(settings.plan, groups=((0,), (1,), (2,))))
    for _ in scheduler_module.run_groups(settings, [[seed] for seed in left], lambda: False):
        pass
    own = {0: (0, 3), 1: (1, 4), 2: (2,)}
    assert {seed: {tuple(cores) for cores in workers.cores_of[seed]} for seed in left} == {s: {own[s]} for s in left}


class MadeUpGroup:
    """A group of one seed that has made so many steps by each of its boundaries, and then ends."""

    def __init__(
        self, *steps: int, pause: Callable[[], None] = lambda: None, saving: Callable[[], None] = lambda: None
    ) -> None:
        self.steps, self.pause, self.saving, self.step = steps, pause, saving, 0
        self.environments = SimpleNamespace(alive=np.array([True]))

    def __call__(self, *_: Any) -> MadeUpGroup:
        """Be the group that is asked for."""
        return self

    def run(self, _: Any) -> Iterator[GroupMessage]:
        *boundaries, last = self.steps
        for self.step in boundaries:
            self.pause()
            yield Boundary(self.step)
        self.step = last
        yield Ended(last, {})

    def settle(self) -> Iterator[GroupMessage]:
        return iter(())

    def save(self) -> Saved:
        self.saving()
        return Saved(self.step, {}, {})

    def close(self) -> None:
        pass


def test_a_run_in_one_process_is_saved_every_ten_minutes_and_at_its_end(tmp_path, monkeypatch):
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)

    def pause() -> None:
        clock.now += 400.0  # so that one is due at every other boundary

    monkeypatch.setattr(scheduler_module, "time", clock)
    monkeypatch.setattr(scheduler_module, "Group", MadeUpGroup(250, 500, 750, 1_000, 1_100, pause=pause))
    settings = plans.settings(SAC(), "Hopper-v4", 100_000, tmp_path, checkpoint_interval=50_000)
    told = [message for _, message in scheduler_module.run_groups(settings, [[0]], lambda: False)]
    assert [message.step for message in told if isinstance(message, Saved)] == [500, 1_000, 1_100]


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.filterwarnings("ignore:os.fork")  # JAX has threads
def test_the_environments_of_every_process_are_closed(tmp_path):
    """Their simulators, which take a signal to end, went on for ever; or training did, where it waited for them."""
    (tmp_path / "ends").mkdir()
    settings: dict[str, Any] = {
        "seeds": 2,
        "groups": 2,
        "evaluation_processes": 1,
        "evaluation_interval": 100,
        "environment_arguments": {"folder": str(tmp_path / "ends")},
    }
    finished = run(tmp_path / "run", SAC(**SMALL), 100, Helped, **settings)
    assert (finished.manifest.state, finished.manifest.failures) == ("finished", {})
    processes, ends = ends_of(tmp_path / "ends")
    assert processes >= 4  # and this one may have looked at the task
    assert ends == {"-15 -15"}


# Workers that cannot go on.


def worked(monkeypatch: pytest.MonkeyPatch, folder: Path, group: Any, *orders: Any) -> list[Any]:
    """Return what a worker with this group says to its first turn and these orders."""
    monkeypatch.setattr(scheduler_module, "Group", group)
    for of_a_process_of_its_own in ("die_with_parent", "outlive_termination", "move_to"):
        monkeypatch.setattr(scheduler_module, of_a_process_of_its_own, lambda *_: None)
    settings = plans.settings(CSAC(), "Hopper-v4", 900, folder, checkpoint_interval=100)
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        for order in ([0], *orders):  # the cores of its first turn
            ours.send(order)
        scheduler_module._work(theirs, settings, [0])
        said = []
        while ours.poll():
            said.append(ours.recv())
        return said


def test_a_worker_that_meets_a_user_s_mistake_says_so(tmp_path, monkeypatch):
    def refuse(*_: Any) -> None:
        raise Damaged("the checkpoint does not fit")

    (message,) = worked(monkeypatch, tmp_path, refuse)
    assert isinstance(message, Refused)
    assert isinstance(message.error, Damaged)
    assert str(message.error) == "the checkpoint does not fit"


def test_a_worker_whose_disk_is_full_says_so_and_obeys(tmp_path, monkeypatch):
    """As a failure of its own it would have been its seeds', which are well."""

    def fill() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    made, saved, ended = worked(monkeypatch, tmp_path, MadeUpGroup(100, 100, saving=fill), "save", "stop")
    assert isinstance(saved, NotSaved)
    assert saved.error.errno == errno.ENOSPC
    assert (made, ended) == (Boundary(100), Ended(100, {}))


class DeadWorker:
    """A worker that was killed in the middle of a message."""

    def __init__(self) -> None:
        self.connection = self.process = self
        self.exitcode, self.pid, self.step, self.cores, self.over = -9, 4711, 250, None, False

    def recv(self) -> None:
        raise OSError("got end of file during message")

    def cause_of_death(self) -> str:
        return "its process was killed by SIGKILL"


@pytest.mark.parametrize(("stopping", "before", "kind"), [(True, set(), Ended), (True, {0}, GroupCrashed)])
def test_a_worker_that_dies_while_a_run_stops_is_no_failure_unless_it_died_before(tmp_path, stopping, before, kind):
    scheduler: Any = object.__new__(_Scheduler)
    scheduler.stopping, scheduler.restarted, scheduler.checkpoints = stopping, before, Checkpoints(tmp_path, 2)
    scheduler.is_urgent = lambda: True
    scheduler.settings = plans.settings(CSAC(), "Hopper-v4", 900, tmp_path, checkpoint_interval=100)
    worker: Any = DeadWorker()
    scheduler.waiting = [worker]
    assert type(scheduler._receive(0, worker)) is kind
    assert worker.over
    assert not scheduler.waiting


def test_a_worker_that_dies_while_a_run_ends_that_has_enough_is_replaced(tmp_path):
    """It ended as finished with one seed behind the other, and without a checkpoint of its last step."""

    def enough(step: int, _: Any) -> bool:
        if step == 200:
            multiprocessing.active_children()[0].kill()
        return step == 200

    settings: dict[str, Any] = {"seeds": 2, "groups": 2, "evaluation_interval": 100, "checkpoint_interval": 100}
    finished = run(tmp_path / "run", SAC(**SMALL), 2_000, "Pendulum-v1", stop_when=enough, **settings)
    manifest, rows = finished.manifest, finished.evaluations
    assert (manifest.state, manifest.failures) == ("finished", {})
    assert 200 <= manifest.steps_done < 2_000
    assert Checkpoints(finished.checkpoints, 2).newest == manifest.steps_done
    last = [rows["step"][rows["seed"] == seed].max() for seed in (0, 1)]
    assert last[0] == last[1] == manifest.steps_done // 100 * 100


@pytest.mark.parametrize(("urgent", "target"), [(True, -1), (False, 250)])
def test_a_run_that_has_enough_waits_for_a_group_that_is_starting_and_a_signal_does_not(tmp_path, urgent, target):
    """It died and began anew just before the run had enough: not waited for, it ended behind the others, unsaved."""
    scheduler: Any = object.__new__(_Scheduler)
    scheduler.settings = plans.settings(CSAC(), "Hopper-v4", 900, tmp_path, checkpoint_interval=100)
    ahead, starting = (
        SimpleNamespace(step=step, saved=100, is_starting=step == 100, cores=None, over=False, told=[])
        for step in (250, 100)
    )
    ahead.tell, starting.tell = ahead.told.append, starting.told.append
    scheduler.workers, scheduler.waiting = [ahead, starting], [ahead, starting]
    scheduler.stopping, scheduler.is_urgent, scheduler.timer = True, lambda: urgent, scheduler_module._Timer()
    scheduler._set_target()
    assert scheduler.target == target
    assert ahead.told == (["stop"] if urgent else ["save"])
    assert scheduler.waiting == ([] if urgent else [starting])


@pytest.mark.parametrize(
    ("steps", "target", "told"),
    [
        ((950_000, 900_000), -1, "seed 1, 50,000 steps behind: it can go on from step 900,000, its newest checkpoint"),
        ((1_000_000, 900_000), -1, "seed 1, 100,000 steps behind: it can go on from step 900,000"),
        ((950_000, 948_750), 950_000, None),  # no further than turns allow
        ((1_000_000, 998_750), 1_000_000, None),
    ],
)
def test_a_signal_waits_for_no_group_that_began_again_far_behind(tmp_path, monkeypatch, steps, target, told):
    """Of 50,000 steps, minutes; whoever sends SIGTERM kills after seconds."""
    SlowWorkers(monkeypatch, seconds=1.0)
    settings = plans.settings(SAC(), "Hopper-v4", 1_000_000, tmp_path, checkpoint_interval=50_000)
    checkpoints: Any = SimpleNamespace(newest=900_000)
    scheduler: Any = _Scheduler(settings, [[0], [1]], lambda: True, checkpoints, lambda: True)
    for worker, step in zip(scheduler.workers, steps, strict=True):
        worker.step = worker.saved = worker.made = step
    messages = [message for _, message in scheduler.run()]
    assert scheduler.target == target
    notes = [message.text for message in messages if isinstance(message, Noted)]
    assert [told in note for note in notes] == [True] * bool(told)
    ends = {message.step for message in messages if isinstance(message, Ended)}
    assert ends == ({steps[0], steps[1] + 250} if told else {target})  # which it was making


def test_a_worker_that_dies_while_it_waits_for_its_turn_gives_its_place_to_the_next(tmp_path, monkeypatch):
    """With more groups than cores most of them wait; whoever is dead is handed no cores."""
    told: list[Any] = []
    monkeypatch.setattr(scheduler_module, "_Worker", lambda settings, seeds: told.append((settings, seeds)) or "next")
    scheduler: Any = object.__new__(_Scheduler)
    scheduler.stopping, scheduler.restarted, scheduler.checkpoints = False, set(), Checkpoints(tmp_path, 2)
    scheduler.settings = plans.settings(CSAC(), "Hopper-v4", 900, tmp_path, checkpoint_interval=100)
    scheduler.settings = scheduler.settings._replace(begin=0, has_other_task=True)
    other: Any = object()
    worker: Any = DeadWorker()
    scheduler.workers, scheduler.waiting, worker.seeds = [other, worker], [worker, other], (1,)
    scheduler.checkpoints.commit(300, {}, {"failures": {}})
    assert scheduler._receive(1, worker) == GroupRestarted("its process was killed by SIGKILL", 300)
    assert scheduler.waiting == [other, "next"]
    assert scheduler.workers == [other, "next"]
    # What it goes on from was made on the task of this run, whatever the run began with.
    ((settings, seeds),) = told
    assert (settings.begin, settings.has_other_task, seeds) == (300, False, (1,))
