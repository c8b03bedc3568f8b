"""What csac's candidate and its peers reach in equal time: stage 4 of results/strong/PROTOCOL.md, run by run.

    python -m benchmarks.equal_time seconds     # T of each task: three runs of the candidate
    python -m benchmarks.equal_time run         # every peer for T seconds: 50 runs of some 13 minutes

One run at a time, on two cores; other programs cost more than most differences. Either goes on where it was stopped: a
run whose file is there is not made again. These runs are no suite: a suite keeps nothing until all of it is measured.
The tables are printed by results/strong/equal_time.py.
"""

from __future__ import annotations

import argparse
import itertools
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.contenders import PEERS_PYTHON
from benchmarks.measuring import ROOT, machine, run_one, surroundings, watch_load
from benchmarks.tables import Row, read_rows, write_rows
from csac.processes import usable_cores
from csac.studies.study import Study, read_study
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

STUDY = ROOT / "results" / "strong" / "confirm.toml"  # stage 1: the candidate, the tasks and the seeds
CANDIDATE = "CSAC, candidate"
FOLDER = ROOT / "results" / "strong" / "equal-time"
PEERS = ("sb3-sac", "sbx-sac", "sbx-tqc", "sbx-crossq", "sbx-simba")  # peers/models.py has their settings
CORES = 2
STEPS = 100_000  # environment steps of the candidate, which take the time T
REPETITIONS = 3
QUIET = 0.2  # processors that other programs may keep busy without a warning


class Run(NamedTuple):
    """One peer on one task with one seed, and the file of its evaluations."""

    peer: str
    task: str
    seed: int
    path: Path


# The time T.


def training(study: Study, task: str, repetition: int) -> list[str]:
    """Return the arguments of `csac` for a run of the candidate that takes the time T.

    csac always evaluates its last policy. One episode is the least that it can be asked for: a second or less, which
    makes T longer, and so is to the peers' good.
    """
    method = next(method for method in study.methods if method.label == CANDIDATE)
    words = ["train", task, "--algorithm", method.algorithm]
    for name, value in method.hyperparameters_on(task).items():
        words += _flag(name.replace("_", "-"), value)
    steps = ["--steps", str(STEPS), "--first-seed", str(study.first_seed + repetition)]
    return [*words, *steps, "--evaluation-interval", str(STEPS), "--evaluation-episodes", "1"]


def _flag(name: str, value: Any) -> list[str]:
    if value is None:
        return []
    if isinstance(value, bool):
        return [f"--{'' if value else 'no-'}{name}"]
    return [f"--{name}", *map(str, value if isinstance(value, (list, tuple)) else [value])]


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


def timed(folder: Path, study: Study) -> list[Row]:
    """Return the rows of seconds.csv. Raises InputError where another candidate was timed."""
    path = folder / "seconds.csv"
    rows = read_rows(path) if path.exists() else []
    for row in rows:
        if row["command"] != shlex.join(["csac", *training(study, row["task"], row["repetition"])]):
            raise InputError(f"{path} was measured with another candidate than {STUDY.name} has: remove it")
    return rows


def time_candidate(folder: Path, study: Study) -> None:
    """Make the runs of the candidate that seconds.csv has not got, the tasks in turns."""
    done = {(row["task"], row["repetition"]) for row in timed(folder, study)}
    for repetition, task in itertools.product(range(REPETITIONS), study.tasks):
        if (task, repetition) in done:
            continue
        words, others = training(study, task, repetition), watch_load()
        seconds, load = time_training(words), others()
        told(f"{task}, repetition {repetition}: {seconds:.1f} s", load)
        folder.mkdir(parents=True, exist_ok=True)
        row = {"task": task, "repetition": repetition, "seconds": seconds, "load": load}
        add_row(folder / "seconds.csv", {**row, "command": shlex.join(["csac", *words])})
        if not (folder / "machine.txt").exists():
            (folder / "machine.txt").write_text("".join(f"{line}\n" for line in machine(1.0)))


