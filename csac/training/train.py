"""`train`: one call from a task to a run directory. The command line calls nothing else."""

from __future__ import annotations

import dataclasses
import errno
import os
import pickle
import platform
import signal
import subprocess
import threading
from contextlib import closing, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import psutil

from csac import __version__
from csac.record.run import RunDirectory, StorageFailure, default_directory, is_run
from csac.tasks.environment import Environment
from csac.tasks.known import adapter_of, check_events, events_of
from csac.tasks.making import Task
from csac.tasks.perturbations import by_step, perturbations_of, refuse_late
from csac.tasks.trust import refuse_untrusted, remember
from csac.training.checkpoint import FOLDER, Checkpoints
from csac.training.compilation import tidy_programs
from csac.training.messages import Settings
from csac.training.recorder import Recorder
from csac.training.resume import (
    BEGINNING,
    Point,
    Source,
    algorithm_of,
    arguments_of,
    refuse_differences,
    roll_back,
    with_past,
)
from csac.training.scheduler import choose_evaluation_processes, choose_groups, run_groups, split_seeds
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from csac.console.progress import Reporter
    from csac.record.tensorboard import TensorBoardLog
    from csac.tasks.perturbations import Perturbation
    from csac.types import Algorithm, Spec

    OnEvaluation = Callable[[int, dict[int, float]], Any]
    StopWhen = Callable[[int, dict[int, float]], bool]

# Measured resident size of a worker process with JAX, MuJoCo and the compiled programs, before its replay.
BYTES_PER_PROCESS = 600 * 2**20
# Likewise of one that evaluates on MuJoCo, without JAX. PyBullet's environments take several times that, in line too.
BYTES_PER_EVALUATION_PROCESS = 80 * 2**20

_CANNOT_WRITE = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENOENT,
    errno.EIO,
    errno.EFBIG,
)


class Interrupted(Exception):
    """Training was stopped by a signal; what was learnt is saved in `run`."""

    def __init__(self, run: RunDirectory, signal_number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signal_number).name}; saved in {run.path}")
        self.run, self.signal_number = run, signal_number


