"""What may be typed after each sub-command: dataclasses, of which tyro makes the options and their help."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, UseAppendAction, arg

from csac.arguments import json_object, nearest, peek
from csac.presets import PRESETS, hyperparameters
from csac.training.options import Options
from csac.types import InputError

if TYPE_CHECKING:
    from csac.record.manifest import Manifest
    from csac.training.options import PlanOptions


@dataclass(frozen=True, kw_only=True)
class Train(Options):
    """Train controllers for a task: independent seeds, each evaluated at regular intervals.

    Exit codes: 0 done, 1 the directory can no longer be written, 2 wrong arguments, 3 a seed failed, 130 or 143
    stopped by a signal (the run is saved).
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    algorithm: str = "csac"
    """The algorithm; its own options are listed below."""
    preset: str | None = None
    """paper: the paper's hyperparameters. strong: critics that learn faster (CSAC, SAC). Options given here win."""
    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/TASK/ALGORITHM/DATE-TIME)")] = None
    """The run directory; it must be new or empty."""
    resume: FlagCreatePairsOff[bool] = False
    """Resume the run in --directory if there is one, else start it."""
    start_from: Annotated[str | None, arg(name="from", metavar="DIR[@STEP]", help_behavior_hint="(default: none)")] = (
        None
    )
    """Start from a copy of another run's checkpoint; what is learnt and how it is evaluated stay, unless given here."""
    events: Annotated[str | None, arg(metavar="NAME,...", help_behavior_hint="(default: the task's own)")] = None
    """More names to record from the info of an evaluation episode's last step: each becomes a column and a curve."""
    env_kwargs: Annotated[str, arg(metavar="JSON")] = "{}"
    """Keyword arguments for the environment, as a JSON object."""
    perturb: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(
            metavar="KIND=VALUE[@STEP]",
            help="Change the task after STEP environment steps, for example friction=1.5@300000. Kinds: factors on "
            "friction, gravity, mass or gain of a MuJoCo task; standard deviations of observation_noise or "
            "action_noise. With --from, none drops what that run had planned.",
        ),
    ] = ()
    groups: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Processes to split the seeds over."""
    evaluation_processes: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Processes per group that evaluate while it trains on; 0 evaluates in between. The results are the same."""
    wandb: FlagCreatePairsOff[bool] = False
    """Also log to Weights & Biases: one run per seed, in the project WANDB_PROJECT or else csac (docs/python.md)."""

    def plan_options(self) -> PlanOptions:
        """Return the options of `train` that are given here."""
        same = {item.name: getattr(self, item.name) for item in dataclasses.fields(Options)}
        options: Any = {
            **same,
            "environment_arguments": json_object("--env-kwargs", self.env_kwargs),
            "perturbations": _perturbations(self.perturb),
            "events": None if self.events is None else self.events.split(","),
            "groups": self.groups,
            "evaluation_processes": self.evaluation_processes,
        }
        return options


@dataclass(frozen=True, kw_only=True)
class Tune(Options):
    """Search for good hyperparameters with Optuna: short trials chosen by TPE, hopeless ones pruned.

    A trial's score is the mean over its seeds of their last three evaluations, on episodes that no other run and no
    report uses. Hyperparameters given below are fixed; the rest of the search space is searched (docs/tuning.md). Any
    number of processes and machines that run the same command share the trials; after Ctrl-C or a crash the same
    command continues.

    Exit codes: 0 done, 1 the directory can no longer be written, 2 wrong arguments, 3 no trial is complete, 130 or 143
    stopped by a signal.
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    algorithm: str = "csac"
    """The algorithm; its own options are listed below, and those given are not searched."""
    preset: str | None = None
    """Start the search from: paper, the paper's hyperparameters; strong, critics that learn faster (CSAC, SAC)."""
    trials: int = 50
    """Number of trials in total, including those of other processes and earlier calls."""
    search: Annotated[str | None, arg(metavar="NAME,...", help_behavior_hint="(default: the whole search space)")] = (
        None
    )
    """Search only these hyperparameters."""
    steps: int = 100_000
    """Environment steps per seed of each trial, warm-up included."""
    seeds: int = 2
    """Number of independent seeds in each trial, the same for all trials."""
    first_seed: int = 1_000
    """Label of the first seed; the others are numbered from it. Report results on other seeds."""
    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/tune/TASK/ALGORITHM)")] = None
    """The directory of the search: new, empty, or of the same search."""
    env_kwargs: Annotated[str, arg(metavar="JSON")] = "{}"
    """Keyword arguments for the environment, as a JSON object."""
    groups: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Processes to split the seeds of a trial over."""

    def home(self) -> Path:
        """Return the study's directory."""
        return self.directory or Path("runs", "tune", self.task.replace("/", "-").replace(":", "-"), self.algorithm)


