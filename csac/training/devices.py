"""Where a process computes: JAX decides it once, at its first computation."""

from __future__ import annotations

import os
from typing import Any

import jax

from csac.types import InputError

PRNG = "threefry2x32"  # runs are the same on every machine with the same keys
PLATFORMS = {"cpu": "cpu", "gpu": "cuda"}  # as JAX calls them


def choose_device(device: str) -> None:
    """Compute on "cpu" or "gpu" in this process and in those that it starts.

    A CPU's programs are dispatched asynchronously, which is JAX's default: the client looks after a program's outputs
    while it runs already. `JAX_CPU_ENABLE_ASYNC_DISPATCH=0` changes that and no number.

    Raises:
        InputError: there is no such device, this process has computed on another one, or JAX is set to numbers or keys
            that csac does not compute with.
    """
    if device not in PLATFORMS:
        raise InputError(f"device must be cpu or gpu, not {device!r}")
    config: Any = jax.config
    if config.jax_enable_x64:
        raise InputError("csac computes in 32 bits and JAX is set to 64: unset JAX_ENABLE_X64 (jax_enable_x64)")
    if config.jax_default_prng_impl != PRNG:
        raise InputError(f"csac's keys are of JAX's {PRNG}: unset JAX_DEFAULT_PRNG_IMPL (jax_default_prng_impl)")
    before = config.jax_platforms
    jax.config.update("jax_platforms", PLATFORMS[device])
    try:
        chosen = jax.default_backend()
    except Exception as error:  # which one depends on what is missing, and on JAX's version
        jax.config.update("jax_platforms", before)
        hint = "pip install '.[cuda]' in a clone of csac, or choose the cpu"
        raise InputError(f"no GPU that JAX can use: {hint}") from error
    if chosen != device:
        jax.config.update("jax_platforms", before)
        raise InputError(f"this process computes on the {chosen} already: train on the {device} in a new one")
    os.environ["JAX_PLATFORMS"] = PLATFORMS[device]  # for the workers
