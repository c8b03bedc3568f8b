"""The paper as data: its tables, what its text claims, and what had to be inferred to compare with it.

Shang, Yuan, Huang, Cui, Chen, Zhu: Effective Reinforcement Learning Control using Conservative Soft Actor-Critic.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

METHODS = ("CSAC", "SAC", "PPO", "TD3", "SD3")


class Published(NamedTuple):
    """A mean over five trials and the standard deviation beside it."""

    mean: float
    std: float


def _columns(*cells: tuple[float, float]) -> Mapping[str, Published]:
    return MappingProxyType({name: Published(*cell) for name, cell in zip(METHODS, cells, strict=True)})


# Table "Maximum average returns over four benchmark tasks".
MAXIMUM_AVERAGE_RETURNS: Mapping[str, Mapping[str, Published]] = MappingProxyType(
    {
        "HalfCheetah-v4": _columns(
            (11672.74, 151.21), (11052.89, 422.84), (4181.89, 723.54), (8224.70, 337.13), (7158.19, 2821.74)
        ),
        "Walker2d-v4": _columns(
            (4106.21, 501.45), (2710.65, 1272.01), (2403.55, 502.86), (3513.25, 295.81), (3404.03, 989.50)
        ),
        "Ant-v4": _columns(
            (5538.20, 209.62), (5229.39, 269.52), (1836.47, 233.91), (2368.35, 99.15), (2960.61, 212.54)
        ),
        "Hopper-v4": _columns(
            (3458.22, 59.87), (3037.19, 242.06), (2204.01, 540.71), (3296.80, 356.86), (3515.30, 107.84)
        ),
    }
)

# Table "Max average returns over two real-robot-based simulation tasks". The arm's task was PandaReach-v2, which ran on
# after a success with rewards of 0; v3 ends there: the same returns, another bootstrap.
ROBOT_RETURNS: Mapping[str, Mapping[str, Published]] = MappingProxyType(
    {
        "PyFlyt/QuadX-Waypoints-v1": _columns(
            (530.28, 29.04), (388.55, 189.51), (267.06, 32.07), (433.56, 56.03), (383.03, 145.51)
        ),
        "PandaReach-v3": _columns((-2.04, 0.18), (-2.12, 0.22), (-49.80, 0.04), (-48.57, 0.08), (-48.36, 0.10)),
    }
)

RETURNS: Mapping[str, Mapping[str, Published]] = MappingProxyType({**MAXIMUM_AVERAGE_RETURNS, **ROBOT_RETURNS})

# Steps of a run on each task: see INFERRED. PPO needs 1.64M on Hopper to reach the lower boundary.
STEPS: Mapping[str, int] = MappingProxyType({**dict.fromkeys(RETURNS, 1_000_000), "Hopper-v4": 2_000_000})

# Table "Number of interactions required to reach the lower bound of maximum average return", there in 10^4 steps.
INTERACTIONS: Mapping[str, Mapping[str, int]] = MappingProxyType(
    {
        task: MappingProxyType(dict(zip(METHODS, (round(10_000 * cell) for cell in cells), strict=True)))
        for task, cells in {
            "HalfCheetah-v4": (10.5, 11.5, 95, 13.5, 16.5),
            "Walker2d-v4": (45, 90.5, 98, 81.5, 65.5),
            "Ant-v4": (22.5, 30, 98, 77, 28),
            "Hopper-v4": (32.5, 84.5, 164, 67, 22),
        }.items()
    }
)

# Section "Ablation study on Walker2d task".
TAUS = (0.005, 0.05, 0.5, 5.0, 50.0)
BEST_TAU = 0.5

COLUMNS = (*METHODS, *(f"tau {tau:g}" for tau in TAUS))  # what a method of a study may stand beside

# Section "Evaluation of robustness in HalfCheetah task".
FRICTION_TASK = "HalfCheetah-v4"
FRICTION_FACTORS = (1.5, 2.0, 2.5)
FRICTION_STEP = 300_000

# Table "Case analysis in QuadX-Waypoints-v1": counts in 1,000 rollouts of each of five trials.
CASES_TASK = "PyFlyt/QuadX-Waypoints-v1"
ROLLOUTS = 1_000
CASES: Mapping[str, Mapping[str, Published]] = MappingProxyType(
    {
        "out_of_bounds": _columns((20.6, 11.24), (48.2, 27.54), (38.4, 17.93), (73.2, 20.5), (56.0, 18.72)),
        "collision": _columns((31.6, 10.41), (50.6, 14.36), (175.4, 4.16), (45.4, 15.01), (61.2, 24.34)),
        "env_complete": _columns((352.0, 241.57), (173.4, 230.56), (31.0, 19.67), (64.0, 68.31), (125.4, 158.86)),
    }
)

# Section "Evaluation of effectiveness in robotic arm": success is near 100 % by these steps.
SUCCESS_TASK = "PandaReach-v3"
SUCCESS_STEPS: Mapping[str, int] = MappingProxyType({"CSAC": 600_000, "SAC": 800_000})

# Table "Common hyper-parameter settings of compared approaches"; None is the paper's "/".
HYPERPARAMETERS: Mapping[str, Mapping[str, str | None]] = MappingProxyType(
    {
        row: MappingProxyType(dict(zip(METHODS, cells, strict=True)))
        for row, cells in {
            "Critic Learning Rate": ("3e-4", "3e-4", "3e-4", "3e-4", "1e-3"),
            "Actor Learning Rate": ("3e-4", "3e-4", "3e-4", "3e-4", "1e-3"),
            "Actor and Critic Structure": ("(256,256)", "(256,256)", "(64,64)", "(256,256)", "(256,256)"),
            "Target Update Rate": ("0.005", "0.005", None, "0.005", "0.005"),
            "Batch Size": ("256", "256", "32", "256", "256"),
            "Memory Size": ("1e6", "1e6", None, "1e6", "1e6"),
            "Warmup Steps": ("1e4", "1e4", None, "1e4", "1e4"),
            "Discount Factor": ("0.99", "0.99", "0.99", "0.99", "0.99"),
        }.items()
    }
)


class Weights(NamedTuple):
    """CSAC's own hyperparameters."""

    sigma: float
    tau: float


