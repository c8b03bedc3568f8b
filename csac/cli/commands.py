"""Implement the sub-commands of `csac`."""

from __future__ import annotations

import dataclasses
import shlex
from contextlib import nullcontext, suppress
from typing import TYPE_CHECKING, Any

from csac.checks import did_you_mean
from csac.cli.exits import complain, interrupted, leave
from csac.cli.options import Evaluate, Export, Latency, List, Play, Resume, Train, Tune, learner_of, parse_training
from csac.cli.parsing import HelpShown, parse
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from csac.record.sets import RunSet


def run(name: str, words: list[str]) -> int:
    """Run a sub-command and return its exit code. Raises InputError, Failure, and KeyboardInterrupt on a signal."""
    command = shlex.join(["csac", name, *words])
    try:
        if name == "study":
            return _study(words)
        if name == "report":
            from csac.studies.commands import Report, report

            return report(parse(Report, words, "csac report"), command)
        if name not in COMMANDS:
            hint = did_you_mean(name, [*COMMANDS, "report", "study"]) or "csac --help lists them"
            raise InputError(f"no command is called {name!r}: {hint}")
        kind, function = COMMANDS[name]
        leaving = nullcontext
        if name in ("train", "resume"):
            from csac.training.signals import leaving_at_once as leaving  # imports NumPy
        with leaving():
            options = (parse_training if name in ("train", "tune") else parse)(kind, words, f"csac {name}")
            return function(options, command)
    except HelpShown:
        return 0


def _train(options: Any, command: str) -> int:
    from csac.training.train import train

    return _run_training(train, learner_of(options), options.task, **options.options(), command=command)


def _resume(options: Resume, command: str) -> int:
    from csac.training.train import resume

    return _run_training(resume, **vars(options), command=command)


def _run_training(training: Callable[..., RunSet], *arguments: Any, **options: Any) -> int:
    """Train and return the exit code; if training was stopped, print the command that resumes it."""
    from csac.console.tables import program
    from csac.training.signals import Interrupted

    try:
        runs = training(*arguments, **options)
    except Interrupted as stop:
        line = f"; to go on, type: {program()} resume {shlex.quote(str(stop.runs.path))}" if stop.can_resume else ""
        return complain(f"{stop}{line}", 128 + stop.signal_number)
    except KeyboardInterrupt as second:
        return leave(complain("stopped at once: what came after the last checkpoint is lost", interrupted(second)))
    return 3 if runs.failures else 0


def _evaluate(options: Evaluate, _: str) -> int:
    from csac.console import tables
    from csac.console.waiting import progress_shown
    from csac.deploy.choosing import has_policy, load_run
    from csac.evaluation.play import evaluate_run, perturbation_notes
    from csac.record.files import writing
    from csac.record.sets import RunSet
    from csac.record.tables import COLUMNS, append_rows, check_new

    arguments, console, runs = dict(vars(options)), tables.make_console(), RunSet.open(options.directory)
    file, deterministic = arguments.pop("csv"), not arguments.pop("stochastic")
    target = file and file.absolute()  # a task may change the working directory
    notes = perturbation_notes(options.directory, options.perturbations)
    if file:
        check_new(file)
    which: Any = options.which
    chosen = [run for run in runs.runs if options.seed in (None, run.seed) and has_policy(run, which)]
    steps = {run.seed: load_run(run, which).step or run.manifest.steps_done for run in chosen}  # a run may go on
    with progress_shown(console, "evaluating", "episodes") as on_progress:
        results = dict(evaluate_run(**arguments, deterministic=deterministic, on_progress=on_progress))
    tables.print_lines(console, notes)
    for table in tables.evaluation_tables(results, runs.failures):
        console.print(table)
    failed = {seed: reason for seed, reason in runs.failures.items() if seed in results}
    notes = [f"seed {seed} failed at {reason}; it is in no mean, and in no file" for seed, reason in failed.items()]
    sound = [run for run in runs.runs if run.seed in results and run.seed not in failed]
    untested = [str(seed) for seed in runs.seeds if seed not in results and options.seed is None]
    notes += [f"without such a policy yet: seed {', '.join(untested)}"] * bool(untested)
    tables.print_lines(console, [f"note: {text}" for text in dict.fromkeys(notes)])
    rows = [episode.row(run.seed, steps[run.seed]) for run in sound for episode in results[run.seed]]
    if target and rows:
        with writing(target):
            append_rows(target, COLUMNS["evaluations"], rows)
        tables.print_lines(console, [str(file)])
    return 0


