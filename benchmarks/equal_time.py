"""What csac's candidate and its peers reach in equal time: stage 4 of results/strong/PROTOCOL.md, run by run.

    python -m benchmarks.equal_time speeds            # how fast each is; for 70 to 90 minutes nothing else may run
    python -m benchmarks.equal_time run --part 1/2    # what each peer learns in as many steps as T has room for
    python -m benchmarks.equal_time run --part 2/2    # the other half, at the same time or on another machine

What is learnt depends on steps and not on time, so only the speeds need a quiet machine: two cores, one run at a time.
The peers take half an hour of it (30 times 60 s), each of csac's two arms 20 to 30 minutes (16 runs). A speed that
other programs disturbed is refused, and so is another machine for those that are missing.
The runs that learn take one core each, on any machine. Each command goes on where it was stopped: a run whose file is
there is not made again. The tables are printed by results/strong/equal_time.py.
"""

from __future__ import annotations

import argparse
import itertools
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.contenders import PEERS_PYTHON
from benchmarks.measuring import ROOT, Process, lasting, machine, run, run_one, surroundings, watch_load
from benchmarks.tables import Row, read_rows, write_rows
from csac.processes import usable_cores
from csac.studies.command_words import options
from csac.studies.study import Study, read_study
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

STUDY = ROOT / "results" / "strong" / "confirm.toml"  # stage 1: csac's two arms, the tasks and the seeds
CANDIDATE = "CSAC, candidate"
OWN = (CANDIDATE, "SAC, candidate")  # csac's arms: T is the time of the first, the second is told as secondary
FOLDER = ROOT / "results" / "strong" / "equal-time"
PEERS = ("sb3-sac", "sbx-sac", "sbx-tqc", "sbx-crossq", "sbx-simba")  # peers/models.py has their settings
CONTENDERS = (*OWN, *PEERS)
# Of the peers; the versions of some are pinned nowhere, so that machine.txt has those of all.
PACKAGES = (
    "sbx-rl",
    "stable-baselines3",
    "torch",
    "jax",
    "flax",
    "optax",
    "tfp-nightly",
    "gymnasium",
    "mujoco",
    "numpy",
)
CORES = 2
STEPS = 100_000  # environment steps of the candidate, which take the time T
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)  # of T: when a peer is evaluated
REPETITIONS = 3
TIMED_STEPS = (14_000, 20_000)  # of csac's arms, beyond their warm-up of 10,000
TIMED_SECONDS = 60.0  # of a peer: its steps are counted after two thirds, and at the end
LEAST_UPDATES = 10  # of a peer before its first count: SBX's CrossQ compiles a program in each of its first three
QUIET = 0.2  # processors that other programs may keep busy: a speed beside more than that does not count


class Run(NamedTuple):
    """One peer on one task with one seed, and the file of its evaluations."""

    peer: str
    task: str
    seed: int
    path: Path


class Speed(NamedTuple):
    """Two moments of a run beyond its warm-up: seconds since the command was started, and steps by then."""

    seconds: tuple[float, float]
    steps: tuple[float, float]

    @property
    def rate(self) -> float:
        """Steps per second."""
        return (self.steps[1] - self.steps[0]) / (self.seconds[1] - self.seconds[0])

    def steps_at(self, seconds: float) -> float:
        """Return the steps that are over by then."""
        return self.steps[1] + self.rate * (seconds - self.seconds[1])

    def seconds_at(self, steps: float) -> float:
        """Return when so many steps are over."""
        return self.seconds[1] + (steps - self.steps[1]) / self.rate


Speeds = dict[tuple[str, str], list[Speed]]  # of a contender on a task, its repetitions


# How fast each is.


def training(study: Study, arm: str, task: str, steps: int) -> list[str]:
    """Return the arguments of `csac` for a run of one of its arms of so many steps.

    csac always evaluates its last policy. One episode is the least that it can be asked for, a second or less.
    """
    method = next(method for method in study.methods if method.label == arm)
    words = ["train", task, "--algorithm", method.algorithm, *options(method.hyperparameters_on(task))]
    plan = ["--steps", str(steps), "--first-seed", str(study.first_seed)]
    return [*words, *plan, "--evaluation-interval", str(steps), "--evaluation-episodes", "1"]


