"""PyBullet's tasks: their observations and actions, their silence, their runs and their pictures."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
from played import policy_for, run_of_task

from csac.algorithms import SAC
from csac.evaluation.evaluator import EPISODES_AT_ONCE, Evaluator
from csac.evaluation.play import play
from csac.seeds import EVALUATION_SEED
from csac.tasks import registry
from csac.tasks.environment import Environment
from csac.tasks.pybullet import Adapter, quietly
from csac.training.train import resume, train

QUAD, HOVER, REACH = "PyFlyt/QuadX-Waypoints-v1", "PyFlyt/QuadX-Hover-v1", "PandaReach-v3"
TINY = SAC(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), batch_size=8, warmup_steps=20, replay_size=200)


@pytest.fixture(scope="module")
def quad():
    environment = Environment(QUAD)
    yield environment
    environment.close()


def test_the_quadrotor_flies_to_flattened_waypoints_with_its_own_bounds(quad):
    raw: Any = quad.raw.unwrapped
    first = quad.reset(5)
    assert first.shape == (27,)
    assert quad.contract_parts.observation_parts == ((None, (27,)),)
    state = raw.state
    np.testing.assert_allclose(first, [*state["attitude"], *state["target_deltas"][:2].ravel()], rtol=1e-6)
    _, _, terminated, _, info = quad.step(np.array([-1, 1, 0, -1], np.float32))
    # Rates of ± pi, none, and no thrust: the box is not symmetric, and a thrust of 0 in [-1, 1] is half of 0.8.
    np.testing.assert_allclose(raw.action, [-np.pi, np.pi, 0, 0], atol=1e-6)
    quad.step(np.zeros(4, np.float32))
    np.testing.assert_allclose(raw.action, [0, 0, 0, 0.4], atol=1e-6)
    assert not terminated
    assert set(info) == set(registry.events_of(QUAD))
    raw.info["collision"] = True  # the task gives one dict again and again
    assert info["collision"] is False


def test_the_flat_waypoints_are_pyflyts_own(quad):
    from PyFlyt.gym_envs import FlattenWaypointEnv

    theirs = FlattenWaypointEnv(gymnasium.make(QUAD, disable_env_checker=True), context_length=2)
    for waypoints in (4, 2, 1):
        observation = {"attitude": np.arange(21.0), "target_deltas": np.arange(3.0 * waypoints).reshape(-1, 3)}
        ours = quad.raw.observation(observation)
        np.testing.assert_array_equal(ours, theirs.observation(observation))
        assert quad.raw.observation_space.shape == ours.shape
    assert theirs.observation_space.shape != ours.shape  # why there is one of ours


def test_the_arm_has_its_parts_in_the_order_of_their_names_and_says_whether_it_is_there():
    environment = Environment(REACH)
    first = environment.reset(5)
    parts = (("achieved_goal", (3,)), ("desired_goal", (3,)), ("observation", (6,)))
    assert environment.contract_parts.observation_parts == parts
    raw = environment.raw_observation
    np.testing.assert_array_equal(first, np.concatenate([raw[key] for key, _ in parts]))
    reward, info, steps, terminated = math.nan, {}, 0, False
    while not terminated and steps < 20:
        raw, steps = environment.raw_observation, steps + 1
        towards = np.clip(10 * (raw["desired_goal"] - raw["achieved_goal"]), -1, 1)
        _, reward, terminated, _, info = environment.step(towards)
    # Version 3 ends where it succeeds, with reward 0: the return is minus the steps before.
    assert (reward, info) == (0.0, {"is_success": True})
    environment.close()


# Silence

CHATTER = r"""
import ctypes, os, sys, threading
from csac.tasks.pybullet import quietly
c = ctypes.CDLL(None)
print("before")
try:
    with quietly():
        c.printf(b"pybullet build time: Jan 29 2025\n")
        c.printf(b"argv[0]=--background_color_red=0.87\n")
        c.printf(b"no chatter\n")
        thread = threading.Thread(target=os.write, args=(1, b"\x1b[2Kprogress"))
        thread.start()
        thread.join()
        print("\033[A                             \033[A")
        print("Version = ours: argv", file=sys.stderr)
        with quietly():
            print("within")
        c.printf(b"numActiveThreads = 0\nstopping threads\n")
        raise ValueError("ours")
except ValueError as error:
    print("raised", error)
c.printf(b"argv[0]=after\n")
c.fflush(None)
"""


def run_python(code: str, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "always", "-c", code, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_silence_is_for_pybullet_alone(tmp_path):
    ended = run_python(CHATTER, tmp_path)
    # C, Python and threads have buffers of their own, so only the order within each is theirs.
    sources = [("before\n", "within\n", "raised ours\n"), ("no chatter\n", "argv[0]=after\n"), ("\x1b[2Kprogress",)]
    for pieces in sources:
        places = [ended.stdout.index(piece) for piece in pieces]
        assert places == sorted(places)
    assert len(ended.stdout) == sum(len(piece) for pieces in sources for piece in pieces)
    assert (ended.stderr, ended.returncode) == ("Version = ours: argv\n", 0)


def test_silence_reaches_streams_that_are_not_the_process_s_own(capsys):
    with quietly():
        print("\033[A                             \033[A")
        print("ours")
    print("after")
    assert capsys.readouterr() == ("ours\nafter\n", "")


def test_silence_is_not_asked_of_other_tasks():
    assert Environment("Pendulum-v1")._quietly is not quietly


ROBOTS = """
import sys
import numpy as np
from csac.tasks.environment import Environment
for task in sys.argv[1:]:
    environments = [Environment(task), Environment(task)]
    for environment in environments:
        environment.reset(1)
        environment.step(np.zeros(environment.spec.action_size, np.float32))
        environment.reset(2)
    environments[0].close()
