"""The runs that one process trains as a program: how they are grouped, and how much memory they take."""

from __future__ import annotations

import multiprocessing
import pickle
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import jax
import psutil

from csac.checks import check_whole
from csac.processes import cores_to_use, may_be_imported, memory_left, script, usable_cores
from csac.training.callbacks import Interests
from csac.training.devices import preallocates
from csac.training.one_seed import KEY_DATA
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from csac.record.config import RunConfig
    from csac.record.run import RunDirectory
    from csac.tasks.registry import Task
    from csac.types import Algorithm, Spec

PROCESSES_PER_GPU = 4  # eight slowed each other down
SEEDS_PER_GPU_PROCESS = 5  # with fewer, another process gains little
# Measured resident size of a process with JAX, MuJoCo and the compiled programs, without its replay; more with CUDA.
BYTES_PER_PROCESS, BYTES_PER_GPU_PROCESS = 600 * 2**20, 1_300 * 2**20
BYTES_PER_EVALUATION_PROCESS = 80 * 2**20  # on MuJoCo, without JAX; PyBullet takes several times that


class Program(NamedTuple):
    """The runs that one process trains together, and how. Of the settings, only `threads` changes the numbers."""

    directories: tuple[Path, ...]
    algorithm: Algorithm
    task: Task
    threads: int
    """Cores among which XLA divides its work."""
    evaluation_processes: int | None = 0
    """How many processes evaluate; None, only in a template, has `programs_of` choose."""
    environment_processes: int | None = 0
    """How many processes share the environments; None chooses by what a step costs."""
    tensorboard: bool = True
    wandb: bool | str = False
    interests: Interests = Interests()
    """The events that are sent to callbacks; training waits for each call."""
    command: str | None = None


