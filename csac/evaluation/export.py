"""A policy leaves its run: written as artefacts, verified, described, and only then put where it was asked for."""

from __future__ import annotations

import dataclasses
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from csac.deploy.artefact import compiler, open_artefact
from csac.deploy.artefact_contract import ArtefactContract, Format, Weights
from csac.deploy.c_size import Size, sizes
from csac.deploy.card import model_card
from csac.deploy.choosing import choose_seed, step_of_policy
from csac.deploy.contract import FLOAT32_MAX, Contract
from csac.deploy.guards import Guards, make_guards
from csac.deploy.policy import Policy
from csac.deploy.writing import CARD, CURVE, check_place, placed, write_artefact, write_contract
from csac.evaluation.verify import Compared, Returns, compare_actions, compare_returns, record, returns_as_fields
from csac.record.atomic import write_atomically
from csac.record.run import RunDirectory, Which
from csac.record.statistics import last_evaluations
from csac.tasks.environment import Environment
from csac.tasks.perturbations import unlike_training
from csac.tasks.trust import refuse_untrusted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from csac.evaluation.verify import Recording
    from csac.tasks.registry import Task

ObservationRange = Literal["bounds", "recorded"]

USUAL_MARGIN = 0.5  # of the width of what the episodes have shown


@dataclass(frozen=True)
class ExportOptions:
    """How a policy is to leave its run; the same for each format."""

    noise_seed: int | None = None
    """Of the noise that actions are sampled with; None exports the deterministic policy."""
    weights: Weights = "float32"
    """The numbers that weights are kept in; smaller ones in C alone."""
    fallback: str | None = None
    """The action in place of one for a bad observation: `zero`, `middle`, `last` or numbers; None lets all pass."""
    observation_range: ObservationRange | None = None
    """What else is bad beside NaN and infinity: what is out of the task's bounds, or of what the episodes show."""
    range_margin: float | None = None
    """How far beyond what the episodes have shown is still good, as a share of its width; None is 0.5."""
    watchdog: int | None = None
    """Bad observations in a row after which only the fallback is left."""
    rate_limit: float | None = None
    """The most that an action may change in a step, as a share of its range; then there is a fallback too, `last`."""
    episodes: int = 10
    """Episodes to verify with, as in `csac evaluate`; 0 plays none, and then the task is not made."""
    card: bool = False
    """Whether to write a model card."""


class Exported(NamedTuple):
    """An artefact that is in its place, and what was found on the way."""

    place: Path
    contract: ArtefactContract
    compared: list[Compared]
    returns: Returns | None
    sizes: list[Size]
    notes: tuple[str, ...] = ()
    """What whoever exports should know, a line each, such as that the seed had failed in training."""