def train(
    algorithm: Algorithm,
    task: Task,
    *,
    steps: int = 1_000_000,
    seeds: int = 1,
    first_seed: int = 0,
    directory: str | Path | None = None,
    groups: int | None = 1,
    evaluation_interval: int = 5_000,
    evaluation_episodes: int = 10,
    evaluation_processes: int | None = 0,
    environment_arguments: dict[str, Any] | None = None,
    perturbations: str | Perturbation | Iterable[str | Perturbation] | None = None,
    device: str = "cpu",
    checkpoint_interval: int = 50_000,
    keep_checkpoints: int = 2,
    resume: bool = False,
    start_from: str | Path | None = None,
    events: Sequence[str] | None = None,
    preset: str | None = None,
    tensorboard: bool = True,
    reporter: Reporter | None = None,
    command: str | None = None,
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
) -> RunDirectory:
    """Train `seeds` controllers for `steps` environment steps each and return the finished run.

    Args:
        algorithm: a hyperparameter dataclass such as `CSAC()`.
        task: a Gymnasium id, `module:Id`, or a callable that makes an environment.
        steps: environment steps per seed, warm-up included.
        seeds: how many independent seeds; they are `first_seed`, `first_seed + 1`, ...
        first_seed: label of the first one.
        directory: the run directory; by default `runs/<task>/<algorithm>/<date-time>`.
        groups: processes to split the seeds over: 1 trains in this process, None chooses by the cores. With more
            than one, a script needs the usual `if __name__ == "__main__":` guard.
        evaluation_interval: environment steps between evaluations; there is one at the last step as well.
        evaluation_episodes: episodes of each evaluation.
        evaluation_processes: processes in which each group evaluates while it trains on; 0 evaluates in line, None
            chooses by the cores. The run is the same to the last bit; `on_evaluation` is called later. A script needs
            the guard here too. With `stop_when`, which would come too late, evaluation is in line.
        environment_arguments: keyword arguments for the environment.
        perturbations: changes of the task, in training and evaluations, such as `("friction=1.5@300000",)`: see
            `Perturbation`. What a run begins with (`start_from`) keeps what had happened to it; with None also what was
            still to happen.
        device: "cpu" or "gpu".
        checkpoint_interval: environment steps between checkpoints; there is one every ten minutes, at the last step and
            when a signal stops the run as well. 0 makes none.
        keep_checkpoints: how many of the newest checkpoints to keep; 0 keeps all.
        resume: go on with the run in `directory`, where there is one, from its newest checkpoint.
        start_from: `DIRECTORY` or `DIRECTORY@STEP` of a run: begin with a copy of its checkpoint of that step.
        events: names in the `info` of an evaluation episode's last step (booleans or numbers): each becomes a column of
            evaluations.csv, beside those that the task has by itself. None keeps those of the run that this one goes on
            from or begins with.
        preset: the name of the preset that the hyperparameters came from, for the manifest.
        tensorboard: whether to write TensorBoard files.
        reporter: where progress is shown; None is silent.
        command: the command line, for the manifest.
        on_evaluation: called as `on_evaluation(step, {seed: mean return})` after each evaluation.
        stop_when: called in the same way; training ends early, and counts as finished, once it returns True.

    Raises:
        InputError: a mistake in the arguments; nothing has been written then.
        Interrupted: on SIGINT or SIGTERM, after everything was saved.
        StorageFailure: the run directory can no longer be written; it is as sound as if the run had been killed.
    """
    environment_arguments = dict(environment_arguments or {})
    _check(steps=steps, seeds=seeds, evaluation_interval=evaluation_interval, evaluation_episodes=evaluation_episodes)
    _check_not_negative(
        first_seed=first_seed,
        checkpoint_interval=checkpoint_interval,
        keep_checkpoints=keep_checkpoints,
        evaluation_processes=evaluation_processes or 0,
    )
    if evaluation_processes and stop_when:
        raise InputError("stop_when is asked before training goes on: leave out evaluation_processes")
    check_events(events or ())
    _choose_device(device)
    with closing(Environment(task, environment_arguments)) as environment:
        spec, task_name = environment.spec, environment.task_name
        remember(task)
        path = Path(directory) if directory is not None else default_directory(task_name, algorithm.name)
        existing = RunDirectory.open(path) if resume and is_run(path) else None
        source = Source.find(start_from) if start_from is not None and not existing else None
        changes = with_past(perturbations, existing, source)
        if not existing:  # whose number of steps has its own refusal
            refuse_late(changes, steps, planned=source is not None and perturbations is None)
        for item in changes:
            environment.perturb({item.kind: item.value})

    labels = list(range(first_seed, first_seed + seeds))
    before = existing or (source.run if source else None)
    names = events_of(task, events or ()) if events is not None or not before else before.manifest.get("events", ())
    parts = split_seeds(labels, _choose_number_of_groups(groups, labels, device, existing))
    settings = Settings(
        algorithm,
        task,
        environment_arguments,
        steps,
        evaluation_interval,
        evaluation_episodes,
        (path / FOLDER).absolute() if checkpoint_interval else None,
        checkpoint_interval,
        events=tuple(names),
        perturbations=changes,
        evaluation_processes=evaluation_processes or 0,
    )
    if len(parts) > 1 or evaluation_processes:
        _check_picklable(settings)
    if evaluation_processes is None and not stop_when and evaluation_interval < steps and _is_picklable(settings):
        settings = settings._replace(evaluation_processes=choose_evaluation_processes(parts, evaluation_episodes))
    notes = [_memory_note(settings, spec, seeds, len(parts)), *_warmup_note(algorithm, steps)]
    manifest = {
        "task": task_name,
        "task_is_callable": not isinstance(task, str),
        "environment_arguments": environment_arguments,
        "perturbations": [str(item) for item in changes],
        "algorithm": algorithm.name,
        "hyperparameters": dataclasses.asdict(algorithm),  # pyright: ignore[reportArgumentType]
        "preset": preset,
        "seeds": labels,
        "groups": parts,
        "steps": steps,
        "evaluation": {"interval": evaluation_interval, "episodes": evaluation_episodes},
        "events": list(names),
        "checkpoints": {"interval": checkpoint_interval, "keep": keep_checkpoints},
        "device": device,
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "host": platform.node()},
        "versions": _versions(task),
        "commit": _commit(),
        "command": command,
        "process": os.getpid(),
    }
    watchers = _Watchers(reporter, tensorboard, on_evaluation, stop_when)
    if existing:
        refuse_differences(existing, manifest, algorithm)
        with existing.locked(), _storage_failures_told(existing):
            return _go_on(existing, settings, manifest, notes, watchers)
    if source:
        source.refuse_misfit(manifest, algorithm, spec)
        run = RunDirectory.create(path, {**manifest, "forked_from": source.described(manifest)})
        with run.locked(), _storage_failures_told(run):
            source.copy_to(run, keep_checkpoints)
            return _go_on(run, settings, manifest, notes, watchers)
    run = RunDirectory.create(path, manifest)
    with run.locked(), _storage_failures_told(run):
        return _run(run, settings, notes, watchers, BEGINNING)