print("ours")
"""


@pytest.mark.slow
def test_pybullet_prints_nothing(tmp_path):
    ended = run_python(ROBOTS, tmp_path, QUAD, REACH)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "ours\n", "")
    assert list(tmp_path.iterdir()) == []


# Evaluation and runs


@pytest.mark.slow
def test_an_arm_that_pushes_is_made_anew_for_each_batch():
    """What PandaPush gives depends on the episodes before it in the same environment."""
    policy = policy_for("PandaPush-v3", seed=3)
    evaluator = Evaluator("PandaPush-v3", episodes=EPISODES_AT_ONCE + 2)
    first = evaluator.run(policy)
    assert evaluator.run(policy) == first
    (_, last) = Evaluator("PandaPush-v3", episodes=2, first_seed=EVALUATION_SEED + EPISODES_AT_ONCE).run(policy)
    assert last[1:] == first[-1][1:]


def test_memory_is_known_by_what_a_task_is_made_of(monkeypatch):
    gymnasium.register("MyPush-v0", entry_point="panda_gym.envs:PandaPushEnv", max_episode_steps=5)
    try:
        environments = [Environment(task) for task in ("PandaPush-v3", "MyPush-v0", REACH, "Hopper-v4")]
        assert [environment.has_memory for environment in environments] == [True, True, False, False]
        for environment in environments:
            environment.close()
    finally:
        del gymnasium.registry["MyPush-v0"]


def test_robots_beside_each_other_do_not_interfere():
    policy = policy_for(REACH, seed=4)
    together = Evaluator(REACH, episodes=2).run(policy)
    alone = [Evaluator(REACH, episodes=1, first_seed=EVALUATION_SEED + n).run(policy)[0] for n in range(2)]
    assert [episode[1:] for episode in together] == [episode[1:] for episode in alone]


@pytest.mark.slow
def test_a_robots_run_is_stopped_and_goes_on(tmp_path):
    short: dict[str, Any] = {"evaluation_interval": 20, "evaluation_episodes": 2, "checkpoint_interval": 20}
    run = train(TINY, QUAD, steps=40, directory=tmp_path / "run", **short)
    before = run.evaluations
    grown = resume(tmp_path / "run", steps=60)
    assert (grown.state, grown.steps_done) == ("finished", 60)
    rows = grown.evaluations
    assert sorted(set(rows["step"].tolist())) == [20, 40, 60]
    np.testing.assert_array_equal(rows["return"][: len(before)], before["return"])
    assert not np.isnan([rows[name] for name in registry.events_of(QUAD)]).any()


# Pictures


@pytest.mark.slow
def test_hovering_is_seen_from_beside_the_drone():
    """PyFlyt's own camera, in the drone's nose, never shows it. Here it is what lies in the middle of the picture."""
    environment = Environment(HOVER, render_mode="rgb_array")
    environment.reset(0)
    drone: Any = environment.raw.unwrapped
    adapter = registry.adapter_of(HOVER)
    assert isinstance(adapter, Adapter)
    assert adapter.camera
    take, state = adapter.camera(environment.raw), drone.env.state(0)
    with_drone = take()
    drone.env.removeBody(drone.env.drones[0].Id)
    drone.env.state = lambda index: state
    rows, columns = np.nonzero((with_drone != take()).any(axis=2))
    np.testing.assert_allclose([np.median(rows), np.median(columns)], [240, 320], atol=20)
    environment.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # JAX is loaded here; where csac plays, it is not
@pytest.mark.parametrize(("task", "size"), [(QUAD, "640x480, 30"), (REACH, "720x480, 10")])
def test_a_robot_is_drawn_without_a_display(tmp_path, monkeypatch, task, size):
    monkeypatch.delenv("DISPLAY", raising=False)
    arguments = {"max_episode_steps": 4} if task == REACH else {"max_duration_seconds": 0.2}
    film = tmp_path / "film.mp4"
    list(play(run_of_task(tmp_path / "run", task, arguments=arguments).path, video=film))
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", film, "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    (width, _, height), speed = size.partition(",")[0].partition("x"), size.rpartition(" ")[2]
    assert f"{width}x{height}".encode() in decoded.stderr
    assert f"{speed} fps".encode() in decoded.stderr
    pictures = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, int(height), int(width)).astype(float)
    assert len(pictures) == int(speed)  # a short episode is on the screen for a second all the same
    assert np.abs(pictures[0] - pictures[-1]).max() > 50  # it moves
