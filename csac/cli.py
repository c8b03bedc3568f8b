"""The front door: each sub-command parses its arguments and calls one function."""

from __future__ import annotations

import dataclasses
import errno
import faulthandler
import io
import os
import shlex
import signal
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from csac.arguments import HelpShown, json_object, nearest, options_in, parse
from csac.commands import Chosen, Evaluate, Export, Latency, Play, Report, Resume, Runs, Tune
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager

    from csac.record.manifest import Manifest
    from csac.record.run import RunDirectory

HELP = """\
usage: csac COMMAND ...

Train controllers for continuous-control tasks with Conservative Soft Actor-Critic.

  csac train TASK      train controllers for a Gymnasium task, several seeds at once
  csac resume DIR      resume a run that was stopped or killed
  csac evaluate DIR    test the policies of a run on fresh episodes
  csac play DIR        watch the policy of a run, or record a video
  csac export DIR      export a policy as NumPy, ONNX or C, and verify it
  csac latency PATH    measure how long an exported policy takes per action
  csac runs [DIR]      list the runs below a directory
  csac report DIR...   compare runs: a page of curves, tables and commands
  csac study COMMAND   run the paper's experiments, or your own
  csac tune TASK       search for good hyperparameters

  csac COMMAND --help  explain a command and its options
  csac --version       print the version

To begin: csac train HalfCheetah-v4 --seeds 2 --steps 60_000
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `csac` with `arguments`, by default the command line's, and return its exit code.

    0 done, 1 a failing environment (internal errors are raised), 2 wrong arguments or input, 3 finished but a seed
    failed, 130 SIGINT, 143 SIGTERM.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _open_standard_streams()
    with suppress(OSError, ValueError):  # where a caller's stderr is no file
        if not faulthandler.is_enabled():
            faulthandler.enable()  # a fault in a simulator's native code ends one seed's process, which is this one
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        code = _answer(arguments)
    finally:
        failure = _settle_output()
    return _full(failure) if failure and not code else code


def _answer(arguments: list[str]) -> int:
    try:
        return _dispatch(arguments)
    except InputError as error:
        return _complain(error, 2)
    except KeyboardInterrupt as interruption:
        return _code(interruption)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        return _full(error)


def _full(error: OSError) -> int:
    return _complain(f"not all of the output could be written: {error.strerror}", 1)


def _code(interruption: KeyboardInterrupt) -> int:
    return 143 if signal.SIGTERM in interruption.args else 130


def _dispatch(arguments: list[str]) -> int:
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in ("-h", "--help"):
        _say(HELP.rstrip())
        return 0
    if arguments[0] in ("--version", "-V", "version"):
        from csac import __version__

        _say(f"csac {__version__}")
        return 0
    commands = {
        "train": _train,
        "resume": _resume,
        "evaluate": _evaluate,
        "play": _play,
        "export": _export,
        "latency": _latency,
        "runs": _runs,
        "report": _report,
        "study": _study,
        "tune": _tune,
    }
    if arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}{nearest(arguments[0], commands)} (csac --help)")
    try:
        with _signals_before_training() if arguments[0] in ("train", "resume") else nullcontext():
            return commands[arguments[0]](arguments[1:])
    except HelpShown:
        return 0


def _signals_before_training() -> AbstractContextManager[None]:
    from csac.training.interruptions import leaving_at_once  # NumPy comes with it

    return leaving_at_once()


def _train(arguments: list[str]) -> int:
    chosen = Chosen.among(arguments)
    options = parse(chosen.command(_first_word(arguments)), arguments, "csac train", chosen.others())
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
            wandb=options.wandb,
            reporter=Reporter(),
            command=shlex.join(["csac", "train", *arguments]),
            **options.plan_options(),
            **chosen.inherited(),
        )
    )


def _first_word(arguments: list[str]) -> str:
    """Return the task where it comes first, so that the help shows what a preset gives for it."""
    return "" if not arguments or arguments[0].startswith("-") else arguments[0]


def _resume(arguments: list[str]) -> int:
    from csac.algorithms import ALGORITHMS

    options = parse(Resume, arguments, "csac resume", ALGORITHMS)
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
    from csac.training.interruptions import Interrupted, StoppedAtOnce

    try:
        run = training()
    except (Interrupted, StoppedAtOnce) as stop:
        line = f"; to go on, type: {program()} resume {shlex.quote(str(stop.run.path))}" if stop.can_go_on else ""
        if isinstance(stop, Interrupted):
            return _complain(f"{stop}{line}", 128 + stop.signal_number)
        return _complain(
            f"stopped at once: what {stop.run.path} did since its last checkpoint is lost{line}", _code(stop)
        )
    except StorageFailure as failure:
        return _complain(f"{failure}; the run can go on from its last checkpoint (csac resume) once that is mended", 1)
    return 3 if run.manifest.state == "failed" else 0


def _evaluate(arguments: list[str]) -> int:
    options = parse(Evaluate, arguments, "csac evaluate")
    from csac.console.tables import case_table, evaluation_table, make_console, silent_events
    from csac.console.waiting import progress_shown
    from csac.deploy.choosing import load
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
                    which=options.checkpoint,
                )
            )
    except EvaluationFailure as error:
        return _complain(error, 1)
    for line in told:
        console.print(line, soft_wrap=True)
    run = RunDirectory.open(options.run)
    manifest = run.manifest
    console.print(evaluation_table(results, manifest.failures))
    sound = {seed: episodes for seed, episodes in results.items() if seed not in manifest.failures}
    if (cases := case_table(sound)) is not None:
        console.print(cases)
    for name in silent_events(results):
        _say(f"note: no episode's last info holds a number called {name!r}")
    if options.seed is None and (others := [one for one in run.seeds_with_policies() if one not in results]):
        names = ", ".join(map(str, others))
        _say(f"note: not tested, never evaluated in training and so without a best policy: seed {names}")
    for seed in sorted(results.keys() & manifest.failures.keys()):
        _say(f"note: seed {seed} failed at {manifest.failures[seed]}; it is in no mean, and in no file of rows")
    _tell_of_warmup(manifest)
    if options.csv:
        steps = {seed: load(run.path, seed, options.checkpoint).step for seed in sound}
        rows = [episode.row(seed, steps[seed]) for seed, episodes in sound.items() for episode in episodes]
        if not rows:
            return _complain(f"{options.csv} is not written: every seed that was tested had failed in training", 1)
        write_rows(options.csv, COLUMNS["evaluations"], rows)
        console.print(str(options.csv), soft_wrap=True)
    return 0


def _play(arguments: list[str]) -> int:
    options = parse(Play, arguments, "csac play")
    from csac.console.tables import make_console
    from csac.console.waiting import progress_shown
    from csac.evaluation.play import perturbation_notes, play
    from csac.record.rendering import number
    from csac.tasks.failures import EnvironmentFailure

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
                which=options.checkpoint,
            ):
                text = f"return {number(episode.episode_return)} in {episode.length:,} steps"
                console.print(f"episode {episode.episode}: {text}")
    except EnvironmentFailure as error:
        return _complain(error, 1)
    if options.video:
        console.print(str(options.video), soft_wrap=True)
    return 0


def _export(arguments: list[str]) -> int:
    options = parse(Export, arguments, "csac export")
    from csac.console.exports import export_lines
    from csac.console.tables import make_console
    from csac.console.waiting import progress_shown
    from csac.evaluation.evaluator import EvaluationFailure
    from csac.evaluation.export import export_run
    from csac.record.run import RunDirectory

    console = make_console()
    try:
        with progress_shown(console, "exporting", "artefacts"):
            exported = export_run(
                options.run,
                options.format,
                options.seed_label(),
                options.checkpoint,
                options.out,
                options.fallback,
                options.rate_limit,
                options.episodes,
                options.card,
                trust_task=options.trust_task,
            )
    except EvaluationFailure as error:
        return _complain(error, 1)
    for line in (str(exported.place), *export_lines(exported.fields["verification"])):
        console.print(line, soft_wrap=True)
    for line in exported.notes:
        _say(f"note: {line}")
    _tell_of_warmup(RunDirectory.open(options.run).manifest)
    return 0


def _tell_of_warmup(manifest: Manifest) -> None:
    """Say where a policy is as it began, since its run was stopped in the warm-up."""
    warmup = manifest.hyperparameters.get("warmup_steps", 0)
    if manifest.steps_done < warmup and not manifest.forked_from:
        _say(f"note: this policy has never learnt: {manifest.steps_done:,} of {warmup:,} warm-up steps are done")


def _latency(arguments: list[str]) -> int:
    options = parse(Latency, arguments, "csac latency")
    if not options.artefacts:
        raise InputError("give the folder of an artefact (csac export writes one)")
    from csac.console.exports import latency_table
    from csac.console.tables import make_console
    from csac.deploy.artefact import open_artefact
    from csac.deploy.latency import measure

    console, measured = make_console(), {}
    for name, artefact in {str(path): open_artefact(path, optimise=True) for path in options.artefacts}.items():
        console.print(f"measuring {name}", soft_wrap=True)  # once: what moves on a terminal takes time from a core
        measured[name] = measure(artefact, options.calls, options.rate, options.seconds)
    console.print(latency_table(measured))
    return 0


def _runs(arguments: list[str]) -> int:
    options = parse(Runs, arguments, "csac runs")
    from csac.console.tables import make_console, print_runs
    from csac.record.run import find_runs

    is_default = options.directory == Path("runs")
    damaged: list[InputError] = []
    runs = [] if is_default and not options.directory.exists() else find_runs(options.directory, damaged.append)
    if runs:
        print_runs(make_console(), runs)
    for error in damaged:
        _say(f"damaged: {error}")
    if not runs and not damaged:
        _say(f"no runs in {options.directory} yet; csac train HalfCheetah-v4 starts one")
    return 0


def _report(arguments: list[str]) -> int:
    options = parse(Report, arguments, "csac report")
    from csac.studies import run_report as reports  # matplotlib is slow to import
    from csac.studies.comparison import Comparison, read_runs

    place = options.place()
    runs = read_runs(options.runs, options.labels(), lambda error: print(f"damaged: {error}", file=sys.stderr))
    comparison = Comparison(runs, options.perturb, options.until)
    reports.refuse_places(comparison, options.curve, options.out)
    if place:
        page, name = place
        reports.write_table(comparison, page, name, options.table or "returns")
        _say(str(page))
    if options.curve:
        reports.draw_curves(comparison, options.curve, options.title)
        _say(str(options.curve))
    if options.out or not (options.into or options.curve):
        command = shlex.join(["csac", "report", *arguments])
        path = reports.write_run_report(comparison, options.out or reports.default_page(), options.title, [command])
        _say(f"{path}\n{path.with_suffix('.md')}")
    if not comparison.has_rows:
        until = "" if options.until is None else f" up to step {options.until:,}"
        _say(f"note: there is no evaluation{until} in these runs, so there is little in it")
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


def _tune(arguments: list[str]) -> int:
    chosen = Chosen.among(arguments)
    options = parse(chosen.command(_first_word(arguments), Tune), arguments, "csac tune", chosen.others())
    if chosen.preset:  # what it gives can depend on the task, which is known by now
        options = parse(chosen.command(options.task, Tune), arguments, "csac tune", chosen.others())
    algorithm = getattr(options, chosen.algorithm)
    from csac.record.run import StorageFailure
    from csac.studies.search_space import searched
    from csac.studies.shared_study import Question
    from csac.studies.tune_command import run_tune
    from csac.training.options import Options

    words = None if options.search is None else options.search.replace("-", "_").split(",")
    wanted = words and [word.strip() for word in words]
    question = Question(
        **{item.name: getattr(options, item.name) for item in dataclasses.fields(Options)},
        task=options.task,
        algorithm=algorithm,
        space=searched(chosen.algorithm, dataclasses.asdict(algorithm), wanted, options_in(arguments)),
        environment_arguments=json_object("--env-kwargs", options.env_kwargs),
    )
    try:
        return run_tune(question, options.home(), options.trials, options.groups, arguments)
    except StorageFailure as failure:
        return _complain(f"{failure}; the same line goes on once that is mended", 1)


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


def _settle_output() -> OSError | None:
    """Write what waits, or return why that fails; where nobody reads it any more (`csac runs | head`), that is none."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return None if isinstance(error, BrokenPipeError) else error
    return None