def resume(
    directory: str | Path,
    *,
    steps: int | None = None,
    evaluation_processes: int | None = 0,
    trust_task: bool = False,
    reporter: Reporter | None = None,
    command: str | None = None,
    on_evaluation: OnEvaluation | None = None,
    stop_when: StopWhen | None = None,
) -> RunDirectory:
    """Go on with a run from its newest checkpoint; everything but a larger number of `steps` comes from its manifest.

    `trust_task` lets the task import its module though nobody has named it here (`csac.tasks.trust`);
    `evaluation_processes` and `reporter` and what follows it are as in `train`.

    Raises:
        InputError: there is no such run, it cannot go on (the message says why), or its task is a Python function:
            call `train` with it and `resume=True` then.
        Interrupted: as `train`.
        StorageFailure: as `train`.
    """
    run = RunDirectory.open(directory)
    refuse_untrusted(run.manifest["task"], run.path, trust_task)
    return train(
        algorithm_of(run.manifest),
        **arguments_of(run),
        steps=run.manifest["steps"] if steps is None else steps,
        directory=directory,
        groups=None,
        evaluation_processes=evaluation_processes,
        resume=True,
        tensorboard=(run.path / "tensorboard").exists(),
        reporter=reporter,
        command=command,
        on_evaluation=on_evaluation,
        stop_when=stop_when,
    )


class _Watchers(NamedTuple):
    """Who is told what happens, beside the run directory."""

    reporter: Reporter | None
    tensorboard: bool
    on_evaluation: OnEvaluation | None
    stop_when: StopWhen | None


def _go_on(
    run: RunDirectory, settings: Settings, manifest: dict[str, Any], notes: list[str], watchers: _Watchers
) -> RunDirectory:
    """Go on with a run from its newest sound checkpoint."""
    if run.manifest["state"] in ("finished", "failed") and run.manifest["steps_done"] >= settings.steps:
        if watchers.reporter:
            watchers.reporter.note(f"{run.path} has made its {settings.steps:,} steps already; more: --steps")
        return run
    point = roll_back(run)
    history = [*run.manifest["history"], point.history_entry(run.manifest, manifest)]
    current = {
        name: manifest[name] for name in ("machine", "versions", "groups", "steps", "process", "device", "checkpoints")
    }
    notes = [*notes, *point.notes(run.manifest, manifest)]
    run.update_manifest(**current, state="running", history=history, failures=point.failures, steps_done=point.step)
    folder = (run.path / FOLDER).absolute() if point.step else settings.checkpoints  # needed, if only to be read
    return _run(run, settings._replace(begin=point.step, checkpoints=folder), notes, watchers, point)


