"""The policies of a finished run again, on fresh episodes: played for the eye, evaluated for the numbers."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csac.checks import check_flag
from csac.deploy.choosing import has_policy, load, load_run
from csac.evaluation.evaluator import LONGEST_EPISODE, EvaluationEpisode, Evaluator, check_contract
from csac.evaluation.pool import EvaluationPool, choose_processes
from csac.record.files import check_name
from csac.record.sets import RunSet
from csac.tasks.environment import Environment
from csac.tasks.known import adapter_of
from csac.tasks.perturbations import constant_perturbations, unlike_training, values_at
from csac.tasks.seeds import FRESH_EVALUATION_SEED
from csac.tasks.trust import refuse_untrusted
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator

    from csac.evaluation.evaluator import OnProgress
    from csac.record.run import Which
    from csac.tasks.perturbations import Perturbation

DEFAULT_FRAMES_PER_SECOND = 30
SECONDS_ON_SCREEN = 1.0  # that an episode has at least: its last picture stays for as long as it takes


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
    """Yield (seed, episodes) for the last policy of each seed of a run, or of the one asked for, or for the best one.

    The episodes are the same for every seed, and none that training or its evaluations have seen. The task is the one
    that the run began with, but for these `perturbations`, which last from beginning to end. The episodes are shared by
    `processes`, by default as many as pay; 1 is this one. Whatever their number, the results are the same.
    `on_progress(episodes done, of how many)` is called after each batch of episodes. `trust_task` lets the task import
    its module though nobody has named it here (`csac.tasks.trust`).

    Raises:
        InputError: no run there, no such seed, a damaged file, a task that can no longer be made or perturbed so, or
            one whose module has never been named here.
        EvaluationFailure: an environment raised, or gave what is not finite; or a process died.
    """
    check_flag("deterministic", deterministic)
    runs = _open(directory, trust_task)
    config = runs.config
    evaluator = Evaluator(config.task, config.environment_arguments, episodes, FRESH_EVALUATION_SEED, config.events)
    evaluator.perturb(values_at(constant_perturbations(perturbations), 0))
    chosen = [run for run in runs.runs if has_policy(run, which)] if seed is None else [runs.run(seed)]
    if not chosen:
        raise InputError(f"{runs.path} holds no {which} policies yet: the first evaluation writes them")
    labels, policies = [run.seed for run in chosen], [load_run(run, which) for run in chosen]
    processes = choose_processes(evaluator, len(policies)) if processes is None else processes
    if processes == 1:
        workers = evaluator
    else:
        Environment(config.task, config.environment_arguments).close()  # says what is to be said
        workers = EvaluationPool(evaluator, processes)
    try:
        yield from zip(labels, workers.run_all(policies, deterministic, on_progress), strict=True)
    finally:
        workers.close()


def perturbation_notes(
    directory: str | Path, perturbations: str | Perturbation | Iterable[str | Perturbation]
) -> list[str]:
    """Return the lines that say what is changed in a test of a run, or what was in its training and is not here."""
    given = constant_perturbations(perturbations)
    if given:
        return [f"perturbed: {', '.join(item.label for item in given)}"]
    return [f"{line}: see --perturb" for line in unlike_training(RunSet.open(directory).config.perturbations)]


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
    """Yield the episodes that a run's policy plays, in a window or, with `video`, into an .mp4 file.

    Without `seed` it is the seed with the best last evaluations; `which` is as in `csac.load`. The video is there once
    the last episode was yielded. `on_progress(steps done, of how many at most)` is called after each step. An episode
    that reaches `LONGEST_EPISODE` steps is broken off there. `perturbations` and `trust_task` are as in `evaluate_run`.

    Raises:
        InputError: as `evaluate_run`, or nothing to draw with: the message says what to do.
        EnvironmentFailure: the environment raised, or gave what is not finite.
    """
    run, perturbed = _open(directory, trust_task), values_at(constant_perturbations(perturbations), 0)
    if episodes < 1:
        raise InputError(f"{episodes} episodes: play at least one")
    policy = load(directory, seed, which)
    if video is None:
        _require_display()
    else:
        _check_video(Path(video))
        _draw_off_screen()
    environment = _drawn_environment(run, "human" if video is None else "rgb_array")
    adapter = adapter_of(run.config.task)
    picture = adapter.camera(environment.raw) if adapter and adapter.camera else environment.raw.render
    frames_per_second = round(
        (adapter and adapter.pictures_per_second)
        or environment.raw.metadata.get("render_fps")
        or DEFAULT_FRAMES_PER_SECOND
    )
    longest, done = _longest_episode(environment), 0
    try:
        check_contract(policy, environment)
        environment.perturb(perturbed)
        _follow(environment)
        with _recording(environment, picture, frames_per_second, video) as record:
            for number in range(episodes):
                observation = environment.reset(FRESH_EVALUATION_SEED + number)
                episode_return, length, ended = 0.0, 0, False
                record()
                while not ended:
                    action = policy.contract.to_environment(policy.act(observation[None])[0])
                    observation, reward, terminated, truncated, _ = environment.step_environment_scale(action)
                    episode_return, length = episode_return + reward, length + 1
                    ended = terminated or truncated or length >= longest
                    record()
                    if on_progress:
                        on_progress(done + length, done + (episodes - number) * longest)
                done += length
                for _ in range(length + 1, round(SECONDS_ON_SCREEN * frames_per_second)):
                    record(again=True)
                yield EvaluationEpisode(number, episode_return, length, None)
    finally:
        environment.close()


def _longest_episode(environment: Environment) -> int:
    """Return how many steps an episode can have."""
    limit = environment.raw.spec.max_episode_steps if environment.raw.spec else None
    return min(limit or LONGEST_EPISODE, LONGEST_EPISODE)


def _open(directory: str | Path, trust_task: bool) -> RunSet:
    """Open a run whose task is to be made."""
    run = RunSet.open(directory)
    if run.config.task_is_callable:
        raise InputError(
            f"the task of {directory} was made by a Python function, {run.config.task}: "
            "evaluate it in Python, with csac.load and csac.evaluate"
        )
    refuse_untrusted(run.config.task, run.path, trust_task)
    return run


def _follow(environment: Environment) -> None:
    """Have the camera follow the body: Gymnasium's own would watch a HalfCheetah run out of the picture."""
    renderer = getattr(environment.raw.unwrapped, "mujoco_renderer", None)
    if renderer is None or renderer.camera_id != -1 or "trackbodyid" in (renderer.default_cam_config or {}):
        return
    with suppress(KeyError):  # no such camera
        renderer.camera_id = renderer.model.camera("track").id


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("there is no display to play on: write a video instead, with --video out.mp4")


