"""A control loop in Python, on NumPy alone: read the sensors, ask the policy, drive the actuators, at a fixed rate.

    csac train Pendulum-v1 --steps 20000 --warmup-steps 1000 --directory runs/swing
    csac export runs/swing --fallback zero
    python examples/deploy/control_loop.py runs/swing/export/numpy < observations.txt > actions.txt

Neither csac nor JAX is needed: `policy.py` lies in the artefact's folder. Sensors and actuators are standard input and
output here, a line for each step. On a robot, write these two functions anew: the rest stays.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

USUAL_RATE = 100.0  # Hz, where the task does not say: as often as the policy was trained to act


def load_policy(folder: Path) -> Any:
    """Return the policy of an artefact, by the loader beside it."""
    spec = importlib.util.spec_from_file_location("exported_policy", folder / "policy.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Policy(folder)


def read_sensors() -> np.ndarray | None:
    """Return the observation, float32 [observation], or None where there are no more."""
    line = sys.stdin.readline().split()
    return np.array(line, np.float32) if line else None  # "nan" is a number here: a sensor that fails, for the guard


def drive_actuators(action: np.ndarray) -> None:
    """Take an action, float32 [action]."""
    print(*(f"{value:.9g}" for value in action), flush=True)


def main() -> None:
    """Control until the sensors say nothing more."""
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
            due -= wait  # go on from here: steps that are late are not made up for by steps that are early
    # Actuators keep the last action until somebody tells them another: on a robot, command here what is safe for it.
    print(f"{steps} steps at {rate:g} Hz, {missed} of them too late", file=sys.stderr)


if __name__ == "__main__":
    main()
