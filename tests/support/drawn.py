"""A task that can be drawn, in a module whose text tests copy to where they need one."""

import gymnasium
import numpy as np


class Drawn(gymnasium.Env):
    """One step of reward 1, then the end."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 1.0, True, False, {}

    def render(self):
        return np.zeros((32, 32, 3), np.uint8)


gymnasium.register("Drawn-v0", entry_point=f"{__name__}:Drawn")
