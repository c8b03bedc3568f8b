"""Evaluate a run's policies on fresh episodes, or play them in a window or into a video."""

from __future__ import annotations

import os
import sys
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_flag, check_whole
from csac.deploy.choosing import has_policy, load, load_run
from csac.evaluation.episode import EvaluationFailure, RunningEpisode
from csac.evaluation.evaluator import LONGEST_EPISODE, Evaluator, check_contract
from csac.evaluation.pool import EvaluationPool, choose_processes
from csac.record.sets import RunSet
from csac.seeds import FRESH_EVALUATION_SEED
from csac.tasks.environment import Environment
from csac.tasks.failures import message
from csac.tasks.perturbations import constant_perturbations, unlike_training, values_at
from csac.tasks.registry import adapter_of
from csac.tasks.trust import named_task
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from csac.evaluation.episode import EvaluationEpisode
    from csac.evaluation.pool import OnProgress
    from csac.record.run import Which
    from csac.tasks.perturbations import Perturbation

DEFAULT_FRAMES_PER_SECOND = 30
SECONDS_ON_SCREEN = 1.0  # minimum duration of an episode in a video: its last frame is repeated to fill it


def evaluate_run(
    directory: str | Path,
    seed: int | None = None,
    episodes: int = 10,
    deterministic: bool = True,
    perturbations: str | Perturbation | Iterable[str | Perturbation] = (),
    processes: int | None = None,
    on_progress: OnProgress | None = None,
    trust_task: bool = False,
    which: Which = "last",
) -> Iterator[tuple[int, list[EvaluationEpisode]]]:
    """Yield (seed, episodes) for each seed of a run, or for one `seed`; `which` is the last or the best policy.

    The episodes are the same for every seed, and occur neither in training nor in its evaluations. The task is the
    run's unperturbed task with these `perturbations`, which hold throughout. `processes` share the episodes, by default
    as many as are worthwhile; 1 means this process. The results do not depend on their number. A run trained with
    `evaluation_environments=0` opens one environment at a time here too. `on_progress(episodes done, episodes in all)`
    is called after each batch of episodes. `trust_task` allows importing the task's module even if the user has never
    named it on this machine (`csac.tasks.trust`).

    Raises:
        InputError: a missing run or seed, a damaged file, a task that can no longer be created, does not support the
            perturbations, or whose module the user has never named.
        EvaluationFailure: an environment raised or returned a non-finite value.
    """
    check_flag("deterministic", deterministic)
    runs = _open(directory, trust_task)
    task, arguments = runs.config.task, runs.config.environment_arguments
    chosen = [run for run in runs.runs if has_policy(run, which)] if seed is None else [runs.run(seed)]
    if not chosen:
        raise InputError(f"{runs.path} holds no {which} policies: an evaluation writes them")
    policies = {run.seed: load_run(run, which) for run in chosen}
    evaluator_arguments = task, arguments, episodes, FRESH_EVALUATION_SEED, runs.config.events
    evaluator = Evaluator(*evaluator_arguments, environments=runs.config.evaluation_environments or 1)
    evaluator.perturb(values_at(constant_perturbations(perturbations), 0))
    with closing(Environment(task, arguments)) as environment:
        environment.perturb(evaluator.perturbed)
        for policy in policies.values():
            check_contract(policy, environment)
    if processes is None:
        processes = choose_processes(evaluator, len(policies)) if runs.config.evaluation_environments else 1
    with closing(evaluator if processes == 1 else EvaluationPool(evaluator, processes)) as workers:
        results = workers.begin(list(policies.values()), deterministic, on_progress).results()
    for label, result in zip(policies, results, strict=True):
        if isinstance(result, EvaluationFailure):
            raise result
        yield label, result


def play(
    directory: str | Path,
    seed: int | None = None,
    episodes: int = 1,
    video: str | Path | None = None,
    perturbations: str | Perturbation | Iterable[str | Perturbation] = (),
    on_progress: OnProgress | None = None,
    trust_task: bool = False,
    which: Which = "last",
) -> Iterator[EvaluationEpisode]:
    """Play a run's policy in a window or, with `video`, into an .mp4 file; yield the episodes.

    The default `seed` is the one with the best last evaluations; `which` is as in `csac.load`. The video is complete
    once the iterator is exhausted. `on_progress(steps done, steps at most)` is called after each step. An episode is
    cut off at `LONGEST_EPISODE` steps. `perturbations` and `trust_task` are as in `evaluate_run`.

    Raises:
        InputError: as `evaluate_run`, or rendering is not possible; the message says what to do.
        EvaluationFailure: the environment raised or returned a non-finite value.
    """
    run, perturbed = _open(directory, trust_task), values_at(constant_perturbations(perturbations), 0)
    check_whole("episodes", episodes, 1, LONGEST_EPISODE)
    policy = load(directory, seed, which)
    with closing(_drawn_environment(run, video)) as environment:
        limit = environment.raw.spec.max_episode_steps if environment.raw.spec else None
        longest, done = min(limit or LONGEST_EPISODE, LONGEST_EPISODE), 0
        check_contract(policy, environment)
        environment.perturb(perturbed)
        with nullcontext() if video is None else _filming(environment, run.config.task, video) as film:
            for number in range(episodes):
                episode = RunningEpisode(environment, number, FRESH_EVALUATION_SEED + number, longest)
                observation = episode.start()
                if film:
                    film.add()
                while not episode.ended:
                    action = policy.contract.to_environment(policy.act(observation[None])[0])
                    observation = episode.step(action)
                    if film:
                        film.add()
                    if on_progress:
                        on_progress(done + episode.length, done + (episodes - number) * longest)
                done += episode.length
                if film:
                    film.end_episode()
                yield episode.result()


