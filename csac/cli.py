"""The front door: each sub-command parses its arguments and calls one function."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, UseAppendAction, arg

from csac.arguments import HelpShown, json_object, nearest, parse, peek
from csac.presets import PRESETS, hyperparameters
from csac.training.options import Options
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csac.record.manifest import Manifest
    from csac.record.run import RunDirectory
    from csac.training.options import PlanOptions

HELP = """\
usage: csac COMMAND ...

Train controllers for continuous-control tasks with Conservative Soft Actor-Critic.

  csac train TASK      train controllers for a Gymnasium task, several seeds at once
  csac resume DIR      go on with a run that was stopped or killed
  csac evaluate DIR    test the policies of a run on fresh episodes
  csac play DIR        watch the policy of a run, or write a video of it
  csac runs [DIR]      list the runs below a directory
  csac study COMMAND   run the paper's experiments, or your own

  csac COMMAND --help  explain a command and its options
  csac --version       print the version

To begin: csac train HalfCheetah-v4 --seeds 2 --steps 60_000
"""


@dataclass(frozen=True, kw_only=True)
class Train(Options):
    """Train controllers for a task: independent seeds, each evaluated as it learns.

    Exit codes: 0 done, 2 wrong arguments, 3 a seed failed, 130 or 143 stopped by a signal (what was learnt is saved).
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    algorithm: str = "csac"
    """What learns; its own options are listed below."""
    preset: str | None = None
    """Hyperparameters to start from: paper is the paper's tables. Options given here win over it."""
    directory: Annotated[Path | None, arg(help_behavior_hint="(default: runs/TASK/ALGORITHM/DATE-TIME)")] = None
    """The run's own directory, new or empty."""
    resume: FlagCreatePairsOff[bool] = False
    """Go on with the run in --directory, if there is one already."""
    start_from: Annotated[str | None, arg(name="from", metavar="DIR[@STEP]", help_behavior_hint="(default: none)")] = (
        None
    )
    """Begin with a copy of that run's checkpoint; what is not given here is as it was there."""
    events: Annotated[str | None, arg(metavar="NAME,...", help_behavior_hint="(default: the task's own)")] = None
    """More names in the info of an evaluation episode's last step: each becomes a column and a curve of its own."""
    env_kwargs: Annotated[str, arg(metavar="JSON")] = "{}"
    """Keyword arguments for the environment, as a JSON object."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE[@STEP]")] = ()
    """Change the task after STEP environment steps, as friction=1.5@300000 does: factors on friction, gravity, mass or
    gain of a MuJoCo task, standard deviations of observation_noise or action_noise. With --from, none leaves out what
    that run had planned."""
    groups: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes to split the seeds over."""
    evaluation_processes: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes in which each group evaluates while it trains on; 0 evaluates in line. The results are the same."""

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


@dataclass(frozen=True)
class Resume:
    """Go on with a run from its newest checkpoint, as if it had never stopped."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    steps: Annotated[int | None, arg(help_behavior_hint="(default: as many as it was started for)")] = None
    """Environment steps per seed in all, counted from the run's beginning; may be more than it was started for."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Run the code of the module that the task names, though you have never named it here; look at it first."""


@dataclass(frozen=True)
class Evaluate:
    """Test the last policies of a run on fresh episodes, which neither training nor its evaluations have seen."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: every seed)")] = None
    """Label of the seed to test."""
    episodes: int = 10
    """Episodes per seed, the same for each."""
    processes: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes that share the episodes; the numbers are the same with any number of them."""
    stochastic: FlagCreatePairsOff[bool] = False
    """Draw actions from the policy instead of taking its most likely one."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE")] = ()
    """Change the task, as friction=2 does; the kinds are those of csac train."""
    csv: Annotated[Path | None, arg(metavar="FILE.csv")] = None
    """Write a row for each episode there as well, as in evaluations.csv."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Run the code of the module that the task names, though you have never named it here; look at it first."""


