"""Kill real runs at random moments, let them go on, and compare what they leave with an uninterrupted run.

    python tests/support/chaos.py --kills 100 --seed 0 --out results/reliability

A run is two seeds in two processes beside their parent: 2,000 steps of Hopper with tiny networks, a checkpoint every
300. Each is killed several times. One in three has friction that changes and noise that begins on its way, and one in
three is forked with them from a run that had none. What is killed and when comes from a seeded generator; what the
processes are doing at that moment does not, since it depends on the machine.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
import psutil
from logs import without_times

from csac.training.checkpoint import FOLDER, Checkpoint, newest_sound, steps_in

STEPS = 2_000
TRAIN = [
    *("train", "Hopper-v4", "--directory", "run", "--resume", "--steps", str(STEPS), "--batch-size", "8"),
    *("--actor-hidden-sizes", "8", "8", "--critic-hidden-sizes", "8", "8", "--warmup-steps", "100"),
    *("--replay-size", "700", "--evaluation-interval", "500", "--evaluation-episodes", "1"),
    *("--checkpoint-interval", "300"),
]
TWO_PROCESSES = ["--seeds", "2", "--groups", "2"]
FORKED_AT = 600
PERTURBED = [
    *("--perturb", "friction=1.5@700", "--perturb", "action_noise=0.05@900"),
    *("--perturb", "observation_noise=0.01@1100"),
]
Case = Literal["plain", "perturbed", "forked"]
CASES: dict[Case, list[str]] = {
    "plain": [],
    "perturbed": PERTURBED,
    "forked": [*PERTURBED, "--from", f"../source/run@{FORKED_AT}"],
}
TABLES = ("episodes.csv", "evaluations.csv", "metrics.csv")
KILLS_PER_RUN = 5
MOST_MISSED = 8  # runs in a row that end before the moment of a kill has come
PATIENCE = 1200.0  # seconds for a process to come to its end
RESTARTED = "started again from step"
MARKERS = ("<!-- chaos -->", "<!-- /chaos -->")

Kind = Literal["parent", "worker", "write", "worker-write", "terminate", "interrupt"]
SAID_OF_CASES: dict[Case, str] = {
    "perturbed": "of these on a perturbed task",
    "forked": "of these forked onto one",
}
KINDS: dict[Kind, str] = {
    "parent": "SIGKILL to the parent",
    "worker": "SIGKILL to a worker",
    "write": "SIGKILL to the parent while a checkpoint is written",
    "worker-write": "SIGKILL to a worker while a checkpoint is written",
    "terminate": "SIGTERM to the parent",
    "interrupt": "SIGINT to every process (Ctrl-C)",
}


class Kill(NamedTuple):
    """One kill that was carried out. `exact` is about the run it belongs to, once that is over."""

    run: int
    case: Case
    kind: Kind
    reached: int  # the last step that the run's tables told of
    exit_code: int | None  # None where a worker died and its parent did not
    resumed_from: int
    by: str
    damaged: int  # checkpoints that were damaged
    lost_rows: int  # rows up to the checkpoint that were missing
    orphans: int  # processes that outlived their parent
    exact: bool = False

    @property
    def steps_lost(self) -> int:
        return max(0, self.reached - self.resumed_from)


class Plan(NamedTuple):
    """What to kill, when (a share of the steps that are left, and seconds later) and how to go on."""

    kind: Kind
    share: float
    delay: float
    worker: int
    by: str


# Processes.


def surroundings(cache: Path) -> dict[str, str]:
    """Return the environment variables of a run whose programs are compiled once for all."""
    return {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "PYTHONUNBUFFERED": "1",
    }


def start(folder: Path, arguments: Sequence[str], cache: Path, output: int | IO[str]) -> subprocess.Popen[str]:
    """Start csac in a folder, in a process group of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-m", "csac", *arguments],
        cwd=folder,
        env=surroundings(cache),
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def workers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """Return the processes that train a group each, in the order of their start."""
    found = []
    with suppress(psutil.NoSuchProcess):
        for child in psutil.Process(process.pid).children():
            with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                if any("spawn_main" in part for part in child.cmdline()):
                    found.append(child)
    return sorted(found, key=lambda child: (child.create_time(), child.pid))


def strike(kind: Kind, process: subprocess.Popen[str], victim: psutil.Process | None) -> None:
    """Send the signal."""
    if kind == "interrupt":
        os.killpg(process.pid, signal.SIGINT)
    elif kind == "terminate":
        process.terminate()
    elif victim is None:
        process.kill()
    else:
        with suppress(psutil.NoSuchProcess):
            victim.kill()


# What is on disk.


def reached(run: Path) -> int:
    """Return the last step that the tables tell of."""
    last = 0
    for name in TABLES:
        with suppress(OSError, ValueError, IndexError), open(run / name, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 500))
            last = max(last, int(file.read().decode().split("\n")[-2].split(",")[1]))
    return last


