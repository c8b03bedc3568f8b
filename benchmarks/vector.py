"""Several environments per seed, compared with one and with Stable-Baselines3: total environment steps per second."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING, NamedTuple

from benchmarks import peers, stamps
from benchmarks.measuring import ROLLOUT_STEPS, ROOT, Launch, Window, csac_command, time_training, usable_cores
from benchmarks.part import Options, Part
from benchmarks.tables import Row, grouped, table, with_range

if TYPE_CHECKING:
    from collections.abc import Sequence

FAST, SLOW, SAC = "PPO, HalfCheetah-v4", "PPO, PyFlyt/QuadX-Waypoints-v1", "SAC, HalfCheetah-v4"
TASKS = {FAST: stamps.TASK, SLOW: stamps.WAYPOINTS, SAC: stamps.TASK}


class Case(NamedTuple):
    """One contender in one setting; the others are compared with the first of the setting."""

    setting: str
    library: str
    environments: int
    processes: int = 0

    @property
    def contender(self) -> str:
        """The name in the table."""
        how = f", in {self.processes} processes" if self.processes else ""
        plural = "s" if self.environments > 1 else ""
        return f"{self.library}, {self.environments} environment{plural}{how}"

    @property
    def name(self) -> str:
        """The text that --only searches."""
        return f"{self.setting}: {self.contender}"

    @property
    def command(self) -> list[str]:
        """The command that starts it."""
        algorithm, numbers = self.setting.split(",")[0].lower(), (str(self.environments), str(self.processes))
        if self.library == "csac":
            words = "--environments", numbers[0], "--environment-processes", numbers[1]
            return csac_command(algorithm, *words, task=TASKS[self.setting])
        words = "--task", TASKS[self.setting], "--environments", numbers[0], "--processes", numbers[1]
        script = str(ROOT / "benchmarks" / "peers" / "speed.py")
        return [peers.PYTHON, script, "--library", "sb3", "--algorithm", algorithm, *words]


CASES = [
    Case(FAST, "csac", 8),
    Case(FAST, "csac", 1),
    Case(FAST, "SB3", 8),
    Case(FAST, "SB3", 8, 8),
    Case(SLOW, "csac", 8, 2),
    Case(SLOW, "csac", 8),
    Case(SLOW, "SB3", 8),
    Case(SLOW, "SB3", 8, 8),
    Case(SAC, "csac", 4),
    Case(SAC, "csac", 1),
]


def measure(case: Case, options: Options) -> list[Row]:
    """Measure the training speed of one contender on two cores. Raises ProcessFailure."""
    found = time_training([Launch(case.command, usable_cores()[:2])], window(case, options), case.environments)
    per_cpu_second = found["steps"] / found["cpu_seconds"]
    row = {"setting": case.setting, "contender": case.contender, **found}
    return [{**row, "steps_per_cpu_second": per_cpu_second}]


def window(case: Case, options: Options) -> Window:
    """Return when the steps of each environment are counted: for PPO in whole rollouts with their updates."""
    if case.setting == SAC:
        warmup, settled = (-(-steps // case.environments) for steps in (250, 500))
        return Window(options.lasting(5.0), warmup, settled, every=20)
    turns = ROLLOUT_STEPS // case.environments
    return Window(options.lasting(5.0), warmup=turns, settled=turns, every=turns)


def render(rows: Sequence[Row]) -> str:
    """Return a table with a row for each contender of each setting."""
    lines = []
    for (setting, contender), mine in grouped(rows, "setting", "contender").items():
        first = next(row["contender"] for row in rows if row["setting"] == setting)
        cells = [setting, contender]
        for column in ("steps_per_second", "steps_per_cpu_second"):
            against = peers.ratios(rows, setting, first, contender, column) if contender != first else []
            cells += [with_range([row[column] for row in mine], ",.0f"), with_range(against, ".2f") if against else ""]
        lines.append([*cells, f"{statistics.median(row['peak_mib'] for row in mine):.0f}"])
    head = ["steps/s", "the setting's first / this", "steps per CPU second", "the setting's first / this"]
    return table(["setting", "", *head, "peak memory, MiB"], lines)


PARTS = [Part("vector", "benchmarks/README.md", "several environments", CASES, measure, render, 3, peers.notes)]
