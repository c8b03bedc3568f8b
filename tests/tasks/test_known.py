"""The robots' tasks, events and success of any task, and evaluation in several processes."""

from __future__ import annotations

import json
import math
import os
import runpy
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import probes
import psutil
import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from csac.tasks.silence import quietly
from scalars import scalars

from csac.algorithms import SAC
from csac.cli import main
from csac.console.progress import Reporter
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.evaluation.evaluator import EPISODES_AT_ONCE, EvaluationFailure, Evaluator, _number
from csac.evaluation.play import evaluate_run
from csac.evaluation.pool import EvaluationPool, choose_processes
from csac.record.csv_tables import read_rows
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory
from csac.tasks import known
from csac.tasks.environment import Environment
from csac.tasks.seeds import EVALUATION_SEED
from csac.training.train import resume, train
from csac.types import InputError, Layer, PolicyNetwork, PolicyParameters

SUPPORT = Path(__file__).parents[1] / "support"
QUAD, HOVER, REACH = "PyFlyt/QuadX-Waypoints-v1", "PyFlyt/QuadX-Hover-v1", "PandaReach-v3"
QUAD_EVENTS = ("out_of_bounds", "collision", "env_complete", "num_targets_reached")
TINY = SAC(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), batch_size=8, warmup_steps=20, replay_size=200)
SHORT: dict[str, Any] = {"evaluation_interval": 20, "evaluation_episodes": 2, "checkpoint_interval": 20}


def run_python(code: str, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *options, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(SUPPORT)},
        capture_output=True,
        text=True,
        check=False,
    )


def policy_for(task: str, width: int = 8, seed: int = 0) -> Policy:
    """A random policy with one hidden layer."""
    environment = Environment(task)
    (inputs, outputs), generator = environment.spec, np.random.default_rng(seed)
    layers = tuple(
        Layer(generator.normal(0, 0.3, shape).astype(np.float32), np.zeros(shape[1], np.float32))
        for shape in ((inputs, width), (width, 2 * outputs))
    )
    contract = Contract(task, "sac", "relu", "tanh_gaussian", *environment.contract_parts)
    environment.close()
    return Policy(PolicyNetwork(PolicyParameters((layers,))), contract, step=9)


def make_run(path: Path, task: str, events: tuple[str, ...] = (), seeds: tuple[int, ...] = (0,), arguments: Any = None):
    """A finished run with a random policy for each seed."""
    manifest = Manifest(
        task=task,
        algorithm="sac",
        seeds=seeds,
        steps=9,
        steps_done=9,
        events=events,
        environment_arguments=arguments or {},
    )
    run = RunDirectory.create(path, manifest)
    for seed in seeds:
        policy_for(task, seed=seed).write(run.policy(seed))
    run.update_manifest(state="finished")
    return run


@pytest.fixture(autouse=True)
def _probes_are_found(monkeypatch):
    monkeypatch.syspath_prepend(SUPPORT)  # by spawned processes as well, which are given the path
    monkeypatch.setenv("PYTHONPATH", str(SUPPORT))


# The robots' tasks


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
    assert state["target_deltas"].shape == (4, 3)
    np.testing.assert_allclose(first, [*state["attitude"], *state["target_deltas"][:2].ravel()], rtol=1e-6)
    _, _, terminated, _, info = quad.step(np.array([-1, 1, 0, -1], np.float32))
    # Rates of ± pi, none, and no thrust: the box is not symmetric, and a thrust of 0 in [-1, 1] is half of 0.8.
    np.testing.assert_allclose(raw.action, [-np.pi, np.pi, 0, 0], atol=1e-6)
    quad.step(np.zeros(4, np.float32))
    np.testing.assert_allclose(raw.action, [0, 0, 0, 0.4], atol=1e-6)
    assert not terminated
    assert set(info) == set(QUAD_EVENTS) == set(known.events_of(QUAD))


