"""Define each sub-command's options as a dataclass, from which tyro builds the parser and the help.

A field has the name of the function argument that it is passed as.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, Suppress, UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

from csac.cli.parsing import JSON, chosen_algorithm, options_of, parse, value_of
from csac.presets import PRESETS, hyperparameters
from csac.record.config import RunConfig
from csac.seeds import EVALUATION_SEED
from csac.types import InputError

if TYPE_CHECKING:
    from csac.record.sets import RunSet

Flag = FlagCreatePairsOff[bool]
Runs = Annotated[Positional[Path], arg(metavar="DIR", help="A set of runs, or one run of it.")]
Which = Annotated[
    Literal["last", "best"], arg(name="checkpoint", help="Each seed's last policy, or that of its best evaluation.")
]
Constant = Annotated[
    UseAppendAction[tuple[str, ...]],
    arg(
        name="perturb",
        metavar="KIND=VALUE",
        help="Change the task, for example friction=2; the kinds are those of csac train.",
    ),
]
Trust = Annotated[
    Flag,
    arg(
        help="Allow the run's task or algorithm to import its module although you have never named it on this machine."
    ),
]
Names = Annotated[
    tuple[str, ...],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME,...",
        instance_from_str=lambda words: tuple(word.strip() for word in words[0].split(",")),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(value)],
    ),
]
PERTURB = (
    "Change the task after STEP environment steps, for example friction=1.5@300000. Kinds: factors on friction, "
    "gravity, mass or gain of a MuJoCo task; standard deviations of observation_noise or action_noise. With --from, "
    "none drops what that run had planned."
)


@dataclass(frozen=True, kw_only=True)
class _Training(RunConfig):
    """The options that `csac train` and `csac tune` share, apart from the algorithm's hyperparameters."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    preset: str | None = None
    """paper: the paper's hyperparameters. strong: critics that learn faster (CSAC, SAC). Other options override it."""
    seeds: int = 1
    """Number of independent seeds."""
    first_seed: int = 0
    """The first seed; the others count up from it."""
    environment_arguments: Annotated[dict[str, Any], JSON, arg(name="env-kwargs")] = field(default_factory=dict)
    """Keyword arguments for the environment, as a JSON object."""
    hyperparameters: Suppress[dict[str, Any]] = field(default_factory=dict)
    demonstrations: Suppress[dict[str, Any]] = field(default_factory=dict)
    seed: Suppress[int] = 0
    evaluation_seed: Suppress[int] = EVALUATION_SEED
    task_is_callable: Suppress[bool] = False


@dataclass(frozen=True, kw_only=True)
class Train(_Training):
    """Train controllers for a task: independent seeds, each evaluated at regular intervals.

    Exit codes: 0 done, 1 the directory can no longer be written, 2 wrong arguments, 3 a seed failed, 130 or 143
    stopped by a signal (the runs are saved).
    """

    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/TASK/ALGORITHM/DATE-TIME)")] = None
    """The folder for the runs, each in its own seed-K; it must be new or empty."""
    resume: Flag = False
    """Resume the runs that exist in --directory, and start the others."""
    start_from: Annotated[str | None, arg(name="from", metavar="DIR[@STEP]", help_behavior_hint="(default: none)")] = (
        None
    )
    """Fork the checkpoints of other runs; their hyperparameters and evaluation settings stay, unless given here."""
    perturbations: Annotated[
        UseAppendAction[tuple[str, ...]], arg(name="perturb", metavar="KIND=VALUE[@STEP]", help=PERTURB)
    ] = ()
    events: Annotated[Names, arg(help_behavior_hint="(default: the task's own)")] = ()
    """More info entries to record: NAME from an episode's last step, NAME:sum or NAME:mean over all its steps. Each
    becomes a column and a curve, for evaluations and for training episodes."""
    given: Annotated[
        str | None, arg(name="demonstrations", metavar="FILE.npz", help_behavior_hint="(default: none)")
    ] = None
    """Transitions to start the replay buffer with, actions on the environment's scale; or a Minari data set's id."""
    seeds_per_process: Annotated[int | None, arg(help_behavior_hint="(default: 1 on a CPU, a few on a GPU)")] = None
    """Seeds that train in one process."""
    evaluation_processes: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Worker processes per training process that evaluate while it trains; 0 pauses training. Results are the same."""
    environment_processes: Annotated[int | None, arg(help_behavior_hint="(default: chosen by a step's cost)")] = None
    """Worker processes per training process that step its --environments; 0 uses none. Results are the same."""
    wandb: Flag = False
    """Also log to Weights & Biases, in the project WANDB_PROJECT or csac (docs/callbacks-and-logging.md)."""

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `train`."""
        if "none" in self.perturbations and len(self.perturbations) > 1:
            raise InputError("--perturb none leaves everything out: give it alone")
        planned = () if "none" in self.perturbations else self.perturbations or None  # None: keep the source's
        others = ("task", "algorithm", _field_of(self.algorithm), "preset", "hyperparameters", "seed")
        others += ("task_is_callable", "given")
        arguments = {name: value for name, value in vars(self).items() if name not in others}
        return {**arguments, "perturbations": planned, "events": self.events or None, "demonstrations": self.given}


