"""Support PyBullet tasks: adapters for panda-gym and PyFlyt, cameras, and keeping their output off the terminal."""

from __future__ import annotations

import ctypes
import io
import logging
import os
import re
import tempfile
from contextlib import contextmanager, redirect_stdout, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

_CONTEXT = 2  # waypoints in the observation: the current one and the next
_EYE = np.array([0.0, 0.0, 0.5])  # metres above the drone
_BESIDE = np.array([-0.6, -0.6, 0.3])  # metres from the drone

# What PyBullet prints (the second half only with a window), and the escape codes with which PyFlyt's Aviary erases it.
# It may follow other output, such as a progress display, on the same line.
_CHATTER = re.compile(
    r"(?:pybullet build time: [^\n]*|arg[cv](?:\[\d+\])? ?=[^\n]*|\x1b\[A *\x1b\[A|b3(?:Printf|Warning|Error)[^\n]*"
    r"|startThreads creating [^\n]*|start(?:ed|ing) thread \d+[^\n]*|numActiveThreads = \d+|stopping threads"
    r"|GL_[A-Z_]+=[^\n]*|MotionThreadFunc: [^\n]*|Thread with taskId [^\n]*|Thread TERMINATED)\r?\n"
)

_log = logging.getLogger(__name__)


class Adapter(NamedTuple):
    """Settings of a known task.

    Importing `module` registers the task. `wrap` turns its observation into one array. `events` are names in the
    `info` of an episode's last step. `has_memory` says that an episode depends on earlier ones in the same environment.
    The rest is for videos: the environment's arguments, frames per second, and a function that returns a camera.
    """

    module: str
    wrap: Callable[[gymnasium.Env], gymnasium.Env] | None = None
    events: tuple[str, ...] = ()
    has_memory: bool = False
    picture_arguments: Mapping[str, Any] = MappingProxyType({})
    pictures_per_second: int | None = None
    camera: Callable[[gymnasium.Env], Callable[[], np.ndarray]] | None = None


class FlatWaypoints(gymnasium.ObservationWrapper):
    """Flattens the observation of PyFlyt's waypoint tasks: attitude, then the next waypoints, zeros after the last.

    The values equal those of PyFlyt's `FlattenWaypointEnv(context_length=2)`, whose space has the wrong size.
    """

    def __init__(self, environment: gymnasium.Env) -> None:
        super().__init__(environment)
        attitude = environment.observation_space["attitude"]  # pyright: ignore[reportIndexIssue]
        deltas = environment.observation_space["target_deltas"].feature_space  # pyright: ignore[reportIndexIssue]
        self._shape = (_CONTEXT, deltas.shape[0])
        self.observation_space = Box(-np.inf, np.inf, (attitude.shape[0] + _CONTEXT * deltas.shape[0],), np.float64)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return attitude and waypoints, [attitude + 2 waypoint], metres in the drone's own frame."""
        waypoints = np.zeros(self._shape)
        near = observation["target_deltas"][:_CONTEXT]
        waypoints[: len(near)] = near
        return np.concatenate([observation["attitude"], waypoints.ravel()])


def follow(environment: gymnasium.Env) -> Callable[[], np.ndarray]:
    """Return a camera that shows a drone from beside it, always from the same side: uint8 [480, 640, 4].

    PyFlyt's own camera sits in the drone's nose: it never shows the drone.
    """
    drone: Any = environment.unwrapped

    def picture() -> np.ndarray:
        position = drone.env.state(0)[-1]
        return _photograph(drone.env, position + _BESIDE, position)

    return picture


def chase(environment: gymnasium.Env) -> Callable[[], np.ndarray]:
    """Return a camera that looks from behind the drone towards its next waypoint: uint8 [480, 640, 4].

    PyFlyt's own camera sits in the drone's nose and mostly sees the ground.
    """
    drone: Any = environment.unwrapped
    direction = np.zeros(3)

    def picture() -> np.ndarray:
        nonlocal direction
        position = drone.env.state(0)[-1]
        if len(drone.waypoints.targets):
            offset = drone.waypoints.targets[0] - position
            wanted = offset / max(float(np.linalg.norm(offset)), 1e-6)
            # Turn gradually towards a new waypoint, but at once in a new episode.
            direction = wanted if drone.step_count == 0 else 0.9 * direction + 0.1 * wanted
        level = direction * np.array([1.0, 1.0, 0.3])
        return _photograph(drone.env, position - 1.2 * level + _EYE, position + level)

    return picture


