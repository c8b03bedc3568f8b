"""When a group says what, and what a scheduler makes of the ends of its processes."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import plans
import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from resuming import SMALL, run

from csac.algorithms import SAC
from csac.training import scheduler as scheduler_module
from csac.training.messages import Boundary, Ended, Saved


@pytest.mark.parametrize(("quota", "groups", "processes"), [(None, 20, 3), (1, 4, 0), (4, 16, 1)])
def test_a_container_s_share_of_the_processors_decides_how_many_processes_there_are(
    monkeypatch, quota, groups, processes
):
    monkeypatch.setattr(scheduler_module, "usable_cores", lambda: list(range(8)))
    monkeypatch.setattr(scheduler_module, "core_quota", lambda: quota)
    assert scheduler_module.choose_groups(20, "cpu") == groups
    assert scheduler_module.choose_evaluation_processes([[0], [1]], 1000) == processes


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


class SlowWorkers:
    """Workers that make their turns at once, on a clock of their own: each turn takes so many seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
        self.clock, self.cores = 0.0, []
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
                    machine.clock += seconds
                    self.answers.append(Boundary(self.made))

            def recv(self) -> Any:
                return self.answers.popleft()

            def kill(self) -> None:
                pass

        monkeypatch.setattr(scheduler_module, "time", clock)
        monkeypatch.setattr(scheduler_module, "_Worker", Worker)
        monkeypatch.setattr(scheduler_module, "usable_cores", lambda: [0, 1])
        monkeypatch.setattr(
            scheduler_module, "wait", lambda all_of_them, timeout: [w for w in all_of_them if w.answers]
        )


def test_a_slow_run_stops_where_all_groups_were_saved(tmp_path, monkeypatch):
    """The clock asked for a checkpoint while the run stopped, at a step that the faster group had left behind."""
    SlowWorkers(monkeypatch, seconds=700.0)
    settings = plans.settings(SAC(), "Hopper-v4", 100_000, tmp_path, checkpoint_interval=50_000)
    scheduler: Any = scheduler_module._Scheduler(settings, [[0], [1]], lambda: True, None)
    scheduler.workers[0].step = scheduler.workers[0].made = 1_250  # as far ahead as a group may be
    told = [(group, message) for group, message in scheduler.run()]
    assert {(group, message.step) for group, message in told if isinstance(message, Saved)} == {(0, 1_250), (1, 1_250)}
    assert {(group, message.step) for group, message in told if isinstance(message, Ended)} == {(0, 1_250), (1, 1_250)}


def test_what_is_left_of_several_groups_keeps_its_number_of_cores(tmp_path, monkeypatch):
    """A seed whose fellow had failed had all cores after a resume, and so other last bits than without one."""
    workers = SlowWorkers(monkeypatch, seconds=1.0)
    settings = plans.settings(SAC(), "Hopper-v4", 250, tmp_path, checkpoint_interval=250)
    settings = settings._replace(plan=replace(settings.plan, groups=((0,), (1,))))
    told = [message for _, message in scheduler_module.run_groups(settings, [[0]], lambda: False)]
    assert (told[-1], workers.cores) == (Ended(250, {}), [[0]])