def _play(options: Play, _: str) -> int:
    from csac.console.tables import make_console, print_lines
    from csac.console.waiting import progress_shown
    from csac.evaluation.play import perturbation_notes, play
    from csac.record.rendering import number

    console = make_console()
    print_lines(console, perturbation_notes(options.directory, options.perturbations))
    with progress_shown(console, "playing", "steps at most") as on_progress:
        for episode in play(**vars(options), on_progress=on_progress):
            outcome = f"return {number(episode.episode_return)} in {episode.length:,} steps"
            print_lines(console, [f"episode {episode.episode}: {outcome}"])
    print_lines(console, [str(options.video)] * bool(options.video))
    return 0


def _export(options: Export, _: str) -> int:
    from csac.console.tables import export_lines, make_console, print_lines
    from csac.evaluation.export import export_run

    console = make_console()
    with console.status("exporting") if console.is_interactive else nullcontext():
        exported = export_run(**vars(options))
    print_lines(console, [str(exported.place), *export_lines(exported.fields["verification"])])
    print_lines(console, [f"note: {text}" for text in exported.notes])
    return 0


def _latency(options: Latency, _: str) -> int:
    if not options.artefacts:
        raise InputError("give the folder of an artefact (csac export writes one)")
    from csac.console.tables import latency_table, make_console, print_lines
    from csac.deploy.artefact import open_artefact
    from csac.deploy.latency import measure

    console, measured = make_console(), {}
    for name, artefact in {str(path): open_artefact(path, optimise=True) for path in options.artefacts}.items():
        print_lines(console, [f"measuring {name}"])  # no live display: it would take CPU time
        measured[name] = measure(artefact, options.calls, options.rate, options.seconds)
    console.print(latency_table(measured))
    return 0


def _runs(options: List, _: str) -> int:
    from csac.console.tables import make_console, print_lines, run_lines
    from csac.record.sets import find_sets

    damaged: list[InputError] = []
    is_there = options.directory != List.directory or options.directory.exists()
    runs = find_sets(options.directory, damaged.append) if is_there else []
    lines = [*run_lines(runs), *(f"damaged: {error}" for error in damaged)]
    print_lines(make_console(), lines or [f"no runs in {options.directory} yet; csac train HalfCheetah-v4 starts one"])
    return 0


def _study(words: list[str]) -> int:
    from csac.studies.commands import COMMANDS, HELP

    if not words or words[0] in ("-h", "--help"):
        with suppress(BrokenPipeError):
            print(HELP.rstrip())
        return 0
    if words[0] not in COMMANDS:
        hint = did_you_mean(words[0], COMMANDS) or "csac study --help lists them"
        raise InputError(f"no study command is called {words[0]!r}: {hint}")
    kind, run = COMMANDS[words[0]]
    return run(parse(kind, words[1:], f"csac study {words[0]}"))


def _tune(options: Any, command: str) -> int:
    from csac.console.tables import make_console
    from csac.record.config import RunConfig
    from csac.seeds import TUNING_EVALUATION_SEED
    from csac.studies.search import Search, space_of
    from csac.studies.tune import tune
    from csac.training.config import seed_range

    learner = learner_of(options)
    typed = [word.partition("=")[0][2:].replace("-", "_") for word in shlex.split(command) if word.startswith("--")]
    wanted = [name.replace("-", "_") for name in options.search] or None
    settings = {item.name: getattr(options, item.name) for item in dataclasses.fields(RunConfig)}
    config = RunConfig(**{**settings, "seed": options.first_seed, "evaluation_seed": TUNING_EVALUATION_SEED})
    seed_range(options.seeds, options.first_seed)
    search = Search(config=config, seeds=options.seeds, algorithm=learner, space=space_of(learner, wanted, typed))
    return tune(search, options.home(), options.trials, command, make_console())


COMMANDS: dict[str, tuple[type, Callable[[Any, str], int]]] = {
    "train": (Train, _train),
    "resume": (Resume, _resume),
    "evaluate": (Evaluate, _evaluate),
    "play": (Play, _play),
    "export": (Export, _export),
    "latency": (Latency, _latency),
    "runs": (List, _runs),
    "tune": (Tune, _tune),
}