def time_training(words: Sequence[str]) -> float:
    """Return the seconds from the start of a `csac` command to its end. Raises InputError where it fails."""
    cores = ",".join(map(str, usable_cores()[:CORES]))
    command = ["taskset", "--cpu-list", cores, sys.executable, "-m", "csac", *words]
    with tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        ended = subprocess.run(command, cwd=folder, env=surroundings("cpu"), capture_output=True, text=True)
        seconds = time.monotonic() - began
    if ended.returncode:
        raise InputError(f"{shlex.join(['csac', *words])} failed:\n{ended.stderr[-3000:]}")
    return seconds


def measure(contender: str, study: Study, task: str) -> Speed:
    """Return how fast an arm of csac or a peer is now. Raises InputError where its command fails."""
    if contender in OWN:
        first, second = (time_training(training(study, contender, task, steps)) for steps in TIMED_STEPS)
        return Speed((first, second), TIMED_STEPS)
    what = ["--task", task, "--seed", str(study.first_seed), "--seconds", str(TIMED_SECONDS)]
    try:
        answer = run_one(_script(contender, *what, "--launched", repr(time.monotonic())), CORES)
    except RuntimeError as error:
        raise InputError(f"{contender} on {task}: {error}") from None
    (first, before, updates), (second, after, _) = answer["marks"]
    if updates < LEAST_UPDATES or before >= after:
        raise InputError(
            f"{contender} on {task} still warmed up after {first:.0f} s: this machine is too slow to time it"
        )
    return Speed((first, second), (before, after))


def measured(folder: Path, study: Study) -> Speeds:
    """Return the speeds of speeds.csv. Raises InputError where those of another arm of csac are there."""
    path = folder / "speeds.csv"
    found: Speeds = {}
    for row in read_rows(path) if path.exists() else []:
        if row["command"] != _command(study, row["contender"], row["task"]):
            raise InputError(f"{path} was measured with another {row['contender']} than {STUDY.name} has: remove it")
        speed = Speed((row["first_seconds"], row["last_seconds"]), (row["first_steps"], row["last_steps"]))
        found.setdefault((row["contender"], row["task"]), []).append(speed)
    return found


def unmeasured(folder: Path, study: Study) -> list[tuple[int, str, str]]:
    """Return the repetition, the task and the contender of what speeds.csv has not got, in turns."""
    found = measured(folder, study)
    turns = itertools.product(range(REPETITIONS), study.tasks, CONTENDERS)
    return [(turn, task, one) for turn, task, one in turns if len(found.get((one, task), [])) <= turn]


def note_machine(folder: Path) -> None:
    """Write machine.txt before the first speed. Raises InputError where there are speeds of another machine."""
    path, here = folder / "machine.txt", [*machine(1.0), peers_versions()]
    if not (folder / "speeds.csv").exists():
        path.write_text("".join(f"{line}\n" for line in here), encoding="utf-8")
        return
    there = lasting(path.read_text(encoding="utf-8").splitlines()) if path.exists() else []
    if other := next((line for line in lasting(here) if line not in there), ""):
        raise InputError(
            f"the speeds in {folder} are of another machine or other versions, as {path.name} has not got "
            f"{other!r}: go on there, or remove them"
        )


