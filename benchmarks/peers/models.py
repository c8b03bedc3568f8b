"""SB3's and SBX's algorithms for the scripts beside this one, at two kinds of settings.

`make_model` has SAC, TD3 and PPO as csac's presets `paper` have them, to compare speed and learning at equal settings.
`make_peer` has what results/strong/PROTOCOL.md compares at equal time: SAC with no setting given, and SBX's TQC, CrossQ
and SimBa at the settings of their authors.
"""

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

# The authors' settings. Every one that a paper names is given, also where SBX 0.28 has the same default. The numbers
# were read in the authors' own code, which is named with each; the papers have them in tables of an appendix.
# Each makes one update after each step of the environment, with 256 transitions of a replay of 1,000,000.
ONE_UPDATE_EACH_STEP = {"buffer_size": 1_000_000, "batch_size": 256, "train_freq": 1, "gradient_steps": 1}

# Kuznetsov et al. 2020, "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
# Critics" (arXiv 2005.04269), hyperparameters in the appendix; SamsungLabs/tqc_pytorch: main.py, tqc/structures.py.
# What SBX cannot do: its TQC has two critics, where the paper has five (`n_critics` changes only how many quantiles are
# kept, not how many critics there are); and it acts at random until the first update, where the authors' policy acts.
TQC = {
    **ONE_UPDATE_EACH_STEP,
    "learning_rate": 3e-4,
    "tau": 0.005,
    "gamma": 0.99,
    "ent_coef": "auto",
    "target_entropy": "auto",  # minus the number of actions
    "learning_starts": 256,  # main.py: the first update is made once there is a batch
    "policy_kwargs": {"net_arch": {"pi": [256, 256], "qf": [512, 512, 512]}, "n_quantiles": 25},
}
# Quantiles that each critic drops, of 25, where it is not 2: the authors' README, by task.
TQC_DROPPED = {"Hopper": 5, "HalfCheetah": 0}

# Bhatt et al. 2024, "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
# Simplicity" (arXiv 1902.05605), hyperparameters in the appendix; adityab/CrossQ: train.py, `-algo crossq`.
# SBX's own default differs in two of them: critics 1024 wide, "for faster computation", and 100 steps of warm-up.
CROSSQ = {
    **ONE_UPDATE_EACH_STEP,
    "learning_rate": 1e-3,  # of actor, critics and temperature
    "gamma": 0.99,
    "policy_delay": 3,
    "ent_coef": "auto",
    "target_entropy": "auto",
    "learning_starts": 5_000,
    "policy_kwargs": {
        "net_arch": {"pi": [256, 256], "qf": [2048, 2048]},
        "n_critics": 2,
        "batch_norm": True,
        "batch_norm_actor": True,
        "batch_norm_momentum": 0.99,
        "renorm_warmup_steps": 100_000,
        "optimizer_kwargs": {"b1": 0.5},
    },
}

# Lee et al. 2025, "SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement Learning" (arXiv 2410.09754),
# hyperparameters of SAC in the appendix; SonyResearch/simba: configs/agent/sac_simba.yaml, configs/base.yaml and
# configs/buffer/numpy_uniform.yaml. Its tasks repeat each action twice, and it makes two updates for each decision: one
# for each step of the environment, as here, where nothing repeats actions. Their later SimbaV2 has a file for these
# tasks that says the same (configs/online_rl.yaml and configs/env/mujoco.yaml: as many updates as repetitions, one).
# What SBX cannot do: its first layers begin with its own weights, where the authors' are orthogonal.
SIMBA = {
    **ONE_UPDATE_EACH_STEP,
    "learning_rate": 1e-4,  # of actor, critics and temperature
    "tau": 0.005,
    # The authors' heuristic, within 0.95 and 0.995: 1 - 5 / (decisions of an episode), which are 1,000 here.
    "gamma": 0.995,
    "ent_coef": "auto_0.01",
    "learning_starts": 5_000,
    "policy_kwargs": {
        "net_arch": {"pi": [128], "qf": [512, 512]},  # the widths of residual blocks: one, and two
        "n_critics": 2,  # and the lesser of both, as the authors have it where episodes can end early
        "optimizer_kwargs": {"weight_decay": 1e-2},  # of AdamW, SBX's default for this policy
    },
}
SIMBA_ENTROPY = -0.5  # the target, for each action
# RSNorm, the running statistics of observations, is no part of SBX's policy, whose author has this wrapper stand for it
# (araffin/sbx, pull request 59). The authors clip nothing.
SIMBA_SCALES = {"norm_obs": True, "norm_reward": False, "clip_obs": float("inf")}

PEERS = ("sb3-sac", "sbx-sac", "sbx-tqc", "sbx-crossq", "sbx-simba")


def make_model(library, algorithm, task, seed, learning_starts, entropy_weight=settings.SAC_ENTROPY_WEIGHT):
    """Return the model: `library` is sb3 or sbx, `algorithm` sac, td3 or ppo; an `auto` entropy weight begins at 1."""
    module = import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[library])
    common = {"seed": seed, "device": "cpu"}
    if algorithm == "ppo":
        return module.PPO("MlpPolicy", _scaled(task, SCALES), **PPO, **common)

    import gymnasium

    environment = gymnasium.make(task)
    common["learning_starts"] = learning_starts
    if algorithm == "td3":
        noise = _noise(environment.action_space.shape)
        return module.TD3("MlpPolicy", environment, action_noise=noise, **TD3, **common)
    weight = entropy_weight if entropy_weight == "auto" else float(entropy_weight)
    return module.SAC("MlpPolicy", environment, ent_coef=weight, **OFF_POLICY, **common)


def make_peer(peer, task, seed):
    """Return the model of one of PEERS, which its authors' settings make, or none: then it has its seed alone."""
    import gymnasium

    if peer == "sb3-sac":
        return import_module("stable_baselines3").SAC("MlpPolicy", gymnasium.make(task), seed=seed)
    sbx = import_module("sbx")
    if peer == "sbx-simba":
        environment = _scaled(task, SIMBA_SCALES)
        target = SIMBA_ENTROPY * environment.action_space.shape[0]
        return sbx.SAC("SimbaPolicy", environment, target_entropy=target, seed=seed, **SIMBA)
    environment = gymnasium.make(task)
    if peer == "sbx-sac":
        return sbx.SAC("MlpPolicy", environment, seed=seed)
    if peer == "sbx-crossq":
        return sbx.CrossQ("MlpPolicy", environment, seed=seed, **CROSSQ)
    dropped = TQC_DROPPED.get(task.partition("-")[0], 2)
    return sbx.TQC("MlpPolicy", environment, top_quantiles_to_drop_per_net=dropped, seed=seed, **TQC)


def _noise(shape):
    """Return TD3's exploration noise. It is added to the random actions of the warm-up too: not quite uniform then."""
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise

    return NormalActionNoise(np.zeros(shape), np.full(shape, settings.TD3_EXPLORATION_NOISE))


def _scaled(task, scales):
    """Return one environment whose observations, and rewards where `scales` says so, are on running scales."""
    import gymnasium
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    return VecNormalize(DummyVecEnv([lambda: Monitor(gymnasium.make(task))]), **scales)
