"""What each sub-command does."""

from __future__ import annotations

import shlex
from contextlib import nullcontext, suppress
from typing import TYPE_CHECKING, Any

from csac.checks import did_you_mean
from csac.cli import complain, interrupted
from csac.cli.options import Evaluate, Export, Latency, List, Play, Resume, Train, Tune, learner_of, parse_training
from csac.cli.parsing import HelpShown, parse
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from csac.record.sets import RunSet


def run(name: str, words: list[str]) -> int:
    """Run a sub-command and return its exit code.

    Raises:
        InputError, Failure: a user's mistake, or what ends the command.
        KeyboardInterrupt: a signal, where nothing is to be saved.
    """
    command = shlex.join(["csac", name, *words])
    try:
        if name == "study":
            return _study(words)
        if name == "report":
            from csac.studies.commands import Report, report

            return report(parse(Report, words, "csac report"), command)
        if name not in COMMANDS:
            raise InputError(
                f"no command is called {name!r}{_hint(name, [*COMMANDS, 'report', 'study'])} (csac --help)"
            )
        kind, function = COMMANDS[name]
        with _leaving_at_once() if name in ("train", "resume") else nullcontext():
            options = (parse_training if name in ("train", "tune") else parse)(kind, words, f"csac {name}")
            return function(options, command)
    except HelpShown:
        return 0


def _train(options: Any, command: str) -> int:
    from csac.training.train import train

    return _trained(train, learner_of(options), options.task, **options.options(), command=command)


def _resume(options: Resume, command: str) -> int:
    from csac.training.train import resume

    return _trained(resume, options.runs, steps=options.steps, trust_task=options.trust_task, command=command)


def _leaving_at_once() -> Any:
    from csac.training.signals import leaving_at_once  # NumPy comes with it

    return leaving_at_once()


def _trained(training: Callable[..., RunSet], *given: Any, **options: Any) -> int:
    """Train, and return the exit code; where it was stopped, print the line to type next."""
    from csac.console.progress import Reporter
    from csac.console.tables import program
    from csac.training.signals import Interrupted

    try:
        runs = training(*given, **options, reporter=Reporter())
    except Interrupted as stop:
        line = f"; to go on, type: {program()} resume {shlex.quote(str(stop.runs.path))}" if stop.can_resume else ""
        return complain(f"{stop}{line}", 128 + stop.signal_number)
    except KeyboardInterrupt as second:
        return complain("stopped at once: what came after the last checkpoint is lost", interrupted(second))
    return 3 if runs.failures else 0


def _evaluate(options: Evaluate, _: str) -> int:
    from csac.console import tables
    from csac.console.waiting import progress_shown
    from csac.deploy.choosing import step_of_policy
    from csac.evaluation.play import evaluate_run, perturbation_notes
    from csac.record.sets import RunSet
    from csac.record.tables import COLUMNS, check_new, write_rows

    console, notes = tables.make_console(), perturbation_notes(options.runs, options.perturb)
    if options.csv:
        check_new(options.csv)
    with progress_shown(console, "evaluating", "episodes") as on_progress:
        results = dict(
            evaluate_run(
                options.runs,
                options.seed,
                options.episodes,
                not options.stochastic,
                options.perturb,
                options.processes,
                on_progress,
                options.trust_task,
                options.checkpoint,
            )
        )
    runs = RunSet.open(options.runs)
    sound = {seed: episodes for seed, episodes in results.items() if seed not in runs.failures}
    tables.print_lines(console, notes)
    for table in tables.evaluation_tables(results, runs.failures):
        console.print(table)
    failed = [f"seed {seed} failed at {runs.failures[seed]}" for seed in results.keys() & runs.failures.keys()]
    silent = tables.silent_events(results)
    untested = [] if options.seed is not None else [str(seed) for seed in runs.seeds if seed not in results]
    tables.print_lines(
        console,
        [f"note: {text}; it is in no mean, and in no file of rows" for text in failed]
        + [f"note: no episode's last info holds a number called {name!r}" for name in silent]
        + [f"note: without such a policy yet: seed {', '.join(untested)}"] * bool(untested)
        + _unlearnt(runs),
    )
    if options.csv:
        steps = {seed: step_of_policy(runs.run(seed), options.checkpoint) for seed in sound}
        rows = [episode.row(seed, steps[seed]) for seed, episodes in sound.items() for episode in episodes]
        if not rows:
            return complain(f"{options.csv} is not written: every seed that was tested had failed in training", 1)
        write_rows(options.csv, COLUMNS["evaluations"], rows)
        tables.print_lines(console, [str(options.csv)])
    return 0


