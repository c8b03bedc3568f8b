"""SB3's and SBX's SAC, TD3 and PPO at the settings of csac's presets `paper`, for the scripts beside this one."""

from importlib import import_module

import settings

OFF_POLICY = {
    "learning_rate": settings.LEARNING_RATE,
    "buffer_size": settings.REPLAY_SIZE,
    "batch_size": settings.BATCH_SIZE,
    "tau": settings.TARGET_RATE,
    "gamma": settings.DISCOUNT,
    "train_freq": 1,
    "gradient_steps": 1,
    "policy_kwargs": {"net_arch": list(settings.HIDDEN_SIZES)},
}
TD3 = {
    **OFF_POLICY,
    "policy_delay": settings.TD3_POLICY_DELAY,
    "target_policy_noise": settings.TD3_TARGET_NOISE,
    "target_noise_clip": settings.TD3_TARGET_NOISE_LIMIT,
}
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


def make_model(library, algorithm, task, seed, learning_starts, entropy_weight=settings.SAC_ENTROPY_WEIGHT):
    """Return the model: `library` is sb3 or sbx, `algorithm` sac, td3 or ppo; an `auto` entropy weight begins at 1."""
    module = import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[library])
    common = {"seed": seed, "device": "cpu"}
    if algorithm == "ppo":
        return module.PPO("MlpPolicy", _scaled(task), **PPO, **common)

    import gymnasium

    environment = gymnasium.make(task)
    common["learning_starts"] = learning_starts
    if algorithm == "td3":
        noise = _noise(environment.action_space.shape)
        return module.TD3("MlpPolicy", environment, action_noise=noise, **TD3, **common)
    weight = entropy_weight if entropy_weight == "auto" else float(entropy_weight)
    return module.SAC("MlpPolicy", environment, ent_coef=weight, **OFF_POLICY, **common)


def _noise(shape):
    """Return TD3's exploration noise. It is added to the random actions of the warm-up too: not quite uniform then."""
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise

    return NormalActionNoise(np.zeros(shape), np.full(shape, settings.TD3_EXPLORATION_NOISE))


def _scaled(task):
    """Return one environment whose observations and rewards are on running scales."""
    import gymnasium
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    return VecNormalize(DummyVecEnv([lambda: Monitor(gymnasium.make(task))]), **SCALES)