def limits(rows: Sequence[Row], tasks: Sequence[str]) -> dict[str, float]:
    """Return T of each task, to a tenth of a second. Raises InputError where it was not timed often enough."""
    found = {task: [row["seconds"] for row in rows if row["task"] == task] for task in tasks}
    for task, seconds in found.items():
        if len(seconds) < REPETITIONS:
            raise InputError(
                f"{task} was timed {len(seconds)} times, not {REPETITIONS}: python -m benchmarks.equal_time seconds"
            )
    return {task: round(statistics.median(seconds), 1) for task, seconds in found.items()}


# The peers.


def runs(folder: Path, study: Study) -> list[Run]:
    """Return every run in its order: seed by seed over all tasks and peers."""
    seeds = range(study.first_seed, study.first_seed + study.seeds)
    parts = itertools.product(seeds, study.tasks, PEERS)
    return [Run(peer, task, seed, folder / task / peer / f"seed-{seed}.csv") for seed, task, peer in parts]


def waiting(planned: Sequence[Run], seconds: dict[str, float]) -> list[Run]:
    """Return the runs that have no file yet. Raises InputError where a file is of another T."""
    for run in planned:
        if run.path.exists() and (limit := read_rows(run.path)[0]["limit"]) != seconds[run.task]:
            raise InputError(f"{run.path} is of {limit} seconds, not of {seconds[run.task]}: remove it")
    return [run for run in planned if not run.path.exists()]


def command(run: Run, seconds: float) -> list[str]:
    """Return the command of a peer that is started at once: its clock runs from now on."""
    script, out = str(ROOT / "benchmarks" / "peers" / "equal_time.py"), str(run.path.resolve())
    what = ["--peer", run.peer, "--task", run.task, "--seed", str(run.seed), "--seconds", str(seconds), "--out", out]
    return [PEERS_PYTHON, script, *what, "--launched", repr(time.monotonic())]


def run_peers(folder: Path, study: Study, seconds: dict[str, float]) -> list[Run]:
    """Make the runs that are missing, one at a time, and return those that failed: they leave no file."""
    if not Path(PEERS_PYTHON).exists():
        raise InputError(f"{PEERS_PYTHON} does not exist: run `make peers` first")
    planned = runs(folder, study)
    left, failed = waiting(planned, seconds), []
    hours = sum(seconds[run.task] for run in left) / 3600
    print(f"{len(planned) - len(left)} of {len(planned)} runs are there; the others take {hours:.1f} hours", flush=True)
    for run in left:
        run.path.parent.mkdir(parents=True, exist_ok=True)
        others = watch_load()
        try:
            answer = run_one(command(run, seconds[run.task]), CORES)
        except RuntimeError as error:
            failed.append(run)
            print(f"failed: {run.peer} on {run.task}, seed {run.seed}: {error}", file=sys.stderr, flush=True)
            continue
        reached = f"{answer['step']:,} steps, {answer['updates']:,} updates in {answer['seconds']:.1f} s"
        load = others()
        told(f"{run.peer} on {run.task}, seed {run.seed}: {reached}", load)
        add_row(folder / "load.csv", {"peer": run.peer, "task": run.task, "seed": run.seed, "load": load})
    return failed


def add_row(path: Path, row: Row) -> None:
    """Write a table again with one row more: a reader meets it whole."""
    aside = path.with_suffix(".partial")
    write_rows(aside, [*(read_rows(path) if path.exists() else []), row])
    aside.replace(path)


def told(what: str, load: float) -> None:
    """Say what came out, and how busy other programs kept the machine meanwhile."""
    warning = ": TOO MUCH, nothing else may run" if load > QUIET else ""
    print(f"{what}; other programs kept {load:.2f} cores busy{warning}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the command line and do what it says; return the exit code: 2, 3 if a run failed, 130 if stopped."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.equal_time",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("seconds", "run"))
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the files go (results/strong/equal-time)")
    given = parser.parse_args(arguments)
    try:
        if not sys.platform.startswith("linux") or len(usable_cores()) < CORES:
            raise InputError("this needs Linux and two processors: run it on such a machine")
        study = read_study(STUDY)
        if given.what == "seconds":
            time_candidate(given.folder, study)
            return 0
        seconds = limits(timed(given.folder, study), study.tasks)
        return 3 if run_peers(given.folder, study, seconds) else 0
    except InputError as error:
        print(f"equal_time: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("equal_time: stopped; the same command goes on with the run that was not over", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
