"""How much memory a set of runs will take, told before it begins and refused where there is not so much."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import psutil

from csac.processes import memory_left
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.record.config import RunConfig
    from csac.training.program import Program
    from csac.types import Algorithm, Spec

# Measured resident size of a process with JAX, MuJoCo and the compiled programs, before its replay; CUDA adds.
BYTES_PER_PROCESS, BYTES_PER_GPU_PROCESS = 600 * 2**20, 1_300 * 2**20
BYTES_PER_EVALUATION_PROCESS = 80 * 2**20  # on MuJoCo, without JAX; PyBullet takes several times that


def memory_needed(programs: Sequence[Program], config: RunConfig, spec: Spec, at_once: int) -> str:
    """Return the line that predicts the memory of programs, `at_once` at a time. Raises InputError for too much."""
    programs = programs[:at_once]
    per_seed = _bytes_per_seed(programs[0].algorithm, config, spec)
    seeds = sum(len(program.directories) for program in programs)
    evaluating = sum((program.evaluation_processes or 0) + (program.environment_processes or 0) for program in programs)
    per_process = BYTES_PER_GPU_PROCESS if config.device == "gpu" else BYTES_PER_PROCESS
    needed = seeds * per_seed + len(programs) * per_process + evaluating * BYTES_PER_EVALUATION_PROCESS
    available, limit = psutil.virtual_memory().available, memory_left()
    available = available if limit is None else min(available, limit)
    if needed > available:
        raise InputError(
            f"this needs about {needed / 2**30:,.1f} GiB of memory and {available / 2**30:.1f} GiB are available: "
            f"use fewer seeds, a smaller replay or batch (one seed takes {per_seed / 2**30:,.2f} GiB)"
        )
    processes = len(programs) + evaluating
    return (
        f"memory: about {needed / 2**30:.1f} GiB of the {available / 2**30:.1f} GiB available "
        f"({seeds} x {per_seed / 2**20:.0f} MiB, {processes} process{'es' if processes > 1 else ''})"
    )


def _bytes_per_seed(algorithm: Algorithm, config: RunConfig, spec: Spec) -> int:
    """Return the size of what a seed learns and remembers, and of what one update needs beside it.

    The latter is the batch, and for each of its transitions a number for every unit of the networks, of which a matrix
    of weights has as many as columns.
    """
    steps, transitions = config.steps, config.steps + config.extra_transitions
    key = jax.ShapeDtypeStruct((2,), "uint32")
    state, memory = jax.eval_shape(
        lambda key: (algorithm.init(key, spec, steps), algorithm.memory(spec, transitions)), key
    )
    jax.eval_shape(lambda state: algorithm.policy(state).parameters, state)  # refuses networks that cannot leave
    units = sum(leaf.shape[-1] for leaf in jax.tree.leaves(state) if len(leaf.shape) == 2)
    kept = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((state, memory)))
    return kept + 4 * algorithm.cadence.transitions_per_update * (memory.rows.shape[1] + units)