def measure_speeds(folder: Path, study: Study) -> None:
    """Measure what speeds.csv has not got, all in turns, and write plan.csv.

    The first runs of csac's arms on a task are not counted: they compile what the others find.

    Raises:
        InputError: other programs ran beside a measurement, which is not written then, or this is another machine.
    """
    _need_peers()
    folder.mkdir(parents=True, exist_ok=True)
    left, prepared = unmeasured(folder, study), set()
    if left:
        note_machine(folder)
    for repetition, task, contender in left:
        if contender in OWN and (contender, task) not in prepared:
            for steps in TIMED_STEPS:  # which have programs of their own: the replay has a row for each step
                time_training(training(study, contender, task, steps))
            prepared.add((contender, task))
        others = watch_load()
        speed, load = measure(contender, study, task), others()
        what = f"{contender} on {task}: {speed.rate:.1f} steps/s; other programs kept {load:.2f} cores busy"
        if load > QUIET:
            raise InputError(f"{what}, more than {QUIET}: it does not count, and the same command measures it again")
        print(what, flush=True)
        row = {"contender": contender, "task": task, "repetition": repetition}
        for name, seconds, steps in zip(("first", "last"), speed.seconds, speed.steps, strict=True):
            row |= {f"{name}_seconds": float(seconds), f"{name}_steps": steps}
        add_row(folder / "speeds.csv", {**row, "load": load, "command": _command(study, contender, task)})
    write_rows(folder / "plan.csv", plan(measured(folder, study), study.tasks))


def plan(speeds: Speeds, tasks: Iterable[str]) -> list[Row]:
    """Return T, and the steps of every contender at each share of it by which it has made any.

    Raises InputError for what was not measured often enough.
    """
    rows = []
    for task, contender in itertools.product(tasks, CONTENDERS):
        own = speeds.get((contender, task), [])
        if len(own) < REPETITIONS:
            raise InputError(
                f"{contender} on {task} was measured {len(own)} times, not {REPETITIONS}: go on with speeds"
            )
        limit = statistics.median(one.seconds_at(STEPS) for one in speeds[CANDIDATE, task])
        rate = statistics.median(one.rate for one in own)
        for share in SHARES:
            steps = round(statistics.median(one.steps_at(share * limit) for one in own))
            row = {"task": task, "contender": contender, "limit": limit, "rate": rate, "share": share, "steps": steps}
            rows += [row] if steps > 0 else []
    return rows


def read_plan(folder: Path, study: Study) -> tuple[dict[str, float], dict[tuple[str, str], list[int]]]:
    """Return T of each task, and the steps of each contender on it.

    Raises:
        InputError: there is no plan, or it is not what the speeds say.
    """
    path = folder / "plan.csv"
    if not path.exists():
        raise InputError(f"{path} does not exist: python -m benchmarks.equal_time speeds writes it")
    if [row["steps"] for row in read_rows(path)] != [
        row["steps"] for row in plan(measured(folder, study), study.tasks)
    ]:
        raise InputError(f"{path} is not what speeds.csv says: python -m benchmarks.equal_time speeds writes it again")
    limits: dict[str, float] = {}
    steps: dict[tuple[str, str], list[int]] = {}
    for row in read_rows(path):
        limits[row["task"]] = row["limit"]
        steps.setdefault((row["contender"], row["task"]), []).append(row["steps"])
    return limits, steps


def _command(study: Study, contender: str, task: str) -> str:
    """Return what an arm of csac is timed by; a peer's settings are in models.py."""
    return shlex.join(["csac", *training(study, contender, task, TIMED_STEPS[-1])]) if contender in OWN else ""


# What the peers learn.


def runs(folder: Path, study: Study) -> list[Run]:
    """Return every run in its order: seed by seed over all tasks and peers."""
    seeds = range(study.first_seed, study.first_seed + study.seeds)
    parts = itertools.product(seeds, study.tasks, PEERS)
    return [Run(peer, task, seed, folder / task / peer / f"seed-{seed}.csv") for seed, task, peer in parts]


def waiting(planned: Sequence[Run], steps: dict[tuple[str, str], list[int]]) -> list[Run]:
    """Return the runs that have no file yet. Raises InputError where a file is of other steps."""
    for one in planned:
        wanted = steps[one.peer, one.task]
        if one.path.exists() and sorted({row["step"] for row in read_rows(one.path)}) != wanted:
            raise InputError(
                f"{one.path} is not of {wanted[0]:,} to {wanted[-1]:,} steps, as plan.csv has it: remove it"
            )
    return [one for one in planned if not one.path.exists()]


