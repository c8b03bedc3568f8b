"""Perturbations: known physics, noise with known moments."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from played import policy_for
from trajectories import steps_of

from csac.evaluation.evaluator import Evaluator, evaluate
from csac.tasks.environment import Environment
from csac.tasks.failures import EnvironmentFailure
from csac.tasks.perturbations import (
    Perturbation,
    by_step,
    constant_perturbations,
    continued,
    perturbations_of,
    refuse_late,
    values_at,
)
from csac.tasks.snapshots import _mujoco_arrays
from csac.tasks.vector import SeedEnvironments
from csac.types import InputError, Snapshot

# What is written, and what is refused.


@pytest.mark.parametrize(
    ("text", "kind", "value", "step"),
    [
        ("friction=1.5@300000", "friction", 1.5, 300_000),
        ("friction=1.5@3e5", "friction", 1.5, 300_000),
        (" mass=2@1_000 ", "mass", 2.0, 1000),
        ("gravity=0", "gravity", 0.0, 0),
        ("gain=.25@0", "gain", 0.25, 0),
        ("observation-noise=1e-3@7", "observation_noise", 0.001, 7),
        ("action_noise=0.1", "action_noise", 0.1, 0),
    ],
)
def test_what_is_written_is_what_is_meant(text, kind, value, step):
    perturbation = Perturbation.parse(text)
    assert perturbation == Perturbation(kind, value, step)
    assert Perturbation.parse(str(perturbation)) == perturbation


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("frction=2", "frction"),
        ("friction", "friction"),
        ("friction=2@", "friction=2@"),
        ("friction=two", "two"),
        ("friction=2@soon", "soon"),
        ("friction=2@1.5", "1.5"),
        ("friction=-1", "friction takes .* -1.0"),
        ("gravity=nan", "gravity"),
        ("mass=0", "mass takes a finite factor above 0"),
        ("action_noise=-0.1", "action_noise takes a finite standard deviation"),
        ("friction=2@1e300", "the step of friction"),
        ("friction=2@-3", "the step of friction"),
    ],
)
def test_a_mistake_is_one_line(text, name):
    with pytest.raises(InputError, match=name) as refusal:
        Perturbation.parse(text)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 200


@pytest.mark.parametrize("given", [("friction", 2, 10**5000), ("friction", 2.0, 1.5), ("friction", "2")])
def test_objects_are_checked_too(given: Any):
    with pytest.raises(InputError, match="friction"):
        Perturbation(*given)


def test_one_may_be_given_alone_and_objects_too():
    one = Perturbation("friction", 2, 5)
    assert perturbations_of("friction=2@5") == perturbations_of(one) == perturbations_of([one]) == (one,)
    assert perturbations_of(str(item) for item in (one,)) == (one,)
    with pytest.raises(InputError, match="5"):
        perturbations_of([5])  # pyright: ignore[reportArgumentType]


def test_two_of_a_kind_at_one_step_are_refused():
    with pytest.raises(InputError, match="friction=2@5 and friction=3@5 are of the same kind and step"):
        perturbations_of(["friction=2@5", "mass=2@5", "friction=3@5"])


def test_a_later_one_of_a_kind_replaces_the_earlier():
    several = perturbations_of(["friction=1@200", "mass=2", "friction=1.5@100"])
    assert values_at(several, 0) == values_at(several, 99) == {"mass": 2.0}
    assert values_at(several, 100) == values_at(several, 199) == {"mass": 2.0, "friction": 1.5}
    assert values_at(several, 200) == {"mass": 2.0, "friction": 1.0}
    assert by_step(several) == [(0, "mass x 2"), (100, "friction x 1.5"), (200, "friction x 1")]


def test_what_changes_nothing_is_refused():
    refuse_late(perturbations_of("friction=2@99"), 100)
    with pytest.raises(InputError, match="friction=2@100 would change nothing: the run ends at step 100"):
        refuse_late(perturbations_of("friction=2@100"), 100)
    with pytest.raises(InputError, match=r"friction=2@1: nothing is learnt here.*leave out @1"):
        constant_perturbations("friction=2@1")


def test_a_fork_keeps_what_had_happened_and_takes_what_is_to_come():
    before = perturbations_of(["mass=2", "friction=2@100", "friction=3@300"])
    assert continued(before, (), 100) == perturbations_of("mass=2")
    assert continued(before, before, 300) == before
    given = perturbations_of(["friction=4@200", "friction=2@100"])
    assert continued(before, given, 200) == perturbations_of(["mass=2", "friction=2@100", "friction=4@200"])
    with pytest.raises(InputError, match="gain=2@199 lies before step 200, where this run begins"):
        continued(before, perturbations_of("gain=2@199"), 200)
    with pytest.raises(InputError, match="friction=4 lies before step 200"):
        continued(before, perturbations_of("friction=4"), 200)


# Physics.


def model_of(environment: Environment) -> Any:
    return environment.raw.unwrapped.model  # pyright: ignore[reportAttributeAccessIssue]


def data_of(environment: Environment) -> Any:
    return environment.raw.unwrapped.data  # pyright: ignore[reportAttributeAccessIssue]


def numbers_of(model: Any) -> dict[str, np.ndarray]:
    """Every array of numbers of a model, and the scalars that the physics depends on."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    numbers = {name: a.copy() for name, a in arrays.items() if isinstance(a, np.ndarray) and a.dtype.kind in "fiu"}
    return {**numbers, "gravity": model.opt.gravity.copy(), "meaninertia": np.array(model.stat.meaninertia)}


