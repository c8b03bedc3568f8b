"""Choose the device that a process computes on, and the cores. JAX fixes both at its first computation."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any

import jax

from csac.processes import move_to, usable_cores
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

PRNG = "threefry2x32"  # with the same keys, runs are the same on every machine
PLATFORMS = {"cpu": "cpu", "gpu": "cuda"}  # by JAX's names
FLAGS = "XLA_FLAGS"  # read by XLA when JAX first looks for devices
EXACT_GPU = "--xla_gpu_deterministic_ops"  # of XLA: the same kernels in every run, which sum in a fixed order
PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"  # of JAX: whether a process reserves most of a GPU's memory at its start
PRECISION = "highest"  # of matrix products on a GPU; by default JAX rounds float32 inputs to TF32, of 10 bits


def choose_device(device: str) -> None:
    """Compute on "cpu" or "gpu" ("cuda") in this process and in those that it starts.

    CPU programs are dispatched asynchronously, which is JAX's default: the client handles a program's outputs while the
    program is already running. `JAX_CPU_ENABLE_ASYNC_DISPATCH=0` turns that off and changes no number.

    A GPU computes as a CPU does, in float32 and the same in every run, unless the user's own XLA_FLAGS or
    JAX_DEFAULT_MATMUL_PRECISION say otherwise. A process allocates GPU memory as it needs it, so that several can share
    a GPU, unless XLA_PYTHON_CLIENT_PREALLOCATE says otherwise. If JAX has already initialised its devices, it is too
    late for that and for XLA's flags: a warning says so. Raises InputError if there is no such device, this process has
    computed on another one, or JAX is set to 64 bits or another PRNG.
    """
    device = "gpu" if device == "cuda" else device
    if device not in PLATFORMS:
        raise InputError(f"device must be cpu or gpu, not {device!r}")
    config: Any = jax.config
    if config.jax_enable_x64:
        raise InputError(
            "csac computes in 32 bits and JAX is set to 64: unset JAX_ENABLE_X64, or jax_enable_x64 in the task"
        )
    if config.jax_default_prng_impl != PRNG:
        raise InputError(f"csac's keys are of JAX's {PRNG}: unset JAX_DEFAULT_PRNG_IMPL (jax_default_prng_impl)")
    before = config.jax_platforms, {name: os.environ.get(name, "") for name in (FLAGS, PREALLOCATE)}
    jax.config.update("jax_platforms", PLATFORMS[device])
    is_late = device == "gpu" and _has_looked_for_devices()
    if device == "gpu" and not is_late:
        os.environ[FLAGS] = with_exact_kernels(os.environ.get(FLAGS, ""))
        os.environ[PREALLOCATE] = os.environ.get(PREALLOCATE) or "false"
    try:
        # A CPU needs no test, and `begin_with` is to come before JAX looks for devices.
        chosen = jax.default_backend() if device == "gpu" or _has_looked_for_devices() else device
    except Exception as error:  # its type depends on what is missing, and on JAX's version
        _restore_settings(*before)
        hint = "pip install '.[cuda]' in a clone of csac, or choose the cpu"
        raise InputError(f"no GPU that JAX can use: {hint}") from error
    if chosen != device:
        _restore_settings(*before)
        raise InputError(f"this process computes on the {chosen} already: train on the {device} in a new one")
    os.environ["JAX_PLATFORMS"] = PLATFORMS[device]  # for the workers
    if device == "gpu":
        multiply_in_float32()
        if is_late and EXACT_GPU not in os.environ.get(FLAGS, ""):
            warnings.warn(
                "JAX was in use before csac, so runs on this GPU may differ in their last bits: "
                f"train first, or set XLA_FLAGS={EXACT_GPU}=true before",
                stacklevel=2,
            )
    if config.jax_default_matmul_precision:
        os.environ["JAX_DEFAULT_MATMUL_PRECISION"] = config.jax_default_matmul_precision  # for the workers


_threads: int | None = None


def begin_with(threads: int) -> None:
    """Have XLA divide its work for this many cores, while this process may run on every core.

    XLA sizes its thread pool by the cores that it sees when JAX first looks for devices; later this has no effect.
    """
    global _threads
    cores = usable_cores()
    if threads >= len(cores) or _has_looked_for_devices():
        return
    move_to(cores[os.getpid() % (len(cores) - threads + 1) :][:threads])
    try:
        jax.devices()
    finally:
        move_to(cores)
    _threads = threads


def threads_in_use() -> int:
    """Return for how many cores XLA divides the work of this process."""
    return _threads or len(usable_cores())


def in_use() -> dict[str, str]:
    """Return the settings that decide the last bits of results in this process and its workers, as in `Machine`."""
    config: Any = jax.config
    return {
        "gpu": jax.devices()[0].device_kind if jax.default_backend() == "gpu" else "",
        "xla_flags": os.environ.get(FLAGS, ""),
        "matmul_precision": config.jax_default_matmul_precision or "",
    }


def with_exact_kernels(flags: str) -> str:
    """Return XLA's flags with deterministic GPU kernels, unless the flags already set that option."""
    return flags if EXACT_GPU in flags else f"{flags} {EXACT_GPU}=true".strip()


def multiply_in_float32() -> None:
    """Compute matrix products in float32 in this process, unless the user has set another precision."""
    config: Any = jax.config
    if config.jax_default_matmul_precision is None:
        config.update("jax_default_matmul_precision", PRECISION)


def preallocates() -> bool:
    """Return whether the user has processes reserve most of a GPU's memory, as JAX reads the variable."""
    return os.environ.get(PREALLOCATE, "") not in ("", "0", "false", "False")


def _has_looked_for_devices() -> bool:
    """Return whether JAX has, after which it ignores the GPU variables. It has no public function for this."""
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()


def _restore_settings(platforms: str | None, variables: Mapping[str, str]) -> None:
    jax.config.update("jax_platforms", platforms)
    os.environ.update(variables)