@dataclass(frozen=True)
class Play:
    """Watch the policy of a run in a window, or write a video of it."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: the one with the best last evaluations)")] = None
    """Label of the seed to watch."""
    episodes: int = 1
    """How many episodes."""
    video: Annotated[Path | None, arg(metavar="OUT.mp4", help_behavior_hint="(default: a window)")] = None
    """Write this file instead of opening a window; needs no display."""
    perturb: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KIND=VALUE")] = ()
    """Change the task, as friction=2 does; the kinds are those of csac train."""
    trust_task: FlagCreatePairsOff[bool] = False
    """Run the code of the module that the task names, though you have never named it here; look at it first."""


@dataclass(frozen=True)
class Runs:
    """List the runs below a directory."""

    directory: Annotated[Positional[Path], arg(metavar="DIR")] = Path("runs")
    """Where to look."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `csac` with `arguments`, by default the command line's, and return its exit code.

    0 done, 1 a failing environment (internal errors are raised), 2 wrong arguments or input, 3 finished but a seed
    failed, 130 SIGINT, 143 SIGTERM.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _open_standard_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    with suppress(OSError):  # a folder that is gone
        # The user's own modules, as `python -m csac` finds them; last, so that they hide nothing of csac's.
        sys.path += [os.getcwd()] if os.getcwd() not in sys.path else []
    try:
        return _dispatch(arguments)
    except InputError as error:
        return _complain(error, 2)
    except KeyboardInterrupt:
        return 130
    finally:
        _settle_output()


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        _say(HELP.rstrip())
        return 0
    if arguments[0] == "--version":
        from csac import __version__

        _say(f"csac {__version__}")
        return 0
    commands = {
        "train": _train,
        "resume": _resume,
        "evaluate": _evaluate,
        "play": _play,
        "runs": _runs,
        "study": _study,
    }
    if arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}{nearest(arguments[0], commands)} (csac --help)")
    try:
        return commands[arguments[0]](arguments[1:])
    except HelpShown:
        return 0


def _train(arguments: list[str]) -> int:
    chosen = Chosen.among(arguments)
    options = parse(chosen.command(""), arguments, "csac train", chosen.others())
    if chosen.preset:  # what it gives can depend on the task, which is known by now
        options = parse(chosen.command(options.task), arguments, "csac train", chosen.others())
    if options.resume and options.directory is None:
        raise InputError("--resume needs the run's --directory (csac resume DIR does without)")

    from csac.console.progress import Reporter
    from csac.training.train import train

    return _exit_code(
        lambda: train(
            getattr(options, chosen.algorithm),
            options.task,
            directory=options.directory,
            resume=options.resume,
            start_from=options.start_from,
            reporter=Reporter(),
            command=shlex.join(["csac", "train", *arguments]),
            **options.plan_options(),
        )
    )


def _resume(arguments: list[str]) -> int:
    options = parse(Resume, arguments, "csac resume")
    from csac.console.progress import Reporter
    from csac.training.train import resume

    command = shlex.join(["csac", "resume", *arguments])
    return _exit_code(
        lambda: resume(
            options.run,
            steps=options.steps,
            evaluation_processes=None,
            trust_task=options.trust_task,
            reporter=Reporter(),
            command=command,
        )
    )


def _exit_code(training: Callable[[], RunDirectory]) -> int:
    """Train, and turn how it ended into an exit code and, where it did not reach its end, the line to type next."""
    from csac.console.tables import program
    from csac.record.run import StorageFailure
    from csac.training.interruptions import Interrupted

    try:
        run = training()
    except Interrupted as interruption:
        line = f"; to go on, type: {program()} resume {shlex.quote(str(interruption.run.path))}"
        return _complain(f"{interruption}{line if interruption.is_saved else ''}", 128 + interruption.signal_number)
    except StorageFailure as failure:
        return _complain(f"{failure}; the run can go on from its last checkpoint (csac resume) once that is mended", 1)
    return 3 if run.manifest.state == "failed" else 0