def test_the_flat_waypoints_are_pyflyts_own(quad):
    from PyFlyt.gym_envs import FlattenWaypointEnv

    theirs = FlattenWaypointEnv(gymnasium.make(QUAD, disable_env_checker=True), context_length=2)
    for waypoints in (4, 2, 1):
        observation = {"attitude": np.arange(21.0), "target_deltas": np.arange(3.0 * waypoints).reshape(-1, 3)}
        ours = quad.raw.observation(observation)
        np.testing.assert_array_equal(ours, theirs.observation(observation))
        assert quad.raw.observation_space.shape == ours.shape
    assert theirs.observation_space.shape != ours.shape  # why there is one of ours


def test_a_dict_that_the_task_gives_again_and_again_is_copied(quad):
    quad.reset(5)
    *_, info = quad.step(np.zeros(4, np.float32))
    quad.raw.unwrapped.info["collision"] = True
    assert info["collision"] is False


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


@pytest.mark.parametrize(
    ("task", "hint"),
    [
        ("PandaReach-v2", r"did you mean PandaReach-v3\?"),
        ("PandaReech-v3", "did you mean PandaReach-v3"),
        ("PyFlyt/QuadX-Waypoint-v1", "did you mean PyFlyt/QuadX-Waypoints-v1"),
        ("quadx-waypoints-v1", "did you mean PyFlyt/QuadX-Waypoints-v1"),
    ],
)
def test_a_robots_name_that_is_nearly_right_gets_a_hint(task, hint):
    with pytest.raises(InputError, match=hint):
        Environment(task)


@pytest.mark.parametrize(
    ("task", "blocked"), [(QUAD, "PyFlyt"), (REACH, "panda_gym"), (REACH, "pybullet"), (QUAD, "pybullet")]
)
def test_without_the_extra_one_line_says_what_to_install(tmp_path, task, blocked):
    code = (
        f"import sys; sys.modules[{blocked!r}] = None; from csac.cli import main; sys.exit(main(['train', {task!r}]))"
    )
    ended = run_python(code, tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"csac: {task} needs packages that are not installed (")
    assert ended.stderr.endswith("): pip install '.[robots]' in a clone of csac\n")
    assert ended.stderr.count("\n") == 1
    assert ended.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_another_release_of_a_package_is_said(monkeypatch):
    known.register(QUAD)
    monkeypatch.delitem(gymnasium.registry, QUAD)
    install = r"pip install '\.\[robots\]' in a clone of csac"
    with pytest.raises(InputError, match=rf"^the PyFlyt that is installed has no .*: {install}$"):
        Environment(QUAD)


def test_only_known_tasks_get_arguments_for_pictures():
    panda, foreign = known.adapter_of("PandaPush-v3"), known.adapter_of("PandaDoor-v0")
    assert panda
    assert panda.picture_arguments
    assert foreign == known.Adapter("panda_gym")


ROBOTS = """
import sys
import numpy as np
from csac.tasks.environment import Environment
if __name__ == "__main__":
    for task in sys.argv[1:]:
        environments = [Environment(task), Environment(task)]
        for environment in environments:
            environment.reset(1)
            environment.step(np.zeros(environment.spec.action_size, np.float32))
            environment.reset(2)
        environments[0].close()
    print("ours")
"""