def export_run(
    directory: str | Path,
    formats: Sequence[Format] = ("numpy",),
    seed: int | None = None,
    which: Which = "last",
    place: str | Path | None = None,
    options: ExportOptions = ExportOptions(),
    task: Task | None = None,
    trust_task: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> Iterator[Exported]:
    """Yield an artefact of a run's policy for each format, each in a folder, verified.

    Args:
        directory: the run.
        formats: which.
        seed: the seed's label; by default the one with the best last evaluations, as `csac.load` chooses it.
        which: the seed's last policy, or the one of its best evaluation.
        place: the folder, or with several formats the folder of their folders; by default `export/<format>` in the run.
        options: noise, numbers, guards, and how it is verified.
        task: makes the environment, of a run whose task was made by a Python function.
        trust_task: lets the task import its module though nobody has named it here.
        on_progress: is called with how many episodes are done, and of how many.

    Raises:
        InputError: options that cannot be, a run or seed that is not there, a task that cannot be made, or an artefact
            that is not the policy: then nothing of it is left behind.
        EvaluationFailure: an environment raised, or gave what is not finite.
    """
    run = RunDirectory.open(directory)
    label = choose_seed(run, seed)
    policy = Policy.load(run.policy(label, which), Contract.load(run.contract))
    places = _places(run, formats, place)
    _check(formats, options, policy)
    told, recording = _Told(), None
    if options.episodes:
        task = _task(run, task, trust_task)
        told = _asked(task, run.manifest.environment_arguments)
        deterministic = options.noise_seed is None
        recording = record(policy, task, run.manifest.environment_arguments, options.episodes, deterministic)
        if on_progress:
            on_progress(options.episodes, options.episodes * (1 + len(formats)))
    guards = _guards(policy.contract, options, told, recording)
    notes = _notes(run, label, options, guards)
    for number, name in enumerate(formats):
        contract = ArtefactContract(
            policy.contract,
            name,
            options.weights,
            observation_low=told.observation_low,
            observation_high=told.observation_high,
            control_rate=told.control_rate,
            noise_seed=options.noise_seed,
            guards=guards,
            provenance=provenance(run, label, which),
        )
        with placed(places[name]) as folder:
            exported = _exported(folder, places[name], contract, policy, recording, task, run)
            exported = exported._replace(notes=(*notes, *exported.notes))
            if options.card:
                _write_card(folder, exported, run)
        if on_progress:
            on_progress(options.episodes * (2 + number), options.episodes * (1 + len(formats)))
        yield exported


def _exported(
    folder: Path,
    place: Path,
    contract: ArtefactContract,
    policy: Policy,
    recording: Recording | None,
    task: Task | None,
    run: RunDirectory,
) -> Exported:
    """Write an artefact and verify it, in a folder that is not yet its place."""
    contract = write_artefact(folder, policy.network, contract)
    artefact = open_artefact(folder)
    compared = compare_actions(artefact, policy, None if recording is None else recording.observations)
    returns = None
    if recording is not None and task is not None:
        returns = compare_returns(artefact, recording, task, run.manifest.environment_arguments)
    not_measured: list[str] = []
    measured = sizes(folder, not_measured.append) if contract.format == "c" else []
    contract = dataclasses.replace(contract, verification=_verification(compared, returns, measured))
    write_contract(folder, contract)
    return Exported(place, contract, compared, returns, measured, tuple(not_measured))


def _notes(run: RunDirectory, seed: int, options: ExportOptions, guards: Guards) -> list[str]:
    """Return what is to be said of every format's artefact."""
    notes, manifest = [], run.manifest
    if (reason := manifest.failures.get(seed)) is not None:
        notes.append(f"seed {seed} failed at {reason}; this is the policy that it has left")
    if options.episodes:
        notes += [f"{line}: csac evaluate --perturb tests it so" for line in unlike_training(manifest.perturbations)]
    if options.observation_range == "recorded" and guards.observation_high is not None:
        unbounded = int((guards.observation_high == np.float32(FLOAT32_MAX)).sum())
        if unbounded:
            count = f"{unbounded:,} of {len(guards.observation_high):,}"
            notes.append(f"{count} numbers of the observation did not vary in the episodes and have no range")
    return notes


class _Told(NamedTuple):
    """What a task says of itself."""

    observation_low: np.ndarray | None = None
    observation_high: np.ndarray | None = None
    control_rate: float | None = None


def _asked(task: Task, environment_arguments: dict[str, Any]) -> _Told:
    environment = Environment(task, environment_arguments)
    try:
        space: Any = environment.raw.observation_space
        boxes = [space if key is None else space[key] for key, _ in environment.contract_parts.observation_parts]
        low, high = (np.concatenate([getattr(box, end).reshape(-1) for box in boxes]) for end in ("low", "high"))
        return _Told(low.astype(np.float64), high.astype(np.float64), control_rate(environment.raw))
    finally:
        environment.close()


def control_rate(raw: Any) -> float | None:
    """Return how many actions a Gymnasium environment takes a second, or None where it does not say.

    By its time step, as MuJoCo's and classic tasks have it, or PyFlyt's count of physics steps, 120 a second, in one of
    its own; else by the pictures a second that it is shown at.
    """
    if isinstance(ratio := getattr(raw.unwrapped, "env_step_ratio", None), int):
        return 120.0 / ratio
    step = getattr(raw.unwrapped, "dt", None)
    if isinstance(step, int | float) and step > 0 and 0 < (rate := round(1.0 / float(step), 6)) <= FLOAT32_MAX:
        return rate
    pictures = raw.metadata.get("render_fps")
    return float(pictures) if isinstance(pictures, int | float) and pictures > 0 else None


def provenance(run: RunDirectory, seed: int, which: Which) -> dict[str, Any]:
    """Return where a policy comes from and how good it was in training, as JSON holds it.

    The returns are those of the seed's newest evaluation up to the policy, which is `steps` old: the policy's own, but
    for the last policy of a run that stopped between two (`step` tells). The interval is over that evaluation's
    episodes. Those of `all_seeds` are of their last evaluations, and the interval over seeds,
    of which those that failed in training are left out as in every table. `failure` says where and how the policy's own
    seed failed, and is None where it did not. `learnt_weights` are those of entropy and relative entropy that the
    hyperparameters leave to be learnt, as metrics.csv last told of them by then.
    """
    manifest, rows = run.manifest, run.evaluations
    own = rows[rows["seed"] == seed] if len(rows) else rows
    at, evaluation = step_of_policy(run, seed, which), {}
    if len(own := own[own["step"] <= at]):
        step = int(own["step"].max())
        evaluation = {"step": step, **returns_as_fields(own["return"][own["step"] == step])}
    last = last_evaluations(rows, points=1) if len(rows) else {}
    sound = [value for label, value in last.items() if label not in manifest.failures]
    over = returns_as_fields(np.array(sound)) if sound else {}
    over = {"seeds" if name == "episodes" else name: value for name, value in over.items()}
    return {
        "task": manifest.task,
        "environment_arguments": manifest.environment_arguments,
        "perturbations": list(manifest.perturbations),
        "algorithm": manifest.algorithm,
        "hyperparameters": manifest.hyperparameters,
        "preset": manifest.preset,
        "seed": seed,
        "checkpoint": which,
        "steps": at,
        "failure": manifest.failures.get(seed),
        "learnt_weights": _learnt_weights(run, seed, at),
        "commit": manifest.commit,
        "versions": manifest.versions,
        "command": manifest.command,
        "created": manifest.created,
        "evaluation": evaluation,
        "all_seeds": over,
    }


def _learnt_weights(run: RunDirectory, seed: int, step: int) -> dict[str, float]:
    """Return what the weights that are learnt had become at this step, as far as metrics.csv knows."""
    learnt = [name for name, value in run.manifest.hyperparameters.items() if value in ("auto", "automatic")]
    if not learnt:
        return {}
    rows = run.rows("metrics")
    rows = rows[(rows["seed"] == seed) & (rows["step"] <= step)]
    columns = [name for name in learnt if name in (rows.dtype.names or ()) and len(rows)]
    return {name: float(rows[name][-1]) for name in columns if np.isfinite(rows[name][-1])}


def _places(run: RunDirectory, formats: Sequence[Format], place: str | Path | None) -> dict[str, Path]:
    """Return where each format goes. Raises InputError for a format that there is not, or a place that is taken."""
    for name in formats:
        if name not in get_args(Format):
            raise InputError(f"no format is called {name!r}: choose {', '.join(get_args(Format))}")
    if not formats or len(set(formats)) < len(formats):
        raise InputError("give each format once, such as numpy,onnx,c")
    if place is None:
        places = {name: run.path / "export" / name for name in formats}
    else:
        places = {name: Path(place) / name if len(formats) > 1 else Path(place) for name in formats}
    for path in places.values():
        check_place(path)
    return places


def _check(formats: Sequence[Format], options: ExportOptions, policy: Policy) -> None:
    """Refuse at once what would fail after the episodes were played."""
    if options.weights not in get_args(Weights):
        raise InputError(f"no weights are called {options.weights!r}: choose {', '.join(get_args(Weights))}")
    if options.weights != "float32" and any(name != "c" for name in formats):
        raise InputError(f"{options.weights} weights are for C alone: give --format c with --weights {options.weights}")
    if options.noise_seed is not None and policy.contract.head == "tanh":
        raise InputError(
            f"the policies of {policy.contract.algorithm} have no spread to sample from: leave out --stochastic"
        )
    if options.noise_seed is not None and not 0 <= options.noise_seed < 2**32:
        raise InputError(f"a noise seed of {options.noise_seed}: give one from 0 to {2**32 - 1}")
    if options.episodes < 0:
        raise InputError(f"{options.episodes} episodes to verify with: give at least one, or 0 for none")
    if options.observation_range not in (None, *get_args(ObservationRange)):
        raise InputError(f"no range is called {options.observation_range!r}: choose bounds or recorded")
    if options.observation_range is not None and not options.episodes:
        raise InputError("a range of observations comes from the task: it needs episodes to verify with")
    if options.observation_range is not None and options.fallback is None and options.rate_limit is None:
        raise InputError("a range of observations needs a --fallback action: zero, middle, last or numbers")
    if options.range_margin is not None and not 0.0 <= options.range_margin < np.inf:
        raise InputError(f"a range margin of {options.range_margin}: give a share of the width, 0 or more")
    if options.range_margin is not None and options.observation_range != "recorded":
        raise InputError(
            "a range margin widens what the episodes have shown: give --observation-range recorded with it"
        )
    make_guards(policy.contract, options.fallback, None, None, options.watchdog, options.rate_limit)
    if "c" in formats:
        compiler()
    if "onnx" in formats:
        _check_onnx()


def _check_onnx() -> None:
    for name in ("onnx", "onnxruntime"):  # the one writes the graph, the other runs it to verify it
        if importlib.util.find_spec(name) is None:
            raise InputError(f"an ONNX artefact needs the package {name}: pip install '.[onnx]' in a clone of csac")


def _task(run: RunDirectory, task: Task | None, trust_task: bool) -> Task:
    """Return what makes the task. Raises InputError where nobody can here."""
    if task is not None:
        return task
    if run.manifest.task_is_callable:
        raise InputError(
            f"the task of {run.path} was made by a Python function, {run.manifest.task}: export it with --no-rollouts, "
            "or in Python with csac.evaluation.export.export_run and task="
        )
    refuse_untrusted(run.manifest.task, run.path, trust_task)
    return run.manifest.task


def _guards(contract: Contract, options: ExportOptions, told: _Told, recording: Recording | None) -> Guards:
    low = high = None
    if options.observation_range == "bounds":
        low, high = told.observation_low, told.observation_high
        if low is None or high is None or not (np.isfinite(low).any() or np.isfinite(high).any()):
            raise InputError(f"{contract.task} has no bounds of its observations: give --observation-range recorded")
    elif options.observation_range == "recorded" and recording is not None:
        least, most = recording.observations.min(axis=0), recording.observations.max(axis=0)
        share = USUAL_MARGIN if options.range_margin is None else options.range_margin
        margin = np.float32(share) * (most - least)
        # What stood still may do so on this machine alone: a width of zero would have the last bit make a step bad.
        varies = most > least
        low, high = np.where(varies, least - margin, -np.inf), np.where(varies, most + margin, np.inf)
    return make_guards(contract, options.fallback, low, high, options.watchdog, options.rate_limit)


def _verification(compared: list[Compared], returns: Returns | None, measured: list[Size]) -> dict[str, Any]:
    """Return what was found, as JSON holds it. Differences are shares of an action's range."""
    fields: dict[str, Any] = {
        "observations": sum(result.observations for result in compared),
        "largest_difference": max(result.largest for result in compared),
        "differences": [
            {
                "observations": result.name,
                "count": result.observations,
                "largest": result.largest,
                "mean": result.mean,
                "rounding_of_the_policy": result.rounding,
            }
            for result in compared
        ],
    }
    if returns is not None:
        fields["returns"] = returns_as_fields(returns.artefact)
        fields["returns_of_the_run"] = returns_as_fields(returns.policy)
    if measured:
        fields["bytes"] = [size._asdict() for size in measured]
    return fields


def _write_card(folder: Path, exported: Exported, run: RunDirectory) -> None:
    has_curve = run.curve.exists()
    if has_curve:
        write_atomically(folder / CURVE, run.curve.read_bytes())
    write_atomically(folder / CARD, model_card(exported.contract, CURVE if has_curve else None).encode())