def perturbation_notes(
    directory: str | Path, perturbations: str | Perturbation | Iterable[str | Perturbation]
) -> list[str]:
    """Return a line on the perturbations of an evaluation, or else on those that only its training had, if any."""
    if parsed := constant_perturbations(perturbations):
        return [f"perturbed: {', '.join(item.label for item in parsed)}"]
    trained = RunSet.open(directory).config.perturbations
    return [f"{line}: see --perturb" for line in unlike_training(trained)]


def _open(directory: str | Path, trust_task: bool) -> RunSet:
    """Open a run and check that its task may be created here. Raise InputError if not."""
    run = RunSet.open(directory)
    named_task(run.config, run.path, trust_task, "evaluate it in Python, with csac.load and csac.evaluate")
    return run


def _drawn_environment(run: RunSet, video: str | Path | None) -> Environment:
    """Create the environment of a run for rendering. Raise InputError if it cannot be rendered."""
    task, arguments = run.config.task, run.config.environment_arguments
    has_display = not sys.platform.startswith("linux") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if video is None and not has_display:
        raise InputError("there is no display to play on: write a video instead, with --video out.mp4")
    if video is not None and Path(video).suffix.lower() != ".mp4":
        raise InputError(f"the video is an .mp4 file: name it so, not {video}")
    if not has_display:
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is first imported
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # without it, pygame complains that there is no display
    adapter = adapter_of(task)
    if adapter and video is not None:
        arguments = {**adapter.picture_arguments, **arguments}
    try:
        environment = Environment(task, arguments, "human" if video is None else "rgb_array")
    except InputError as error:
        raise _cannot_be_drawn(task, error) from error
    renderer = getattr(environment.raw.unwrapped, "mujoco_renderer", None)
    if renderer and renderer.camera_id == -1:  # Gymnasium's default free camera does not follow the body
        with suppress(KeyError):  # the model has no such camera
            renderer.camera_id = renderer.model.camera("track").id
    return environment


def _cannot_be_drawn(task: str, error: Exception) -> InputError:
    reason, hint = message(error), ""
    if os.environ.get("MUJOCO_GL") == "egl" and "egl" in reason.lower():
        hint = "; to draw without a display, MuJoCo needs the system's EGL library (on Debian: apt install libegl1)"
    return InputError(f"{task} cannot be drawn: {reason}{hint}")


class _Film:
    """Write rendered frames of an environment into a video."""

    def __init__(self, environment: Environment, task: str, path: Path) -> None:
        adapter, raw = adapter_of(task), environment.raw
        self._picture: Callable[[], Any] = adapter.camera(raw) if adapter and adapter.camera else raw.render
        speed = (adapter and adapter.pictures_per_second) or raw.metadata.get("render_fps") or DEFAULT_FRAMES_PER_SECOND
        self._frames_per_second, self._task, self._path = speed, task, path
        self._writer: Any = None
        self._frames_written = 0  # in this episode
        self._last = np.zeros((0, 0, 3), np.uint8)

    def add(self) -> None:
        """Render and write a frame. Raise InputError if rendering fails."""
        try:
            pixels = np.asarray(self._picture())
        except Exception as error:
            raise _cannot_be_drawn(self._task, error) from error
        if pixels.ndim != 3 or pixels.shape[2] < 3:
            raise InputError(f"{self._task} draws no pictures, so there is no video of it")
        self._last = np.ascontiguousarray(pixels[:, :, :3], dtype=np.uint8)
        self._write()

    def end_episode(self) -> None:
        """Repeat the last frame until the episode lasts `SECONDS_ON_SCREEN`."""
        while self._frames_written < round(SECONDS_ON_SCREEN * self._frames_per_second):
            self._write()
        self._frames_written = 0

    def close(self) -> None:
        if self._writer:
            self._writer.close()

    def _write(self) -> None:
        if self._writer is None:
            import imageio_ffmpeg

            size, speed = self._last.shape[1::-1], self._frames_per_second
            self._writer = imageio_ffmpeg.write_frames(
                str(self._path), size, fps=speed, macro_block_size=2, ffmpeg_log_level="error"
            )
            self._writer.send(None)
        self._writer.send(self._last)
        self._frames_written += 1


@contextmanager
def _filming(environment: Environment, task: str, video: str | Path) -> Iterator[_Film]:
    """Yield a film that is written to a temporary file, and renamed to `video` once it is complete."""
    path = Path(video).absolute()  # a task may change the working directory
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    film = _Film(environment, task, temporary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        yield film
        film.close()
        if not temporary.stat().st_size:  # ffmpeg may exit before anything is written
            raise OSError("ffmpeg failed")
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or 'ffmpeg failed'}; choose another place") from error
    finally:
        film.close()
        with suppress(OSError):  # renamed already, or another error is on its way
            temporary.unlink()
