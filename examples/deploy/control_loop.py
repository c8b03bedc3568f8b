"""A control loop in Python with NumPy only: read sensors, run the policy, drive actuators, at a fixed rate.

    csac train Pendulum-v1 --steps 20000 --warmup-steps 1000 --directory runs/swing
    csac export runs/swing --fallback zero
    python examples/deploy/control_loop.py runs/swing/export/numpy < observations.txt > actions.txt

It needs neither csac nor JAX: `policy.py` is in the artefact's folder. Here sensors and actuators are standard input
and output, one line per step. For a robot, replace `read_sensors` and `drive_actuators`; the rest stays.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

USUAL_RATE = 100.0  # Hz, if the task states no rate; use the rate of training


def load_policy(folder: Path) -> Any:
    """Load the policy of an artefact with the loader in its folder."""
    spec = importlib.util.spec_from_file_location("exported_policy", folder / "policy.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Policy(folder)


def read_sensors() -> np.ndarray | None:
    """Return the observation, float32 [observation], or None at the end of input."""
    line = sys.stdin.readline().split()
    return np.array(line, np.float32) if line else None  # "nan" is valid: a failed sensor, which the guard handles


def drive_actuators(action: np.ndarray) -> None:
    """Apply an action, float32 [action]."""
    print(*(f"{value:.9g}" for value in action), flush=True)


def main() -> None:
    """Control until the end of input."""
    policy = load_policy(Path(sys.argv[1]))
    rate = policy.contract["control_rate_hz"] or USUAL_RATE
    steps = missed = 0
    due = time.monotonic()
    while (observation := read_sensors()) is not None:
        drive_actuators(policy.act(observation))
        steps += 1

        due += 1 / rate
        if (wait := due - time.monotonic()) > 0:
            time.sleep(wait)
        else:
            missed += 1
            due -= wait  # continue from now: do not shorten later steps to catch up
    # Actuators hold the last action until they get another: on a robot, command a safe action here.
    print(f"{steps} steps at {rate:g} Hz, {missed} of them too late", file=sys.stderr)


if __name__ == "__main__":
    main()