def _play(options: Play, _: str) -> int:
    from csac.console.tables import make_console, print_lines
    from csac.console.waiting import progress_shown
    from csac.evaluation.play import perturbation_notes, play
    from csac.record.rendering import number

    console = make_console()
    print_lines(console, perturbation_notes(options.runs, options.perturb))
    with progress_shown(console, "playing", "steps at most") as on_progress:
        for episode in play(
            options.runs,
            options.seed,
            options.episodes,
            options.video,
            options.perturb,
            on_progress,
            options.trust_task,
            options.checkpoint,
        ):
            told = f"return {number(episode.episode_return)} in {episode.length:,} steps"
            print_lines(console, [f"episode {episode.episode}: {told}"])
    print_lines(console, [str(options.video)] * bool(options.video))
    return 0


def _export(options: Export, _: str) -> int:
    from csac.console.exports import export_lines
    from csac.console.tables import make_console, print_lines
    from csac.evaluation.export import export_run
    from csac.record.sets import RunSet

    console = make_console()
    with console.status("exporting") if console.is_interactive else nullcontext():
        exported = export_run(
            options.runs,
            options.format,
            options.seed,
            options.checkpoint,
            options.out,
            options.fallback,
            options.rate_limit,
            options.episodes,
            options.card,
            trust_task=options.trust_task,
        )
    print_lines(console, [str(exported.place), *export_lines(exported.fields["verification"])])
    print_lines(console, [f"note: {text}" for text in exported.notes] + _unlearnt(RunSet.open(options.runs)))
    return 0


def _unlearnt(runs: RunSet) -> list[str]:
    """Return what to say of policies that are as they began, since their runs were stopped in the warm-up."""
    manifest = runs.runs[0].manifest
    warmup = manifest.config.hyperparameters.get("warmup_steps", 0)
    if manifest.steps_done >= warmup or manifest.forked_from:
        return []
    return [f"note: this policy has never learnt: {manifest.steps_done:,} of {warmup:,} warm-up steps are done"]


def _latency(options: Latency, _: str) -> int:
    if not options.artefacts:
        raise InputError("give the folder of an artefact (csac export writes one)")
    from csac.console.exports import latency_table
    from csac.console.tables import make_console, print_lines
    from csac.deploy.latency import measure

    console, measured = make_console(), {}
    for path in options.artefacts:
        print_lines(console, [f"measuring {path}"])  # once: what moves on a terminal takes time from a core
        measured[str(path)] = measure(path, options.calls, options.rate, options.seconds)
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
        raise InputError(f"no study command is called {words[0]!r}{_hint(words[0], COMMANDS)} (csac study --help)")
    kind, run = COMMANDS[words[0]]
    return run(parse(kind, words[1:], f"csac study {words[0]}"))


def _tune(options: Any, command: str) -> int:
    from csac.console.tables import make_console
    from csac.studies.search import Search, space_of
    from csac.studies.tune import tune

    learner = learner_of(options)
    given = [word.partition("=")[0][2:].replace("-", "_") for word in shlex.split(command) if word.startswith("--")]
    wanted = [name.replace("-", "_") for name in options.search] or None
    names = ("task", "steps", "seeds", "first_seed", "device", "evaluation_interval", "evaluation_episodes")
    names += ("checkpoint_interval", "keep_checkpoints", "environment_arguments")
    search = Search(
        **{name: getattr(options, name) for name in names},
        algorithm=learner,
        space=space_of(learner, wanted, given),
    )
    return tune(search, options.home(), options.trials, command, make_console())


def _hint(word: str, known: Iterable[str]) -> str:
    hint = did_you_mean(word, known, most=2)
    return f"; {hint}" if hint else ""


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
