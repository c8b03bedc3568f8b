"""The paper's experiments as studies, and what this library asks beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from csac.studies import paper
from csac.studies.cells import similar
from csac.studies.study import Method, Study, read_study
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

# A cell is known by every hyperparameter: these name what they do not use as well, as it was when their cells ran.
PINNED = MappingProxyType(
    {"relative_entropy_estimator": "closed_form", "reference_period": 1000, "reference_rate": 0.005}
)

CSAC_PAPER = Method("CSAC (paper)", "csac", "paper", published="CSAC")
CSAC_PERIODIC = Method("CSAC (periodic)", "csac", hyperparameters={**PINNED, "reference_policy": "periodic"})
SAC = Method("SAC", "sac", "paper", published="SAC")
PPO = Method("PPO", "ppo", "paper", published="PPO")
TD3 = Method("TD3", "td3", "paper", published="TD3")
SD3 = Method("SD3", "sd3", "paper", published="SD3")
ALL = (CSAC_PAPER, CSAC_PERIODIC, SAC, PPO, TD3, SD3)

MUJOCO = Study(
    "mujoco",
    "Learning curves and maximum average returns on four MuJoCo tasks",
    tasks=tuple(paper.MAXIMUM_AVERAGE_RETURNS),
    methods=ALL,
    steps_on=MappingProxyType({"Hopper-v4": paper.STEPS["Hopper-v4"]}),
)

ABLATION = Study(
    "ablation",
    "The weight of the relative entropy (tau) on Walker2d",
    tasks=("Walker2d-v4",),
    methods=tuple(
        replace(
            method,
            label=f"{method.label}, tau {tau:g}",
            hyperparameters={**method.hyperparameters, "relative_entropy_weight": tau},
            published=f"tau {tau:g}" if method.published else None,
        )
        for method in (CSAC_PAPER, CSAC_PERIODIC)
        for tau in paper.TAUS
    ),
)

EFFICIENCY = replace(
    MUJOCO, name="efficiency", title="Interactions to the lower boundary of the returns", analyses=("efficiency",)
)

ROBUSTNESS = Study(
    "robustness",
    "More friction in mid-training on HalfCheetah",
    tasks=(paper.FRICTION_TASK,),
    methods=(CSAC_PAPER, CSAC_PERIODIC, SAC),
    conditions=tuple((f"friction={factor:g}@{paper.FRICTION_STEP}",) for factor in paper.FRICTION_FACTORS),
    analyses=("robustness",),
)

QUADX = Study(
    "quadx",
    "A quadrotor that flies to four waypoints",
    tasks=("PyFlyt/QuadX-Waypoints-v1",),
    methods=ALL,
    rollouts=paper.ROLLOUTS,
    analyses=("curves", "returns", "cases"),
)

PANDA = Study(
    "panda",
    "A robot arm that reaches for a point",
    tasks=(paper.SUCCESS_TASK,),
    methods=ALL,
    analyses=("curves", "returns", "success"),
)

REFERENCE = replace(
    MUJOCO,
    name="reference",
    title="CSAC's reference policies against SAC",
    tasks=("Hopper-v4", "Walker2d-v4", "HalfCheetah-v4"),
    claims=False,
    methods=(
        replace(SAC, label="SAC, 0.2"),
        Method("SAC, automatic", "sac"),
        replace(CSAC_PAPER, label="CSAC, paper"),
        *(
            Method(
                f"CSAC, {label}",
                "csac",
                hyperparameters={"relative_entropy_weight": 0.5, **PINNED, **hyperparameters},
            )
            for label, hyperparameters in (
                ("previous", {"reference_policy": "average", "reference_rate": 1.0}),
                ("periodic 100", {"reference_policy": "periodic", "reference_period": 100}),
                ("periodic 1000", {"reference_policy": "periodic", "reference_period": 1000}),
                ("average 0.005", {"reference_policy": "average", "reference_rate": 0.005}),
                ("average 0.05", {"reference_policy": "average", "reference_rate": 0.05}),
            )
        ),
    ),
)

WHOLE = (MUJOCO, ABLATION, EFFICIENCY, ROBUSTNESS, QUADX, PANDA, REFERENCE)
SMOKE_SCALE = 0.001

NAMED: Mapping[str, tuple[Study, ...]] = MappingProxyType(
    {
        **{study.name: (study,) for study in WHOLE},
        "smoke": tuple(
            replace(study, evaluation_episodes=1).narrowed(seeds=1).shortened(SMOKE_SCALE) for study in WHOLE
        ),
    }
)


def find(name: str) -> tuple[Study, ...]:
    """Return the studies of this name, or the one that a TOML file of this path describes.

    Raises:
        InputError: there is neither, or the file is not understood.
    """
    if name in NAMED:
        return NAMED[name]
    if name.endswith(".toml") or Path(name).is_file():
        return (read_study(name),)
    raise InputError(f"no study is called {name!r}{similar(name, NAMED)} (or give a .toml file of your own)")