@dataclass(frozen=True)
class Resume:
    """Resume a run from its newest checkpoint, as if it had never stopped."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    steps: Annotated[int | None, arg(help_behavior_hint="(default: as the run was started)")] = None
    """Total environment steps per seed, counted from the run's beginning; more than before extends the run."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Allow the task to import its module although you have never named it on this machine; read it first."""


@dataclass(frozen=True)
class Evaluate:
    """Test the policies of a run on fresh episodes that neither training nor its evaluations have used."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: every seed)")] = None
    """Label of the seed to test."""
    checkpoint: Literal["last", "best"] = "last"
    """Each seed's last policy, or the one of its best evaluation."""
    episodes: int = 10
    """Episodes per seed, the same for each."""
    processes: Annotated[int | None, arg(help_behavior_hint="(default: chosen by the cores)")] = None
    """Processes that share the episodes; the results do not depend on it."""
    stochastic: FlagCreatePairsOff[bool] = False
    """Sample actions from the policy instead of taking the deterministic one."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE")] = ()
    """Change the task, for example friction=2; the kinds are those of csac train."""
    csv: Annotated[Path | None, arg(metavar="FILE.csv")] = None
    """Also write one row per episode to this file, as in evaluations.csv."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Allow the task to import its module although you have never named it on this machine; read it first."""


@dataclass(frozen=True)
class Play:
    """Watch the policy of a run in a window, or record a video of it."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: the one with the best last evaluations)")] = None
    """Label of the seed to watch."""
    checkpoint: Literal["last", "best"] = "last"
    """The seed's last policy, or the one of its best evaluation."""
    episodes: int = 1
    """Number of episodes."""
    video: Annotated[Path | None, arg(metavar="OUT.mp4", help_behavior_hint="(default: a window)")] = None
    """Record to this file instead of opening a window; no display is needed."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE")] = ()
    """Change the task, for example friction=2; the kinds are those of csac train."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Allow the task to import its module although you have never named it on this machine; read it first."""


@dataclass(frozen=True)
class Export:
    """Export a policy that maps the raw observation to the environment's action, and verify it.

    The artefact is a folder with the policy and contract.json, which describes its inputs and outputs.
    """

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[str, arg(metavar="best|K")] = "best"
    """Label of the seed; best is the one with the best last evaluations."""
    checkpoint: Literal["last", "best"] = "last"
    """The seed's last policy, or the one of its best evaluation."""
    format: Literal["numpy", "onnx", "c"] = "numpy"
    """numpy: needs only NumPy, with a loader beside it. onnx: a graph. c: one C99 header."""
    out: Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="(default: DIR/export/FORMAT)")] = None
    """The artefact's folder."""
    fallback: Annotated[str | None, arg(metavar="zero|middle|last|X,...", help_behavior_hint="(default: no guard)")] = (
        None
    )
    """Guard against NaN and infinity: the action to take then."""
    rate_limit: Annotated[
        float | None,
        arg(
            help="Largest change of an action from one step to the next, as a share of its range; the fallback is "
            "then the last action, unless another is given.",
            help_behavior_hint="(default: no limit)",
        ),
    ] = None
    episodes: int = 10
    """Episodes to verify with, the same as those of csac evaluate; 0 if the task cannot be made on this machine."""
    card: FlagCreatePairsOff[bool] = False
    """Also write a model card, README.md."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Allow the task to import its module although you have never named it on this machine; read it first."""

    def seed_label(self) -> int | None:
        """Return the seed that was asked for, or None for the best. Raises InputError for neither."""
        if self.seed == "best":
            return None
        if not self.seed.isdecimal():
            raise InputError(f"--seed {self.seed}: give best, or the label of a seed")
        return int(self.seed)