def _draw_off_screen() -> None:
    """Have MuJoCo draw without a display. It reads this variable when it is first imported."""
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


def _check_video(path: Path) -> None:
    if path.suffix.lower() != ".mp4":
        better = path.with_suffix(".mp4") if path.name else path / "video.mp4"
        raise InputError(f"the video is an .mp4 file: name it {better}")
    check_name(path, _aside(path))
    if path.is_dir():
        raise InputError(f"{path} is a directory: give the name of a file for the video")


def _drawn_environment(run: RunSet, render_mode: str) -> Environment:
    task, arguments = run.config.task, run.config.environment_arguments
    adapter = adapter_of(task)
    if adapter and render_mode == "rgb_array":
        arguments = {**adapter.picture_arguments, **arguments}
    try:
        return Environment(task, arguments, render_mode)
    except InputError as error:
        raise _cannot_be_drawn(task, error) from error


def _cannot_be_drawn(task: str, error: Exception) -> InputError:
    reason = " ".join(str(error).split())
    hint = ""
    if os.environ.get("MUJOCO_GL") == "egl" and "egl" in reason.lower():
        hint = "; to draw without a display, MuJoCo needs the system's EGL library (on Debian: apt install libegl1)"
    return InputError(f"{task} cannot be drawn: {reason}{hint}")


@contextmanager
def _recording(
    environment: Environment, picture: Callable[[], Any], frames_per_second: int, video: str | Path | None
) -> Iterator[Callable[..., None]]:
    """Yield a function that adds the present picture to the video, or the last one again.

    The video gets its name once it is whole.
    """
    if video is None:
        yield lambda again=False: None
        return
    path = Path(video)
    aside = _aside(path)
    writer: list[Generator[None, Any, None]] = []
    frame = np.zeros((0, 0, 3), np.uint8)

    def record(again: bool = False) -> None:
        nonlocal frame
        frame = frame if again else _frame(environment, picture)
        if not writer:
            writer.append(_open_video(aside, frame.shape, frames_per_second))
        writer[0].send(frame)

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield record
        for open_writer in writer:
            open_writer.close()
        aside.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {_reason(error, aside)}; choose another place") from error
    finally:
        for open_writer in writer:
            open_writer.close()
        with suppress(OSError):  # what was raised is told
            aside.unlink()


def _reason(error: OSError, aside: Path) -> str:
    """Say in a few words why there is no video: a failure of ffmpeg's comes as a broken pipe with its whole command."""
    if error.strerror:
        return error.strerror
    try:
        aside.open("ab").close()
    except OSError as own:
        return own.strerror or str(own)
    return "ffmpeg broke off, for the reason that it gave above"


def _aside(path: Path) -> Path:
    return path.with_name(f".{os.getpid()}.{path.name}")


def _frame(environment: Environment, picture: Callable[[], Any]) -> np.ndarray:
    """Return the present picture, uint8 [height, width, 3]."""
    try:
        frame = picture()
    except Exception as error:
        raise _cannot_be_drawn(environment.task_name, error) from error
    pixels = np.asarray(frame)
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise InputError(f"{environment.task_name} draws no pictures, so there is no video of it")
    return np.ascontiguousarray(pixels[:, :, :3], dtype=np.uint8)


def _open_video(path: Path, shape: tuple[int, ...], frames_per_second: int) -> Generator[None, Any, None]:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path), (shape[1], shape[0]), fps=frames_per_second, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    return writer
