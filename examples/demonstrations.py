"""Start with demonstrations: a one-line controller shows SAC the flag, which it rarely finds by itself.

python examples/demonstrations.py
"""

import argparse

import gymnasium
import numpy as np

from csac import SAC, train

TASK = "MountainCarContinuous-v0"


def controller(observation):
    """Push in the direction of motion, so that the car gains energy."""
    return np.sign(observation[1:])


def demonstrate(episodes):
    """Return the controller's transitions, in the format of a file from np.savez, and its mean return."""
    steps, environment = [], gymnasium.make(TASK)
    for episode in range(episodes):
        observation, _ = environment.reset(seed=episode)
        terminated = truncated = False
        while not (terminated or truncated):
            action = controller(observation).astype(np.float32)
            following, reward, terminated, truncated, _ = environment.step(action)
            steps.append((observation, action, reward, following, terminated, truncated))
            observation = following
    names = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
    arrays = {name: np.array(field) for name, field in zip(names, zip(*steps, strict=True), strict=True)}
    return arrays, arrays["rewards"].sum() / episodes


def main(directory, steps, episodes):
    """Train with and without demonstrations, and print the mean return of each evaluation."""
    demonstrations, mean_return = demonstrate(episodes)
    print(f"the controller: {mean_return:.0f}")
    settings = {"steps": steps, "evaluation_interval": max(steps // 5, 1)}
    for name, given in (("without", None), ("with", demonstrations)):
        # Demonstrations make random warm-up steps unnecessary.
        algorithm = SAC(warmup_steps=0 if given else 500)
        run = train(algorithm, TASK, directory=f"{directory}/{name}", demonstrations=given, **settings)
        rows = run.evaluations
        means = [rows["return"][rows["step"] == step].mean() for step in np.unique(rows["step"])]
        print(f"{name}, every {settings['evaluation_interval']:,} steps: {' '.join(f'{mean:.0f}' for mean in means)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--directory", default="runs/demonstrations")
    parser.add_argument("--steps", type=int, default=5_000)
    parser.add_argument("--episodes", type=int, default=20)
    main(**vars(parser.parse_args()))
