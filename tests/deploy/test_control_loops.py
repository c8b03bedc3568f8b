"""The control loops of examples/deploy: what they say is what the policy says."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from artefacts import leave
from policies import algorithm_policy, contract, random_policy

from csac.deploy.guards import make_guards

EXAMPLES = Path(__file__).parents[2] / "examples" / "deploy"


def left(folder, policy, format):
    return leave(folder, policy, format, make_guards(policy.contract, fallback="zero"), control_rate_hz=1000.0)


def check_loop(command, policy):
    """Run a loop on observations, one of them broken, and compare its actions with the policy's."""
    observations = np.random.default_rng(0).normal(size=(20, 5)).astype(np.float32)
    expected = policy.predict(observations)[0]
    observations[7, 2], expected[7] = np.nan, 0.0
    lines = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in observations) + "\n"
    done = subprocess.run(command, input=lines, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    actions = np.array([line.split() for line in done.stdout.splitlines()], np.float32)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert done.stderr.startswith("20 steps at 1000 Hz, ")


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
def test_the_loop_in_c(tmp_path):
    policy = algorithm_policy("sd3")
    folder, program = left(tmp_path / "c", policy, "c"), tmp_path / "control_loop"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run(["cc", *strict, "-I", folder, EXAMPLES / "control_loop.c", "-o", program, "-lm"], check=True)
    check_loop([program], policy)


def test_the_loop_in_python(tmp_path):
    policy = algorithm_policy("csac")
    folder = left(tmp_path / "numpy", policy, "numpy")
    alone = [sys.executable, "-I", "-c", "import sys, runpy; "]
    alone[-1] += "sys.modules.update(dict.fromkeys(['csac', 'jax', 'gymnasium', 'safetensors'])); "
    alone[-1] += f"sys.argv = ['control_loop.py', {str(folder)!r}]; "
    alone[-1] += f"runpy.run_path({str(EXAMPLES / 'control_loop.py')!r}, run_name='__main__')"
    check_loop(alone, policy)


def test_the_node_without_ros(tmp_path):
    """Its robot's sensors fall silent after half of the time; two tenths of a second later the fallback stands in."""
    agreement = dataclasses.replace(contract(((None, (3,)),), (1,), -2.0, 2.0), task="Pendulum-v1")
    guards = make_guards(agreement, fallback="1.5")
    folder = leave(tmp_path / "numpy", random_policy(agreement), "numpy", guards, control_rate_hz=20.0, provenance={})
    command = [sys.executable, EXAMPLES / "ros2_node.py", folder, "--seconds", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    actions = [line.partition("action ")[2] for line in done.stdout.splitlines()]
    assert len(actions) == 20
    assert actions[14:] == ["[1.5]"] * 6  # heard last at 0.45 s: too old from 0.70 s on
    assert "[1.5]" not in actions[:14]


def test_the_node_s_robot_is_the_task_with_its_arguments_and_all_parts_of_its_observation(tmp_path):
    parts = (("angle", (2,)), ("speed", (1,)))
    agreement = dataclasses.replace(contract(parts, (1,), -2.0, 2.0), task="node_task:Parts-v0")
    guards, policy = make_guards(agreement, fallback="1.5"), random_policy(agreement)
    facts = {"control_rate_hz": 20.0, "provenance": {"environment_arguments": {"angle": 0.25}}}
    folder = leave(tmp_path / "numpy", policy, "numpy", guards, **facts)
    (tmp_path / "node_task.py").write_text(
        "import gymnasium, numpy as np\n"
        "class Parts(gymnasium.Env):\n"
        "    def __init__(self, angle): self.seen = {'speed': np.zeros(1), 'angle': np.full(2, angle)}\n"
        "    def reset(self, **given): return self.seen, {}\n"
        "    def step(self, action): return self.seen, 0.0, False, False, {}\n"
        "gymnasium.register('Parts-v0', Parts, disable_env_checker=True, order_enforce=False)\n"
    )
    command = [sys.executable, EXAMPLES / "ros2_node.py", folder, "--seconds", "0.1"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    expected, _ = policy.predict({"angle": np.full(2, 0.25), "speed": np.zeros(1)})
    assert f"action {np.array2string(expected.reshape(-1), precision=3)}" in done.stdout
    (tmp_path / "node_task.py").write_text("")
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.stderr.startswith("Gymnasium alone does not make node_task:Parts-v0: ")


def test_the_node_wants_a_fallback(tmp_path):
    folder = leave(tmp_path / "numpy", random_policy(contract()), "numpy")
    done = subprocess.run([sys.executable, EXAMPLES / "ros2_node.py", folder], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "export the policy with --fallback: a topic that falls silent has to mean something\n"
