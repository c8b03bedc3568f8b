"""Changes of a task in the middle of training: friction and other physics of MuJoCo tasks, and noise on any task.

What a perturbation with step S changes is every environment step after the first S: the step that makes S + 1 is the
first that differs, and an evaluation at step S still shows the task as it was.
"""

from __future__ import annotations

import copy
import difflib
import itertools
import math
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

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
KINDS = (*PHYSICS, *NOISES)

_EXAMPLE = "friction=1.5@300000"


@dataclass(frozen=True)
class Perturbation:
    """One change of a task after `step` environment steps, written `KIND=VALUE@STEP`; without `@STEP` from the start.

    `value` is a factor on the task's own physics (`friction`, `gravity`, `mass`, `gain`), never on an earlier
    perturbation's, or a standard deviation: of `observation_noise` in units of the observation, of `action_noise` in
    those of an action in [-1, 1].

    Raises:
        InputError: no such kind, or a value or step that it cannot have.
    """

    kind: str
    value: float
    step: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            similar = difflib.get_close_matches(str(self.kind), KINDS, n=1)
            hint = f"did you mean {similar[0]}? " if similar else ""
            raise InputError(f"no perturbation is called {self.kind!r}: {hint}there are {', '.join(KINDS)}")
        is_number = isinstance(self.value, int | float | np.number) and not isinstance(self.value, bool)
        what = "factor" if self.kind in PHYSICS else "standard deviation"
        if self.kind == "mass" and not (is_number and 0 < self.value < math.inf):
            raise InputError(f"mass takes a finite factor above 0, not {self.value!r}")
        if not (is_number and 0 <= self.value < math.inf):
            raise InputError(f"{self.kind} takes a finite {what} of 0 or more, not {self.value!r}")
        if isinstance(self.step, bool) or not isinstance(self.step, int | np.integer) or self.step < 0:
            raise InputError(f"the step of {self.kind} must be a whole number of 0 or more, not {self.step!r}")
        object.__setattr__(self, "value", float(self.value))
        object.__setattr__(self, "step", int(self.step))

    @classmethod
    def parse(cls, text: str) -> Perturbation:
        """Return the perturbation that `KIND=VALUE@STEP` or `KIND=VALUE` describes. Raises InputError."""
        kind, equals, rest = text.strip().partition("=")
        value, at, step = rest.partition("@")
        if not equals or not value or (at and not step):
            raise InputError(f"a perturbation is written KIND=VALUE or KIND=VALUE@STEP, as {_EXAMPLE}, not {text!r}")
        return cls(kind.strip().replace("-", "_"), _number(value, text), _step(step, text) if at else 0)

    def __str__(self) -> str:
        return f"{self.kind}={_plain(self.value)}" + (f"@{self.step}" if self.step else "")

    @property
    def label(self) -> str:
        """What it does, in few words: `friction x 1.5`, `observation noise 0.1`."""
        return (
            f"{self.kind} x {self.value:g}" if self.kind in PHYSICS else f"{self.kind.replace('_', ' ')} {self.value:g}"
        )


def perturbations_of(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations, written out or not, in the order of their steps.

    Raises:
        InputError: one is not what it should be, or two of one kind have the same step.
    """
    several = (given,) if isinstance(given, str | Perturbation) else given
    parsed = [Perturbation.parse(item) if isinstance(item, str) else item for item in several]
    for item in parsed:
        if not isinstance(item, Perturbation):
            raise InputError(f"{item!r} is no perturbation: write it as {_EXAMPLE!r}, or make a Perturbation")
    parsed.sort(key=lambda item: (item.step, KINDS.index(item.kind)))
    for first, second in itertools.pairwise(parsed):
        if (first.kind, first.step) == (second.kind, second.step):
            raise InputError(f"{first} and {second} are of the same kind and step: give one of them")
    return tuple(parsed)


def lasting(given: str | Perturbation | Iterable[str | Perturbation]) -> tuple[Perturbation, ...]:
    """As `perturbations_of`, where nothing is learnt and so there is no step to wait for. Raises InputError."""
    perturbations = perturbations_of(given)
    for item in perturbations:
        if item.step:
            raise InputError(f"{item}: nothing is learnt here, so it holds from the beginning: leave out @{item.step}")
    return perturbations


def values_at(perturbations: Iterable[Perturbation], step: int) -> dict[str, float]:
    """Return the value of each kind that the environment step after the first `step` ones has."""
    ordered = sorted(perturbations, key=lambda item: item.step)
    return {item.kind: item.value for item in ordered if item.step <= step}


def continued(before: Sequence[Perturbation], given: Sequence[Perturbation], begin: int) -> tuple[Perturbation, ...]:
    """Return the perturbations of a run that goes on at step `begin` from one that had those of `before`.

    What happened before that step stays; what comes from it on is as `given`.

    Raises:
        InputError: a given one lies before `begin` and was not there.
    """
    past = [item for item in before if item.step < begin]
    for item in given:
        if item.step < begin and item not in past:
            later = Perturbation(item.kind, item.value, begin)
            raise InputError(f"{item} lies before step {begin}, where this run begins: write {later}, or a later step")
    return perturbations_of([*past, *(item for item in given if item.step >= begin)])


def refuse_late(perturbations: Iterable[Perturbation], steps: int, planned: bool = False) -> None:
    """Raise InputError for what would only change steps that a run of `steps` does not make.

    Those that were `planned` in the run that this one begins with have nobody who asked for them now.
    """
    for item in perturbations:
        if item.step >= steps:
            hint = "was planned in the run that this one begins with: --perturb none leaves that out" if planned else ""
            raise InputError(
                f"{item} would change nothing: the run ends at step {steps}; {hint or 'give an earlier step'}"
            )


def by_step(perturbations: Iterable[Perturbation]) -> list[tuple[int, str]]:
    """Return (step, what changes there in few words) for each step at which something does, in order."""
    labels: dict[int, list[str]] = {}
    for item in perturbations_of(perturbations):
        labels.setdefault(item.step, []).append(item.label)
    return [(step, ", ".join(texts)) for step, texts in labels.items()]


class Physics:
    """The model of a MuJoCo task, scaled. Factors are on what the model was when this object was made.

    A reset leaves it scaled, since it only renews the state.

    Raises:
        InputError: not a MuJoCo task.
    """

    def __init__(self, environment: gymnasium.Env, task_name: str) -> None:
        self._mujoco: Any = sys.modules.get("mujoco")  # a task that it simulates has imported it
        self._model: Any = getattr(environment.unwrapped, "model", None)
        if self._mujoco is None or not isinstance(self._model, self._mujoco.MjModel):
            raise InputError(
                f"{task_name} is no MuJoCo task: {', '.join(PHYSICS)} cannot be changed, and {' and '.join(NOISES)} can"
            )
        self._task_name = task_name
        self._original = copy.copy(self._model)
        self._factors = dict.fromkeys(PHYSICS, 1.0)

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
            raise InputError(f"{self._task_name} has actuators such as muscles, whose gain is more than a factor")


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

    def take_back(self, state: Mapping[str, Any]) -> None:
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


def _number(text: str, whole: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{whole}: {text!r} is not a number; write it as {_EXAMPLE}") from None


def _step(text: str, whole: str) -> int:
    """Return a step, which may be written 3e5 too."""
    try:
        value = int(text) if text.strip("+-_ 0123456789") == "" else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value != int(value):
        raise InputError(f"{whole}: {text!r} is not a whole number of steps; write it as {_EXAMPLE}")
    return int(value)


def _plain(value: float) -> str:
    """Return the shortest text that gives the number back."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