def choose_groups(
    seeds: Sequence[int],
    existing: Mapping[int, RunDirectory],
    seeds_per_process: int | None,
    device: str,
    *sent: Any,
) -> list[list[int]]:
    """Return the seeds of each program: as recorded in existing runs, as requested, or as is fastest here.

    A seed that failed is behind the others of its program: it is tried again with those that failed at the same
    checkpoint. By default all new seeds train together if one of `sent`, the task and the algorithm, cannot be sent to
    a process; then failed seeds wait for a call of their own.
    """
    known = {seed: existing[seed].manifest for seed in seeds if seed in existing}
    together: dict[tuple[int | None, tuple[int, ...]], list[int]] = {}
    for seed, manifest in known.items():
        failed_at = manifest.last_checkpoint if manifest.state == "failed" else None
        together.setdefault((failed_at, manifest.program or (seed,)), []).append(seed)
    groups = [group for (failed_at, _), group in together.items() if failed_at is None]
    retried = [group for (failed_at, _), group in together.items() if failed_at is not None]
    rest = [seed for seed in seeds if seed not in known]
    is_sendable, size = all(map(can_be_sent, sent)), seeds_per_process
    if size is None:
        size = 1 if is_sendable else len(rest)
        if device == "gpu":
            processes = max(1, min(len(rest) // SEEDS_PER_GPU_PROCESS, len(usable_cores()) // 2, PROCESSES_PER_GPU))
            size = max(1, -(-len(rest) // (1 if preallocates() else processes)))
    check_whole("seeds_per_process", size, min(len(rest), 1), max(len(seeds), 1))
    groups += [rest[i : i + size] for i in range(0, len(rest), max(size, 1))]
    return groups + (retried if is_sendable or not groups else [])


def programs_of(
    template: Program, directories: Sequence[Sequence[Path]], existing: Mapping[int, RunDirectory], config: RunConfig
) -> list[Program]:
    """Return a program like `template` for each group of directories, with its share of the cores and processes.

    Raises InputError for numbers out of range, and for a task or an algorithm that cannot be sent to another process.
    """
    cores = cores_to_use()
    ahead = groups_ahead(directories, existing, config.steps)
    begun = [run for run in existing.values() if any(run.path in group for group in ahead)]
    threads = threads_of(begun, cores, max(1, cores // len(ahead)))
    has_processes = can_be_sent(template.task) and may_be_imported()
    spare, batches = cores - len(directories), len(directories[0]) * -(-config.evaluation_episodes // 10)
    processes = template.evaluation_processes
    if processes is None:
        is_worthwhile = spare > 0 and config.evaluation_environments > 0 and not template.interests.evaluations
        is_worthwhile = is_worthwhile and 0 < config.evaluation_interval < config.steps
        processes = min(batches, max(1, spare // len(directories))) if is_worthwhile and has_processes else 0
    check_whole("evaluation_processes", processes, 0, 1_000)
    if not config.evaluation_environments and (processes or max(config.environments, *map(len, directories)) > 1):
        raise InputError(
            "evaluation_environments=0 is for one environment, one seed per process and evaluation_processes=0"
        )
    stepping = template.environment_processes if has_processes else template.environment_processes or 0
    most = config.environments if config.environments > 1 else 0
    check_whole("environment_processes", stepping or 0, 0, most)
    used_by = {"task": processes or stepping or len(directories) > 1, "algorithm": len(directories) > 1}
    for name in (name for name, is_used in used_by.items() if is_used and not can_be_sent(getattr(template, name))):
        raise InputError(
            f"the {name} cannot be sent to another process: define it in a module that can be imported, or train "
            "with seeds_per_process=seeds, evaluation_processes=0 and environment_processes=0"
        )
    settings = {"threads": threads, "evaluation_processes": processes, "environment_processes": stepping}
    return [template._replace(directories=tuple(group), **settings) for group in directories]


def groups_ahead(
    directories: Sequence[Sequence[Path]], existing: Mapping[int, RunDirectory], steps: int
) -> list[Sequence[Path]]:
    """Return the groups of directories that have steps to make, or all if none has."""
    over = {run.path for run in existing.values() if run.manifest.steps_done >= steps}
    return [group for group in directories if not over.issuperset(group)] or list(directories)


def threads_of(existing: Iterable[RunDirectory], cores: int, default: int) -> int:
    """Return the threads that existing runs began with if there are as many cores: the last bits depend on them."""
    recorded = [run.manifest.machine.cores for run in existing if run.manifest.process is not None]
    return recorded[0] if recorded and 0 < recorded[0] <= cores else default


def can_be_sent(task: Task | Algorithm) -> bool:
    """Return whether a task or an algorithm can be sent to another process, which cannot import from a notebook."""
    if multiprocessing.current_process().daemon:  # a worker of a Pool, which may have no children
        return False
    has_script, maker = script() is not None, task
    if isinstance(task, str):
        known = gymnasium.registry.get(task)
        if has_script or known is None:
            return True
        maker = known.entry_point
    try:
        pickled = pickle.dumps(maker)
    except Exception:
        return False
    return has_script or b"__main__" not in pickled


def memory_needed(programs: Sequence[Program], config: RunConfig, spec: Spec, at_once: int) -> str:
    """Return a line that predicts the memory of programs, `at_once` at a time. Raises InputError if it is too much."""
    programs = programs[:at_once]
    per_seed = _bytes_per_seed(programs[0].algorithm, config, spec)
    seeds = sum(len(program.directories) for program in programs)
    helpers = sum((program.evaluation_processes or 0) + (program.environment_processes or 0) for program in programs)
    per_process = BYTES_PER_GPU_PROCESS if config.device == "gpu" else BYTES_PER_PROCESS
    needed = seeds * per_seed + len(programs) * per_process + helpers * BYTES_PER_EVALUATION_PROCESS
    available, limit = psutil.virtual_memory().available, memory_left()
    available = available if limit is None else min(available, limit)
    if needed > available:
        raise InputError(
            f"this needs about {needed / 2**30:,.1f} GiB of memory and {available / 2**30:.1f} GiB are available: "
            f"use fewer seeds or a smaller replay (one seed takes {per_seed / 2**30:,.2f} GiB)"
        )
    return f"memory: about {needed / 2**30:.1f} of {available / 2**30:.1f} GiB available"


def _bytes_per_seed(algorithm: Algorithm, config: RunConfig, spec: Spec) -> int:
    """Return the size of a seed's state and memory."""
    steps, transitions = config.steps, config.steps + config.extra_transitions
    state, memory = jax.eval_shape(
        lambda key: (algorithm.init(key, spec, steps), algorithm.memory(spec, transitions)), KEY_DATA
    )
    jax.eval_shape(lambda state: algorithm.policy(state).parameters, state)  # refuses networks that cannot be exported
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((state, memory)))