def _perturbations(given: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return what a run is to be perturbed by; without a word of it None, as planned in the run that it begins with."""
    if "none" in given:
        if len(given) > 1:
            raise InputError("--perturb none leaves everything out: give it alone")
        return ()
    return given or None


def _evaluate(arguments: list[str]) -> int:
    options = parse(Evaluate, arguments, "csac evaluate")
    from csac.console.tables import case_table, evaluation_table, make_console, silent_events
    from csac.console.waiting import progress_shown
    from csac.evaluation.evaluator import EvaluationFailure
    from csac.evaluation.play import evaluate_run, perturbation_notes
    from csac.record.csv_tables import COLUMNS, check_new, write_rows
    from csac.record.run import RunDirectory

    console = make_console()
    told = perturbation_notes(options.run, options.perturb)
    if options.csv:
        check_new(options.csv)
    results = {}
    try:
        with progress_shown(console, "evaluating", "episodes") as on_progress:
            results.update(
                evaluate_run(
                    options.run,
                    options.seed,
                    options.episodes,
                    not options.stochastic,
                    options.perturb,
                    processes=options.processes,
                    on_progress=on_progress,
                    trust_task=options.trust_task,
                )
            )
    except EvaluationFailure as error:
        return _complain(error, 1)
    for line in told:
        console.print(line, soft_wrap=True)
    console.print(evaluation_table(results))
    if (cases := case_table(results)) is not None:
        console.print(cases)
    for name in silent_events(results):
        _say(f"note: no episode's last info holds a number called {name!r}")
    if options.csv:
        step = RunDirectory.open(options.run).manifest.steps_done
        rows = [episode.row(seed, step) for seed, episodes in results.items() for episode in episodes]
        write_rows(options.csv, COLUMNS["evaluations"], rows)
        console.print(str(options.csv), soft_wrap=True)
    return 0


def _play(arguments: list[str]) -> int:
    options = parse(Play, arguments, "csac play")
    from csac.console.tables import make_console
    from csac.console.waiting import progress_shown
    from csac.evaluation.play import perturbation_notes, play
    from csac.tasks.spaces import EnvironmentFailure

    console = make_console()
    for line in perturbation_notes(options.run, options.perturb):
        console.print(line, soft_wrap=True)
    try:
        with progress_shown(console, "playing", "steps at most") as on_progress:
            for episode in play(
                options.run,
                options.seed,
                options.episodes,
                options.video,
                options.perturb,
                on_progress=on_progress,
                trust_task=options.trust_task,
            ):
                text = f"return {episode.episode_return:,.2f} in {episode.length:,} steps"
                console.print(f"episode {episode.episode}: {text}")
    except EnvironmentFailure as error:
        return _complain(error, 1)
    if options.video:
        console.print(str(options.video), soft_wrap=True)
    return 0


def _runs(arguments: list[str]) -> int:
    options = parse(Runs, arguments, "csac runs")
    from csac.console.tables import make_console, print_runs
    from csac.record.run import find_runs

    is_default = options.directory == Path("runs")
    runs = [] if is_default and not options.directory.exists() else find_runs(options.directory)
    if runs:
        print_runs(make_console(), runs)
    else:
        _say(f"no runs in {options.directory} yet; csac train HalfCheetah-v4 starts one")
    return 0


def _study(arguments: list[str]) -> int:
    from csac.studies.commands import COMMANDS, HELP

    if not arguments or arguments[0] in ("-h", "--help"):
        _say(HELP.rstrip())
        return 0
    if arguments[0] not in COMMANDS:
        hint = nearest(arguments[0], COMMANDS)
        raise InputError(f"no study command is called {arguments[0]!r}{hint} (csac study --help)")
    kind, run = COMMANDS[arguments[0]]
    return run(parse(kind, arguments[1:], f"csac study {arguments[0]}"))


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
            from csac.training.resume import Source

            source = Source.find(where).run.manifest
        name = peek(arguments, "--algorithm", source.algorithm if source else "csac")
        if name not in ALGORITHMS:
            raise InputError(f"no algorithm is called {name!r}: choose {' or '.join(ALGORITHMS)}")
        return cls(name, peek(arguments, "--preset", None), source)

    def command(self, task: str) -> type[Any]:
        """Return `Train` with the hyperparameters of the algorithm beside its own options.

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
        documented = {"__doc__": Train.__doc__}
        return dataclasses.make_dataclass(
            "Train", fields, bases=(Train,), frozen=True, kw_only=True, namespace=documented
        )

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


def _say(text: str) -> None:
    with suppress(BrokenPipeError):
        print(text)


def _complain(message: object, code: int) -> int:
    print(f"csac: {' '.join(str(message).split())}", file=sys.stderr)
    return code


def _open_standard_streams() -> None:
    """Lead streams that were closed to nowhere: the next file to be opened would get what libraries print there."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def _settle_output() -> None:
    """Write what waits; where nobody reads it any more (`csac runs | head`), leave without a fuss."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
