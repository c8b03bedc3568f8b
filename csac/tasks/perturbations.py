"""Perturbations of a task during training: friction and other physics of MuJoCo tasks, and noise on any task.

A perturbation with step S changes every environment step after the first S: step S + 1 is the first that differs, and
an evaluation at step S still uses the task as it was before.
"""

from __future__ import annotations

import copy
import itertools
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_whole
from csac.record.config import STEPS_LIMIT
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import gymnasium

# The arrays of MjModel that each kind scales. Pairs are contacts that a model lists explicitly; their friction replaces
# that of their geoms. No Gymnasium task has any.
_SCALED = {
    "friction": ("geom_friction", "pair_friction"),
    "gravity": ("opt.gravity",),
    "mass": ("body_mass", "body_inertia"),
    "gain": ("actuator_gainprm", "actuator_biasprm"),
}
PHYSICS = tuple(_SCALED)
NOISES = ("observation_noise", "action_noise")
KINDS = (*PHYSICS, *NOISES)

_EXAMPLE = "friction=1.5@300000"


@dataclass(frozen=True)
class Perturbation:
    """A change of a task after `step` environment steps, written `KIND=VALUE@STEP`; without `@STEP` from the start.

    `value` is a factor on the unperturbed physics (`friction`, `gravity`, `mass`, `gain`), whatever earlier
    perturbations did, or a standard deviation: of `observation_noise` in units of the observation, of `action_noise`
    in units of an action in [-1, 1].
    """

    kind: str
    value: float
    step: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"no perturbation is called {self.kind!r}: there are {', '.join(KINDS)}")
        check_whole(f"the step of {self.kind}", self.step, 0, STEPS_LIMIT)
        number = math.nan if isinstance(self.value, bool) or not isinstance(self.value, Real) else float(self.value)
        if not 0 <= number < math.inf or (self.kind == "mass" and not number):
            what = "factor" if self.kind in PHYSICS else "standard deviation"
            least = "above 0" if self.kind == "mass" else "of 0 or more"
            raise InputError(f"{self.kind} takes a finite {what} {least}, not {number}")
        object.__setattr__(self, "value", number)
        object.__setattr__(self, "step", int(self.step))

    @classmethod
    def parse(cls, text: str) -> Perturbation:
        """Return the perturbation that `KIND=VALUE@STEP` or `KIND=VALUE` describes. Raise InputError if malformed."""
        kind, _, rest = text.partition("=")
        value, at, step = rest.partition("@")
        try:
            number, begin = float(value), float(step) if at else 0.0
        except ValueError:
            raise InputError(
                f"a perturbation is written KIND=VALUE or KIND=VALUE@STEP, as {_EXAMPLE}, not {text!r:.60}"
            ) from None
        begin = int(begin) if begin.is_integer() else begin  # a step may be written as 3e5
        return cls(kind.strip().replace("-", "_"), number, begin)  # pyright: ignore[reportArgumentType]

    def __str__(self) -> str:
        return f"{self.kind}={repr(self.value).removesuffix('.0')}" + (f"@{self.step}" if self.step else "")

    @property
    def label(self) -> str:
        """A short description: `friction x 1.5`, `observation noise 0.1`."""
        times = "x " if self.kind in PHYSICS else ""
        return f"{self.kind.replace('_', ' ')} {times}{self.value:g}"


def unlike_training(trained: Iterable[str | Perturbation]) -> list[str]:
    """Return a line saying that an unperturbed test differs from its perturbed training; [] if that was unperturbed."""
    listed = ", ".join(map(str, perturbations_of(trained)))
    return [f"not perturbed, unlike its training ({listed})"] if listed else []