def _run(run: RunDirectory, settings: Settings, notes: list[str], watchers: _Watchers, point: Point) -> RunDirectory:
    """Train until the last step, a signal or a failure, and write down what happens."""
    reporter, labels, begin, failures = watchers.reporter, run.manifest["seeds"], point.step, point.failures
    groups = [group for group in run.manifest["groups"] if not set(group) <= set(failures)]
    notes = [*notes, *filter(None, [tidy_programs()])]
    if reporter:
        reporter.start(run.manifest["task"], run.manifest["algorithm"], labels, settings.steps, run.path, notes)
        reporter.go_on(begin, run.evaluations, failures)
    log = _tensorboard_log(run, labels, begin) if watchers.tensorboard else None
    checkpoints = None
    if settings.checkpoints:
        checkpoints = Checkpoints(settings.checkpoints, run.manifest["checkpoints"]["keep"], point.pinned)
    recorder = Recorder(run, groups, reporter, log, checkpoints, begin, failures, by_step(settings.perturbations))
    received, told = [], False
    try:
        with (
            _signals() as (stop, received),
            closing(run_groups(settings, groups, stop.is_set, checkpoints)) as messages,
        ):
            for group, message in messages:
                if received and reporter and not told:
                    told = True
                    reporter.note("stopping at the next step where all can be saved; once more to leave at once")
                recorder.handle(group, message)
                if _tell_caller(recorder, watchers.on_evaluation, watchers.stop_when):
                    stop.set()
        recorder.close()
        stopped = bool(received) and not recorder.is_complete(settings.steps)  # a signal may come too late
        _finish(run, recorder, "interrupted" if stopped else "failed" if recorder.failures else "finished")
        if reporter:
            reporter.finish(run)
    except BaseException:
        _leave(run, recorder)
        raise
    finally:
        if log:
            log.close()
        if reporter:
            reporter.close()
    if stopped:
        raise Interrupted(run, received[0])
    return run


def _tensorboard_log(run: RunDirectory, labels: list[int], begin: int) -> TensorBoardLog:
    from csac.record.tensorboard import TensorBoardLog  # slow to import, and some runs do without

    return TensorBoardLog(run.path / "tensorboard", labels, begin)


@contextmanager
def _storage_failures_told(run: RunDirectory) -> Iterator[None]:
    """Raise StorageFailure where the run can no longer be written."""
    try:
        yield
    except OSError as error:
        if error.errno in _CANNOT_WRITE:
            raise StorageFailure(f"{run.path} cannot be written: {error.strerror}") from error
        raise


def _leave(run: RunDirectory, recorder: Recorder) -> None:
    """Write what can still be written of a run that an error ends; it can go on from its last checkpoint."""
    with suppress(OSError):
        recorder.close()
        run.update_manifest(state="interrupted")


def _choose_number_of_groups(groups: int | None, labels: list[int], device: str, existing: RunDirectory | None) -> int:
    if groups is not None:
        return groups
    if existing and existing.manifest["seeds"] == labels:
        return len(existing.manifest["groups"])  # so that the numbers stay the same to the last bit
    return choose_groups(len(labels), device)


def _tell_caller(recorder: Recorder, on_evaluation: OnEvaluation | None, stop_when: StopWhen | None) -> bool:
    """Call the caller's functions for each new evaluation; return whether the run is to end early."""
    enough = False
    while recorder.evaluated:
        step, returns = recorder.evaluated.pop(0)
        if on_evaluation:
            on_evaluation(step, returns)
        enough = bool(stop_when and stop_when(step, returns)) or enough
    return enough


def _finish(run: RunDirectory, recorder: Recorder, state: str) -> None:
    rows = run.evaluations
    if len(rows):
        name, task = run.manifest["algorithm"].upper(), run.manifest["task"]
        perturbed = by_step(perturbations_of(run.manifest.get("perturbations", [])))
        marks = [(step, text) for step, text in perturbed if step <= rows["step"].max()]
        from csac.record.plots import learning_curve  # matplotlib is slow to import

        learning_curve([(name, rows)], run.path / "curve.png", title=task, marks=marks)
    run.update_manifest(state=state, failures=recorder.failures)