def is_writing(run: Path) -> bool:
    """Whether a checkpoint is being written: a file that has not got its name yet, or one that none counts on yet."""
    folder = run / FOLDER
    newest = max(steps_in(folder), default=0)
    with suppress(OSError):
        names = [*os.listdir(folder), *os.listdir(folder / "replay")]
        steps = [int(name.split(".")[0][5:]) for name in names if name.startswith("step_") and ".seed_" in name]
        return any(name.startswith(".") for name in names) or max(steps, default=0) > newest
    return False


def lost_rows(run: Path, whole: Path) -> int:
    """Return how many rows are missing of those that the newest checkpoint counts on."""
    step = max(steps_in(run / FOLDER), default=0)
    missing = 0
    for name in TABLES:
        ours = set((run / name).read_text().splitlines()) if (run / name).exists() else set()
        theirs = [line for line in (whole / name).read_text().splitlines()[1:] if int(line.split(",")[1]) <= step]
        missing += sum(line not in ours for line in theirs)
    return missing


def differences(run: Path, whole: Path) -> list[str]:
    """Return what two finished runs differ in, of all that exact resume promises."""
    ours, theirs = _files(run), _files(whole)
    lines = [f"only one has {name}" for name in sorted(ours.keys() ^ theirs.keys())]
    lines += [f"{name} differs" for name in sorted(ours.keys() & theirs.keys()) if ours[name] != theirs[name]]
    return lines + _checkpoint_differences(run / FOLDER, whole / FOLDER)


def _files(run: Path) -> dict[str, bytes]:
    """Return what each file says that two runs must have alike."""
    contents = {}
    for path in sorted(path for path in run.rglob("*") if path.is_file()):
        name = path.relative_to(run).as_posix()
        if name == "manifest.json":
            fields = json.loads(path.read_bytes())
            for field in ("history", "process", "created", "commit"):  # the code may be committed meanwhile
                fields.pop(field)
            contents[name] = json.dumps(fields).encode()
        elif name == "log.txt":
            lines = without_times(path.read_bytes()).splitlines()
            contents[name] = b"\n".join(line for line in lines if RESTARTED.encode() not in line)
        elif not name.startswith(("tensorboard/", f"{FOLDER}/")) and name != ".lock":
            contents[name] = path.read_bytes()
    return contents


def _checkpoint_differences(ours: Path, theirs: Path) -> list[str]:
    one, other = newest_sound(ours)[0], newest_sound(theirs)[0]
    if one is None or other is None or one.step != other.step:
        return ["the last checkpoint is of another step"]
    lines = [f"{name}: unfinished file" for name in os.listdir(ours) if name.startswith(".")]
    first, second = _checkpoint_contents(one), _checkpoint_contents(other)
    return lines + [f"the last checkpoint's {name} differs" for name in first if first[name] != second.get(name)]


def _checkpoint_contents(checkpoint: Checkpoint) -> dict[str, Any]:
    contents: dict[str, Any] = {"values": {**checkpoint.values, "log_bytes": None}}
    for seed in [seed for group in checkpoint.values["groups"] for seed in group]:
        saved = checkpoint.seed(seed)
        rows = np.zeros((700, saved.arrays["learner.waiting"].shape[-1]), np.float32)
        checkpoint.memory(seed, rows)
        contents[f"seed {seed}"] = saved.values
        contents[f"transitions of seed {seed}"] = rows.tobytes()
        contents |= {f"seed {seed}: {name}": (str(a.dtype), a.shape, a.tobytes()) for name, a in saved.arrays.items()}
    for name in checkpoint.files:
        if name.endswith((".best.safetensors", ".csv")):
            contents[name] = (checkpoint.folder / name).read_bytes()
    return contents


# Chaos.


