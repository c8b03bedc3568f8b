"""The algorithms. To add one, write its file and register it here."""

from csac.algorithms.csac import CSAC
from csac.algorithms.hyperparameters import reject_unknown_names
from csac.algorithms.ppo import PPO
from csac.algorithms.sac import SAC
from csac.algorithms.sd3 import SD3
from csac.algorithms.td3 import TD3

ALGORITHMS = {algorithm.name: reject_unknown_names(algorithm) for algorithm in (CSAC, SAC, TD3, SD3, PPO)}
