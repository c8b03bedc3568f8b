"""A policy as a ROS 2 node: it subscribes to observations and publishes actions at a fixed rate.

    csac train Pendulum-v1 --steps 20000 --warmup-steps 1000 --directory runs/swing
    csac export runs/swing --fallback zero
    python examples/deploy/ros2_node.py runs/swing/export/numpy

`Controller` holds the node's logic, without ROS. If `rclpy` is installed, `run_with_ros` connects it to topics and a
timer; otherwise `run_without_ros` simulates the robot with the task that the policy was trained on.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from control_loop import USUAL_RATE, load_policy


class Controller:
    """Keeps the newest observation and returns an action at each tick.

    Args:
        folder: a NumPy artefact, exported with `--fallback`.
        patience: seconds after which an observation is too old to act on.
    """

    def __init__(self, folder: Path, patience: float = 0.2) -> None:
        self.policy = load_policy(folder)
        if self.policy.contract["guards"]["fallback"] is None:
            raise SystemExit("export the policy with --fallback: a topic that falls silent has to mean something")
        self.rate = self.policy.contract["control_rate_hz"] or USUAL_RATE
        self._patience, self._heard_at = patience, -np.inf
        self._nothing = np.full(self.policy.contract["observation_size"], np.nan, np.float32)
        self._newest = self._nothing

    def hear(self, observation: np.ndarray, now: float) -> None:
        """Store an observation received at `now` seconds; one of the wrong size counts as missing."""
        flat = np.asarray(observation, np.float32).reshape(-1)
        self._newest, self._heard_at = (flat if flat.shape == self._nothing.shape else self._nothing), now

    def tick(self, now: float) -> np.ndarray:
        """Return the action, float32 [action]: the fallback if the last observation is too old."""
        is_old = now - self._heard_at > self._patience
        return self.policy.act(self._nothing if is_old else self._newest)


def run_with_ros(controller: Controller) -> None:
    """Subscribe to `observation` and publish on `action`, both `std_msgs/Float32MultiArray`."""
    import rclpy  # pyright: ignore[reportMissingImports]
    from std_msgs.msg import Float32MultiArray  # pyright: ignore[reportMissingImports]

    rclpy.init()
    node = rclpy.create_node("csac_policy")
    publisher = node.create_publisher(Float32MultiArray, "action", 1)

    def hear(message: Any) -> None:
        controller.hear(np.array(message.data, np.float32), time.monotonic())

    def tick() -> None:
        publisher.publish(Float32MultiArray(data=controller.tick(time.monotonic()).tolist()))

    node.create_subscription(Float32MultiArray, "observation", hear, 1)
    node.create_timer(1 / controller.rate, tick)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def run_without_ros(controller: Controller, seconds: float) -> None:
    """Use the task as the robot, in simulated time; its sensors fail in the second half."""
    import gymnasium

    contract = controller.policy.contract
    keys = [part["key"] for part in contract["observation_parts"]]

    def flat(observation: Any) -> np.ndarray:
        parts = [observation] if keys == [None] else [observation[key] for key in keys]
        return np.concatenate([np.ravel(part) for part in parts])

    try:
        robot = gymnasium.make(contract["task"], **contract["provenance"].get("environment_arguments", {}))
    except gymnasium.error.Error as error:
        raise SystemExit(f"Gymnasium alone does not make {contract['task']}: {error}") from None
    observation, _ = robot.reset(seed=0)
    steps = round(seconds * controller.rate)
    for step in range(steps):
        now = step / controller.rate
        if step < steps / 2:
            controller.hear(flat(observation), now)
        action = controller.tick(now)
        print(f"{now:.2f} s: action {np.array2string(action, precision=3)}")
        observation, _, terminated, truncated, _ = robot.step(action.reshape(contract["action_shape"]))
        if terminated or truncated:
            observation, _ = robot.reset()
            controller.policy.reset()
    robot.close()


def main() -> None:
    """Run as a node or, without ROS, with a simulated robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("artefact", type=Path, help="folder that csac export --format numpy has written")
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated, without ROS")
    options = parser.parse_args()
    controller = Controller(options.artefact)
    try:
        import rclpy  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        run_without_ros(controller, options.seconds)
    else:
        run_with_ros(controller)


if __name__ == "__main__":
    main()
