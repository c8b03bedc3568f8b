"""Speed beside Stable-Baselines3, SBX, CleanRL-style files, Tianshou and PARL.

Environment steps, each with its update, per second. README.md of benchmarks says how it is done and what was found.
"""

from __future__ import annotations

import statistics
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.contenders import CASES, LIBRARIES, PARL_PYTHON, PEERS_PYTHON, REACHES, Case, Reach
from benchmarks.measuring import ROLLOUT_STEPS, ROOT, TASK, Process, Window, run, surroundings, training, watch_load
from benchmarks.parts import Options, Part
from benchmarks.tables import Row, grouped, table, with_range
from csac.processes import usable_cores
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

QUIET = 0.2  # processors that others may keep busy


def measure(case: Case, options: Options) -> list[Row]:
    """Run one case to its end; nothing where it cannot be run here.

    Raises:
        InputError: the peers are not installed, and their places in the table would stay empty.
    """
    if not (Path(PEERS_PYTHON).exists() or options.only):
        raise InputError(f"there is no {PEERS_PYTHON}: run `make peers` first, or choose with --only")
    if lacks := LIBRARIES[case.library].lacks():
        print(f"not measured: {case.contender}: {lacks}", flush=True)
        return []
    cores, other_load = usable_cores()[: case.cores], watch_load()
    shares = [cores[i :: case.together] for i in range(case.together)]
    processes = [Process(command(case, window(case, options)), share) for share in shares]
    results = run(processes, surroundings("cpu"), together=case.together > 1)
    row = {
        "setting": case.setting,
        "contender": case.contender,
        "allowed": case.allowed,  # what does its arithmetic, and on how many cores or threads
        "steps_per_second": sum(result["steps_per_second"] for result in results),  # of all seeds together
        "steps": sum(result["steps"] for result in results),
        "seconds": max(result["seconds"] for result in results),
        "start_seconds": max(result["start_seconds"] for result in results),  # from launching to the first update
        "peak_mib": sum(result["peak_mib"] for result in results),  # resident memory, all processes together
        "other_load": other_load(),  # processors that others kept busy, the hypervisor's share included
    }
    return [row]


def window(case: Case, options: Options) -> Window:
    """Return when steps are counted: an evaluated case's window is one interval."""
    if case.evaluated:
        return options.window(0.0, evaluated=True)
    counted = options.window(10.0 if case.seeds > 1 else 5.0)
    return counted._replace(warmup=ROLLOUT_STEPS, settled=ROLLOUT_STEPS) if case.algorithm == "ppo" else counted


def command(case: Case, counted: Window) -> list[str]:
    """Return how one process of the case is started."""
    if case.library == "csac":
        return training(case.algorithm, counted, case.seeds)
    library = LIBRARIES[case.library]
    arguments = {"algorithm": case.algorithm, "task": TASK, "seeds": case.seeds, "launched": time.monotonic()}
    arguments |= counted._asdict() | ({"threads": case.threads_each} if library.has_threads else {})
    options = [f"--{name.replace('_', '-')}={value}" for name, value in arguments.items()]
    script = str(ROOT / "benchmarks" / "peers" / library.script)
    return [library.python, script, *options, *library.options, *["--together"] * (case.together > 1)]


def lacking() -> list[str]:
    """Return a line for each contender that this machine cannot run."""
    reasons = {case.contender: LIBRARIES[case.library].lacks() for case in CASES}
    return [f"{contender}: {reason}" for contender, reason in reasons.items() if reason]


def notes(rows: list[Row], options: Options) -> list[str]:
    """Return what the numbers depend on beside the machine, a line each."""
    loads = [row["other_load"] for row in rows]
    peers = ("stable_baselines3", "tianshou", "torch", "sbx-rl", "jax", "gymnasium", "mujoco", "numpy")
    parl = ("parl", "paddlepaddle", "gymnasium", "mujoco", "numpy")
    return [
        *([f"peers: {_versions(PEERS_PYTHON, peers)}"] if Path(PEERS_PYTHON).exists() else []),
        *([f"PARL apart from them: {_versions(PARL_PYTHON, parl)}"] if Path(PARL_PYTHON).exists() else []),
        *(f"not measured: {line}" for line in lacking()),
        f"one-seed windows of {options.lasting(5.0):g} s and more, five-seed windows of {options.lasting(10.0):g} s; "
        f"repetitions: {1 + max(row['repetition'] for row in rows)} of the settings with a range, 1 of the others",
        f"other programs kept {statistics.mean(loads):.2f} cores busy on average, {max(loads):.2f} at most"
        + (": **not a quiet machine**" if max(loads) > QUIET else ""),
    ]


def _versions(python: str, packages: Sequence[str]) -> str:
    code = "import sys, importlib.metadata as m; print(', '.join(f'{n} {m.version(n)}' for n in sys.argv[1:]))"
    result = subprocess.run([python, "-c", code, *packages], capture_output=True, text=True, check=True)
    return result.stdout.strip()


def ratios(rows: Sequence[Row], setting: str, contender: str, peer: str) -> list[float]:
    """Return the ratio of steps per second, one for each repetition that has both."""
    ours, theirs = (
        {
            row["repetition"]: row["steps_per_second"]
            for row in grouped(rows, "setting", "contender").get((setting, name), [])
        }
        for name in (contender, peer)
    )
    return [ours[repetition] / theirs[repetition] for repetition in sorted(ours.keys() & theirs.keys())]


def render(rows: Sequence[Row], reaches: Sequence[Reach] = REACHES) -> str:
    """Return what was to be reached, and everything measured."""
    return "\n\n".join(part for part in (_reached(rows, reaches), _measured(rows)) if part)


def _reached(rows: Sequence[Row], reaches: Sequence[Reach]) -> str:
    lines = []
    for setting, contender, peer, wanted in reaches:
        if found := ratios(rows, setting, contender, peer):
            verdict = "yes" if statistics.median(found) >= wanted else "**no**"
            lines.append([setting, f"{contender} / {peer}", f">= {wanted}", with_range(found, ".2f"), verdict])
    return table(["setting", "ratio of steps/s", "to reach", "measured", "reached"], lines) if lines else ""


def _measured(rows: Sequence[Row]) -> str:
    lines = []
    for (setting, contender), mine in grouped(rows, "setting", "contender").items():
        first = next(row["contender"] for row in rows if row["setting"] == setting)
        against = ratios(rows, setting, first, contender) if contender != first else []
        lines.append(
            [
                *(setting, contender, mine[0]["allowed"]),
                with_range([row["steps_per_second"] for row in mine], ".0f"),
                with_range(against, ".2f") if against else "",
                f"{statistics.median(row['start_seconds'] for row in mine):.1f}",
                f"{max(row['peak_mib'] for row in mine):.0f}",
            ]
        )
    head = ["setting", "", "allowed", "steps/s", "the setting's first / this", "start, s", "peak memory, MiB"]
    return table(head, lines)


PARTS = [Part("peers", "benchmarks/README.md", "steps per second", CASES, measure, render, 3, len(CASES), notes)]