def command(one: Run, steps: Sequence[int]) -> list[str]:
    """Return the command that trains a peer and evaluates it after each of these steps."""
    what = ["--task", one.task, "--seed", str(one.seed), "--out", str(one.path.resolve())]
    return _script(one.peer, *what, "--steps", *map(str, steps))


def run_peers(folder: Path, study: Study, part: tuple[int, int]) -> list[Run]:
    """Make the runs of a part that are missing, one at a time, and return those that failed: they leave no file."""
    _need_peers()
    limits, steps = read_plan(folder, study)
    which, parts = part
    planned = runs(folder, study)[which - 1 :: parts]
    left, failed = waiting(planned, steps), []
    hours = sum(limits[one.task] for one in left) / 3600
    print(
        f"{len(planned) - len(left)} of {len(planned)} runs are there; the others take {hours:.1f} hours or more",
        flush=True,
    )
    core = usable_cores()[(which - 1) % len(usable_cores())]
    for one in left:
        one.path.parent.mkdir(parents=True, exist_ok=True)
        name = f"{one.peer} on {one.task}, seed {one.seed}"
        try:
            (answer,) = run([Process(command(one, steps[one.peer, one.task]), [core])], surroundings("cpu"))
        except RuntimeError as error:
            failed.append(one)
            print(f"failed: {name}: {error}", file=sys.stderr, flush=True)
            continue
        failure = "; training failed with NaN, which counts as 0" if answer["failed"] else ""
        print(f"{name}: {answer['step']:,} steps, {answer['updates']:,} updates{failure}", flush=True)
    return failed


def _script(peer: str, *what: str) -> list[str]:
    return [PEERS_PYTHON, str(ROOT / "benchmarks" / "peers" / "equal_time.py"), "--peer", peer, *what]


def peers_versions() -> str:
    """Return the versions of the peers' Python and libraries. Raises InputError where one is not installed."""
    script = "import platform, sys; from importlib.metadata import version; "
    script += "print(platform.python_version(), *map(version, sys.argv[1:]))"
    ended = subprocess.run([PEERS_PYTHON, "-c", script, *PACKAGES], capture_output=True, text=True)
    if ended.returncode:
        reason = ended.stderr.strip().rpartition("\n")[2]
        raise InputError(f"{PEERS_PYTHON} lacks a library: run `make peers` ({reason})")
    python, *versions = ended.stdout.split()
    told = (f"{name} {version}" for name, version in zip(PACKAGES, versions, strict=True))
    return f"the peers: Python {python}, {', '.join(told)}"


def _need_peers() -> None:
    if not Path(PEERS_PYTHON).exists():
        raise InputError(f"{PEERS_PYTHON} does not exist: run `make peers` first")


def add_row(path: Path, row: Row) -> None:
    """Write a table again with one row more: a reader meets it whole."""
    aside = path.with_suffix(".partial")
    write_rows(aside, [*(read_rows(path) if path.exists() else []), row])
    aside.replace(path)


def read_part(text: str) -> tuple[int, int]:
    """Return (1, 2) of `1/2`. Raises ArgumentTypeError for anything else."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    which, parts = map(int, found.groups()) if found else (0, 0)
    if not 1 <= which <= parts:
        raise argparse.ArgumentTypeError(f"{text!r} is no part such as 1/2")
    return which, parts


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the command line and do what it says; return the exit code: 2, 3 if a run failed, 130 if stopped."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.equal_time",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("speeds", "run"))
    parser.add_argument("--part", type=read_part, default=(1, 1), help="of the runs, such as 1/2; each takes one core")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the files go (results/strong/equal-time)")
    given = parser.parse_args(arguments)
    try:
        if not sys.platform.startswith("linux"):
            raise InputError("this needs Linux: run it on such a machine")
        study = read_study(STUDY)
        if given.what == "speeds":
            if len(usable_cores()) < CORES:
                raise InputError(f"speeds are those of {CORES} processors: run it on such a machine")
            measure_speeds(given.folder, study)
            return 0
        return 3 if run_peers(given.folder, study, given.part) else 0
    except InputError as error:
        print(f"equal_time: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("equal_time: stopped; the same command goes on with the run that was not over", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
