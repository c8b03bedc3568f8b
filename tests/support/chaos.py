"""Kill real runs at random moments, let them go on, and compare what they leave with uninterrupted ones.

    python tests/support/chaos.py --kills 100 --seed 0 --out results/reliability

A run is a set of two seeds in two processes beside their parent: 2,000 steps of Hopper with tiny networks, a checkpoint
every 300. One in three has friction that changes and noise that begins on its way, and one in three is forked with them
from a run that had none. What is killed and when comes from a seeded generator.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import IO, Literal, NamedTuple

import numpy as np
import psutil

from csac.training.checkpoint import newest_sound

STEPS, FORKED_AT, KILLS_PER_RUN = 2_000, 600, 5
TRAIN = [
    *("train", "Hopper-v4", "--algorithm", "csac", "--seeds", "2", "--directory", "run", "--resume"),
    *("--steps", str(STEPS), "--batch-size", "8", "--actor-hidden-sizes", "8", "8"),
    *("--critic-hidden-sizes", "8", "8", "--warmup-steps", "100", "--replay-size", "700"),
    *("--evaluation-interval", "500", "--evaluation-episodes", "1", "--checkpoint-interval", "300"),
    *("--updates-per-step", "10"),
]
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
PATIENCE = 1200.0  # seconds for a process to come to its end
MARKERS = ("<!-- chaos -->", "<!-- /chaos -->")

Kind = Literal["parent", "worker", "write", "terminate", "interrupt"]
KINDS: dict[Kind, str] = {
    "parent": "SIGKILL to the parent",
    "worker": "SIGKILL to a worker",
    "write": "SIGKILL to the parent while a checkpoint is written",
    "terminate": "SIGTERM to the parent",
    "interrupt": "SIGINT to every process (Ctrl-C)",
}


class Kill(NamedTuple):
    """One kill that was carried out; `exact` is about the run that it belongs to, once that is over."""

    run: int
    case: Case
    kind: Kind
    reached: int  # the last step that the tables told of
    exit_code: int | None  # None where a worker died and its parent did not
    orphans: int  # processes that outlived their parent
    exact: bool = False


def start(folder: Path, arguments: Sequence[str], cache: Path, output: int | IO[str]) -> subprocess.Popen[str]:
    """Start csac in a folder, in a process group of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    surroundings = {
        **{name: value for name, value in os.environ.items() if name != "XLA_FLAGS"},
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "PYTHONUNBUFFERED": "1",
    }
    return subprocess.Popen(
        [sys.executable, "-m", "csac", *arguments],
        cwd=folder,
        env=surroundings,
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def workers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """Return the processes that train, in the order of their start."""
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
    elif kind == "worker" and victim:
        with suppress(psutil.NoSuchProcess):
            victim.kill()
    else:
        process.kill()


def reached(run: Path) -> int:
    """Return the last step that the tables of a run tell of."""
    last = 0
    for name in TABLES:
        with suppress(OSError, ValueError, IndexError):
            last = max(last, int((run / name).read_text().split("\n")[-2].split(",")[1]))
    return last


def differences(ours: Path, theirs: Path) -> list[str]:
    """Return what two finished sets differ in, of all that exact resume promises."""
    lines = []
    for whole in sorted(theirs.glob("seed-*")):
        run = ours / whole.name
        names = [*TABLES, "policy/last.safetensors", "policy/best.safetensors"]
        lines += [f"{run / name}" for name in names if (run / name).read_bytes() != (whole / name).read_bytes()]
        one, other = (newest_sound(folder / "checkpoint")[0] for folder in (run, whole))
        if one is None or other is None or one.step != other.step:
            lines.append(f"{run}: the last checkpoint is of another step")
            continue
        saved, expected = one.state(), other.state()
        lines += [
            f"{run}: {name}"
            for name in expected.arrays
            if not np.array_equal(saved.arrays[name], expected.arrays[name])
        ]
        rows = [np.zeros((700, saved.arrays["learner.waiting"].shape[-1]), np.float32) for _ in range(2)]
        if one.fill(rows[0]) + other.fill(rows[1]) or not np.array_equal(rows[0], rows[1]):
            lines.append(f"{run}: transitions")
        lines += [f"{path}: unfinished" for path in run.rglob(".*.*")]
    return lines


def one_run(
    folder: Path, case: Case, whole: Path, cache: Path, number: int, generator: np.random.Generator
) -> list[Kill]:
    """Kill one set several times until it finishes, and return the kills."""
    kills: list[Kill] = []
    kinds = generator.permutation(list(KINDS)).tolist()
    shares = np.sort(generator.uniform(0.02, 0.95, len(kinds)))
    train = [*TRAIN, *CASES[case]]
    command = train
    while True:
        process = start(folder, command, cache, subprocess.DEVNULL)
        while kinds and process.poll() is None:
            target = shares[len(kills)] * STEPS
            while process.poll() is None and (
                max(map(reached, folder.glob("run/seed-*")), default=0) < target
                or not workers_of(process)  # SIGINT while Python itself starts gives exit code 1
            ):
                time.sleep(0.02)
            if process.poll() is not None:
                break
            kind = kinds.pop()
            time.sleep(float(generator.uniform(0, 0.3)))
            while kind == "write" and process.poll() is None and not any(folder.glob("run/seed-*/checkpoint/.*")):
                time.sleep(0.0005)
            workers = workers_of(process)
            victim = workers[int(generator.integers(len(workers)))] if workers else None
            step = max(map(reached, folder.glob("run/seed-*")), default=0)
            strike(kind, process, victim)
            if kind == "worker":
                kills.append(Kill(number, case, kind, step, None, 0))
                continue
            code = process.wait(PATIENCE)
            left = psutil.wait_procs(workers, timeout=10)[1]
            kills.append(Kill(number, case, kind, step, code, len(left)))
        process.wait(PATIENCE)
        if process.returncode == 0:
            exact = not differences(folder / "run", whole)
            return [kill._replace(exact=exact) for kill in kills]
        if process.returncode not in (-9, -2, -15, 130, 143):  # -2 and -15: csac has returned
            return kills  # none of which is exact
        command = train if generator.random() < 0.5 else ["resume", "run"]


def summary(kills: Sequence[Kill]) -> str:
    """Return the table: one row per kind of kill, and one for all."""
    lines = ["| kill | number | same files in the end | processes left over |", "|---|---|---|---|"]
    kinds: list[tuple[str, list[Kill]]] = [(text, [k for k in kills if k.kind == kind]) for kind, text in KINDS.items()]
    cases: list[tuple[str, list[Kill]]] = [
        ("of these on a perturbed task", [kill for kill in kills if kill.case == "perturbed"]),
        ("of these forked onto one", [kill for kill in kills if kill.case == "forked"]),
    ]
    for text, part in [*kinds, ("all", list(kills)), *cases]:
        if part:
            cells = [text, len(part), sum(kill.exact for kill in part), sum(kill.orphans for kill in part)]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def write_results(kills: Sequence[Kill], out: Path) -> None:
    """Write one row per kill, and the table between the markers of the README."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "chaos.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["number", *Kill._fields])
        for number, kill in enumerate(kills, start=1):
            cells = ["" if cell is None else int(cell) if isinstance(cell, bool) else cell for cell in kill]
            writer.writerow([number, *cells])
    readme = out / "README.md"
    if readme.exists() and MARKERS[0] in (text := readme.read_text()):
        before, after = text.split(MARKERS[0])[0], text.split(MARKERS[1])[1]
        readme.write_text(f"{before}{MARKERS[0]}\n{summary(kills)}\n{MARKERS[1]}{after}")


def make_wholes(folder: Path, cache: Path) -> None:
    """Make the run that is forked, and an uninterrupted run of each case."""
    commands = {case: [*TRAIN, *arguments] for case, arguments in CASES.items()}
    for name, command in {"source": [*commands["plain"], "--keep-checkpoints", "0"], **commands}.items():
        code = start(folder / name, command, cache, subprocess.DEVNULL).wait(PATIENCE)
        assert code == 0, (name, code)


def main() -> int:
    """Return 0 where every run ended with the files of the uninterrupted one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--out", type=Path, help="where chaos.csv goes and the table of README.md; neither without")
    options = parser.parse_args()
    cases = list(CASES)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_wholes(folder, cache := folder / "programs")

        def killed(number: int) -> list[Kill]:
            case, generator = cases[number % 3], np.random.default_rng([options.seed, number])
            return one_run(folder / f"{number}", case, folder / case / "run", cache, number, generator)

        with ThreadPoolExecutor(options.jobs) as pool:
            parts = list(pool.map(killed, range(-(-options.kills // KILLS_PER_RUN))))
    kills = [kill for part in parts for kill in part]
    print(summary(kills))
    if options.out:
        write_results(kills, options.out)
    return int(not all(kill.exact and not kill.orphans for kill in kills))


if __name__ == "__main__":
    sys.exit(main())
