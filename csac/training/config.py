"""Build the configurations of runs from a user's options: resolve names, check values, try the task once."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from csac.algorithms import ALGORITHMS
from csac.checks import check_arguments, check_whole, did_you_mean
from csac.evaluation.evaluator import LONGEST_EPISODE
from csac.record.config import SEED_LIMIT, RunConfig, as_json
from csac.synonyms import argument_hint
from csac.tasks.environment import Environment
from csac.tasks.perturbations import Perturbation, perturbations_of, refuse_late
from csac.tasks.preflight import limit_warning, seed_warning, try_task, wrapper_warnings
from csac.tasks.registry import check_events, events_of, import_module_of
from csac.tasks.trust import refuse_untrusted, remember
from csac.training.demonstrations import Demonstrations, are_facts
from csac.training.hindsight import check_goals
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from csac.tasks.registry import Task
    from csac.training.demonstrations import DemonstrationData
    from csac.training.resume import Source
    from csac.types import Algorithm, Spec


class TrainOptions(TypedDict, total=False):
    """The keyword arguments of `train` that define what a run computes; `RunConfig` documents them."""

    steps: int
    environments: int
    device: Literal["cpu", "gpu", "cuda"]
    evaluation_interval: int
    evaluation_episodes: int
    evaluation_environments: int
    evaluation_seed: int
    checkpoint_interval: int
    keep_checkpoints: int
    environment_arguments: dict[str, Any] | None
    perturbations: str | Perturbation | Iterable[str | Perturbation] | None
    events: Sequence[str] | None
    hindsight: int
    demonstrations: DemonstrationData | None


RUN_OPTIONS = tuple(TrainOptions.__annotations__)
MOST_SEEDS = 10_000
PROTOCOL = ("cadence", "memory", "init", "act", "update", "policy")  # `csac.types.Algorithm`


def make_configs(
    algorithm: Algorithm, task: Task, seeds: Sequence[int], given: TrainOptions, source: Source | None
) -> tuple[list[RunConfig], Demonstrations | None, Spec, list[str]]:
    """Return each seed's configuration, the demonstrations, the task's sizes, and notes for the user.

    The task is created, stepped and perturbed once. Raises InputError for invalid options, or a task that csac cannot
    learn.
    """
    _refuse_unknown(given, algorithm)
    options: Any = dict(given)
    arguments = options.pop("environment_arguments", None)
    check_arguments("environment_arguments", arguments)
    arguments = as_json("environment_arguments", dict(arguments or {}))
    perturbations, events = options.pop("perturbations", None), options.pop("events", None)
    if events is not None:
        check_events(events)
    if source and events is None:
        events = next(iter(source.runs.values())).config.events
    else:
        events = events_of(task, events or ())
    data, demonstrations = options.pop("demonstrations", None), None
    hyperparameters = dataclasses.asdict(algorithm)  # pyright: ignore[reportArgumentType]
    with closing(Environment(task, arguments)) as environment:
        spec, name = environment.spec, environment.task_name
        try_task(environment, arguments)
        facts = data if are_facts(data) else {}
        if data and not facts:
            if source:
                raise InputError("demonstrations are for a new run: a fork has the replay that it begins with")
            demonstrations = Demonstrations.read(data, algorithm, environment.contract_parts)
            facts = demonstrations.facts
        task_warnings = seed_warning(environment), limit_warning(environment, task, LONGEST_EPISODE)
        notes = [*wrapper_warnings(environment), *filter(None, task_warnings)]
        remember(task)
        remember(name_of(algorithm))
        perturbation_texts = tuple(map(str, perturbations_of(perturbations or ())))
        configs = [
            RunConfig(
                task=name,
                algorithm=name_of(algorithm),
                hyperparameters=hyperparameters,
                seed=seed,
                environment_arguments=arguments,
                perturbations=source.perturbations(seed, perturbations) if source else perturbation_texts,
                demonstrations=source.runs[seed].config.demonstrations if source else facts,
                events=tuple(events),
                task_is_callable=not isinstance(task, str),
                **options,
            )
            for seed in seeds
        ]
        if configs[0].hindsight:
            check_goals(algorithm, environment)
        changes = perturbations_of(configs[0].perturbations)
        refuse_late(changes, configs[0].steps)
        for item in changes:
            environment.perturb({item.kind: item.value})
    spec = spec._replace(environments=configs[0].environments)
    return configs, demonstrations, spec, [f"note: {line}" for line in notes]


def seed_range(seeds: int, first_seed: int) -> list[int]:
    """Return the seeds from `first_seed` on. Raises InputError if there are none or too many."""
    check_whole("seeds", seeds, 1, MOST_SEEDS)
    check_whole("first_seed", first_seed, 0, SEED_LIMIT - seeds)
    return list(range(first_seed, first_seed + seeds))


def name_of(algorithm: Algorithm) -> str:
    """Return an algorithm's name in the manifest: a key of `ALGORITHMS`, or `module:Class` if it is user-defined."""
    kind = type(algorithm)
    return next((name for name, own in ALGORITHMS.items() if own is kind), f"{kind.__module__}:{kind.__qualname__}")


