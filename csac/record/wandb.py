"""The curves of a run in Weights & Biases: one W&B run for each seed, with the tags of `scalars`.

Everything that could wait for W&B happens in a thread of its own: it is handed the numbers, training goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
import time
from contextlib import suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from csac.record.files import write_atomically
from csac.record.scalars import Point, Scalars
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.record.run import RunDirectory
    from csac.record.scalars import Tables

DEFAULT_PROJECT = "csac"
LOGGED = "logged.json"
SECONDS_TO_FINISH = 60.0  # that the end of a run waits for W&B at most
_SETTINGS = {"silent": True, "console": "off", "init_timeout": 30.0, "finish_timeout": 30.0}


class WandbLog:
    """Hands the curves of a run to W&B, in one W&B run for each seed; those of a run directory are one group.

    A W&B run has an id that follows from the run directory's manifest, so that a run that goes on goes on there too; a
    step that was handed over before is left out. Where W&B cannot be reached the numbers go to files beside the run,
    which `wandb sync` sends; where it fails, training does not. All of it stands below `wandb/` in the run directory.

    Args:
        run: the run directory.
        seeds: the labels of its seeds.
        begin: the step that it goes on from; 0 for a new run.
        project: W&B's project; None for the one that the run had before, or W&B's own WANDB_PROJECT, or "csac".
        before: the rows that its tables have already, which count in means over several episodes.
        clock: seconds, for the speed.

    Raises:
        InputError: wandb is not installed.
    """

    def __init__(
        self,
        run: RunDirectory,
        seeds: Sequence[int],
        begin: int = 0,
        project: str | None = None,
        before: Tables | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._wandb = import_wandb()
        self._run, self._scalars = run, Scalars(seeds, begin, before, clock)
        known = _read(run)
        self.project = project or known.get("project") or os.environ.get("WANDB_PROJECT") or DEFAULT_PROJECT
        self.group = group_of(run)
        logged = known.get("logged", {})
        self._logged = {seed: int(logged.get(str(seed), 0)) for seed in seeds}
        self._waiting: SimpleQueue[list[Point] | None] = SimpleQueue()
        self._news: SimpleQueue[str] = SimpleQueue()
        self._is_online = False
        self._thread = threading.Thread(target=self._work, name="wandb", daemon=True)
        self._news.put(f"W&B: project {self.project}, group {self.group}, files in {run.wandb}")
        self._thread.start()

    def write(self, tables: Tables) -> Sequence[str]:
        """Hand over the points of these rows; return what there is to say of W&B, a line each."""
        points = self._scalars.points(tables)
        if points and self._thread.is_alive():
            self._waiting.put(points)
        return self._told()

    def flush(self) -> None:
        """Do nothing: W&B writes its own files, and training never waits for it."""

    def close(self) -> Sequence[str]:
        """Wait for W&B, but not for ever; return what there is to say of it. May be called again."""
        self._waiting.put(None)
        self._thread.join(SECONDS_TO_FINISH)
        if self._thread.is_alive():
            self._news.put(f"W&B did not take everything in {SECONDS_TO_FINISH:.0f} s: wandb sync {self._run.wandb}/*")
        return self._told()

    def _told(self) -> list[str]:
        return [self._news.get() for _ in range(self._news.qsize())]

    def _work(self) -> None:
        runs: dict[int, Any] = {}
        try:
            self._go_online()
            for seed in self._logged:
                runs[seed] = self._begin(seed)
            while (points := self._waiting.get()) is not None:
                self._log(runs, points)
            for run in runs.values():
                run.finish()
        except Exception as error:
            self._news.put(f"W&B gets no more of this run: {_line(error)}; its own files hold everything")

    def _begin(self, seed: int) -> Any:
        """Begin the W&B run of a seed, or go on with it; without W&B, in files."""
        manifest, wandb = self._run.manifest, self._wandb
        hyperparameters = {
            name: list(value) if isinstance(value, tuple) else value for name, value in manifest.hyperparameters.items()
        }
        surroundings = {
            name: getattr(manifest, name)
            for name in ("task", "algorithm", "preset", "steps", "device", "environment_arguments", "commit")
        }
        options = {
            "project": self.project,
            "group": self.group,
            "name": f"{self.group} seed {seed}",
            "id": run_id(self._run, seed),
            "job_type": "train",
            "tags": [manifest.task[:64], manifest.algorithm],
            "config": {**hyperparameters, **surroundings, "seed": seed, "directory": str(self._run.path)},
            "dir": str(self._run.path),
            "reinit": "create_new",
        }
        if self._is_online:
            return wandb.init(**options, resume="allow", settings=wandb.Settings(**_SETTINGS))
        mode = wandb.setup().settings.mode
        return wandb.init(**options, mode="offline" if mode == "online" else mode, settings=wandb.Settings(**_SETTINGS))

    def _go_online(self) -> None:
        """Find out whether numbers are to be sent, and can be: W&B itself would ask the user for a key.

        Not by trying to begin a run: where that fails, W&B keeps its id from being used again.
        """
        wandb = self._wandb
        if wandb.setup(settings=wandb.Settings(silent=True)).settings.mode != "online":
            return
        self._is_online = True
        try:
            if not wandb.login(prompt=False, verify=True):
                self._go_offline("there is no key; wandb login asks for one")
        except Exception as error:
            self._go_offline(_line(error))

    def _go_offline(self, reason: str) -> None:
        self._is_online = False
        self._news.put(f"W&B is sent nothing: {reason}. To send it later: wandb sync {self._run.wandb}/offline-*")

    def _log(self, runs: dict[int, Any], points: list[Point]) -> None:
        """Hand points over, in the order of their steps: W&B takes none that is behind the last."""
        steps: dict[tuple[int, int], dict[str, float]] = {}
        for seed, step, values in points:
            if step > self._logged[seed]:
                steps.setdefault((step, seed), {}).update(values)
        for (step, seed), values in sorted(steps.items()):
            runs[seed].log(values, step=step, commit=True)
            self._logged[seed] = step
        if steps:
            _write(self._run, self.project, self._logged)


def import_wandb() -> Any:
    """Return the module. Raises InputError where it is not installed."""
    try:
        import wandb
    except ImportError:
        wandb = None
    if not hasattr(wandb, "init"):  # a folder of that name, which W&B itself makes, can be imported too
        raise InputError("W&B is not installed: pip install '.[wandb]' in a clone of csac")
    return wandb


def logs_to_wandb(run: RunDirectory) -> bool:
    """Whether the curves of this run have gone to W&B."""
    return (run.wandb / LOGGED).exists()


def group_of(run: RunDirectory) -> str:
    """Return the W&B group of a run, the end of its path; runs of a study that differ by the seed alone have one."""
    parts = run.path.resolve().parts[-3:]
    return "/".join(parts[:-1] if re.fullmatch(r"seed-\d+", parts[-1]) else parts)[:100]


def run_id(run: RunDirectory, seed: int) -> str:
    """Return the id of a seed's W&B run: another for every run, and the same whenever this one goes on.

    Steps are not in it, as a run may be given more of them: runs of a study that differ in these have other folders.
    """
    manifest, place = run.manifest, run.path.resolve().parts[-2:]
    known = [manifest.created, place, manifest.task, manifest.algorithm, manifest.hyperparameters]
    known += [manifest.environment_arguments, manifest.perturbations, manifest.seeds, seed]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()[:16]


def _read(run: RunDirectory) -> dict[str, Any]:
    """Return what was handed over before: the project, and each seed's last step."""
    with suppress(OSError, ValueError):
        return json.loads((run.wandb / LOGGED).read_bytes())
    return {}


def _write(run: RunDirectory, project: str, logged: dict[int, int]) -> None:
    run.wandb.mkdir(exist_ok=True)
    write_atomically(run.wandb / LOGGED, json.dumps({"project": project, "logged": logged}).encode())


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