def different(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> set[str]:
    return {name for name in first if not np.array_equal(first[name], second[name], equal_nan=True)}


def zero_action(environment: Environment) -> np.ndarray:
    return np.zeros(environment.spec.action_size, np.float32)


def test_friction_scales_every_column_of_every_geom_and_nothing_else():
    environment = Environment("HalfCheetah-v4")
    before = numbers_of(model_of(environment))
    assert (before["geom_friction"] > 0).all()
    environment.perturb({"friction": 1.5})
    environment.reset(0)
    for _ in range(3):
        environment.step(zero_action(environment))
    environment.reset(1)
    after = numbers_of(model_of(environment))
    np.testing.assert_array_equal(after["geom_friction"], 1.5 * before["geom_friction"])
    assert different(before, after) == {"geom_friction"}
    environment.perturb({"friction": 2.0})  # of the task's own, not of what it was just now
    np.testing.assert_array_equal(model_of(environment).geom_friction, 2.0 * before["geom_friction"])
    environment.perturb({})
    assert different(before, numbers_of(model_of(environment))) == set()


def test_every_kind_alters_what_it_says_and_leaves_the_episode_as_it_was():
    environment = Environment("Ant-v4")
    environment.reset(3)
    for _ in range(5):
        environment.step(zero_action(environment))
    before, state = numbers_of(model_of(environment)), _mujoco_arrays(environment.raw.unwrapped)
    state = {name: array.copy() for name, array in state.items()}
    derived = {"actuator_acc0", "body_invweight0", "body_subtreemass", "dof_M0", "dof_invweight0", "meaninertia"}
    for kind, names in {
        "gravity": {"gravity"},
        "gain": {"actuator_gainprm"},  # motors have no bias
        "mass": {"body_mass", "body_inertia", *derived},
    }.items():
        environment.perturb({kind: 2.0})
        after = numbers_of(model_of(environment))
        assert different(before, after) == names
        for name in names - derived:
            np.testing.assert_array_equal(after[name], 2.0 * before[name])
        environment.perturb({kind: 1.0})
        assert different(before, numbers_of(model_of(environment))) == set()
    for name, array in _mujoco_arrays(environment.raw.unwrapped).items():
        np.testing.assert_array_equal(array, state[name])


def test_a_doubled_mass_is_what_the_compiler_makes_of_a_doubled_mass():
    environment = Environment("HalfCheetah-v4")
    text = Path(environment.raw.unwrapped.fullpath).read_text()  # pyright: ignore[reportAttributeAccessIssue]
    assert 'settotalmass="14"' in text
    heavy = mujoco.MjModel.from_xml_string(  # pyright: ignore[reportAttributeAccessIssue]
        text.replace('settotalmass="14"', 'settotalmass="28"')
    )
    environment.perturb({"mass": 2.0})
    ours, theirs = numbers_of(model_of(environment)), numbers_of(heavy)
    for name in ("body_mass", "body_inertia", "dof_M0", "body_invweight0", "dof_invweight0", "actuator_acc0"):
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert different(ours, theirs) == set()


BLOCK = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1" friction="0.05 0.001 0.001"/>
    <body name="block" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/> <joint name="z" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.2 0.2 0.1" mass="3" friction="0.3 0.001 0.001"/>
    </body>
    <body name="cart" pos="0 5 1">
      <joint name="cart" type="slide" axis="1 0 0"/> <geom type="sphere" size="0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
MOTOR = '<motor joint="cart" gear="1" ctrlrange="-1 1"/>'


class Block(MujocoEnv):
    """A block that slides on a floor, and beside it a cart with a motor on rails without friction."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 500}  # noqa: RUF012

    def __init__(self, path: str, **settings: Any) -> None:
        space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        super().__init__(path, 1, space, **settings)

    def reset_model(self) -> np.ndarray:
        self.set_state(self.init_qpos, self.init_qvel)
        return self.data.qvel.copy()

    def step(self, action: np.ndarray) -> Any:
        self.do_simulation(action, self.frame_skip)
        return self.data.qvel.copy(), 0.0, False, False, {}


def block(folder: Path, actuator: str = MOTOR) -> Environment:
    path = folder / "block.xml"
    path.write_text(BLOCK.format(actuator=actuator))
    return Environment(Block, {"path": str(path)})


@pytest.mark.parametrize(
    ("values", "acceleration"),
    [({}, 0.5), ({"mass": 2.0}, 0.25), ({"gain": 2.0}, 1.0), ({"mass": 2.0, "gain": 2.0}, 0.5), ({"gain": 0.0}, 0.0)],
)
def test_a_cart_obeys_newton(tmp_path, values, acceleration):
    """A force of 1 on 2 kg."""
    environment = block(tmp_path)
    environment.reset(0)
    environment.perturb(values)
    observation, *_ = environment.step(np.ones(1, np.float32))
    assert observation[2] == pytest.approx(acceleration * 0.002, rel=1e-5)


def test_the_gain_of_a_servo_leaves_its_goal_where_it_was(tmp_path):
    servo = '<position joint="cart" kp="8" ctrlrange="-1 1"/>'
    environment = block(tmp_path, servo)
    environment.perturb({"gain": 3.0})
    environment.reset(0)
    data_of(environment).qpos[2] = 0.25
    environment.step(np.full(1, 0.5, np.float32))
    assert data_of(environment).actuator_force[0] == pytest.approx(3 * 8 * (0.5 - 0.25))
    data_of(environment).qpos[2] = 0.5
    environment.step(np.full(1, 0.5, np.float32))
    assert data_of(environment).actuator_force[0] == pytest.approx(0.0, abs=1e-9)


def test_muscles_have_no_gain_to_scale(tmp_path):
    muscle = '<muscle joint="cart" ctrlrange="0 1" lengthrange="0.5 1.5"/>'
    environment = block(tmp_path, muscle)
    environment.perturb({"mass": 2.0})
    with pytest.raises(InputError, match="Block has actuators, such as muscles"):
        environment.perturb({"gain": 2.0})


class Randomised(Block):
    """A block whose friction, mass or whole model is another one in each episode."""

    def __init__(self, path: str, what: str) -> None:
        self.what = ""  # the constructor of MujocoEnv makes no episode
        super().__init__(path)
        self.what = what

    def reset_model(self) -> np.ndarray:
        friction = self.np_random.uniform(0.2, 0.4)
        if self.what == "friction":
            self.model.geom_friction[1, 0] = friction
        if self.what == "mass":
            self.model.body_mass[1] *= 1.5
        if self.what == "gravity":
            self.model.opt.gravity[2] = -9.0
        if self.what == "model":
            self.model, self.data = self._initialize_simulation()
        return super().reset_model()


def randomised(folder: Path, what: str) -> Environment:
    path = folder / "block.xml"
    path.write_text(BLOCK.format(actuator=MOTOR))
    return Environment(Randomised, {"path": str(path), "what": what})


@pytest.mark.parametrize(
    ("what", "kind"), [("friction", "friction"), ("mass", "mass"), ("gravity", "gravity"), ("model", "gain")]
)
@pytest.mark.parametrize("episodes", [0, 1])
def test_a_task_that_sets_its_own_physics_at_reset_says_so(tmp_path, what, kind, episodes):
    environment = randomised(tmp_path, what)
    for seed in range(episodes):
        environment.reset(seed)
    environment.perturb({kind: 2.0})
    with pytest.raises(EnvironmentFailure, match=f"^Randomised sets its own physics at reset: {kind}"):
        environment.reset(7)


def test_a_task_that_sets_other_physics_at_reset_or_is_not_perturbed_goes_on(tmp_path):
    environment = randomised(tmp_path, "friction")
    environment.perturb({"mass": 2.0, "gravity": 0.5})
    environment.reset(0)
    environment.perturb({"friction": 1.0})
    environment.reset(1)
    environment = randomised(tmp_path, "model")
    environment.perturb({"friction": 1.0})
    environment.reset(0)


# Noise.


class Wide(gymnasium.Env):
    """Observes zeros for ever, in two parts, and remembers the actions; their range is not symmetric."""

    observation_space = spaces.Dict(b=spaces.Box(-9, 9, (2, 3), np.float32), a=spaces.Box(-9, 9, (), np.float64))
    action_space = spaces.Box(np.array([-2.0, 10.0], np.float32), np.array([2.0, 30.0], np.float32))

    def __init__(self) -> None:
        self.actions: list[np.ndarray] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return {"b": np.zeros((2, 3), np.float32), "a": 1.0}, {}

    def step(self, action: np.ndarray) -> Any:
        self.actions.append(action)
        return *self.reset()[:1], 0.0, False, False, {}


def noisy(seed: int, steps: int, **levels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what an episode of `Wide` shows [steps + 1, 7] and what it is given for the action (0, 0) [steps, 2]."""
    environment = Environment(Wide)
    environment.perturb(levels)
    first = environment.reset(seed)
    observations = [first, *(environment.step(np.zeros(2, np.float32))[0] for _ in range(steps))]
    return np.array(observations), np.array(environment.raw.unwrapped.actions)  # pyright: ignore[reportAttributeAccessIssue]


def test_observations_have_the_noise_that_was_asked_for():
    seen, actions = noisy(5, 4000, observation_noise=0.3)
    np.testing.assert_allclose(seen.mean(axis=0), [1, 0, 0, 0, 0, 0, 0], atol=4 * 0.3 / np.sqrt(4000))
    np.testing.assert_allclose(seen.std(axis=0), 0.3, rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(seen.T), np.eye(7), atol=0.07)
    assert abs(np.corrcoef(seen[1:, 0], seen[:-1, 0])[0, 1]) < 0.07
    assert seen.dtype == np.float32
    assert seen[0, 1] != 0  # what reset gives, too
    np.testing.assert_array_equal(actions, np.tile([0.0, 20.0], (4000, 1)).astype(np.float32))


def test_actions_have_noise_in_units_of_their_range_and_stay_within_it():
    seen, actions = noisy(5, 4000, action_noise=0.1)
    np.testing.assert_allclose(actions.mean(axis=0), [0.0, 20.0], atol=4 * 0.1 * 10 / np.sqrt(4000))
    np.testing.assert_allclose(actions.std(axis=0), [0.1 * 2, 0.1 * 10], rtol=0.05)
    assert (seen == [1, 0, 0, 0, 0, 0, 0]).all()
    _, wild = noisy(5, 400, action_noise=5.0)
    assert {*wild[:, 0].tolist()} >= {-2.0, 2.0}
    assert ((wild >= [-2, 10]) & (wild <= [2, 30])).all()
    assert actions.dtype == np.float32


def test_noise_depends_on_the_episodes_seed_alone():
    first, second = noisy(5, 20, observation_noise=0.3)[0], noisy(5, 20, observation_noise=0.3)[0]
    np.testing.assert_array_equal(first, second)
    assert (noisy(6, 20, observation_noise=0.3)[0] != first).all()
    # Twice the noise is the same noise twice; and noise on actions takes nothing from that on observations.
    zero = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)
    np.testing.assert_allclose(noisy(5, 20, observation_noise=0.6)[0] - zero, 2 * (first - zero), rtol=1e-4, atol=1e-6)
    both, actions = noisy(5, 20, observation_noise=0.3, action_noise=0.2)
    np.testing.assert_array_equal(both, first)
    np.testing.assert_array_equal(noisy(5, 20, action_noise=0.2)[1], actions)
    draws = [np.random.default_rng(5).normal(size=7), np.random.default_rng([5, 2]).normal(size=7)]
    assert all(not np.allclose((first[0] - zero) / 0.3, draw, atol=1e-3) for draw in draws)