@dataclass(frozen=True, kw_only=True)
class Tune(_Training):
    """Search for good hyperparameters with Optuna: short trials chosen by TPE, unpromising ones pruned.

    A trial's score is the mean over its seeds of their last three evaluations, on episodes that no other run and no
    report uses. Hyperparameters given below are fixed; the rest of the search space is searched (docs/tuning.md). Any
    number of processes and machines that run the same command share the trials; after Ctrl-C or a crash the same
    command continues the search.

    Exit codes: 0 done, 1 the directory can no longer be written, 2 wrong arguments, 3 no trial is complete, 130 or 143
    stopped by a signal.
    """

    trials: int = 50
    """Number of trials in total, including those of other processes and earlier calls."""
    search: Annotated[Names, arg(help_behavior_hint="(default: the whole search space)")] = ()
    """Search only these hyperparameters."""
    steps: int = 100_000
    """Environment steps per seed of each trial, warm-up included."""
    seeds: int = 2
    """Number of independent seeds in each trial, the same for all trials."""
    first_seed: int = 1_000
    """The first seed; the others count up from it. Report final results on other seeds."""
    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/tune/TASK/ALGORITHM)")] = None
    """The directory of the search: new, empty, or one that holds the same search."""
    perturbations: Suppress[tuple[str, ...]] = ()
    events: Suppress[tuple[str, ...]] = ()

    def home(self) -> Path:
        """Return the directory of the search."""
        from csac.record.sets import as_folder

        return self.directory or Path("runs", "tune", as_folder(self.task), as_folder(self.algorithm))


@dataclass(frozen=True)
class Resume:
    """Resume runs from their newest checkpoints, as if they had never stopped."""

    directory: Runs
    steps: Annotated[int | None, arg(help_behavior_hint="(default: as the runs were started)")] = None
    """Total environment steps per seed, counted from the beginning; more than before extends the runs."""
    trust_task: Trust = False


@dataclass(frozen=True)
class Evaluate:
    """Test the policies of runs on fresh episodes that neither training nor its evaluations have used."""

    directory: Runs
    seed: Annotated[int | None, arg(help_behavior_hint="(default: every seed)")] = None
    """The seed to test."""
    which: Which = "last"
    episodes: int = 10
    """Episodes per seed; every seed is tested on the same ones."""
    processes: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Worker processes that share the episodes; the results do not depend on their number."""
    stochastic: Flag = False
    """Sample actions from the policy instead of taking its deterministic action."""
    perturbations: Constant = ()
    csv: Annotated[Path | None, arg(metavar="FILE.csv", help_behavior_hint="(default: none)")] = None
    """Also write one row per episode to this file, as in evaluations.csv."""
    trust_task: Trust = False


@dataclass(frozen=True)
class Play:
    """Watch a policy in a window, or record a video of it."""

    directory: Runs
    seed: Annotated[int | None, arg(help_behavior_hint="(default: the one with the best last evaluations)")] = None
    """The seed to watch."""
    which: Which = "last"
    episodes: int = 1
    """Number of episodes."""
    video: Annotated[Path | None, arg(metavar="OUT.mp4", help_behavior_hint="(default: a window)")] = None
    """Record to this file instead of opening a window; no display is needed."""
    perturbations: Constant = ()
    trust_task: Trust = False


@dataclass(frozen=True)
class Export:
    """Export a policy that maps the raw observation to the environment's action, and verify it.

    The artefact is a folder with the policy and contract.json, which describes its inputs and outputs.
    """

    directory: Runs
    seed: Annotated[int | None, arg(help_behavior_hint="(default: the one with the best last evaluations)")] = None
    """The seed whose policy is exported."""
    which: Which = "last"
    format: Literal["numpy", "onnx", "c"] = "numpy"
    """numpy: arrays and a loader that needs only NumPy. onnx: an ONNX graph. c: one C99 header."""
    place: Annotated[
        Path | None, arg(name="out", metavar="PATH", help_behavior_hint="(default: DIR/export/FORMAT)")
    ] = None
    """The artefact's folder."""
    fallback: Annotated[str | None, arg(metavar="zero|middle|last|X,...", help_behavior_hint="(default: no guard)")] = (
        None
    )
    """The action to take if the observation or the action has a NaN or an infinity."""
    rate_limit: Annotated[float | None, arg(help_behavior_hint="(default: no limit)")] = None
    """Largest change of an action from one step to the next, as a share of its range. The fallback is then the previous
    action, unless --fallback is given."""
    episodes: int = 10
    """Episodes to verify with, the same as those of csac evaluate; 0 if the task cannot run on this machine."""
    card: Flag = False
    """Also write a model card, README.md."""
    trust_task: Trust = False


