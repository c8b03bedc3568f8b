"""What a perturbation does to a task: a MuJoCo model that is scaled, noise on observations and actions."""

from __future__ import annotations

import copy
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import gymnasium

# The arrays of MjModel that are multiplied. The pairs are contacts that a model lists one by one: their friction
# replaces that of their geoms. No task of Gymnasium's has any.
_SCALED = {
    "friction": ("geom_friction", "pair_friction"),
    "gravity": ("opt.gravity",),
    "mass": ("body_mass", "body_inertia"),
    "gain": ("actuator_gainprm", "actuator_biasprm"),
}
PHYSICS = tuple(_SCALED)
NOISES = ("observation_noise", "action_noise")


class Physics:
    """The model of a MuJoCo task, scaled. Factors are on what the model was when this object was made.

    A reset leaves it scaled where it only renews the state, as those of Gymnasium's tasks do; `undone` finds out.

    Raises:
        InputError: not a MuJoCo task.
    """

    def __init__(self, environment: gymnasium.Env, task_name: str) -> None:
        self._environment: Any = environment.unwrapped
        self._mujoco: Any = sys.modules.get("mujoco")  # a task that it simulates has imported it
        self._model: Any = getattr(self._environment, "model", None)
        if self._mujoco is None or not isinstance(self._model, self._mujoco.MjModel):
            raise InputError(f"{task_name} is no MuJoCo task: of it only {' and '.join(NOISES)} can be perturbed")
        self._task_name = task_name
        self._original = copy.copy(self._model)
        self._factors = dict.fromkeys(PHYSICS, 1.0)
        self._scaled: dict[str, np.ndarray] = {}  # what was written of the kinds whose factor is not 1, by its array

    def set(self, factors: Mapping[str, float]) -> None:
        """Scale the model from the next step on; a kind that is not named has the factor 1.

        Raises:
            InputError: the actuators have a gain that is not proportional to their parameters.
        """
        wanted = {**dict.fromkeys(PHYSICS, 1.0), **factors}
        changed = {kind: factor for kind, factor in wanted.items() if factor != self._factors[kind]}
        if "gain" in changed:
            self._refuse_curved_actuators()
        for kind, factor in changed.items():
            for name in _SCALED[kind]:
                _array(self._model, name)[...] = _array(self._original, name) * factor
        if "mass" in changed:
            self._renew_constants()
        self._factors = wanted
        names = (name for kind, factor in wanted.items() if factor != 1.0 for name in _SCALED[kind])
        self._scaled = {name: _array(self._model, name).copy() for name in names}

    def undone(self) -> str | None:
        """Return what to say where a reset has taken back what was scaled, and None where it has not.

        A task does so that draws other physics for each episode. To see it takes a few microseconds.
        """
        is_same = not self._scaled or getattr(self._environment, "model", None) is self._model
        if is_same and all((_array(self._model, name) == array).all() for name, array in self._scaled.items()):
            return None
        kinds = " and ".join(kind for kind, factor in self._factors.items() if factor != 1.0)
        return f"{self._task_name} sets its own physics at reset: {kinds} cannot be perturbed"

    def _renew_constants(self) -> None:
        """Have MuJoCo derive anew what it derives of masses, with data of its own: the episode's is not touched."""
        model, original = self._model, self._original
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))
        # The mean of the mass matrix's diagonal, a scale of the solver's tolerance, which only the compiler sets.
        ratio = model.dof_M0.mean() / original.dof_M0.mean() if model.nv else 1.0
        model.stat.meaninertia = original.stat.meaninertia * ratio

    def _refuse_curved_actuators(self) -> None:
        gains, biases = self._mujoco.mjtGain, self._mujoco.mjtBias
        straight = np.isin(self._model.actuator_gaintype, [int(gains.mjGAIN_FIXED), int(gains.mjGAIN_AFFINE)])
        straight &= np.isin(self._model.actuator_biastype, [int(biases.mjBIAS_NONE), int(biases.mjBIAS_AFFINE)])
        if not straight.all():
            raise InputError(f"{self._task_name} has actuators, such as muscles, whose gain cannot be scaled")


class Noise:
    """Gaussian noise on one environment, drawn for each episode from generators of its reset seed.

    One generator per kind, so that neither kind changes what the other draws. They are part of a snapshot.
    """

    def __init__(self) -> None:
        self._levels: dict[str, float] = {}
        self._generators: dict[str, np.random.Generator] = {}

    def set(self, levels: Mapping[str, float], seed: int | None) -> None:
        """Have these standard deviations from now on, in an episode that was reset with `seed`."""
        self._levels = dict(levels)
        if seed is not None:
            self._generators = {**_generators(levels, seed), **self._generators}

    def begin(self, seed: int) -> None:
        """Begin an episode that is reset with `seed`."""
        self._generators = _generators(self._levels, seed)

    def on_observation(self, observation: np.ndarray) -> np.ndarray:
        """Return a float32 [observation] with its noise."""
        return self._noisy("observation_noise", observation, 1.0)

    def on_action(self, action: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a flat action on the environment's scale with its noise, within its bounds [action]."""
        if not self._levels.get("action_noise"):
            return action
        return np.clip(self._noisy("action_noise", action, 0.5 * high - 0.5 * low), low, high)

    def state(self) -> dict[str, Any]:
        """Return what JSON can hold of the generators."""
        return {kind: generator.bit_generator.state for kind, generator in self._generators.items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on drawing where `state` was taken."""
        for kind in self._generators.keys() & state.keys():
            self._generators[kind].bit_generator.state = state[kind]

    def _noisy(self, kind: str, values: np.ndarray, unit: np.ndarray | float) -> np.ndarray:
        level = self._levels.get(kind)
        if not level:
            return values
        noise = self._generators[kind].standard_normal(values.shape, dtype=np.float32)
        return (values + np.float32(level) * unit * noise).astype(np.float32)


def _generators(kinds: Iterable[str], seed: int) -> dict[str, np.random.Generator]:
    """Return a generator for each kind, of a stream that neither the task nor a stochastic policy draws from."""
    return {kind: np.random.default_rng([seed, 1 + NOISES.index(kind)]) for kind in kinds}


def _array(model: Any, name: str) -> np.ndarray:
    first, _, rest = name.partition(".")
    return getattr(getattr(model, first), rest) if rest else getattr(model, first)