@dataclass(frozen=True)
class Latency:
    """Measure how long artefacts take per action, call by call: as fast as possible and at a fixed rate.

    A C artefact is timed inside a compiled program, the others around their call in Python.
    """

    artefacts: Annotated[Positional[tuple[Path, ...]], arg(metavar="ARTEFACT...", help_behavior_hint="(required)")]
    """Folders written by csac export."""
    calls: int = 100_000
    """Number of calls made one after the other."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint="(default: the task's, or 100)")] = None
    """Calls per second of the measurement at a fixed rate."""
    seconds: float = 10.0
    """Length of the measurement at a fixed rate; 0 skips it."""


@dataclass(frozen=True)
class Runs:
    """List the runs below a directory."""

    directory: Annotated[Positional[Path], arg(metavar="[DIR]")] = Path("runs")
    """Where to look."""


@dataclass(frozen=True)
class Report:
    """Compare runs: curves, returns, intervals, effects of perturbations, cases, hyperparameters, commands.

    Runs that differ only in their seeds are merged into one arm. A cell collected by csac study run --results counts as
    a run, and so does a CSV file with the rows of an evaluations.csv.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR...", help_behavior_hint="(or --label)")] = ()
    """Run directories, directories that contain some, or the collected cells of a study."""
    label: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=DIR,...")] = ()
    """More runs, merged into an arm of this name on each task."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE@STEP")] = ()
    """The perturbation of these runs, which a CSV file alone does not record."""
    until: Annotated[int | None, arg(help_behavior_hint="(default: the end)")] = None
    """Ignore evaluations after this step, and rollouts of policies trained for longer."""
    title: Annotated[str | None, arg(help_behavior_hint="(default: the task)")] = None
    """Title of the report, or of the figure."""
    out: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="(default: runs/reports/DATE-TIME/)")] = (
        None
    )
    """Where to write the report (in a directory: report.html); a Markdown version and the figures go beside it."""
    into: Annotated[str | None, arg(metavar="FILE.md#NAME", help_behavior_hint="(default: none)")] = None
    """Instead of a report, write one table into a page, between <!-- NAME: begin --> and <!-- NAME: end -->."""
    table: Annotated[Literal["returns", "recovery", "cases"] | None, arg(help_behavior_hint="(default: returns)")] = (
        None
    )
    """The table for --into."""
    curve: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")] = None
    """Instead of a report, draw the learning curves to this file."""

    def labels(self) -> list[tuple[str, list[Path]]]:
        """Return the labels, each with its runs. Raises InputError for one that is not written NAME=DIR,..."""
        pairs = [text.partition("=")[::2] for text in self.label]
        for text, (name, paths) in zip(self.label, pairs, strict=True):
            if not (name and all(paths.split(","))):
                raise InputError(f"--label is written NAME=DIR,DIR, not {text!r}")
        return [(name, [Path(path) for path in paths.split(",")]) for name, paths in pairs]

    def place(self) -> tuple[Path, str] | None:
        """Return the page and the name of its markers. Raises InputError where --into is not written FILE.md#NAME."""
        if self.into is None:
            if self.table:
                raise InputError("--table chooses what --into writes: give --into FILE.md#NAME too")
            return None
        page, _, name = self.into.rpartition("#")
        if not (page and name):
            raise InputError(f"--into is written FILE.md#NAME, not {self.into!r}")
        return Path(page), name


