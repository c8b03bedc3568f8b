"""The front door: each sub-command parses its arguments and calls one function."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shlex
import sys
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, UseAppendAction, arg

from csac.arguments import json_object, nearest, parse, peek
from csac.presets import PRESETS, hyperparameters
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import Console

    from csac.record.run import RunDirectory

HELP = """\
usage: csac COMMAND ...

Train controllers for continuous-control tasks with Conservative Soft Actor-Critic.

  csac train TASK      train controllers for a Gymnasium task, several seeds at once
  csac resume DIR      go on with a run that was stopped or killed
  csac evaluate DIR    test the policies of a run on fresh episodes
  csac play DIR        watch the policy of a run, or write a video of it
  csac runs [DIR]      list the runs below a directory

  csac COMMAND --help  explain a command and its options
  csac --version       print the version

To begin: csac train HalfCheetah-v4 --seeds 2 --steps 60_000
"""


@dataclass(frozen=True)
class Train:
    """Train controllers for a task: independent seeds, each evaluated as it learns.

    Exit codes: 0 done, 2 wrong arguments, 3 a seed failed, 130 or 143 stopped by a signal (what was learnt is saved).
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """A Gymnasium id such as HalfCheetah-v4, or module:Id for an environment that a module registers."""
    algorithm: str = "csac"
    """What learns; its own options are listed below."""
    preset: str | None = None
    """Hyperparameters to start from: paper is the paper's tables. Options given here win over it."""
    steps: int = 1_000_000
    """Environment steps per seed, warm-up included."""
    seeds: int = 1
    """How many seeds to train."""
    first_seed: int = 0
    """Label of the first seed; the others follow."""
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
    device: Literal["cpu", "gpu"] = "cpu"
    """Where the networks learn."""
    groups: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes to split the seeds over."""
    evaluation_interval: int = 5_000
    """Environment steps between two evaluations; there is one at the last step as well."""
    evaluation_episodes: int = 10
    """Episodes of each evaluation."""
    evaluation_processes: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes in which each group evaluates while it trains on; 0 evaluates in line. The results are the same."""
    checkpoint_interval: int = 50_000
    """Environment steps between checkpoints; there is one every ten minutes and at the end as well. 0 makes none."""
    keep_checkpoints: int = 2
    """How many of the newest checkpoints to keep; 0 keeps all."""


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
    commands = {"train": _train, "resume": _resume, "evaluate": _evaluate, "play": _play, "runs": _runs}
    if arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}{nearest(arguments[0], commands)} (csac --help)")
    try:
        return commands[arguments[0]](arguments[1:])
    except SystemExit:  # tyro has printed a command's help
        return 0


