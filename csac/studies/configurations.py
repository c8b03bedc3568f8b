"""What runs were given, and the labels that this gives them: what tells them apart from others of their name."""

from __future__ import annotations

import dataclasses
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from csac.presets import PRESETS, hyperparameters
from csac.studies.sections import plain
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.record.manifest import Manifest
    from csac.studies.arms import Arm

LENGTH = "steps"
FITTED = ("warmup_steps", "replay_size")  # to the length of a run, whatever preset it follows


def filled_in(manifests: Sequence[Manifest | None]) -> list[Manifest | None]:
    """Return the manifests, with the default of each hyperparameter that an older run beside a newer one has not got.

    That is what it did. One that this version does not understand stays as it is.
    """
    names: dict[str, set[frozenset[str]]] = {}
    for one in filter(None, manifests):
        names.setdefault(one.config.algorithm, set()).add(frozenset(one.config.hyperparameters))
    return [_complete(one) if one and len(names[one.config.algorithm]) > 1 else one for one in manifests]


def _complete(manifest: Manifest) -> Manifest:
    from csac.studies.cells import complete  # which imports JAX

    with suppress(InputError):
        known = complete(manifest.config.algorithm, manifest.config.hyperparameters)
        config = dataclasses.replace(manifest.config, hyperparameters=known)
        return dataclasses.replace(manifest, config=config)
    return manifest


def name_of(manifest: Manifest) -> str:
    """Return the algorithm, the preset that a run follows, if any, and what was fitted to its length beside that."""
    name, own = manifest.config.algorithm.upper(), manifest.config.hyperparameters
    if manifest.preset:
        return f"{name} ({manifest.preset})"
    for preset in PRESETS:
        with suppress(InputError):  # of a preset that says nothing of the algorithm
            given = hyperparameters(preset, manifest.config.algorithm, manifest.config.task)
            fitted = {item: own[item] for item in FITTED if item in own and plain(own[item]) != plain(given.get(item))}
            if fitted and _follows(manifest, {**given, **fitted}):
                return ", ".join([f"{name} ({preset})", *(f"{item} {plain(value)}" for item, value in fitted.items())])
    return name


def _follows(manifest: Manifest, given: Mapping[str, Any]) -> bool:
    """Whether a run has these hyperparameters, and the default of each other one."""
    own = manifest.config.hyperparameters
    if any(plain(own.get(name)) != plain(value) for name, value in given.items()):
        return False
    from csac.studies.cells import complete  # which imports JAX

    whole = complete(manifest.config.algorithm, given)
    return all(plain(whole.get(name)) == plain(value) for name, value in own.items())


def settings_of(manifest: Manifest) -> dict[str, Any]:
    """Return what a run was given that its numbers depend on, beside task, algorithm and perturbations."""
    settings = {**manifest.config.hyperparameters, LENGTH: manifest.config.steps}
    settings |= {
        "evaluation interval": manifest.config.evaluation_interval,
        "evaluation episodes": manifest.config.evaluation_episodes,
        "evaluation seed": manifest.config.evaluation_seed,
    }
    settings |= {f"environment: {name}": value for name, value in manifest.config.environment_arguments.items()}
    return settings


def merged(several: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the settings of an arm; of one that is not the same in all its runs, every value that it has."""
    told = {
        name: "; ".join(dict.fromkeys(plain(settings.get(name)) or "none" for settings in several))
        for name in differing(several)
    }
    return {**several[0], **told}


def differing(several: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the settings that are not the same in all of these, one that is missing among them."""
    names = dict.fromkeys(name for settings in several for name in settings)
    return [name for name in names if len({plain(settings.get(name)) for settings in several}) > 1]


def labels(arms: Sequence[Arm], names: Sequence[str]) -> list[str]:
    """Return the label of each arm: its own, or its name, and how it differs from arms of that name beside it.

    What tells arms apart on one task is told on every task, so that a method has one label.
    """
    apart = {name: _apart([arm for arm, its in zip(arms, names, strict=True) if its == name]) for name in set(names)}
    return [
        arm.label or ", ".join([name, *(f"{item} {plain(arm.hyperparameters.get(item))}" for item in apart[name])])
        for arm, name in zip(arms, names, strict=True)
    ]


def _apart(arms: Sequence[Arm]) -> list[str]:
    """Return the settings in which any arms on one task differ."""
    places = dict.fromkeys((arm.task, arm.condition) for arm in arms)
    beside = [[arm.hyperparameters for arm in arms if (arm.task, arm.condition) == place] for place in places]
    return list(dict.fromkeys(name for own in beside for name in differing(own)))


def unlike(arms: Sequence[Arm]) -> dict[str, list[str]]:
    """Return the settings in which a label is not the same method on every task; its length is no part of a method."""
    found = {}
    for label in dict.fromkeys(arm.label for arm in arms):
        names = differing([arm.hyperparameters for arm in arms if arm.label == label and arm.hyperparameters])
        if names := [name for name in names if name != LENGTH]:
            found[label] = names
    return found