class Chosen(NamedTuple):
    """What is known of a `csac train` before its options can be: they and their defaults depend on it."""

    algorithm: str
    preset: str | None
    source: Manifest | None
    """Of the run to begin with."""

    @classmethod
    def among(cls, arguments: list[str]) -> Chosen:
        """Look for what was chosen. Raises InputError for an algorithm, or a run to begin with, that is not there."""
        from csac.algorithms import ALGORITHMS

        source = None
        if (where := peek(arguments, "--from", None)) is not None:
            from csac.training.plan import Before

            before = Before.find(peek(arguments, "--directory", None), "--resume" in arguments, where)
            source = before.run.manifest if before.run else None
        name = peek(arguments, "--algorithm", source.algorithm if source else "csac")
        if name not in ALGORITHMS:
            hint = nearest(name, ALGORITHMS) or f": choose {' or '.join(ALGORITHMS)}"
            raise InputError(f"no algorithm is called {name!r}{hint}")
        return cls(name, peek(arguments, "--preset", None), source)

    def command(self, task: str, base: type[Any] = Train) -> type[Any]:
        """Return `Train` (or `Tune`) with the hyperparameters of the algorithm beside its own options.

        Their defaults are those of the preset for this task, or of the run to begin with.
        """
        from csac.algorithms import ALGORITHMS

        presets: Any = Literal[PRESETS]
        hint = arg(help_behavior_hint=f"(default: {self.preset or 'none'})")
        values = hyperparameters(self.preset, self.algorithm, task) if self.preset else {}
        algorithm, fields = ALGORITHMS[self.algorithm](**values), []
        if self.source:
            from csac.training.plan import algorithm_of

            is_same = self.source.algorithm == self.algorithm and not self.preset
            algorithm = algorithm_of(self.source) if is_same else algorithm
            fields += [(name, kind, field(default=value)) for name, kind, value in _inherited(self.source)]
        fields += [
            ("algorithm", Literal[tuple(ALGORITHMS)], field(default=self.algorithm)),
            ("preset", Annotated[presets | None, hint], field(default=self.preset)),
            (self.algorithm, OmitArgPrefixes[type(algorithm)], field(default=algorithm)),
        ]
        documented = {"__doc__": base.__doc__}
        return dataclasses.make_dataclass(
            base.__name__, fields, bases=(base,), frozen=True, kw_only=True, namespace=documented
        )

    def inherited(self) -> PlanOptions:
        """Return what a run takes from the one that it begins with and no option tells."""
        return {"evaluation_seed": self.source.evaluation.first_seed} if self.source else {}

    def others(self) -> dict[str, type[Any]]:
        """Return the algorithms that were not chosen, by name."""
        from csac.algorithms import ALGORITHMS

        return {name: kind for name, kind in ALGORITHMS.items() if name != self.algorithm}


def _inherited(source: Manifest) -> list[tuple[str, Any, Any]]:
    """Return the options of `Train`, with their types, that a run takes from the one it begins with."""
    return [
        ("steps", int, source.steps),
        ("seeds", int, len(source.seeds)),
        ("first_seed", int, source.seeds[0]),
        ("evaluation_interval", int, source.evaluation.interval),
        ("evaluation_episodes", int, source.evaluation.episodes),
        ("env_kwargs", Annotated[str, arg(metavar="JSON")], json.dumps(source.environment_arguments)),
    ]


def _perturbations(given: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return what a run is to be perturbed by; without a word of it None, as planned in the run that it begins with."""
    if "none" in given:
        if len(given) > 1:
            raise InputError("--perturb none leaves everything out: give it alone")
        return ()
    return given or None
