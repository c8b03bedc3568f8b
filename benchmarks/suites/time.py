"""Where the time goes: starting, the parts of a training step, evaluation, and the tasks alone."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from benchmarks.measuring import TASK, Process, run, run_one, worker
from benchmarks.parts import Options, Part
from benchmarks.tables import Row, grouped, table, with_range
from csac.processes import usable_cores

PAGE = "benchmarks/README.md"
TASKS = ["HalfCheetah-v4", "Walker2d-v4", "Ant-v4", "Hopper-v4", "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3"]


class Start(NamedTuple):
    """A start of `csac`: a command that trains nothing, or training until the first update of all its seeds."""

    name: str
    arguments: tuple[str, ...] = ()
    seeds: int = 0


STARTS = [
    Start("`csac --help`", ("--help",)),
    Start("`csac evaluate --help`", ("evaluate", "--help")),
    Start("`csac train --help`", ("train", "--help")),
    Start("a mistake in `csac train`", ("train", TASK, "--stepz", "3")),
    Start("first update, 1 seed", seeds=1),
    Start("first update, 5 seeds", seeds=5),
]


def measure_start(start: Start, options: Options) -> list[Row]:
    """Return the seconds of a command, or those to the first update with nothing kept and with the programs kept."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    with tempfile.TemporaryDirectory() as cache:
        environment["XDG_CACHE_HOME"] = cache
        if start.arguments:
            began = time.monotonic()
            subprocess.run([sys.executable, "-m", "csac", *start.arguments], env=environment, capture_output=True)
            return [{"what": start.name, "seconds": time.monotonic() - began}]
        rows = []
        for kept in ("nothing kept", "programs kept"):
            began, process = time.monotonic(), Process(worker("start", seeds=start.seeds), usable_cores())
            seconds = run([process], environment)[0]["first_update"] - began
            rows.append({"what": f"{start.name}, {kept}", "seconds": seconds})
        return rows


def render_starts(rows: list[Row]) -> str:
    """Return medians, and the smallest and largest."""
    starts = grouped(rows, "what").items()
    return table(
        ["", "seconds"], [[what, with_range([row["seconds"] for row in mine], ".2f")] for (what,), mine in starts]
    )


def measure_loop(task: str, options: Options) -> list[Row]:
    """Return the shares of the parts of a training step."""
    steps, episodes = (20, 1) if options.quick else (200, 10)
    return [{"task": task, **run_one(worker("loop", task=task, steps=steps, episodes=episodes))}]


LOOP_COLUMNS = {
    "task": "{task}",
    "step, ms": "{milliseconds:.2f}",
    "environment": "{environment:.1%}",
    "evaluation (longest)": "{evaluation:.1%} ({longest_evaluation:.1%})",
    "the rest": "{rest:.1%}",
    "outside the update (longest)": "{outside_update:.1%} ({longest_outside_update:.1%})",
}


class Evaluated(NamedTuple):
    """A task whose evaluations are measured."""

    name: str
    task: str
    episodes: int
    arguments: dict[str, Any]


EVALUATED = [
    Evaluated("HalfCheetah-v4", "HalfCheetah-v4", 10, {}),
    Evaluated("Ant-v4, never broken off", "Ant-v4", 4, {"terminate_when_unhealthy": False}),
]


def measure_evaluation(case: Evaluated, options: Options) -> list[Row]:
    """Return the share of time lost with evaluations in line and beside training."""
    episodes, seconds = (1, 0.1) if options.quick else (case.episodes, options.lasting(11.0))
    arguments = {"task": case.task, "episodes": episodes, "environment_arguments": case.arguments}
    found = run_one(worker("evaluation", seconds=seconds, **arguments))
    return [{"task": case.name, "episodes": episodes, **found}]


EVALUATION_COLUMNS = {
    "task": "{task}",
    "episodes every 5,000 steps": "{episodes}",
    "lost in line": "{lost_in_line:.1%}",
    "lost beside training": "{lost_beside:.1%}",
    "steps/s alone, while a process evaluates": "{steps_per_second_alone:.1f}, {steps_per_second_beside:.1f}",
    "turns": "{turns}",
}


def measure_stepping(task: str, options: Options) -> list[Row]:
    """Step one task on one core."""
    return [{"task": task, **run_one(worker("stepping", task=task, seconds=options.lasting(5.0)), cores=1)}]


STEPPING_COLUMNS = {
    "task": "{task}",
    "steps/s": "{steps_per_second:,.0f}",
    "length of a random episode": "{episode_length:,.0f}",
}


PARTS = [
    Part("time-start", PAGE, "from launch to help, and to the first update", STARTS, measure_start, render_starts, 3),
    Part("time-loop", PAGE, "the parts of a training step, by task", TASKS, measure_loop, LOOP_COLUMNS),
    Part("time-evaluation", PAGE, "evaluation in line, and beside", EVALUATED, measure_evaluation, EVALUATION_COLUMNS),
    Part("time-stepping", "docs/tasks.md", "each task alone", TASKS, measure_stepping, STEPPING_COLUMNS),
]