def class_named(name: str) -> Any:
    """Return the algorithm class of a name; imports the module of `module:Class`, so check that it is trusted first.

    Raises InputError if there is no such class, or it cannot be imported.
    """
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    module, _, kind = name.rpartition(":")
    if not module:
        raise InputError(f"the algorithm {name!r} is unknown: {' or '.join(ALGORITHMS)} are known, or module:Class")
    if module == "__main__" or "." in kind:
        raise InputError(f"no module can give {name}: call csac.train with the algorithm and resume=True")
    found = getattr(import_module_of(name), kind, None)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise InputError(f"the module {module} has no algorithm {kind}, a dataclass")
    return found


def class_typed(name: str) -> Any:
    """Return the class `module:Class` that the user typed. Raises InputError too if a field has no default."""
    kind = class_named(name)
    for item in dataclasses.fields(kind):
        if item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise InputError(f"{item.name} of {name} has no default: each option needs one")
    check_algorithm(kind())
    return kind


def algorithm_of(config: RunConfig, run: str | Path = "the run", trust_task: bool = False) -> Algorithm:
    """Return the algorithm of a run with its hyperparameters; a user-defined one only if its module is trusted.

    Raises InputError if this csac does not know them, or if nobody on this machine has named the module, which is then
    not imported.
    """
    refuse_untrusted(config.algorithm if config.algorithm not in ALGORITHMS else "", run, trust_task)
    make = class_named(config.algorithm)
    unknown = config.hyperparameters.keys() - {item.name for item in dataclasses.fields(make)}
    if unknown:
        raise InputError(f"the run has unknown hyperparameters: {', '.join(sorted(unknown))}")
    algorithm = make(**{name: tuple(v) if isinstance(v, list) else v for name, v in config.hyperparameters.items()})
    check_algorithm(algorithm)
    return algorithm


def check_algorithm(algorithm: Any) -> None:
    """Raise InputError unless this is an instance of a valid algorithm, rather than a name or a class."""
    if isinstance(algorithm, type) or not (dataclasses.is_dataclass(algorithm) and hasattr(algorithm, "update")):
        text = algorithm.__name__ if isinstance(algorithm, type) else str(algorithm)
        names = {name: kind.__name__ for name, kind in ALGORITHMS.items()}
        raise InputError(f"{text:.60} is no algorithm with hyperparameters: give {names.get(text.lower(), 'CSAC')}()")
    kind: Any = type(algorithm)
    if not kind.__dataclass_params__.frozen:
        raise InputError(f"{kind.__name__} must be a frozen dataclass: write @dataclass(frozen=True)")
    if missing := [name for name in PROTOCOL if not hasattr(algorithm, name)]:
        raise InputError(
            f"{kind.__name__} has no {' or '.join(missing)}, which an algorithm needs (csac.types.Algorithm)"
        )
    for item in dataclasses.fields(algorithm):
        if dataclasses.is_dataclass(getattr(algorithm, item.name)):
            raise InputError(
                f"{item.name} of {kind.__name__} cannot be kept in a manifest: use numbers, texts and tuples"
            )


def _refuse_unknown(given: TrainOptions, algorithm: Algorithm) -> None:
    for name in given:
        if name in RUN_OPTIONS:
            continue
        hint = argument_hint(name, RUN_OPTIONS) or did_you_mean(name, RUN_OPTIONS)
        if name in (item.name for item in dataclasses.fields(algorithm)):  # pyright: ignore[reportArgumentType]
            hint = f"it is a hyperparameter, as in {type(algorithm).__name__}({name}=...)"
        raise InputError(f"train takes no {name}" + (f": {hint}" if hint else ""))
