"""SB3's and SBX's SAC, TD3 and PPO at the settings of csac's presets `paper`."""

from importlib import import_module

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

OFF_POLICY = {
    "learning_rate": 3e-4,
    "buffer_size": 1_000_000,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "policy_kwargs": {"net_arch": [256, 256]},
}
TD3 = {**OFF_POLICY, "policy_delay": 2, "target_policy_noise": 0.2, "target_noise_clip": 0.5}
EXPLORATION_NOISE = 0.1  # added to the random actions of the warm-up too: not quite uniform then
PPO = {
    # The last rollout ends after the last step, where the line would be below zero.
    "learning_rate": lambda progress_remaining: 3e-4 * max(progress_remaining, 0.0),
    "n_steps": 2048,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "clip_range_vf": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "policy_kwargs": {"net_arch": {"pi": [64, 64], "vf": [64, 64]}},
}
SCALES = {"norm_obs": True, "norm_reward": True, "clip_obs": 10.0, "clip_reward": 10.0, "gamma": 0.99}


def make_model(library, algorithm, environment, seed, learning_starts, entropy_weight=0.2):
    """Return the model: `library` is sb3 or sbx, `algorithm` sac, td3 or ppo; an `auto` entropy weight begins at 1.

    PPO takes several environments too, as a `VecEnv`: its rollouts have the same steps of all.
    """
    module = import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[library])
    common = {"seed": seed, "device": "cpu"}
    if algorithm == "ppo":
        several = environment if isinstance(environment, VecEnv) else DummyVecEnv([lambda: Monitor(environment)])
        rollout = {**PPO, "n_steps": PPO["n_steps"] // several.num_envs}
        return module.PPO("MlpPolicy", VecNormalize(several, **SCALES), **rollout, **common)
    common["learning_starts"] = learning_starts
    if algorithm == "td3":
        shape = environment.action_space.shape
        noise = NormalActionNoise(np.zeros(shape), np.full(shape, EXPLORATION_NOISE))
        return module.TD3("MlpPolicy", environment, action_noise=noise, **TD3, **common)
    weight = entropy_weight if entropy_weight == "auto" else float(entropy_weight)
    return module.SAC("MlpPolicy", environment, ent_coef=weight, **OFF_POLICY, **common)