def test_pybullet_prints_nothing(tmp_path):
    (tmp_path / "robots.py").write_text(ROBOTS)
    ended = subprocess.run(
        [sys.executable, "-W", "always", "robots.py", QUAD, REACH], cwd=tmp_path, capture_output=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"ours\n", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["robots.py"]


CHATTER = r"""
import ctypes, os, sys, threading
from csac.tasks.silence import quietly
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


def test_silence_is_for_pybullet_alone(tmp_path):
    ended = run_python(CHATTER, tmp_path)
    # C, Python and threads have buffers of their own, so only the order within each is theirs.
    sources = [("before\n", "within\n", "raised ours\n"), ("no chatter\n", "argv[0]=after\n"), ("\x1b[2Kprogress",)]
    for pieces in sources:
        places = [ended.stdout.index(piece) for piece in pieces]
        assert places == sorted(places)
    assert len(ended.stdout) == sum(len(piece) for pieces in sources for piece in pieces)
    assert ended.stderr == "Version = ours: argv\n"
    assert ended.returncode == 0


def test_silence_reaches_streams_that_are_not_the_process_s_own(capsys):
    with quietly():
        print("\033[A                             \033[A")
        print("pybullet build time: now", file=sys.stderr)
        print("ours")
        print("ours too", file=sys.stderr)
    print("after")
    assert capsys.readouterr() == ("ours\nafter\n", "ours too\n")


def test_silence_survives_a_closed_output(tmp_path):
    code = "import os; from csac.tasks.silence import quietly; os.close(1)\nwith quietly(): pass\nos._exit(7)"
    assert run_python(code, tmp_path).returncode == 7


def test_silence_is_not_asked_of_other_tasks():
    assert Environment("Pendulum-v1")._quietly is not quietly


@pytest.mark.parametrize(("task", "inputs"), [(QUAD, 27), (REACH, 12)])
def test_a_robots_run_is_stopped_and_goes_on(tmp_path, task, inputs):
    run = train(TINY, task, steps=40, directory=tmp_path / "run", **SHORT)
    assert run.manifest.events == tuple(known.events_of(task))
    assert run.manifest.inexact_seeds == (0,)
    assert {"pybullet"} <= run.manifest.versions.keys()
    before = run.evaluations

    reporter = Notes()
    grown = resume(tmp_path / "run", steps=60, reporter=reporter)

    assert "note: seed 0 restarts the episode in progress, which the checkpoint could not hold" in reporter.notes
    assert (grown.manifest.state, grown.manifest.steps_done) == ("finished", 60)
    assert grown.manifest.history[0].exact is False
    assert grown.manifest.events == run.manifest.events
    rows = grown.evaluations
    assert rows.dtype.names == before.dtype.names
    for name in before.dtype.names or ():  # one by one: the NaN of a record equals nothing
        np.testing.assert_array_equal(rows[name][: len(before)], before[name])
    assert sorted(set(rows["step"].tolist())) == [20, 40, 60]
    columns = rows[["success", *known.events_of(task)]].tolist()
    assert not np.isnan(np.array(columns)[:, 1 if task == QUAD else 0 :]).any()
    contract = Contract.load(tmp_path / "run" / "policy" / "contract.json")
    assert contract.spec.observation_size == inputs


class Notes(Reporter):
    """Shows nothing and remembers what it was told."""

    def __init__(self) -> None:
        super().__init__()
        self.console.quiet = True
        self.notes: list[str] = []

    def start(self, *arguments: Any, **options: Any) -> None:
        super().start(*arguments, **options)
        self.notes += arguments[5]

    def note(self, text: str) -> None:
        self.notes.append(text)


def test_hovering_is_seen_from_beside_the_drone():
    """PyFlyt's own camera, in the drone's nose, never shows it. Here it is what lies in the middle of the picture."""
    environment = Environment(HOVER, render_mode="rgb_array")
    environment.reset(0)
    drone: Any = environment.raw.unwrapped
    adapter = known.adapter_of(HOVER)
    assert adapter
    assert adapter.camera
    take, state = adapter.camera(environment.raw), drone.env.state(0)
    with_drone = take()
    drone.env.removeBody(drone.env.drones[0].Id)
    drone.env.state = lambda index: state
    rows, columns = np.nonzero((with_drone != take()).any(axis=2))
    np.testing.assert_allclose([np.median(rows), np.median(columns)], [240, 320], atol=20)
    environment.close()


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # JAX is loaded here; where csac plays, it is not
@pytest.mark.parametrize(("task", "size"), [(QUAD, "640x480, 30"), (HOVER, "640x480, 30"), (REACH, "720x480, 10")])
def test_a_robot_is_drawn_without_a_display(tmp_path, capsys, monkeypatch, task, size):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.chdir(tmp_path)
    arguments = {"max_episode_steps": 4} if task == REACH else {"max_duration_seconds": 0.2}
    make_run(Path("run"), task, arguments=arguments)

    assert main(["play", "run", "--video", "film.mp4"]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert (len(lines), lines[1]) == (2, "film.mp4")
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    (width, _, height), speed = size.partition(",")[0].partition("x"), size.rpartition(" ")[2]
    assert f"{width}x{height}".encode() in decoded.stderr
    assert f"{speed} fps".encode() in decoded.stderr
    pictures = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, int(height), int(width)).astype(float)
    assert len(pictures) == int(speed)  # a short episode is on the screen for a second all the same
    assert pictures[0].std() > 10
    assert np.abs(pictures[0] - pictures[-1]).max() > 50  # it moves


# Events


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a,b"], "'a,b' cannot name an event: names have no spaces, commas or quotes"),
        (['a"b'], "cannot name an event"),
        (["a b"], "cannot name an event"),
        (["a\nb"], "cannot name an event"),
        ([""], "'' cannot name an event"),
        ([3], "3 cannot name an event"),
        (["length"], "'length' cannot name an event: evaluations have something of that name already"),
        (["success_rate"], "something of that name already"),
        ("crashed", r"events are a list of names: write \('crashed',\)"),
    ],
)
def test_a_name_that_cannot_be_a_column_is_refused(tmp_path, names, message):
    with pytest.raises(InputError, match=message):
        train(TINY, probes.Cases, steps=40, directory=tmp_path / "run", events=names)
    assert not (tmp_path / "run").exists()


def test_the_command_line_refuses_it_in_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "probes:Cases-v0", "--events", "crashed,,stops"]) == 2
    assert capsys.readouterr().err == "csac: '' cannot name an event: names have no spaces, commas or quotes\n"
    assert list(tmp_path.iterdir()) == []


def story(number: int) -> tuple[bool, int]:
    """What an episode of `Cases` says at its end."""
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(EVALUATION_SEED + number)))
    return bool(generator.random() < 0.5), int(generator.integers(5))


@pytest.mark.parametrize("number", [0, 1, 12])
def test_an_episode_says_what_its_last_info_holds(number):
    evaluator = Evaluator("probes:Cases-v0", episodes=13, events=("stops", "crashed", "phase", "nothing"))
    episode = evaluator.run(policy_for("probes:Cases-v0"))[number]
    crashed, stops = story(number)
    assert episode.events == {"stops": stops, "crashed": crashed, "phase": None, "nothing": None}
    assert list(episode.events) == ["stops", "crashed", "phase", "nothing"]
    assert type(episode.events["crashed"]) is bool
    assert episode.success == (not crashed)
    assert evaluator.info_names == {"crashed", "stops", "is_success"}


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """A run with an event that there is and one that there is not: (the run, what its reporter was told)."""
    reporter = Notes()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SUPPORT)
        folder = tmp_path_factory.mktemp("cases")
        events = ["crashed", "stops", "nothing", "stops"]
        run = train(
            TINY, "probes:Cases-v0", steps=40, directory=folder / "run", events=events, reporter=reporter, **SHORT
        )
    return run, reporter


def test_events_are_columns_after_success(cases):
    run, _ = cases
    assert run.manifest.events == ("crashed", "stops", "nothing")
    lines = (run.path / "evaluations.csv").read_text().splitlines()
    assert lines[0] == "seed,step,episode,return,length,success,crashed,stops,nothing"
    expected = []
    for step in (20, 40):
        for number in range(2):
            crashed, stops = story(number)
            expected.append(f"0,{step},{number},3.0,3,{float(not crashed)},{int(crashed)},{stops},")
    assert lines[1:] == expected
    rows = run.evaluations
    assert np.isnan(rows["nothing"]).all()
    assert rows["stops"].tolist() == [story(number)[1] for number in (0, 1)] * 2


def test_events_are_curves_of_tensorboard(cases):
    found = scalars(cases[0].path / "tensorboard" / "seed_0")
    mean = (story(0)[1] + story(1)[1]) / 2
    assert found["eval/stops"] == [(20, mean), (40, mean)]
    assert {"eval/crashed", "eval/success_rate"} <= found.keys()
    assert "eval/nothing" not in found


def test_a_name_that_nobody_says_is_noted_once(cases):
    run, reporter = cases
    note = "note: no episode's last info holds a number called 'nothing' so far; it holds crashed, is_success, stops"
    assert [line for line in reporter.notes if "nothing" in line] == [note]
    assert (run.path / "log.txt").read_text().count(note) == 1


def test_events_stay_in_a_longer_run_and_in_a_fork(cases, tmp_path):
    source = cases[0].path
    forked = train(TINY, "probes:Cases-v0", steps=60, directory=tmp_path / "fork", start_from=source, **SHORT)
    assert forked.manifest.events == ("crashed", "stops", "nothing")
    assert forked.evaluations.dtype.names == cases[0].evaluations.dtype.names
    assert len(forked.evaluations) == 6
    grown = resume(tmp_path / "fork", steps=80)
    assert len(grown.evaluations) == 8
    curves = scalars(grown.path / "tensorboard" / "seed_0")
    assert [[step for step, _ in curves[f"eval/{name}"]] for name in ("mean_reward", "stops")] == [[60, 80]] * 2
    assert grown.manifest.events == ("crashed", "stops", "nothing")
    for change, events in (({"start_from": source, "directory": tmp_path / "x"}, ["stops"]), ({"resume": True}, [])):
        arguments = {"directory": tmp_path / "fork", "steps": 80, **SHORT, **change}
        with pytest.raises(InputError, match=r"events is \['crashed', 'stops', 'nothing'\], not \["):
            train(TINY, "probes:Cases-v0", events=events, **arguments)


def test_a_run_of_a_csac_that_knew_no_events_goes_on(cases, tmp_path):
    run = train(TINY, "probes:Endless-v0", steps=20, directory=tmp_path / "run", **SHORT)
    path = run.path / "manifest.json"
    older = json.loads(path.read_text())
    del older["events"]
    path.write_text(json.dumps(older))
    assert resume(run.path, steps=40).manifest.state == "finished"


def test_the_report_says_how_the_last_episodes_ended(cases, capsys):
    reporter = Reporter()
    reporter.finish(cases[0])
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    mean = (story(0)[1] + story(1)[1]) / 2
    assert f"stops {mean:.3f}" in lines
    assert "nothing" in lines
    assert any(line.startswith("success ") for line in lines)


class Unreadable:
    def __array__(self, *_, **__):
        raise TypeError("on another device")


def test_info_may_hold_anything():
    odd = (Unreadable(), [[1], [1, 2]], "3", b"3", None, np.nan, np.array([1, 2]), {})
    assert [_number(value) for value in odd] == [None] * len(odd)
    assert [_number(value) for value in (True, np.bool_(False), 2, np.float32(0.5), np.array([7]))] == [
        True,
        0,
        2,
        0.5,
        7,
    ]


# Evaluation in several processes


def test_perturbed_episodes_do_not_depend_on_the_processes_either(tmp_path):
    make_run(tmp_path / "run", "Hopper-v4")
    perturbed = [
        dict(
            evaluate_run(
                tmp_path / "run", episodes=2 * EPISODES_AT_ONCE, perturbations="gravity=0.5", processes=processes
            )
        )
        for processes in (1, 2)
    ]
    assert perturbed[0] == perturbed[1]
    assert perturbed[0] != dict(evaluate_run(tmp_path / "run", episodes=2 * EPISODES_AT_ONCE, processes=1))


def test_a_task_that_cannot_be_perturbed_so_is_never_evaluated():
    evaluator = Evaluator("Pendulum-v1", episodes=1)
    evaluator.perturb({"mass": 2.0})
    for _ in range(2):
        with pytest.raises(InputError, match="Pendulum-v1 is no MuJoCo task"):
            evaluator.run(policy_for("Pendulum-v1"))


def test_the_command_finds_modules_of_the_folder_that_it_is_called_in(tmp_path):
    make_run(tmp_path / "run", "probes:Cases-v0")
    ended = subprocess.run(
        [Path(sys.executable).with_name("csac"), "evaluate", tmp_path / "run", "--episodes", "2"],
        cwd=SUPPORT,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "per 1,000 rollouts (from 2 of each seed)" in ended.stdout


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_numbers_do_not_depend_on_the_processes(deterministic):
    evaluator = Evaluator("Hopper-v4", episodes=2 * EPISODES_AT_ONCE + 3)
    policies = [policy_for("Hopper-v4", width=256, seed=seed) for seed in (0, 1)]
    expected = evaluator.run_all(policies, deterministic)
    pool = EvaluationPool(Evaluator("Hopper-v4", episodes=2 * EPISODES_AT_ONCE + 3), processes=2)
    told = []
    assert pool.run_all(policies, deterministic, lambda *counts: told.append(counts)) == expected
    assert pool.run(policies[1], deterministic) == expected[1]
    pool.close()
    assert sorted(told) == told
    assert told[-1] == (46, 46)
    assert len(told) == 6


def test_an_arm_that_pushes_is_made_anew_for_each_batch():
    """What PandaPush gives depends on the episodes before it in the same environment."""
    policy = policy_for("PandaPush-v3", seed=3)
    evaluator = Evaluator("PandaPush-v3", episodes=EPISODES_AT_ONCE + 2)
    first = evaluator.run(policy)
    assert evaluator.run(policy) == first
    assert (
        Evaluator("PandaPush-v3", episodes=2, first_seed=EVALUATION_SEED + EPISODES_AT_ONCE).run(policy)[1][1:]
        == first[-1][1:]
    )


def test_memory_is_known_by_what_a_task_is_made_of():
    gymnasium.register("MyPush-v0", entry_point="panda_gym.envs:PandaPushEnv", max_episode_steps=5)
    try:
        environments = [Environment(task) for task in ("PandaPush-v3", "MyPush-v0", REACH, QUAD, "Hopper-v4")]
        assert [environment.has_memory for environment in environments] == [True, True, False, False, False]
        for environment in environments:
            environment.close()
    finally:
        del gymnasium.registry["MyPush-v0"]


def test_robots_beside_each_other_do_not_interfere():
    policy = policy_for(REACH, seed=4)
    together = Evaluator(REACH, episodes=3).run(policy)
    alone = [Evaluator(REACH, episodes=1, first_seed=EVALUATION_SEED + n).run(policy)[0] for n in range(3)]
    assert [episode[1:] for episode in together] == [episode[1:] for episode in alone]


def test_evaluate_writes_its_episodes_where_nothing_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_run(Path("run"), "probes:Cases-v0", events=("crashed", "stops"), seeds=(0, 3))
    assert main(["evaluate", "run", "--episodes", "3", "--csv", "cases.csv"]) == 0
    assert capsys.readouterr().out.endswith("cases.csv\n")
    rows = read_rows("cases.csv")
    assert rows.dtype.names == ("seed", "step", "episode", "return", "length", "success", "crashed", "stops")
    results = dict(evaluate_run("run", episodes=3))
    expected = [(seed, 9, *episode[:4], *episode.events.values()) for seed in (0, 3) for episode in results[seed]]
    assert rows.tolist() == expected

    before = Path("cases.csv").read_bytes()
    for name, complaint in (
        ("cases.csv", "cases.csv exists: give another name"),
        ("none/cases.csv", "cannot write into none"),
        ("cases.txt", "the table is a .csv file: name it cases.csv"),
        ("there/hopper.v4.txt", "the table is a .csv file: name it there/hopper.v4.csv"),
        (".", "the table is a .csv file: name it table.csv"),
    ):
        assert main(["evaluate", "run", "--csv", name]) == 2
        assert complaint in capsys.readouterr().err
    assert Path("cases.csv").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cases.csv", "run"]


def test_workers_import_no_jax_and_are_several():
    evaluator = Evaluator("probes:Cases-v0", {"tell": True}, 6 * EPISODES_AT_ONCE, events=("process", "has_jax"))
    pool = EvaluationPool(evaluator, processes=2)
    episodes = pool.run(policy_for("probes:Cases-v0"))
    assert {episode.events["has_jax"] for episode in episodes} == {False}
    processes = {episode.events["process"] for episode in episodes}
    assert os.getpid() not in processes
    assert len(processes) == 2
    again = {episode.events["process"] for episode in pool.run(policy_for("probes:Cases-v0"))}
    assert again == processes
    assert {"process", "stops"} <= pool.info_names
    pool.close()


def test_the_first_failure_in_order_is_told():
    seeds = [EVALUATION_SEED + 12, EVALUATION_SEED + 31]
    pool = EvaluationPool(Evaluator("probes:Failing-v0", {"seeds": seeds}, episodes=4 * EPISODES_AT_ONCE), processes=2)
    with pytest.raises(
        EvaluationFailure, match=r"evaluation episode 12, .* step raised RuntimeError: the simulator broke"
    ):
        pool.run(policy_for("probes:Endless-v0"))
    assert pool._workers == []


def test_a_process_that_dies_is_one_line(tmp_path, capsys):
    make_run(tmp_path / "run", "probes:Deadly-v0", arguments={"seed": 2_000_000 + 11})
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "20", "--processes", "2"]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == ("csac: the evaluation was broken off: its process was killed by SIGKILL (out of memory?)\n")


def test_processes_are_chosen_by_the_work_and_at_least_one_is_asked_for(monkeypatch):
    monkeypatch.setattr("csac.evaluation.pool.usable_cores", lambda: [0, 1, 2])
    assert choose_processes(Evaluator("probes:Cases-v0", episodes=EPISODES_AT_ONCE), 1) == 1
    for quota, most in ((None, 3), (2, 2)):
        monkeypatch.setattr("csac.evaluation.pool.core_quota", lambda quota=quota: quota)
        assert choose_processes(Evaluator("probes:Cases-v0", episodes=1000), 5) == most
    with pytest.raises(InputError, match="0 processes: use at least one"):
        EvaluationPool(Evaluator("probes:Cases-v0"), processes=0)
    with pytest.raises(InputError, match="cannot be sent to another process"):
        EvaluationPool(Evaluator(lambda: probes.Cases()), processes=2)


def test_evaluate_counts_cases_per_thousand(tmp_path, capsys):
    events = ("crashed", "stops", "nothing")
    make_run(tmp_path / "run", "probes:Cases-v0", events, seeds=(3, 4))
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "40", "--processes", "2"]) == 0
    out = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in out.splitlines()]
    drawn = []
    for number in range(40):
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(2_000_000 + number)))
        drawn.append((generator.random() < 0.5, generator.integers(5)))
    crashed, stops = np.array(drawn, float).mean(axis=0)
    # The same episodes for both seeds, so the deviation over seeds is 0.
    assert "per 1,000 rollouts (from 40 of each seed) seed 3 seed 4 mean ± std" in lines
    assert f"crashed {1000 * crashed:.1f} {1000 * crashed:.1f} {1000 * crashed:.1f} 0.0" in lines
    assert f"success {1000 * (1 - crashed):.1f} {1000 * (1 - crashed):.1f} {1000 * (1 - crashed):.1f} 0.0" in lines
    assert f"stops (mean) {stops:.3f} {stops:.3f} {stops:.3f} 0.000" in lines
    assert lines[-1] == "note: no episode's last info holds a number called 'nothing'"


def test_control_c_ends_an_evaluation_and_its_processes(tmp_path):
    make_run(tmp_path / "run", "probes:Endless-v0", arguments={"length": 10**9})
    line = f"evaluate {tmp_path / 'run'} --episodes 40 --processes 2 --trust-task"
    process = subprocess.Popen(
        [sys.executable, "-m", "csac", *shlex.split(line)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    workers: list[psutil.Process] = []
    while len(workers) < 2 and process.poll() is None:
        children = psutil.Process(process.pid).children()
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    os.killpg(process.pid, signal.SIGINT)
    output = process.communicate()
    assert (process.returncode, output) == (130, (b"", b""))
    assert not any(worker.is_running() for worker in workers)


# A task of one's own


def test_the_example_of_the_documentation_runs(tmp_path, capsys, monkeypatch):
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "own_task.py"))
    example["main"](tmp_path / "run", 600)
    run = RunDirectory.open(tmp_path / "run")
    assert run.manifest.events == ("off_the_rail", "reversals")
    assert (run.evaluations.dtype.names or ())[-3:] == ("success", "off_the_rail", "reversals")
    assert run.manifest.inexact_seeds == ()
    assert capsys.readouterr().out.startswith("success ")