def test_noise_begins_and_ends_in_mid_episode():
    environment = Environment(Wide)
    first = environment.reset(5)
    environment.perturb({"observation_noise": 0.5})
    noise = environment.step(np.zeros(2, np.float32))[0]
    assert (first == [1, 0, 0, 0, 0, 0, 0]).all()
    assert (noise != first).all()
    environment.perturb({"observation_noise": 0.0})
    np.testing.assert_array_equal(environment.step(np.zeros(2, np.float32))[0], first)


def test_a_foreign_policy_is_given_the_same_noise_in_the_tasks_own_shape():
    environment = Environment(Wide)
    environment.perturb({"observation_noise": 0.5})
    flat = environment.reset(5)
    assert environment.raw_observation.keys() == {"a", "b"}
    np.testing.assert_array_equal(environment.raw_observation["a"], flat[0])
    np.testing.assert_array_equal(environment.raw_observation["b"], flat[1:].reshape(2, 3))
    plain = Environment("Hopper-v4")
    plain.perturb({"observation_noise": 0.5})
    np.testing.assert_array_equal(plain.reset(5), plain.raw_observation)


def test_an_episode_with_noise_goes_on_bit_for_bit():
    values = {"observation_noise": 0.1, "action_noise": 0.2, "friction": 2.0}
    first, second = (SeedEnvironments("Hopper-v4", None, (4, 9)) for _ in range(2))
    for environments in (first, second):
        environments.perturb(values)
    first.reset()
    steps_of(first, 33)
    for index in range(2):
        saved = first.save(index)
        second.restore(index, Snapshot(saved.arrays, json.loads(json.dumps(saved.values))))
    np.testing.assert_array_equal(second.observations, first.observations)
    after = steps_of(first, 120)
    assert sum(len(episodes) for _, _, episodes in after) > 3
    assert steps_of(second, 120) == after


