"""The front door: each sub-command parses its arguments and calls one function."""

from __future__ import annotations

import dataclasses
import io
import os
import shlex
import sys
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from csac.arguments import json_object, nearest, parse, peek
from csac.presets import PRESETS, hyperparameters
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

HELP = """\
usage: csac COMMAND ...

Train controllers for continuous-control tasks with Conservative Soft Actor-Critic.

  csac train TASK      train controllers for a Gymnasium task, several seeds at once
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
    env_kwargs: Annotated[str, arg(metavar="JSON")] = "{}"
    """Keyword arguments for the environment, as a JSON object."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Where the networks learn."""
    groups: Annotated[int | None, arg(help_behavior_hint="(default: as many as pay here)")] = None
    """Processes to split the seeds over."""
    evaluation_interval: int = 5_000
    """Environment steps between two evaluations; there is one at the last step as well."""
    evaluation_episodes: int = 10
    """Episodes of each evaluation."""


@dataclass(frozen=True)
class Evaluate:
    """Test the last policies of a run on fresh episodes, which neither training nor its evaluations have seen."""

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """The directory of a run."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: every seed)")] = None
    """Label of the seed to test."""
    episodes: int = 10
    """Episodes per seed, the same for each."""
    stochastic: FlagCreatePairsOff[bool] = False
    """Draw actions from the policy instead of taking its most likely one."""


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
    commands = {"train": _train, "evaluate": _evaluate, "play": _play, "runs": _runs}
    if arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}{nearest(arguments[0], commands)} (csac --help)")
    try:
        return commands[arguments[0]](arguments[1:])
    except SystemExit:  # tyro has printed a command's help
        return 0


def _train(arguments: list[str]) -> int:
    from csac.algorithms import ALGORITHMS

    name = peek(arguments, "--algorithm", "csac")
    if name not in ALGORITHMS:
        raise InputError(f"no algorithm is called {name!r}: choose {' or '.join(ALGORITHMS)}")
    preset, others = peek(arguments, "--preset", None), {k: v for k, v in ALGORITHMS.items() if k != name}
    # Twice: what a preset gives can depend on the task, and the task is known once the arguments are parsed.
    options = parse(_with_algorithm(ALGORITHMS, name, preset, ""), arguments, "csac train", others)
    if preset:
        options = parse(_with_algorithm(ALGORITHMS, name, preset, options.task), arguments, "csac train", others)

    from csac.training.console import program
    from csac.training.progress import Reporter
    from csac.training.train import Interrupted, train

    try:
        run = train(
            getattr(options, name),
            options.task,
            steps=options.steps,
            seeds=options.seeds,
            first_seed=options.first_seed,
            directory=options.directory,
            groups=options.groups,
            evaluation_interval=options.evaluation_interval,
            evaluation_episodes=options.evaluation_episodes,
            environment_arguments=json_object("--env-kwargs", options.env_kwargs),
            device=options.device,
            preset=preset,
            reporter=Reporter(),
            command=shlex.join(["csac", "train", *arguments]),
        )
    except Interrupted as interruption:
        look = f"{program()} evaluate {shlex.quote(str(interruption.run.path))}"
        return _complain(f"{interruption}; to test what was learnt, type: {look}", 128 + interruption.signal_number)
    return 3 if run.manifest["state"] == "failed" else 0


def _evaluate(arguments: list[str]) -> int:
    options = parse(Evaluate, arguments, "csac evaluate")
    from csac.training.console import evaluation_table, make_console
    from csac.training.evaluation import EvaluationFailure
    from csac.training.play import evaluate_run

    console = make_console()
    results = {}
    try:
        with _waiting(console, "evaluating"):
            results.update(evaluate_run(options.run, options.seed, options.episodes, not options.stochastic))
    except EvaluationFailure as error:
        return _complain(error, 1)
    console.print(evaluation_table(results))
    return 0


def _play(arguments: list[str]) -> int:
    options = parse(Play, arguments, "csac play")
    from csac.training.console import make_console
    from csac.training.environments import EnvironmentFailure
    from csac.training.play import play

    console = make_console()
    try:
        with _waiting(console, "playing"):
            for episode in play(options.run, options.seed, options.episodes, options.video):
                text = f"return {episode.episode_return:,.2f} in {episode.length:,} steps"
                console.print(f"episode {episode.episode}: {text}")
    except EnvironmentFailure as error:
        return _complain(error, 1)
    if options.video:
        console.print(str(options.video), soft_wrap=True)
    return 0


def _runs(arguments: list[str]) -> int:
    options = parse(Runs, arguments, "csac runs")
    from csac.record.run import find_runs
    from csac.training.console import make_console, runs_table

    is_default = options.directory == Path("runs")
    runs = [] if is_default and not options.directory.exists() else find_runs(options.directory)
    if runs:
        make_console().print(runs_table(runs))
    else:
        _say(f"no runs in {options.directory} yet; csac train HalfCheetah-v4 starts one")
    return 0


def _with_algorithm(algorithms: dict[str, Any], name: str, preset: str | None, task: str) -> type[Any]:
    """Return `Train` with the options of one algorithm beside its own; a preset sets what they are by default."""
    algorithm = algorithms[name](**(hyperparameters(preset, name, task) if preset else {}))
    presets: Any = Literal[PRESETS]
    hint = arg(help_behavior_hint=f"(default: {preset or 'none'})")
    fields = [
        ("algorithm", Literal[tuple(algorithms)], field(default=name)),
        ("preset", Annotated[presets | None, hint], field(default=preset)),
        (name, OmitArgPrefixes[type(algorithm)], field(default=algorithm)),
    ]
    return dataclasses.make_dataclass(
        "Train", fields, bases=(Train,), frozen=True, namespace={"__doc__": Train.__doc__}
    )


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