class Chaos:
    """One run after another, killed as planned, each compared with `whole` once it is over.

    Args:
        folder: where the runs go.
        wholes: an uninterrupted run of each case.
        cache: the folder of compiled programs.
    """

    def __init__(self, folder: Path, wholes: Mapping[Case, Path], cache: Path) -> None:
        self.folder, self.wholes, self.cache = folder, wholes, cache
        self.kills: list[Kill] = []
        self.complaints: list[str] = []

    def carry_out(self, plans: Sequence[Plan], number: int) -> None:
        """Kill runs until every plan was carried out once, and let the last one finish."""
        waiting, missed = list(plans), 0
        for attempt in count():
            made = self._one_run(self.folder / f"{number}-{attempt}", waiting, number)
            waiting, missed = waiting[made:], 0 if made else missed + 1
            if not waiting:
                return
            if missed == MOST_MISSED:
                self.complaints.append(f"run {number}: the moment of {waiting[0]} never came")
                return
            if missed:  # writing takes milliseconds, and near the end there are few checkpoints to wait for
                waiting[0] = waiting[0]._replace(share=waiting[0].share / 2)

    def _one_run(self, folder: Path, plans: Sequence[Plan], number: int) -> int:
        """Kill one run as planned until it finishes, and return how many plans it took."""
        kills: list[Kill] = []
        case = case_of(number)
        arguments = command = [*TRAIN, *TWO_PROCESSES, *CASES[case]]
        while True:
            with open(folder.with_suffix(".txt"), "a+") as output:
                at = output.seek(0, os.SEEK_END)
                process = start(folder, arguments, self.cache, output)
                life = self._one_life(process, folder / "run", plans[len(kills) :], number)
                output.seek(at)
                kills += _with_restarts(life, output.read())
            if process.returncode == 0 or not life or life[-1].exit_code is None:
                break
            arguments = ["resume", "run"] if kills[-1].by == "resume" else command
        found = [f"ended with {process.returncode} by itself"]
        if process.returncode == 0:
            found = differences(folder / "run", self.wholes[case])
        self.complaints += [f"run {folder.name}: {line}" for line in found]
        self.kills += [kill._replace(exact=not found) for kill in kills]
        print(f"run {folder.name}, {case}: {len(kills)} kills, {'; '.join(found) or 'the same files'}", flush=True)
        return len(kills)

    def _one_life(self, process: subprocess.Popen[str], run: Path, plans: Sequence[Plan], number: int) -> list[Kill]:
        """Carry out plans until the process is over."""
        struck: list[Kill] = []
        victims: list[psutil.Process] | None = None  # a group that dies twice is given up: each is killed once
        begin = max(steps_in(run / FOLDER), default=0)
        for plan in plans:
            if not _wait_for_moment(plan, process, run, begin + plan.share * (STEPS - begin)):
                break
            if "write" not in plan.kind:
                time.sleep(plan.delay)
            children = workers_of(process)
            victims = children.copy() if victims is None and children else victims
            victim = None
            if "worker" in plan.kind:
                if not victims:
                    break
                victim = victims.pop(plan.worker % len(victims))
            if process.poll() is not None or (victim and not victim.is_running()):
                break
            strike(plan.kind, process, victim)
            if victim is None:
                struck.append(self._after_death(plan, process, run, number, children))
                return struck
            begin = reached(run)
            struck.append(Kill(number, case_of(number), plan.kind, begin, None, begin, "itself", 0, 0, 0))
        process.wait(PATIENCE)
        return struck

    def _after_death(
        self, plan: Plan, process: subprocess.Popen[str], run: Path, number: int, children: list[psutil.Process]
    ) -> Kill:
        process.wait(PATIENCE)
        orphans = len(psutil.wait_procs(children, timeout=20)[1])
        checkpoint, complaints = newest_sound(run / FOLDER)
        step = checkpoint.step if checkpoint else 0
        case, last = case_of(number), reached(run)
        lost = lost_rows(run, self.wholes[case])
        if case == "forked" and not step:
            shutil.rmtree(run, ignore_errors=True)  # as csac asks for, where a fork dies before it has its checkpoint
        by = plan.by if (run / "manifest.json").exists() else "train"  # it may have died before there was a run
        return Kill(number, case, plan.kind, last, process.returncode, step, by, len(complaints), lost, orphans)


def _wait_for_moment(plan: Plan, process: subprocess.Popen[str], run: Path, target: float) -> bool:
    """Wait for the moment of a plan; return false where the process ends before."""
    until = time.monotonic() + PATIENCE
    has_victim = "worker" not in plan.kind
    while process.poll() is None and time.monotonic() < until:
        has_victim = has_victim or bool(workers_of(process))  # once: it takes longer than a write
        is_time = has_victim and reached(run) >= target
        if is_time and ("write" not in plan.kind or is_writing(run)):
            return True
        time.sleep(0.0005 if is_time else 0.02)
    return False


def _with_restarts(life: Sequence[Kill], output: str) -> list[Kill]:
    """Fill in where workers began anew, as the output tells in order."""
    steps = [int(line.split(RESTARTED)[1].replace(",", "")) for line in output.splitlines() if RESTARTED in line]
    return [kill._replace(resumed_from=steps.pop(0)) if kill.exit_code is None and steps else kill for kill in life]


def case_of(number: int) -> Case:
    """Return the case of a run: they take turns."""
    return list(CASES)[number % len(CASES)]


