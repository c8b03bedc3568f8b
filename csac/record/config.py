"""The configuration of a run: one object that the command line, `train`, the manifest and studies share.

It holds plain values without JAX, so that every part of csac can import it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, Literal

from csac.checks import check_arguments, check_whole
from csac.seeds import EVALUATION_SEED
from csac.types import InputError

STEPS_LIMIT = 2**31 - 1  # learners count their steps in int32
SEED_LIMIT = 2**32  # a random key uses only the lowest 32 bits of a seed
NEVER = 10**15  # an interval longer than any run


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything that determines what one run computes. Steps are environment steps.

    Raises InputError for a number outside its range, or a value that JSON would change.
    """

    task: str
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    algorithm: str = "csac"
    """The algorithm, or module:Class for one of your own; its own options are listed below."""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    """All hyperparameters of the algorithm, so that a later change of a default does not change the run."""
    seed: int = 0
    """Seed of the networks, of exploration, of replay sampling and of the training episodes."""
    steps: int = 1_000_000
    """Environment steps per seed, warm-up included."""
    environments: int = 1
    """Environments that each seed steps in parallel; steps are counted over all of them."""
    device: Literal["cpu", "gpu", "cuda"] = "cpu"
    """Device that the networks are trained on; cuda means gpu."""
    evaluation_interval: int = 5_000
    """Environment steps between evaluations; there is also one at the last step. 0: no evaluations."""
    evaluation_episodes: int = 10
    """Episodes per evaluation."""
    evaluation_environments: int = 10
    """Parallel environments for evaluations, kept open. 0: the training environment, between its episodes."""
    evaluation_seed: int = EVALUATION_SEED
    """Seed of the first evaluation episode; each next episode has the next number."""
    checkpoint_interval: int = 50_000
    """Environment steps between checkpoints; there is also one every ten minutes and at the end. 0: no checkpoints."""
    keep_checkpoints: int = 2
    """Number of newest checkpoints to keep; 0 keeps all."""
    environment_arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments for the environment."""
    perturbations: tuple[str, ...] = ()
    """Changes of the task during training, such as friction=1.5@300000."""
    hindsight: int = 0
    """Copies of each transition, relabelled with goals that its episode reached later (HER); for tasks with goals."""
    demonstrations: dict[str, Any] = field(default_factory=dict)
    """Demonstrations that the replay buffer begins with: origin, number of transitions, and their file's checksum."""
    events: tuple[str, ...] = ()
    """Names in the last `info` of an episode, or NAME:sum and NAME:mean over its steps; each becomes a column of
    evaluations.csv and episodes.csv."""
    task_is_callable: bool = False
    """Whether the task is a Python function, which a manifest cannot name."""

    @property
    def extra_transitions(self) -> int:
        """Upper bound on the transitions that the replay buffer receives beyond those of the steps."""
        return self.steps * self.hindsight + self.demonstrations.get("transitions", 0)

    def __post_init__(self) -> None:
        if self.device == "cuda":
            object.__setattr__(self, "device", "gpu")
        if self.device not in ("cpu", "gpu"):
            raise InputError(f"device must be cpu or gpu, not {self.device!r}")
        for name, least, most in _RANGES:
            check_whole(name, getattr(self, name), least, most)
            object.__setattr__(self, name, int(getattr(self, name)))  # NumPy's are not JSON
        if self.steps % self.environments:
            raise InputError(f"steps must be a multiple of environments, {self.environments}, not {self.steps:,}")
        if self.steps + self.extra_transitions > STEPS_LIMIT:
            raise InputError(f"steps and hindsight make more than {STEPS_LIMIT:,} transitions: give fewer steps")
        for name in ("hyperparameters", "environment_arguments", "demonstrations"):
            object.__setattr__(self, name, as_json(name, getattr(self, name)))
        for name in ("perturbations", "events"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @property
    def title(self) -> str:
        """The algorithm's name in tables and plots: SAC for sac, MySAC for my_module:MySAC."""
        module, _, name = self.algorithm.rpartition(":")
        return name if module else name.upper()


_RANGES = (
    ("seed", 0, SEED_LIMIT - 1),
    ("steps", 1, STEPS_LIMIT),
    ("environments", 1, 1_000),
    ("hindsight", 0, 100),
    ("evaluation_interval", 0, NEVER),
    ("evaluation_episodes", 1, 1_000_000),
    ("evaluation_environments", 0, 10),
    ("evaluation_seed", 0, 2**30 - 1),
    ("checkpoint_interval", 0, NEVER),
    ("keep_checkpoints", 0, NEVER),
)


def as_json(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return keyword arguments as JSON reads them back: tuples become lists, NumPy scalars plain numbers.

    Raises InputError if JSON would change a value, since a resumed run would then not be the same run.
    """
    check_arguments(name, values)
    plain = _plain(values)
    try:
        kept = json.loads(json.dumps(plain), parse_constant=float)  # no NaN is equal to another
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{name} cannot be kept in a manifest: {error}; use numbers, texts, lists and dicts") from None
    if not isinstance(values, dict) or kept != plain:
        raise InputError(f"{name} cannot be kept in a manifest: keys must be texts, no value NaN: {values!r:.60}")
    return kept


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist") and not getattr(value, "shape", None):  # a NumPy scalar
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> list[str]:
    """Return "name is X, not Y" for each value that differs, with one line per hyperparameter or argument."""
    lines = []
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            lines += differences(old, new, f"{name}." if name in ("environment_arguments", "demonstrations") else "")
        elif (old := _plain(old)) != (new := _plain(new)):
            lines.append(f"{prefix}{name} is {old!r}, not {new!r}")
    return lines
