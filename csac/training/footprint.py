"""How much memory a run will take, told before it begins and refused where there is not so much."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import psutil

from csac.processes import memory_left
from csac.types import InputError

if TYPE_CHECKING:
    from csac.training.plan import Plan
    from csac.types import Spec

# Measured resident size of a worker process with JAX, MuJoCo and the compiled programs, before its replay; CUDA adds.
BYTES_PER_PROCESS, BYTES_PER_GPU_PROCESS = 600 * 2**20, 1_300 * 2**20
# Likewise of one that evaluates on MuJoCo, without JAX. PyBullet's environments take several times that, in line too.
BYTES_PER_EVALUATION_PROCESS = 80 * 2**20


def memory_needed(plan: Plan, spec: Spec, goes_on: bool = False) -> str:
    """Return the line that predicts the memory needed. Raises InputError where it is more than there is.

    A run that goes on from a checkpoint has its replay twice for a moment, as it was read and as JAX has it.
    """
    per_seed, seeds, groups = _bytes_per_seed(plan, spec, 2 if goes_on else 1), plan.seeds, len(plan.groups)
    evaluating = groups * plan.evaluation_processes
    per_process = BYTES_PER_GPU_PROCESS if plan.device == "gpu" else BYTES_PER_PROCESS
    needed = seeds * per_seed + groups * per_process + evaluating * BYTES_PER_EVALUATION_PROCESS
    available, limit = psutil.virtual_memory().available, memory_left()
    available = available if limit is None else min(available, limit)
    if needed > available:
        raise InputError(
            f"this run needs about {needed / 2**30:,.1f} GiB of memory and {available / 2**30:.1f} GiB are available: "
            f"use fewer seeds or groups, a smaller replay or batch (one seed takes {per_seed / 2**30:,.2f} GiB)"
        )
    text = f"memory: about {needed / 2**30:.1f} GiB of the {available / 2**30:.1f} GiB available"
    beside = f", {evaluating} of them to evaluate" if evaluating else ""
    processes = groups + evaluating
    return f"{text} ({seeds} x {per_seed / 2**20:.0f} MiB, {processes} process{'es' if processes > 1 else ''}{beside})"


def _bytes_per_seed(plan: Plan, spec: Spec, memories: int) -> int:
    """Return the size of what a seed learns and remembers, `memories` times, and of what one update needs beside it.

    The latter is the batch, and for each of its transitions a number for every unit of the networks, of which a matrix
    of weights has as many as columns.
    """
    algorithm, steps, key = plan.algorithm, plan.steps, jax.ShapeDtypeStruct((2,), "uint32")
    state, memory = jax.eval_shape(lambda key: (algorithm.init(key, spec, steps), algorithm.memory(spec, steps)), key)
    transitions = algorithm.cadence.transitions_per_update
    units = sum(leaf.shape[-1] for leaf in jax.tree.leaves(state) if len(leaf.shape) == 2)
    kept = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((state, [memory] * memories)))
    return kept + 4 * transitions * (memory.rows.shape[1] + units)
