"""Exploration noise: standard normal at each step, and over steps independent (white) or correlated (pink, ou).

Correlated noise is a weighted sum of draws that neighbouring steps share. The keys of these draws follow from the step
number: nothing is carried from step to step, so nothing has to be restored.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from csac.algorithms.shapes import Action, Count, Key

Noise: TypeAlias = Literal["white", "pink", "ou"]

OCTAVES = 11  # of pink noise: draws held for 1, 2, 4, ... 1024 steps, all with the same weight (Voss 1978)
PULL = 0.15  # of Ornstein-Uhlenbeck noise towards 0 per step (theta of DDPG, Lillicrap et al. 2016)
FIRST_FREE = np.uint32(2**31)  # for fold_in: larger than any step number
WINDOW = 64  # past steps that Ornstein-Uhlenbeck noise sums: (1 - PULL)^64 is 3e-5


def keys_at(noise: Noise, key: Key, step: Count) -> Key:
    """Return the keys [n] of the draws that correlated noise sums at a step; `key` is the same at all steps."""
    if noise == "ou":
        return jax.vmap(jax.random.fold_in, (None, 0))(key, step - jnp.arange(WINDOW))
    lengths = 2 ** jnp.arange(OCTAVES)
    indices = (step + lengths // 2) // lengths  # offset by half a length each, so that few are redrawn at the same step
    octaves = jax.vmap(jax.random.fold_in, (None, 0))(key, lengths)
    return jax.vmap(jax.random.fold_in)(octaves, indices)


def keys_of(noise: Noise, run: Key, step: Count, environments: int) -> Key:
    """Return `keys_at` for each environment, [environment, n], after `step` steps in all; `run` is the run's key."""
    numbers = FIRST_FREE + jnp.arange(environments, dtype=jnp.uint32)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(run, numbers)
    return jax.vmap(lambda key: keys_at(noise, key, step // environments))(keys)


def noise_of(noise: Noise, key: Key, size: int) -> Action:
    """Return standard normal noise [size]; `key` is the step's own for white noise, else what `keys_at` returns."""
    if noise == "white":
        return jax.random.normal(key, (size,))
    draws = jax.vmap(lambda one: jax.random.normal(one, (size,)))(key)
    weights = (1.0 - PULL) ** jnp.arange(WINDOW) if noise == "ou" else jnp.ones(OCTAVES)
    return weights @ draws / jnp.sqrt(jnp.sum(weights**2))


def uniform_of(noise: Noise, key: Key, size: int) -> Action:
    """Return this noise mapped to uniform in [-1, 1] by 2 Φ(x) - 1, with Φ the normal distribution function."""
    return jax.scipy.special.erf(noise_of(noise, key, size) / math.sqrt(2.0))