def test_noise_that_begins_after_a_snapshot_is_the_same_as_without_one():
    first, second = (SeedEnvironments("Hopper-v4", None, (4,)) for _ in range(2))
    first.reset()
    steps_of(first, 10)
    second.restore(0, first.save(0))
    for environments in (first, second):
        environments.perturb({"observation_noise": 0.1})
    after = steps_of(first, 60)
    assert steps_of(second, 60) == after
    third = SeedEnvironments("Hopper-v4", None, (4,))
    third.reset()
    steps_of(third, 10)
    assert steps_of(third, 60) != after


# Evaluation.


def test_an_evaluation_with_noise_depends_on_the_episode_alone():
    """Not on the other episodes, how many there are, or what was evaluated before."""
    policy, values = policy_for("Hopper-v4"), {"observation_noise": 0.1, "action_noise": 0.1, "friction": 2.0}
    many, one = Evaluator("Hopper-v4", None, 12, 50), Evaluator("Hopper-v4", None, 1, 61)
    for evaluator in (many, one):
        evaluator.perturb(values)
    episodes = many.run(policy)
    assert [episode[1:] for episode in one.run(policy)] == [episodes[11][1:]]
    assert many.run(policy) == episodes
    assert len({episode.episode_return for episode in episodes}) == 12
    many.perturb({})
    calm = many.run(policy)
    assert calm == Evaluator("Hopper-v4", None, 12, 50).run(policy)
    assert calm != episodes
    many.perturb(values)
    assert many.run(policy) == episodes


def test_evaluate_takes_perturbations():
    policy = policy_for("Hopper-v4")
    usual, light = (evaluate(policy, "Hopper-v4", 2, perturbations=given) for given in ((), "gravity=0.5"))
    assert (usual != light).all()
    np.testing.assert_array_equal(evaluate(policy, "Hopper-v4", 2, perturbations=["gravity=1"]), usual)
    with pytest.raises(InputError, match="leave out @5"):
        evaluate(policy, "Hopper-v4", 2, perturbations="gravity=0.5@5")
    with pytest.raises(InputError, match="no MuJoCo task"):
        evaluate(policy_for("Pendulum-v1"), "Pendulum-v1", 2, perturbations="gravity=0.5")