# Section "Experimental settings" and table "Specific hyperparameters of CSAC".
WEIGHTS: Mapping[str, Weights] = MappingProxyType(
    {
        **dict.fromkeys(MAXIMUM_AVERAGE_RETURNS, Weights(0.2, 0.5)),
        "PyFlyt/QuadX-Waypoints-v1": Weights(0.2, 0.1),
        "PandaReach-v3": Weights(0.2, 0.5),
    }
)


class Spaces(NamedTuple):
    """Sizes of observations and actions."""

    observation: int
    action: int


# Tables "Observation and action spaces". Those of the two robots match neither environment, which have 27 and 4 (QuadX,
# with two waypoints in sight) and 12 and 3 (Panda).
SPACES: Mapping[str, Spaces] = MappingProxyType(
    {
        "HalfCheetah-v4": Spaces(17, 6),
        "Walker2d-v4": Spaces(17, 6),
        "Ant-v4": Spaces(27, 8),
        "Hopper-v4": Spaces(11, 3),
        "PyFlyt/QuadX-Waypoints-v1": Spaces(9, 4),
        "PandaReach-v3": Spaces(17, 6),
    }
)

INFERRED = (
    "The paper does not state how long it trained; the steps in its table of interactions reach 0.98M on three tasks "
    "and 1.64M on Hopper, so 1M steps, and 2M on Hopper, are inferred.",
    '"Maximum average return" is taken as the highest mean over seeds among the evaluation points, and "lower '
    'boundary" as the lowest of these maxima among the methods compared.',
    "The paper's robot arm is PandaReach-v2, which ran on after a success; PandaReach-v3 ends there.",
)
