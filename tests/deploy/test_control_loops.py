"""The control loops of examples/deploy: what they say is what the policy says."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from artefacts import WITHOUT_ABSOLUTE_SLEEP
from policies import algorithm_policy, contract, random_policy

from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.guards import make_guards
from csac.deploy.writing import write_artefact

EXAMPLES = Path(__file__).parents[2] / "examples" / "deploy"


def leave(folder, policy, format):
    folder.mkdir()
    guards = make_guards(policy.contract, fallback="zero")
    write_artefact(
        folder, policy.network, ArtefactContract(policy.contract, format, control_rate=1000.0, guards=guards)
    )
    return folder


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
@pytest.mark.parametrize("algorithm", ["csac", "sd3", "ppo"])
def test_the_loop_in_c(tmp_path, algorithm):
    policy = algorithm_policy(algorithm)
    folder, program = leave(tmp_path / "c", policy, "c"), tmp_path / "control_loop"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run(["cc", *strict, "-I", folder, EXAMPLES / "control_loop.c", "-o", program, "-lm"], check=True)
    check_loop([program], policy)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
def test_the_loop_in_c_sleeps_where_nobody_can_sleep_until_a_time(tmp_path):
    """As on macOS."""
    policy = algorithm_policy("csac")
    folder, program, source = leave(tmp_path / "c", policy, "c"), tmp_path / "control_loop", tmp_path / "loop.c"
    source.write_text(WITHOUT_ABSOLUTE_SLEEP + (EXAMPLES / "control_loop.c").read_text())
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run(["cc", *strict, "-I", folder, source, "-o", program, "-lm"], check=True)
    began = time.perf_counter()
    check_loop([program], policy)
    assert time.perf_counter() - began > 0.019  # 20 steps at 1,000 Hz


def test_the_loop_in_python(tmp_path):
    policy = algorithm_policy("csac")
    folder = leave(tmp_path / "numpy", policy, "numpy")
    alone = [sys.executable, "-I", "-c", "import sys, runpy; sys.modules['csac'] = sys.modules['jax'] = None; "]
    alone[-1] += f"sys.argv = ['control_loop.py', {str(folder)!r}]; "
    alone[-1] += f"runpy.run_path({str(EXAMPLES / 'control_loop.py')!r}, run_name='__main__')"
    check_loop(alone, policy)


def test_the_node_without_ros(tmp_path):
    """Its robot's sensors fall silent after half of the time; two tenths of a second later the fallback stands in."""
    agreement = dataclasses.replace(contract(((None, (3,)),), (1,), -2.0, 2.0), task="Pendulum-v1")
    folder = tmp_path / "numpy"
    folder.mkdir()
    guards, policy = make_guards(agreement, fallback="1.5"), random_policy(agreement)
    write_artefact(folder, policy.network, ArtefactContract(agreement, "numpy", control_rate=20.0, guards=guards))
    command = [sys.executable, EXAMPLES / "ros2_node.py", folder, "--seconds", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    actions = [line.partition("action ")[2] for line in done.stdout.splitlines()]
    assert len(actions) == 20
    assert actions[14:] == ["[1.5]"] * 6  # heard last at 0.45 s: too old from 0.70 s on
    assert "[1.5]" not in actions[:14]


def test_the_node_s_robot_is_the_task_with_its_arguments_and_all_parts_of_its_observation(tmp_path):
    parts, folder = (("angle", (2,)), ("speed", (1,))), tmp_path / "numpy"
    agreement = dataclasses.replace(contract(parts, (1,), -2.0, 2.0), task="node_task:Parts-v0")
    folder.mkdir()
    guards, policy = make_guards(agreement, fallback="1.5"), random_policy(agreement)
    told = {"environment_arguments": {"angle": 0.25}}
    artefact = ArtefactContract(agreement, "numpy", control_rate=20.0, guards=guards, provenance=told)
    write_artefact(folder, policy.network, artefact)
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
    agreement, folder = contract(), tmp_path / "numpy"
    folder.mkdir()
    write_artefact(folder, random_policy(agreement).network, ArtefactContract(agreement, "numpy"))
    done = subprocess.run([sys.executable, EXAMPLES / "ros2_node.py", folder], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "export the policy with --fallback: a topic that falls silent has to mean something\n"
