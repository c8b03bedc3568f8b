"""A run as seed groups: each group is trained by one process, here or beside us, and cores are handed out in turns."""

from __future__ import annotations

import time
import traceback
from contextlib import closing, suppress
from itertools import count
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from csac.evaluation.evaluator import EPISODES_AT_ONCE
from csac.processes import Child, core_quota, die_with_parent, end, move_to, outlive_termination, usable_cores
from csac.training.checkpoint import remove_unfinished
from csac.training.devices import preallocates
from csac.training.group import Group
from csac.training.messages import (
    TURN_STEPS,
    Boundary,
    Ended,
    GroupCrashed,
    GroupMessage,
    GroupRestarted,
    Message,
    Noted,
    NotSaved,
    Order,
    Refused,
    Saved,
    Settings,
)
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    from csac.training.checkpoint import Checkpoints

# More processes than this for each core only cost memory: the seeds of a larger run share processes.
GROUPS_PER_CORE = 4
# So many processes share a GPU at most: eight were in each other's way.
GROUPS_PER_GPU = 4
# With fewer seeds than this, one more process gains little.
SEEDS_PER_GPU_GROUP = 5
# One that steps its environments, and one for what JAX does beside; chosen, not measured.
CORES_PER_GPU_GROUP = 2

# Steps that one group may be ahead of another when its turn begins: all can be saved at one step without a long wait.
LONGEST_LEAD = 1_000

# A checkpoint is made at least this often, whatever the interval in steps.
SECONDS_BETWEEN_CHECKPOINTS = 600.0

# What a group has to close its environments, after the processes that evaluate for it have had their own moment.
SECONDS_TO_CLOSE = 5.0


def split_seeds(seeds: Sequence[int], groups: int) -> list[list[int]]:
    """Return the seeds in `groups` consecutive parts whose sizes differ by one at most."""
    if not 1 <= groups <= len(seeds):
        raise InputError(f"groups must lie between 1 and the number of seeds ({len(seeds)}), not {groups}")
    size, larger = divmod(len(seeds), groups)
    ends = [size * (i + 1) + min(i + 1, larger) for i in range(groups)]
    return [list(seeds[begin:end]) for begin, end in zip([0, *ends], ends)]  # noqa: B905