def _train(arguments: list[str]) -> int:
    from csac.algorithms import ALGORITHMS

    source = _source(peek(arguments, "--from", None))
    name = peek(arguments, "--algorithm", source["algorithm"] if source else "csac")
    if name not in ALGORITHMS:
        raise InputError(f"no algorithm is called {name!r}: choose {' or '.join(ALGORITHMS)}")
    preset, others = peek(arguments, "--preset", None), {k: v for k, v in ALGORITHMS.items() if k != name}
    # Twice: what a preset gives can depend on the task, and the task is known once the arguments are parsed.
    options = parse(_with_algorithm(ALGORITHMS, name, preset, "", source), arguments, "csac train", others)
    if preset:
        options = parse(
            _with_algorithm(ALGORITHMS, name, preset, options.task, source), arguments, "csac train", others
        )
    if options.resume and options.directory is None:
        raise InputError("--resume needs the run's --directory (csac resume DIR does without)")

    from csac.console.progress import Reporter
    from csac.training.train import train

    return _exit_code(
        lambda: train(
            getattr(options, name),
            options.task,
            steps=options.steps,
            seeds=options.seeds,
            first_seed=options.first_seed,
            directory=options.directory,
            groups=options.groups,
            evaluation_interval=options.evaluation_interval,
            evaluation_episodes=options.evaluation_episodes,
            evaluation_processes=options.evaluation_processes,
            environment_arguments=json_object("--env-kwargs", options.env_kwargs),
            perturbations=_perturbations(options.perturb),
            device=options.device,
            checkpoint_interval=options.checkpoint_interval,
            keep_checkpoints=options.keep_checkpoints,
            resume=options.resume,
            start_from=options.start_from,
            events=None if options.events is None else options.events.split(","),
            preset=preset,
            reporter=Reporter(),
            command=shlex.join(["csac", "train", *arguments]),
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
    from csac.training.train import Interrupted

    try:
        run = training()
    except Interrupted as interruption:
        line = f"{program()} resume {shlex.quote(str(interruption.run.path))}"
        return _complain(f"{interruption}; to go on, type: {line}", 128 + interruption.signal_number)
    except StorageFailure as failure:
        return _complain(f"{failure}; the run can go on from its last checkpoint (csac resume) once that is mended", 1)
    return 3 if run.manifest["state"] == "failed" else 0


def _source(where: str | None) -> dict[str, Any] | None:
    """Return the manifest of the run that another is to begin with."""
    if where is None:
        return None
    from csac.training.resume import Source

    return Source.find(where).run.manifest


def _perturbations(given: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return what a run is to be perturbed by; without a word of it None, as planned in the run that it begins with."""
    if "none" in given:
        if len(given) > 1:
            raise InputError("--perturb none leaves everything out: give it alone")
        return ()
    return given or None


def _evaluate(arguments: list[str]) -> int:
    options = parse(Evaluate, arguments, "csac evaluate")
    from csac.console.progress import told_progress
    from csac.console.tables import case_table, evaluation_table, make_console, silent_events
    from csac.evaluation.evaluator import EvaluationFailure
    from csac.evaluation.play import evaluate_run, perturbation_notes
    from csac.record.run import RunDirectory
    from csac.record.tables import COLUMNS, check_new, write_rows

    console = make_console()
    told = perturbation_notes(options.run, options.perturb)
    if options.csv:
        check_new(options.csv)
    results = {}
    try:
        with _waiting(console, "evaluating") as status:
            progress = told_progress(status, "evaluating", "episodes") if status else None
            results.update(
                evaluate_run(
                    options.run,
                    options.seed,
                    options.episodes,
                    not options.stochastic,
                    options.perturb,
                    processes=options.processes,
                    on_progress=progress,
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
        step = RunDirectory.open(options.run).manifest["steps_done"]
        rows = [episode.row(seed, step) for seed, episodes in results.items() for episode in episodes]
        write_rows(options.csv, COLUMNS["evaluations"], rows)
        console.print(str(options.csv), soft_wrap=True)
    return 0


def _play(arguments: list[str]) -> int:
    options = parse(Play, arguments, "csac play")
    from csac.console.progress import told_progress
    from csac.console.tables import make_console
    from csac.evaluation.play import perturbation_notes, play
    from csac.tasks.spaces import EnvironmentFailure

    console = make_console()
    for line in perturbation_notes(options.run, options.perturb):
        console.print(line, soft_wrap=True)
    try:
        with _waiting(console, "playing") as status:
            for episode in play(
                options.run,
                options.seed,
                options.episodes,
                options.video,
                options.perturb,
                on_progress=told_progress(status, "playing", "steps at most") if status else None,
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
    from csac.console.tables import make_console, runs_table
    from csac.record.run import find_runs

    is_default = options.directory == Path("runs")
    runs = [] if is_default and not options.directory.exists() else find_runs(options.directory)
    if runs:
        make_console().print(runs_table(runs))
    else:
        _say(f"no runs in {options.directory} yet; csac train HalfCheetah-v4 starts one")
    return 0


def _with_algorithm(
    algorithms: dict[str, Any], name: str, preset: str | None, task: str, source: dict[str, Any] | None
) -> type[Any]:
    """Return `Train` with the options of one algorithm beside its own.

    What they are by default comes from a preset or from the manifest of the run to begin with, if one is given.
    """
    presets: Any = Literal[PRESETS]
    hint = arg(help_behavior_hint=f"(default: {preset or 'none'})")
    algorithm = algorithms[name](**(hyperparameters(preset, name, task) if preset else {}))
    fields: list[Any] = []
    if source:
        from csac.training.resume import algorithm_of

        algorithm = algorithm_of(source) if source["algorithm"] == name and not preset else algorithm
        fields += [(field, type_, dataclasses.field(default=value)) for field, type_, value in _inherited(source)]
    fields += [
        ("algorithm", Literal[tuple(algorithms)], field(default=name)),
        ("preset", Annotated[presets | None, hint], field(default=preset)),
        (name, OmitArgPrefixes[type(algorithm)], field(default=algorithm)),
    ]
    return dataclasses.make_dataclass(
        "Train", fields, bases=(Train,), frozen=True, namespace={"__doc__": Train.__doc__}
    )


def _inherited(source: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return the options of `Train`, with their types, that a run takes from the one it begins with."""
    return [
        ("steps", int, source["steps"]),
        ("seeds", int, len(source["seeds"])),
        ("first_seed", int, source["seeds"][0]),
        ("evaluation_interval", int, source["evaluation"]["interval"]),
        ("evaluation_episodes", int, source["evaluation"]["episodes"]),
        ("env_kwargs", Annotated[str, arg(metavar="JSON")], json.dumps(source.get("environment_arguments", {}))),
    ]


def _waiting(console: Console, doing: str) -> AbstractContextManager[Any]:
    """Say on a terminal what takes its time."""
    return console.status(doing) if console.is_interactive else nullcontext()


def _say(text: str) -> None:
    with suppress(BrokenPipeError):
        print(text)


def _complain(message: object, code: int) -> int:
    print(f"csac: {' '.join(str(message).split())}", file=sys.stderr)
    return code


def _settle_output() -> None:
    """Write what waits; where nobody reads it any more (`csac runs | head`), leave without a fuss."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