def perturbations_of(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations, given as text or objects, sorted by step. Raise InputError for invalid ones."""
    several = [given] if isinstance(given, str | Perturbation) or not isinstance(given, Iterable) else given
    parsed = [Perturbation.parse(item) if isinstance(item, str) else item for item in several]
    if not all(isinstance(item, Perturbation) for item in parsed):
        raise InputError(f"perturbations are a list such as [{_EXAMPLE!r}], not {given!r:.40}")
    parsed.sort(key=lambda item: (item.step, KINDS.index(item.kind)))
    for first, second in itertools.pairwise(parsed):
        if (first.kind, first.step) == (second.kind, second.step):
            raise InputError(f"{first} and {second} are of the same kind and step: give one of them")
    return tuple(parsed)


def constant_perturbations(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """Return the perturbations of an evaluation, which hold throughout. Raise InputError for one with a step."""
    perturbations = perturbations_of(given)
    for item in perturbations:
        if item.step:
            raise InputError(f"{item}: nothing is learnt here, so it holds from the beginning: leave out @{item.step}")
    return perturbations


def values_at(perturbations: Iterable[Perturbation], step: int) -> dict[str, float]:
    """Return the values by kind that are in force after `step` environment steps."""
    ordered = sorted(perturbations, key=lambda item: item.step)
    return {item.kind: item.value for item in ordered if item.step <= step}


def continued(before: Sequence[Perturbation], given: Sequence[Perturbation], begin: int) -> tuple[Perturbation, ...]:
    """Return the perturbations of a fork at step `begin`: those of `before` until then, the `given` ones from there on.

    Raise InputError for a given one with an earlier step that the source run did not have.
    """
    past = [item for item in before if item.step < begin]
    for item in given:
        if item.step < begin and item not in past:
            raise InputError(f"{item} lies before step {begin}, where this run begins: give that step, or a later one")
    return perturbations_of([*past, *(item for item in given if item.step >= begin)])


def refuse_late(perturbations: Iterable[Perturbation], steps: int) -> None:
    """Raise InputError for a perturbation that starts only when a run of `steps` is over."""
    for item in perturbations:
        if item.step >= steps:
            hint = "give an earlier step, or --perturb none"
            raise InputError(f"{item} would change nothing: the run ends at step {steps}; {hint}")


def by_step(perturbations: Iterable[Perturbation]) -> list[tuple[int, str]]:
    """Return (step, labels of the perturbations that start there), in order of the steps."""
    groups = itertools.groupby(perturbations_of(perturbations), attrgetter("step"))
    return [(step, ", ".join(item.label for item in group)) for step, group in groups]


class Physics:
    """Scales the physics of a MuJoCo task. Factors are relative to the model at the time this object is created.

    The scaling survives resets that only renew the state, as those of Gymnasium's tasks do; `undone` checks this.
    """

    def __init__(self, environment: gymnasium.Env, task_name: str) -> None:
        self._environment: Any = environment.unwrapped
        self._mujoco: Any = sys.modules.get("mujoco")  # a MuJoCo task has imported it
        self._model: Any = getattr(self._environment, "model", None)
        if self._mujoco is None or not isinstance(self._model, self._mujoco.MjModel):
            raise InputError(f"{task_name} is no MuJoCo task: of it only {' and '.join(NOISES)} can be perturbed")
        self._task_name = task_name
        self._original = copy.copy(self._model)
        self._factors = dict.fromkeys(PHYSICS, 1.0)

    def set(self, factors: Mapping[str, float]) -> None:
        """Scale the model from the next step on; a kind that is missing has the factor 1.

        Raise InputError if `gain` is to change and an actuator's gain is not proportional to its parameters.
        """
        wanted = {**dict.fromkeys(PHYSICS, 1.0), **factors}
        changed = {kind: factor for kind, factor in wanted.items() if factor != self._factors[kind]}
        if "gain" in changed:
            self._refuse_nonlinear_actuators()
        for kind, factor in changed.items():
            for name in _SCALED[kind]:
                attrgetter(name)(self._model)[...] = attrgetter(name)(self._original) * factor
        if "mass" in changed:
            self._renew_constants()
        self._factors = wanted

    def undone(self) -> str | None:
        """Return an error message if a reset has undone the scaling, else None.

        Tasks that randomise their physics at each reset do so. The check takes a few microseconds.
        """
        factors = {kind: factor for kind, factor in self._factors.items() if factor != 1.0}
        scaled = ((attrgetter(name), factor) for kind, factor in factors.items() for name in _SCALED[kind])
        is_same = not factors or getattr(self._environment, "model", None) is self._model
        if is_same and all((of(self._model) == of(self._original) * factor).all() for of, factor in scaled):
            return None
        return f"{self._task_name} sets its own physics at reset: {' and '.join(factors)} cannot be perturbed"

    def _renew_constants(self) -> None:
        """Recompute the model constants derived from masses, using separate MjData to leave the episode untouched."""
        model, original = self._model, self._original
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))
        # Only MuJoCo's compiler sets the mean of the mass matrix's diagonal, a scale of the solver's tolerance.
        ratio = model.dof_M0.mean() / original.dof_M0.mean() if model.nv else 1.0
        model.stat.meaninertia = original.stat.meaninertia * ratio

    def _refuse_nonlinear_actuators(self) -> None:
        gains, biases = self._mujoco.mjtGain, self._mujoco.mjtBias
        is_linear = np.isin(self._model.actuator_gaintype, [int(gains.mjGAIN_FIXED), int(gains.mjGAIN_AFFINE)])
        is_linear &= np.isin(self._model.actuator_biastype, [int(biases.mjBIAS_NONE), int(biases.mjBIAS_AFFINE)])
        if not is_linear.all():
            raise InputError(f"{self._task_name} has actuators, such as muscles, whose gain cannot be scaled")


class Noise:
    """Gaussian noise for one environment, drawn from generators that each episode's reset seed determines.

    There is one generator per kind, so that the kinds are independent. Snapshots contain the generators.
    """

    def __init__(self) -> None:
        self._levels: dict[str, float] = {}
        self._generators: dict[str, np.random.Generator] = {}

    def set(self, levels: Mapping[str, float], seed: int | None) -> None:
        """Use these standard deviations from now on, in an episode that was reset with `seed`."""
        self._levels = dict(levels)
        if seed is not None:
            self._generators = {**_generators(levels, seed), **self._generators}

    def begin(self, seed: int) -> None:
        """Start an episode that is reset with `seed`."""
        self._generators = _generators(self._levels, seed)

    def on_observation(self, observation: np.ndarray) -> np.ndarray:
        """Return a float32 [observation] with noise added."""
        return self._noisy("observation_noise", observation, 1.0)

    def on_action(self, action: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a flat action on the environment's scale with noise added, clipped to the bounds [action]."""
        if not self._levels.get("action_noise"):
            return action
        return np.clip(self._noisy("action_noise", action, 0.5 * high - 0.5 * low), low, high)

    def state(self) -> dict[str, Any]:
        """Return the state of the generators as JSON values."""
        return {kind: generator.bit_generator.state for kind, generator in self._generators.items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Set the generators to a `state` saved earlier."""
        for kind in self._generators.keys() & state.keys():
            self._generators[kind].bit_generator.state = state[kind]

    def _noisy(self, kind: str, values: np.ndarray, unit: np.ndarray | float) -> np.ndarray:
        level = self._levels.get(kind)
        if not level:
            return values
        noise = self._generators[kind].standard_normal(values.shape, dtype=np.float32)
        return (values + np.float32(level) * unit * noise).astype(np.float32)


def _generators(kinds: Iterable[str], seed: int) -> dict[str, np.random.Generator]:
    """Return a generator for each kind, with a stream separate from those of the task and of a stochastic policy."""
    return {kind: np.random.default_rng([seed, 1 + NOISES.index(kind)]) for kind in kinds}
