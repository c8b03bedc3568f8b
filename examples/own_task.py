"""A custom task: push a cart to a goal on a rail. With success, events, and snapshots for exact resume.

python examples/own_task.py
"""

import argparse

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from csac import SAC, evaluate, load, train


class Rail(gymnasium.Env):
    """Push a cart to `goal`, both in [-1, 1]; success at the goal, failure beyond the ends of the rail."""

    observation_space = Dict(
        cart=Box(-np.inf, np.inf, (2,), np.float32),  # position, speed
        goal=Box(-1.0, 1.0, (1,), np.float32),
    )
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        """Start in the middle, with a goal drawn from the seed."""
        super().reset(seed=seed)
        self.cart = np.zeros(2)
        self.goal = self.np_random.uniform(-0.8, 0.8, 1)
        self.reversals, self.last_push = 0, 0.0
        return self.observe(), {}

    def step(self, action):
        """Push for a tenth of a second."""
        push = float(action[0])
        self.reversals += push * self.last_push < 0
        self.last_push = push
        self.cart[1] += 0.1 * push
        self.cart[0] += 0.1 * self.cart[1]
        distance = abs(self.cart[0] - self.goal[0])
        arrived = distance < 0.05 and abs(self.cart[1]) < 0.1
        off = abs(self.cart[0]) > 1.0
        # csac recognises `is_success`; the others are events, selected by name.
        info = {"is_success": arrived, "off_the_rail": off, "reversals": self.reversals}
        return self.observe(), -distance - 10.0 * off, arrived or off, False, info

    def observe(self):
        """Return the parts by name; csac concatenates them in alphabetical order."""
        return {"cart": self.cart.astype(np.float32), "goal": self.goal.astype(np.float32)}

    def get_snapshot(self):
        """Return the state of the current episode: arrays by name, and JSON values."""
        return {"cart": self.cart, "goal": self.goal}, {"reversals": self.reversals, "last_push": self.last_push}

    def set_snapshot(self, arrays, values):
        """Restore this state, after a reset with the episode's seed."""
        self.cart, self.goal = arrays["cart"].copy(), arrays["goal"].copy()
        self.reversals, self.last_push = values["reversals"], values["last_push"]


# This also enables `csac train own_task:Rail-v0 --events off_the_rail,reversals` in this folder.
gymnasium.register("Rail-v0", entry_point=lambda **options: Rail(**options), max_episode_steps=100)


def make_task():
    """Create the task for `train`; add any wrappers here."""
    return gymnasium.make("Rail-v0")


def main(directory, steps):
    """Train, print success and events, and evaluate on fresh episodes."""
    algorithm = SAC(warmup_steps=500, actor_hidden_sizes=(64, 64), critic_hidden_sizes=(64, 64), batch_size=64)
    events = ("off_the_rail", "reversals")
    run = train(algorithm, make_task, steps=steps, directory=directory, evaluation_interval=1_000, events=events)
    rows = run.evaluations
    last = rows[rows["step"] == steps]
    print(f"success {last['success'].mean():.0%}, off the rail {last['off_the_rail'].mean():.0%}")
    print(f"mean return of 100 fresh episodes: {evaluate(load(run.path), make_task, episodes=100).mean():.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--directory", default="runs/rail")
    parser.add_argument("--steps", type=int, default=5_000)
    main(**vars(parser.parse_args()))
