"""How long cells take on this machine: each kind is measured for a few seconds, once, and remembered."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import pickle
import platform
import statistics
import tempfile
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from csac.processes import Child, die_with_parent, end, move_to, outlive_termination, usable_cores
from csac.record.files import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection

    from csac.studies.cells import Cell

WARMUP = 300  # steps before the measured ones, as many as a batch needs
UNITS = 4  # that are measured, after one that compiles
STEPS_OF_A_UNIT = 100
SECONDS_TO_START = 10.0  # importing JAX, compiling or loading programs
BYTES_PER_PROCESS = 600 * 2**20  # with JAX, MuJoCo and the compiled programs
BYTES_PER_NUMBER = 4


class Cost(NamedTuple):
    """What a kind of cell costs on one core."""

    learning: float
    """Seconds for an environment step and what is learnt from it."""
    evaluating: float
    """Seconds for a step of an evaluation episode."""
    longest_episode: int
    """Steps of an evaluation episode at most, or those of one that was seen."""
    transition_size: int
    """Numbers in a transition."""


class Prediction(NamedTuple):
    """What a cell will take, of which every episode that tests a policy goes on as far as the task's limit."""

    seconds: float
    memory: float
    """Bytes of its process."""
    disk: float
    """Bytes of its checkpoints while it runs."""


def predict(cell: Cell, cost: Cost, done: int = 0, rollouts: int = 0) -> Prediction:
    """Return what the steps of a cell after the first `done` will take, and so many rollouts of its last policy."""
    warmup = min(cell.hyperparameters.get("warmup_steps", 0), cell.steps)
    learning = cell.steps - max(warmup, done)
    evaluations = math.ceil((cell.steps - done) / cell.evaluation_interval) * cell.evaluation_episodes
    seconds = learning * cost.learning + max(warmup - done, 0) * cost.evaluating
    seconds += (evaluations + rollouts) * cost.longest_episode * cost.evaluating
    capacity = cell.hyperparameters.get("replay_size", cell.hyperparameters.get("rollout_steps", 0))
    memory = min(capacity, cell.steps) * cost.transition_size * BYTES_PER_NUMBER
    return Prediction(seconds + SECONDS_TO_START, memory + BYTES_PER_PROCESS, memory)


class Calibration:
    """The costs that were measured on this kind of machine, by kind of cell."""

    def __init__(self) -> None:
        self._path = _home() / "speed.json"
        self.is_busy = False
        """Whether something was measured while others kept the machine busy."""
        self._known: dict[str, list[float]] = {}
        with suppress(OSError, ValueError):
            self._known = json.loads(self._path.read_bytes())

    def cost(self, cell: Cell) -> Cost | None:
        """Return what was measured, or None where nothing was."""
        known = self._known.get(_kind(cell))
        return None if known is None else Cost(known[0], known[1], int(known[2]), int(known[3]))

    def measure(self, cell: Cell) -> Cost:
        """Measure a cell in a process on one core, and remember it for its kind. Raises RuntimeError where it fails."""
        busy = os.getloadavg()[0] >= len(usable_cores())
        child = Child(_work, usable_cores()[:1], pickle.dumps(cell), daemon=False)
        try:
            outcome = child.connection.recv()
        except EOFError:
            outcome = child.cause_of_death()
        finally:
            end([child])
        if isinstance(outcome, str):
            raise RuntimeError(outcome)
        self._known[_kind(cell)] = list(outcome)
        self.is_busy = self.is_busy or busy
        with suppress(OSError):  # nothing is remembered then
            if self.is_busy:
                return outcome
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, (json.dumps(self._known, indent=1) + "\n").encode())
        return outcome


def _work(connection: Connection, cores: Sequence[int], packed: bytes) -> None:
    die_with_parent()
    outlive_termination()
    move_to(cores)
    try:
        connection.send(_measure(pickle.loads(packed)))
    except Exception as error:
        connection.send(" ".join(str(error).split()) or type(error).__name__)


def _measure(cell: Cell) -> Cost:
    from csac.evaluation.play import evaluate_run
    from csac.tasks.environment import Environment
    from csac.training.train import train

    algorithm: Any = cell.make_algorithm()
    warmup = min(WARMUP, cell.hyperparameters.get("warmup_steps", 0))
    unit = max(STEPS_OF_A_UNIT, *(cell.hyperparameters.get(name, 0) for name in ("update_interval", "rollout_steps")))
    if "warmup_steps" in cell.hyperparameters:
        algorithm = dataclasses.replace(algorithm, warmup_steps=warmup)
    times: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        run = train(
            algorithm,
            cell.task,
            steps=warmup + (UNITS + 1) * unit,
            directory=Path(folder) / "run",
            evaluation_interval=unit,
            evaluation_episodes=1,
            environment_arguments=cell.environment_arguments,
            checkpoint_interval=0,
            tensorboard=False,
            on_evaluation=lambda *_: times.append(time.perf_counter()),
        )
        lengths = run.evaluations["length"][-UNITS:]
        began = time.perf_counter()
        ((_, episodes),) = evaluate_run(run.path, processes=1)
        evaluating = (time.perf_counter() - began) / sum(episode.length for episode in episodes)
    passed = [later - earlier for earlier, later in zip(times[-UNITS - 1 :], times[-UNITS:], strict=False)]
    learning = [max(seconds - length * evaluating, 0.0) / unit for seconds, length in zip(passed, lengths, strict=True)]
    environment = Environment(cell.task, cell.environment_arguments)
    try:
        observation, action = environment.spec
        limit = environment.raw.spec.max_episode_steps if environment.raw.spec else None
    finally:
        environment.close()
    longest = limit or max(episode.length for episode in episodes)
    return Cost(statistics.median(learning), evaluating, longest, 2 * observation + action + 3)


def _kind(cell: Cell) -> str:
    """Return what decides how fast a cell is: weights and rates do not."""
    sizes = {name: value for name, value in cell.hyperparameters.items() if not isinstance(value, float)}
    told = [cell.task, cell.environment_arguments, cell.algorithm, sizes, _machine()]
    return f"{cell.algorithm} {cell.task} {hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]}"


def _machine() -> list[str]:
    processor = platform.processor()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return [processor, *(version(package) for package in ("csac", "jaxlib"))]


def _home() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "csac"