def _photograph(client: Any, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Render the view from `eye`, kept above the ground, towards `target`, in metres: uint8 [480, 640, 4]."""
    eye = np.maximum(eye, (-np.inf, -np.inf, 0.1))
    view = client.computeViewMatrix(eye.tolist(), target.tolist(), [0.0, 0.0, 1.0])
    projection = client.computeProjectionMatrixFOV(fov=60.0, aspect=640 / 480, nearVal=0.05, farVal=60.0)
    return np.asarray(client.getCameraImage(640, 480, view, projection)[2], np.uint8).reshape(480, 640, 4)


_WAYPOINTS = Adapter(
    "PyFlyt.gym_envs",
    FlatWaypoints,
    events=("out_of_bounds", "collision", "env_complete", "num_targets_reached"),
)
_PYFLYT = Adapter("PyFlyt.gym_envs")
# Pushing, lifting and stacking leave state in PyBullet's solver that a reset does not clear.
_PANDA = Adapter(
    "panda_gym",
    has_memory=True,
    picture_arguments={"render_target_position": (-0.25, 0.0, 0.25), "render_distance": 1.3, "render_pitch": -25},
    pictures_per_second=10,
)

ADAPTERS: Mapping[str, Adapter] = {
    "PyFlyt/QuadX-Waypoints-v1": _WAYPOINTS._replace(camera=chase),
    "PyFlyt/QuadX-Hover-v1": _PYFLYT._replace(events=("out_of_bounds", "collision"), camera=follow),
    "PyFlyt/Fixedwing-Waypoints-v1": _WAYPOINTS,
    "PyFlyt/Rocket-Landing-v1": _PYFLYT._replace(events=("out_of_bounds", "fatal_collision", "env_complete")),
    **{
        f"Panda{task}{control}{reward}-v3": _PANDA._replace(has_memory=task not in ("Reach", "Slide"))
        for task in ("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip")
        for control in ("", "Joints")
        for reward in ("", "Dense")
    },
}
FAMILIES = {"PyFlyt/": _PYFLYT, "Panda": Adapter("panda_gym")}  # for other ids with these prefixes


@contextmanager
def quietly() -> Iterator[None]:
    """Redirect what PyBullet prints in this block to the log, at level DEBUG.

    PyBullet prints from C, past Python's streams, and PyFlyt from Python, whose streams need not write to the file
    descriptors (a notebook's do not). Any other output is passed on at the end of the block.
    """
    written = io.StringIO()
    try:
        with _filter_descriptor(1), _filter_descriptor(2), redirect_stdout(written):
            yield
    finally:
        print(_without_chatter(written.getvalue()), end="")


@contextmanager
def _filter_descriptor(descriptor: int) -> Iterator[None]:
    """Redirect a file descriptor to a file during this block, then pass on what is not chatter."""
    _flush()
    original = os.dup(descriptor)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        try:
            yield
        finally:
            _flush()
            os.dup2(original, descriptor)
            os.close(original)
            file.seek(0)
            rest = _without_chatter(file.read().decode(errors="surrogateescape"))
            with open(descriptor, "w", errors="surrogateescape", closefd=False) as output:
                output.write(rest)


def _without_chatter(written: str) -> str:
    if chatter := _CHATTER.findall(written):
        _log.debug("PyBullet: %s", "".join(chatter).strip())
    return _CHATTER.sub("", written)


def _flush() -> None:
    """Flush the standard outputs of Python and C."""
    with suppress(OSError):  # the reader is gone
        print(end="", flush=True)
    ctypes.CDLL(None).fflush(None)
