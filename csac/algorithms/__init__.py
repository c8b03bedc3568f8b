"""What is learnt. To add an algorithm, write its file and announce it here."""

from csac.algorithms.csac import CSAC
from csac.algorithms.ppo import PPO
from csac.algorithms.sac import SAC

ALGORITHMS = {algorithm.name: algorithm for algorithm in (CSAC, SAC, PPO)}
