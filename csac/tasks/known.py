"""What known tasks need beside `gymnasium.make`: who registers them, an adapter, their events, a better picture."""

from __future__ import annotations

import importlib
from collections.abc import Collection
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

INSTALL = "pip install '.[robots]' in a clone of csac"
RESERVED = frozenset({"seed", "step", "episode", "return", "length", "success"})  # columns that there are anyway
RESERVED_TAGS = frozenset({"mean_reward", "mean_ep_length", "success_rate"})

_CONTEXT = 2  # waypoints that the policy sees: the one it flies to and the next
_EYE = np.array([0.0, 0.0, 0.5])  # metres above the drone
_BESIDE = np.array([-0.6, -0.6, 0.3])  # metres from the drone


class Adapter(NamedTuple):
    """What one task needs.

    `module` registers the task when it is imported. `wrap` makes its observation one array. `events` are names in the
    `info` of an episode's last step. With `has_memory` what an episode gives depends on those before it in the same
    environment. The rest is for pictures: the environment's arguments, how many a second, and how to take one.
    """

    module: str
    wrap: Callable[[gymnasium.Env], gymnasium.Env] | None = None
    events: tuple[str, ...] = ()
    has_memory: bool = False
    picture_arguments: Mapping[str, Any] = MappingProxyType({})
    pictures_per_second: int | None = None
    camera: Callable[[gymnasium.Env], Callable[[], np.ndarray]] | None = None


class FlatWaypoints(gymnasium.ObservationWrapper):
    """PyFlyt's waypoint tasks with one array as observation: attitude, then the next waypoints, zeros after the last.

    The numbers are those of PyFlyt's own `FlattenWaypointEnv(context_length=2)`, whose space has the wrong size.
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
    """Return what takes a picture of a drone from beside it, always from the same side: uint8 [480, 640, 4].

    PyFlyt's own camera sits in the drone's nose: it never shows the drone.
    """
    drone: Any = environment.unwrapped

    def picture() -> np.ndarray:
        position = drone.env.state(0)[-1]
        eye = position + _BESIDE
        eye[2] = max(eye[2], 0.1)
        return _photograph(drone.env, eye, position)

    return picture


def chase(environment: gymnasium.Env) -> Callable[[], np.ndarray]:
    """Return what takes a picture from behind the drone, towards its next waypoint: uint8 [480, 640, 4].

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
            # A new waypoint turns the camera by and by; a new episode, at once.
            direction = wanted if drone.step_count == 0 else 0.9 * direction + 0.1 * wanted
        level = direction * np.array([1.0, 1.0, 0.3])
        eye = position - 1.2 * level + _EYE
        eye[2] = max(eye[2], 0.1)
        return _photograph(drone.env, eye, position + level)

    return picture


def _photograph(client: Any, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return what PyBullet sees from `eye` towards `target`, both in metres: uint8 [480, 640, 4]."""
    view = client.computeViewMatrix(eye.tolist(), target.tolist(), [0.0, 0.0, 1.0])
    projection = client.computeProjectionMatrixFOV(fov=60.0, aspect=640 / 480, nearVal=0.05, farVal=60.0)
    return np.asarray(client.getCameraImage(640, 480, view, projection)[2], np.uint8).reshape(480, 640, 4)


_WAYPOINTS = Adapter(
    "PyFlyt.gym_envs",
    FlatWaypoints,
    events=("out_of_bounds", "collision", "env_complete", "num_targets_reached"),
)
_PYFLYT = Adapter("PyFlyt.gym_envs")
# Pushing, lifting and stacking leave something in PyBullet's solver that a reset does not remove.
_PANDA = Adapter(
    "panda_gym",
    has_memory=True,
    picture_arguments={"render_target_position": (-0.25, 0.0, 0.25), "render_distance": 1.3, "render_pitch": -25},
    pictures_per_second=10,
)

ADAPTERS: Mapping[str, Adapter] = MappingProxyType(
    {
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
)
_FAMILIES = {"PyFlyt/": _PYFLYT, "Panda": Adapter("panda_gym")}  # what other ids of that name take is not known


def adapter_of(task: object) -> Adapter | None:
    """Return the adapter of a task given by its id, with or without the module in front, or None."""
    name = task.rpartition(":")[2] if isinstance(task, str) else ""
    if name in ADAPTERS:
        return ADAPTERS[name]
    return next((adapter for prefix, adapter in _FAMILIES.items() if name.startswith(prefix)), None)


def register(name: str) -> None:
    """Import what registers a known task, if there is such a task and it is not registered yet.

    Raises:
        InputError: the package is not installed, or another version; the message says what to install.
    """
    adapter = adapter_of(name)
    if adapter is None or name in gymnasium.registry:
        return
    try:
        importlib.import_module(adapter.module)
    except ImportError as error:
        if name in ADAPTERS:
            raise InputError(missing(name, error)) from error
    if name in ADAPTERS and name not in gymnasium.registry:
        package = adapter.module.partition(".")[0]
        raise InputError(f"the {package} that is installed has no {name}: {INSTALL}")


def missing(name: str, error: Exception) -> str:
    """Say what to install for a task of the robots."""
    return f"{name} needs packages that are not installed ({' '.join(str(error).split())}): {INSTALL}"


def events_of(task: object, more: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names of a task's own events, then `more`, each once."""
    adapter = adapter_of(task)
    return tuple(dict.fromkeys([*(adapter.events if adapter else ()), *more]))


def check_events(events: Sequence[str]) -> None:
    """Raise InputError for a name that cannot be a column of evaluations.csv and a tag of TensorBoard."""
    if isinstance(events, str):
        raise InputError(f"events are a list of names: write ({events!r},)")
    if not isinstance(events, Collection):
        raise InputError(f"events are a list of names such as ('collision',), not {events!r:.40}")
    for name in events:
        if (
            not isinstance(name, str)
            or not name
            or any(c in ",;\"'#" or c.isspace() or not c.isprintable() for c in name)
        ):
            raise InputError(f"{name!r} cannot name an event: names have no spaces, commas or quotes")
        if name in RESERVED | RESERVED_TAGS:
            raise InputError(f"{name!r} cannot name an event: evaluations have something of that name already")


def is_pybullet(environment: gymnasium.Env) -> bool:
    """Whether this is one of PyFlyt's or panda-gym's environments, or derived from one."""
    return bool(_packages(environment) & {"PyFlyt", "panda_gym"})


def has_memory(task: object, environment: gymnasium.Env) -> bool:
    """Whether what an episode gives depends on those before it: so a task of panda-gym's that is not known not to."""
    if isinstance(task, str) and (adapter := ADAPTERS.get(task.rpartition(":")[2])):
        return adapter.has_memory
    return "panda_gym" in _packages(environment)


def wrapper_notes(environment: gymnasium.Env) -> list[str]:
    """Return a line for each wrapper that learns something by itself, which csac neither saves nor hands on."""
    notes = []
    while isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, NormalizeObservation):
            notes.append(
                "NormalizeObservation keeps statistics of its own, which are saved neither with the policy nor in "
                "checkpoints, and each environment has others: leave it out (PPO normalises by itself)"
            )
        if isinstance(environment, NormalizeReward):
            notes.append(
                "NormalizeReward keeps statistics of its own, which no checkpoint saves, and returns are in units that "
                "change as they do: leave it out, or put a constant factor in its place"
            )
        environment = environment.env
    return notes


def _packages(environment: gymnasium.Env) -> set[str]:
    return {kind.__module__.partition(".")[0] for kind in type(environment.unwrapped).__mro__}