@contextmanager
def _signals() -> Iterator[tuple[threading.Event, list[int]]]:
    """Yield (a request to stop, the signals behind it). A second SIGINT or SIGTERM is taken literally.

    SIGHUP is ignored: a run outlives its terminal.
    """
    stop, received = threading.Event(), []
    if threading.current_thread() is not threading.main_thread():
        yield stop, received
        return

    def note(number: int, _: Any) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)
        stop.set()

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    if hasattr(signal, "SIGHUP"):
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield stop, received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check(**counts: int) -> None:
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError(f"{name} must be a whole number of at least 1, not {count!r}")


def _check_not_negative(**counts: int) -> None:
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise InputError(f"{name} must be a whole number of 0 or more, not {count!r}")


def _check_picklable(settings: Settings) -> None:
    try:
        pickle.dumps(settings)
    except Exception as error:
        wanted, without = ("evaluation_processes need", "evaluation_processes=0")
        if not settings.evaluation_processes:
            wanted, without = ("several groups need", "groups=1")
        raise InputError(
            f"the task cannot be sent to another process, which {wanted}: "
            f"make it a module's function, or train with {without} ({error})"
        ) from None


def _is_picklable(settings: Settings) -> bool:
    try:
        pickle.dumps(settings)
    except Exception:
        return False
    return True


def _choose_device(device: str) -> None:
    if device not in ("cpu", "gpu"):
        raise InputError(f"device must be cpu or gpu, not {device!r}")
    before, platform_name = os.environ.get("JAX_PLATFORMS"), "cpu" if device == "cpu" else "cuda"
    jax.config.update("jax_platforms", platform_name)
    if device == "gpu":
        try:
            jax.devices()
        except Exception as error:  # which one depends on what is missing, and on JAX's version
            jax.config.update("jax_platforms", before)
            raise InputError("no GPU that JAX can use: install csac[cuda], or choose the cpu") from error
    # Every dispatch is waited for at once: handing it to another thread would only cost the hand-over.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    os.environ |= {"JAX_PLATFORMS": platform_name, "JAX_CPU_ENABLE_ASYNC_DISPATCH": "0"}  # for the workers


def _memory_note(settings: Settings, spec: Spec, seeds: int, groups: int) -> str:
    """Return the line that predicts the memory needed; refuse what cannot fit."""
    algorithm, steps = settings.algorithm, settings.steps
    shapes = jax.eval_shape(
        lambda key: (algorithm.init(key, spec, steps), algorithm.memory(spec, steps)),
        jax.ShapeDtypeStruct((2,), "uint32"),
    )
    per_seed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
    evaluating = groups * settings.evaluation_processes
    needed = seeds * per_seed + groups * BYTES_PER_PROCESS + evaluating * BYTES_PER_EVALUATION_PROCESS
    available = psutil.virtual_memory().available
    text = f"memory: about {needed / 2**30:.1f} GiB of the {available / 2**30:.1f} GiB available"
    if needed > available:
        raise InputError(
            f"this run needs about {needed / 2**30:.1f} GiB of memory and {available / 2**30:.1f} GiB are available: "
            f"use fewer seeds, fewer groups or a smaller replay (one seed takes {per_seed / 2**30:.2f} GiB)"
        )
    beside = f", {evaluating} of them to evaluate" if evaluating else ""
    processes = groups + evaluating
    return f"{text} ({seeds} x {per_seed / 2**20:.0f} MiB, {processes} process{'es' if processes > 1 else ''}{beside})"


def _warmup_note(algorithm: Algorithm, steps: int) -> list[str]:
    if steps >= algorithm.warmup_steps:
        return []
    return [
        f"note: nothing will be learnt, since all {steps:,} steps are warm-up (warmup_steps={algorithm.warmup_steps:,})"
    ]


def _versions(task: Task) -> dict[str, str]:
    robots = ("pybullet", "PyFlyt", "panda-gym") if adapter_of(task) else ()
    versions = {"csac": __version__, "python": platform.python_version()}
    for package in ("jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco", *robots):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _processor() -> str:
    """Return the processor's model, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _commit() -> str | None:
    """Return the commit of csac's own checkout, if it runs from one."""
    try:
        folder = Path(__file__).parent
        result = subprocess.run(
            ["git", "-C", folder, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None