def choose_groups(seeds: int, device: str) -> int:
    """Return one group per seed on a CPU, as long as their processes are not too many, and a few groups on a GPU.

    Two learners on a core each do about a fifth more than one learner of two seeds on both. A GPU computes for many
    seeds at once, but their environments wait for each other in one process: four with a few seeds each do nearly twice
    as much as one (docs/gpu.md). A process that takes most of the GPU's memory as it begins stays alone.
    """
    cores = len(usable_cores()[: core_quota()])
    if device == "gpu":
        if preallocates():
            return 1
        return max(1, min(seeds // SEEDS_PER_GPU_GROUP, cores // CORES_PER_GPU_GROUP, GROUPS_PER_GPU))
    return min(seeds, GROUPS_PER_CORE * cores)


def choose_evaluation_processes(groups: Sequence[Sequence[int]], episodes: int) -> int:
    """Return how many processes each group is to evaluate with while it trains on: none where no core is to spare.

    Several groups may share the cores that are to spare, since they evaluate for a small part of the time only.
    """
    spare = len(usable_cores()[: core_quota()]) - len(groups)
    batches = max(map(len, groups)) * -(-episodes // EPISODES_AT_ONCE)
    return min(batches, max(1, spare // len(groups))) if spare > 0 else 0


def run_groups(
    settings: Settings,
    groups: Sequence[Sequence[int]],
    should_stop: Callable[[], bool],
    checkpoints: Checkpoints | None = None,
    is_urgent: Callable[[], bool] = lambda: True,
) -> Generator[tuple[int, Message], None, None]:
    """Train every group and yield (group, what happened) as it comes. A single group is trained in this process.

    One that is left of several, since the others had failed, has its own as before: the last bits depend on its cores.

    All groups are saved at the same steps. Whoever takes the messages commits to `checkpoints`; here it is only read.
    `is_urgent` says whether a stop is a signal's, after which a process that dies is not replaced.
    """
    if len(groups) == 1 and len(settings.plan.groups) <= 1:
        yield from ((0, message) for message in _run_here(settings, groups[0], should_stop))
        return
    scheduler = _Scheduler(settings, groups, should_stop, checkpoints, is_urgent)
    try:
        yield from scheduler.run()
    finally:
        scheduler.kill()


class _Timer:
    """Says when a checkpoint is due by the clock."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._began = time.monotonic()

    def is_due(self) -> bool:
        return time.monotonic() - self._began >= SECONDS_BETWEEN_CHECKPOINTS


def _run_here(settings: Settings, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[GroupMessage]:
    timer, saved = _Timer(), settings.begin
    with closing(Group(settings, seeds)) as group:
        for message in group.run(should_stop):
            due = isinstance(message, Ended)
            if isinstance(message, Boundary):
                yield message
                due = is_regular(settings, message.step) or timer.is_due()
            if settings.saves and due and group.step > saved:
                yield from group.settle()
                if group.environments.alive.any():
                    saved = group.step
                    timer.reset()
                    yield group.save()
            if not isinstance(message, Boundary):
                yield message


def is_regular(settings: Settings, step: int) -> bool:
    """Whether there is a checkpoint at this step in any case."""
    plan = settings.plan
    return settings.saves and (step == plan.steps or step % plan.checkpoint_interval == 0)


class _Worker(Child):
    """The parent's end of one group's process, which is told an `Order`."""

    def __init__(self, settings: Settings, seeds: Sequence[int]) -> None:
        # Not a daemon, which could not have processes that evaluate.
        super().__init__(_work, settings, list(seeds), daemon=False)
        self.step = self.saved = settings.begin
        self.is_starting = True
        self.seeds, self.over = seeds, False
        self.cores: list[int] | None = None


class _Scheduler:
    """Hands sets of cores to the group that is furthest behind, a few hundred steps at a time.

    So five seeds on two cores all advance together and both cores are busy to the end, while nothing that a seed
    computes depends on when its turn comes. Between its turns a group can be saved: all of them are at the same steps,
    the regular ones and a `target` that the clock or a request to stop sets.
    """

    def __init__(
        self,
        settings: Settings,
        groups: Sequence[Sequence[int]],
        should_stop: Callable[[], bool],
        checkpoints: Checkpoints | None,
        is_urgent: Callable[[], bool],
    ) -> None:
        self.settings, self.should_stop, self.checkpoints = settings, should_stop, checkpoints
        self.is_urgent = is_urgent
        self.workers: list[_Worker] = []
        try:
            for seeds in groups:
                self.workers.append(_Worker(settings, seeds))
        except BaseException:
            self.kill()
            raise
        self.restarted: set[int] = set()
        cores = usable_cores()
        planned = max(settings.plan.groups, groups, key=len)  # also those of which nothing is left
        sets = min(len(planned), len(cores))
        self.free = [cores[i::sets] for i in range(sets)]
        # Sets differ in size where there are more cores than groups: each group has its own, since its last bits depend
        # on how many cores its process began with. Of several groups to a core, each takes the one that is free.
        owned = self.free if sets == len(planned) else []
        self.own = {seed: its for its, group in zip(owned, planned, strict=False) for seed in group}
        self.waiting = list(self.workers)
        self.stopping, self.target = False, -1
        self.timer = _Timer()

    def run(self) -> Generator[tuple[int, Message], None, None]:
        self._hand_out()
        while running := [worker for worker in self.workers if not worker.over]:
            if not self.stopping and self.should_stop():
                self.stopping = True
                late = self._set_target()
                if late and self.checkpoints:
                    yield 0, Noted(_not_waited_for(late, self._furthest(), self.checkpoints.newest))
            elif not self.stopping and self.settings.saves and self.timer.is_due() and not self._is_awaited():
                self._set_target()
            ready = wait([worker.connection for worker in running], timeout=0.1)
            for index, worker in enumerate(self.workers):
                if worker.connection in ready:
                    yield index, self._receive(index, worker)
            self._hand_out()

    def kill(self) -> None:
        """End every process: at once what still trains, and what is over once its environments are closed."""
        for worker in self.workers:
            if not worker.over:
                worker.kill()
        end([worker for worker in self.workers if worker.over], SECONDS_TO_CLOSE)

    def _receive(self, index: int, worker: _Worker) -> Message:
        message: Message | None = None
        with suppress(EOFError, OSError):  # the latter where it died in the middle of a message
            message = worker.connection.recv()
        if message is None:
            return self._died(index, worker)
        worker.is_starting = False
        if isinstance(message, Boundary):
            worker.step = message.step
            self._take_cores(worker)
            self._next(worker)
        elif isinstance(message, Saved):
            worker.saved = message.step
            self.timer.reset()
            self._next(worker)
        elif isinstance(message, Ended | GroupCrashed):
            worker.over = True
            if isinstance(message, Ended):
                worker.step = message.step
            self._take_cores(worker)
        return message

    def _died(self, index: int, worker: _Worker) -> Message:
        """Let another process go on from the newest checkpoint, once."""
        reason = worker.cause_of_death()
        self._take_cores(worker)
        self.waiting = [other for other in self.waiting if other is not worker]
        if self.settings.checkpoints:
            remove_unfinished(self.settings.checkpoints, worker.process.pid)
        if self.stopping and self.is_urgent() and self.checkpoints and index not in self.restarted:
            worker.over = True  # and no failure: the run goes on from the last step at which all were saved
            return Ended(worker.step, {})
        if index in self.restarted or not self.checkpoints:
            worker.over = True
            again = "for the second time, " if index in self.restarted else ""
            return GroupCrashed(again + reason, "")
        self.restarted.add(index)
        begin = self.checkpoints.newest or 0
        has_other_task = self.settings.has_other_task and begin == self.settings.begin
        again = self.settings._replace(begin=begin, has_other_task=has_other_task)
        self.workers[index] = _Worker(again, worker.seeds)
        self.waiting.append(self.workers[index])
        return GroupRestarted(reason, begin)

    def _next(self, worker: _Worker) -> None:
        """Say what a group does that has just ended its turn or was saved."""
        due = worker.step == self.target or is_regular(self.settings, worker.step)
        if self.settings.saves and due and worker.saved < worker.step:
            worker.tell("save")
        elif worker.step == self.settings.plan.steps or (self.stopping and worker.step >= self.target):
            worker.tell("stop")
        else:
            self.waiting.append(worker)

    def _set_target(self) -> list[_Worker]:
        """Choose the next step that every group passes as the one to be saved at, and to stop at if that is asked.

        Return those that would keep the others waiting for too long: where there are any, there is no such step.
        """
        self.timer.reset()
        living = [worker for worker in self.workers if not worker.over]
        late = [worker for worker in living if self._is_late(worker)] if self._is_in_haste() else []
        if late or not self.settings.saves:
            self.target = -1
        elif any(worker.step == self.settings.plan.steps for worker in self.workers):
            self.target = self.settings.plan.steps  # one has made all its steps, and the others are close behind
        else:
            # Also of those that are over: what is saved before the step at which a seed failed has to hold that seed.
            self.target = max(map(self._end_of_turn, self.workers))
        waiting, self.waiting = self.waiting, []
        for worker in waiting:
            self._next(worker)
        return late

    def _is_late(self, worker: _Worker) -> bool:
        """Whether a group is still starting or, where a signal asks for a stop, was begun again and is far behind."""
        return worker.is_starting or (self.stopping and self._furthest() - worker.step > LONGEST_LEAD + TURN_STEPS)

    def _furthest(self) -> int:
        return max(worker.step for worker in self.workers)

    def _is_in_haste(self) -> bool:
        """Whether nobody waits for one that is behind: not where a run ends that has enough, and is to end whole."""
        return not self.stopping or self.is_urgent()

    def _is_awaited(self) -> bool:
        """Whether a group has saved at the target and another has not: moved, that checkpoint would never be whole."""
        if not any(worker.saved >= self.target for worker in self.workers):
            return False
        return any(worker.saved < self.target for worker in self.workers if not worker.over)

    def _end_of_turn(self, worker: _Worker) -> int:
        if worker.cores is None and not worker.over:
            return worker.step
        return next(step for step in count(worker.step + 1) if self.settings.ends_turn(step))

    def _take_cores(self, worker: _Worker) -> None:
        if worker.cores is not None:
            self.free.append(worker.cores)
            worker.cores = None

    def _hand_out(self) -> None:
        """Give free cores to those who are furthest behind, and to nobody who is too far ahead of the last."""
        self.waiting.sort(key=lambda worker: worker.step, reverse=True)
        last = min((worker.step for worker in self.workers if not worker.over), default=0)
        while self.free and self.waiting and self.waiting[-1].step <= last + LONGEST_LEAD:
            worker = self.waiting.pop()
            worker.cores = self.own.get(worker.seeds[0], self.free[0])
            self.free.remove(worker.cores)
            worker.tell(worker.cores)


def _not_waited_for(late: Sequence[_Worker], furthest: int, newest: int | None) -> str:
    told = [
        f"seed{'s' * (len(worker.seeds) > 1)} {', '.join(map(str, worker.seeds))}, "
        + ("still starting" if worker.is_starting else f"{furthest - worker.step:,} steps behind")
        for worker in late
    ]
    where = f"step {newest:,}, its newest checkpoint" if newest else "the beginning"
    return f"the run stops without waiting for {'; '.join(told)}: it can go on from {where}"


def _work(connection: Connection, settings: Settings, seeds: list[int]) -> None:
    """Train one group in a process of its own, one turn at a time."""
    die_with_parent()
    outlive_termination()
    cores, turns = usable_cores(), _Turns(connection)
    try:
        turns.take(None)
        if turns.stopped:
            connection.send(Ended(settings.begin, {}))
            return
        with closing(Group(settings, seeds, cores)) as group:
            for message in group.run(lambda: turns.stopped):
                connection.send(message)
                if isinstance(message, Boundary):
                    turns.take(group)
    except (BrokenPipeError, EOFError, ConnectionResetError):
        return  # the parent is gone, and with it whoever would write this down
    except InputError as error:
        connection.send(Refused(error))
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        connection.send(GroupCrashed(reason, traceback.format_exc()))


class _Turns:
    """A worker's view of the scheduler."""

    def __init__(self, connection: Connection) -> None:
        self.connection, self.stopped = connection, False

    def take(self, group: Group | None) -> None:
        """Obey until it is this group's turn again, with every thread of this process on the cores given, or over."""
        while not self.stopped:
            order: Order = self.connection.recv()
            if order == "stop":
                self.stopped = True
            elif order == "save":
                assert group
                self._save(group)
            else:
                move_to([int(core) for core in order])
                return

    def _save(self, group: Group) -> None:
        """Say what the group's files are, or stop where an evaluation has left no seed to save."""
        for message in group.settle():
            self.connection.send(message)
        if not group.environments.alive.any():
            self.stopped = True
            return
        try:
            saved = group.save()
        except OSError as error:
            saved = NotSaved(error)
        self.connection.send(saved)