@dataclass(frozen=True)
class Latency:
    """Measure how long artefacts take per action: in calls one after the other, and in calls at a fixed rate.

    A C artefact is timed inside a compiled program, the others around the Python call.
    """

    artefacts: Annotated[Positional[tuple[Path, ...]], arg(metavar="ARTEFACT...", help_behavior_hint="(required)")]
    """Folders written by csac export."""
    calls: int = 100_000
    """Number of calls made one after the other."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint="(default: the task's, or 100)")] = None
    """Calls per second in the measurement at a fixed rate."""
    seconds: float = 10.0
    """Length of the measurement at a fixed rate; 0 skips it."""


@dataclass(frozen=True)
class List:
    """List the runs below a directory."""

    directory: Annotated[Positional[Path], arg(metavar="[DIR]")] = Path("runs")
    """The directory to search."""


def parse_training(base: type[Any], words: list[str], program: str) -> Any:
    """Return the parsed `Train` or `Tune`; its defaults come from the preset or from the runs given by `--from`."""
    first = "" if not words or words[0].startswith("-") else words[0]
    if bare := [word for word, after in pairwise([*words, "-"]) if word.endswith("-sizes") and after.startswith("-")]:
        raise InputError(f"{bare[0]} needs numbers ({program} --help)")
    options = parse(_with_algorithm(base, words, first), words, program, _other_algorithms_hint)
    if options.preset and options.task != first:  # a preset's values can depend on the task
        options = parse(_with_algorithm(base, words, options.task), words, program, _other_algorithms_hint)
    return options


def learner_of(options: Any) -> Any:
    """Return the algorithm with its hyperparameters from the options that `parse_training` returned."""
    return getattr(options, _field_of(options.algorithm))


def _field_of(algorithm: str) -> str:
    """Return the name of the field that holds the hyperparameters of `algorithm`, a name or `module:Class`."""
    return algorithm.rpartition(":")[2]


def _with_algorithm(base: type[Any], words: list[str], task: str) -> type[Any]:
    """Return a subclass of `Train` or `Tune` with a field for the chosen algorithm's hyperparameters."""
    from csac.algorithms import ALGORITHMS

    source, preset = _source(words), value_of(words, "--preset")
    name, kind = chosen_algorithm(words, source.config.algorithm if source else None)
    if taken := options_of(base) & options_of(kind):
        raise InputError(f"{', '.join(sorted(taken))} of {name}: give the field another name, csac has such an option")
    defaults: dict[str, Any] = {"algorithm": name, "preset": preset}
    learner = kind(**(hyperparameters(preset, name, task) if preset else {}))
    if source:
        evaluation = ("interval", "episodes", "environments", "seed")
        kept = ("steps", "environments", "hindsight", "device", "checkpoint_interval", "keep_checkpoints")
        kept = (*kept, *(f"evaluation_{item}" for item in evaluation))
        defaults |= {item: getattr(source.config, item) for item in kept}
        defaults |= {"seeds": len(source.seeds), "first_seed": source.seeds[0]}
        defaults["environment_arguments"] = source.config.environment_arguments
        if source.config.algorithm == name and not preset:
            from csac.training.config import algorithm_of  # imports Gymnasium

            learner = algorithm_of(source.config)
    hint = arg(help_behavior_hint=f"(default: {preset or 'none'})")
    hints: dict[str, Any] = get_type_hints(base, include_extras=True)
    names = tuple(dict.fromkeys([*ALGORITHMS, name]))
    hints |= {"algorithm": Literal[names], "preset": Annotated[Literal[PRESETS] | None, hint]}  # pyright: ignore[reportInvalidTypeForm]
    fields = [(item, hints[item], field(default_factory=lambda value=value: value)) for item, value in defaults.items()]
    fields.append((_field_of(name), OmitArgPrefixes[type(learner)], field(default=learner)))
    return dataclasses.make_dataclass(
        base.__name__, fields, bases=(base,), frozen=True, kw_only=True, namespace={"__doc__": base.__doc__}
    )


def _source(words: list[str]) -> RunSet | None:
    """Return the runs given by `--from`, or to resume those in `--directory`. Raises InputError if there are none."""
    where, directory = value_of(words, "--from"), value_of(words, "--directory")
    if where is None:
        return None
    from csac.record.sets import RunSet, split_step

    if "--resume" in words and directory and any(Path(directory).glob("seed-*")):
        return RunSet.open(directory)
    return RunSet.open(split_step(where)[0])


def _other_algorithms_hint(option: str) -> str:
    """Return a hint that names the algorithms with this option, or an empty string."""
    from csac.algorithms import ALGORITHMS

    names = [name for name, kind in ALGORITHMS.items() if option in options_of(kind)]
    return f"--algorithm {' or '.join(names)} has it" if names else ""