def make_plans(kills: int, seed: int) -> list[Plan]:
    """Return kills of every kind in equal parts, in random order, at random moments."""
    generator = np.random.default_rng(seed)
    kinds = generator.permutation([list(KINDS)[i % len(KINDS)] for i in range(kills)])
    plans = []
    for kind in kinds.tolist():
        share, delay = generator.uniform(0, 0.8), generator.uniform(0, 0.3)
        if generator.random() < 0.15 and kind in ("parent", "terminate", "interrupt"):
            share, delay = 0.0, generator.uniform(0, 12)  # while it starts
        by = "resume" if generator.random() < 0.7 else "train"
        plans.append(Plan(kind, float(share), float(delay), int(generator.integers(2)), by))
    return plans


def second_kill(folder: Path, cache: Path) -> list[str]:
    """Kill the same group twice; return what is not as promised: it is named, the other finishes, exit code 3."""
    with open(folder.with_suffix(".txt"), "a+") as output:
        process = start(folder, [*TRAIN, *TWO_PROCESSES], cache, output)
        for target in (400, 700):
            plan = Plan("worker", 0.0, 0.0, 0, "")
            if not _wait_for_moment(plan, process, folder / "run", target):
                return ["it ended too early"]
            workers = workers_of(process)
            strike("worker", process, workers[0] if target == 400 else workers[-1])
        process.wait(PATIENCE)
    manifest = json.loads((folder / "run" / "manifest.json").read_text())
    failure = manifest["failures"].get("0", "")
    wrong = [] if process.returncode == 3 else [f"exit code {process.returncode} instead of 3"]
    if list(manifest["failures"]) != ["0"] or "for the second time, its process was killed by SIGKILL" not in failure:
        wrong.append(f"failures are {manifest['failures']}")
    return wrong


# Results.


def summary(kills: Sequence[Kill]) -> str:
    """Return the table: one row per kind of kill, and one for all."""
    lines = [
        "| kill | number | same files in the end | checkpoints damaged | rows lost | processes left over | "
        "steps to repeat, mean (most) |",
        "|---|---|---|---|---|---|---|",
    ]
    kinds: list[tuple[str, list[Kill]]] = [(text, [k for k in kills if k.kind == kind]) for kind, text in KINDS.items()]
    parts = [(text, [kill for kill in kills if kill.case == case]) for case, text in SAID_OF_CASES.items()]
    for text, part in [*kinds, ("all", list(kills)), *parts]:
        if part:
            lost = [kill.steps_lost for kill in part]
            cells = [text, len(part), sum(k.exact for k in part), sum(k.damaged for k in part)]
            cells += [sum(k.lost_rows for k in part), sum(k.orphans for k in part)]
            lines.append("| " + " | ".join(map(str, [*cells, f"{np.mean(lost):.0f} ({max(lost)})"])) + " |")
    return "\n".join(lines)


def write_results(kills: Sequence[Kill], out: Path) -> None:
    """Write one row per kill, and the table between the markers of the README."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "chaos.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["number", *Kill._fields, "steps_lost"])
        for number, kill in enumerate(kills, start=1):
            cells = ["" if cell is None else int(cell) if isinstance(cell, bool) else cell for cell in kill]
            writer.writerow([number, *cells, kill.steps_lost])
    readme = out / "README.md"
    if readme.exists() and MARKERS[0] in (text := readme.read_text()):
        before, after = text.split(MARKERS[0])[0], text.split(MARKERS[1])[1]
        readme.write_text(f"{before}{MARKERS[0]}\n{summary(kills)}\n{MARKERS[1]}{after}")


def make_wholes(folder: Path, cache: Path) -> dict[Case, Path]:
    """Make the run that is forked, and an uninterrupted run of each case."""
    commands = {case: [*TRAIN, *TWO_PROCESSES, *arguments] for case, arguments in CASES.items()}
    with open(os.devnull, "w") as nowhere:
        for name, command in {"source": [*commands["plain"], "--keep-checkpoints", "0"], **commands}.items():
            start(folder / name, command, cache, nowhere).wait(PATIENCE)
    return {case: folder / case / "run" for case in CASES}


def main() -> int:
    """Return 0 where every run ended with the files of the uninterrupted one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--out", type=Path, help="where chaos.csv goes and the table of README.md; neither without")
    parser.add_argument("--folder", type=Path, help="keep the runs here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)).absolute()
        cache = folder / "programs"
        chaos = Chaos(folder, make_wholes(folder, cache), cache)
        plans = make_plans(options.kills, options.seed)
        parts = [plans[i : i + KILLS_PER_RUN] for i in range(0, len(plans), KILLS_PER_RUN)]
        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(chaos.carry_out, parts, range(len(parts))))
        twice = second_kill(folder / "twice", cache)
    kills = sorted(chaos.kills, key=lambda kill: kill.run)
    print(summary(kills))
    print("a group killed twice: " + ("; ".join(twice) or "named, and the other finished"))
    for complaint in chaos.complaints:
        print(complaint)
    if options.out:
        write_results(kills, options.out)
    return int(bool(chaos.complaints or twice))


if __name__ == "__main__":
    sys.exit(main())
