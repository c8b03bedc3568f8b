"""The paper's numbers, and one function for each of its claims. docs/studies.md says which parts are inferred.

Shang, Yuan, Huang, Cui, Chen, Zhu: Effective Reinforcement Learning Control using Conservative Soft Actor-Critic.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from csac.record.statistics import (
    bootstrap_interval,
    drawdown,
    evaluation_matrix,
    mean_over_episodes,
    probability_of_improvement,
    recovery,
    steps_to_reach,
)
from csac.record.summaries import last_rows

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from csac.studies.arms import Arm

COLUMNS = ("CSAC", "SAC", "PPO", "TD3", "SD3")
CHEETAH, WALKER, ANT, HOPPER = "HalfCheetah-v4", "Walker2d-v4", "Ant-v4", "Hopper-v4"
QUADX, PANDA = "PyFlyt/QuadX-Waypoints-v1", "PandaReach-v3"  # the paper's v2 did not end at success

STEPS: Mapping[str, int] = {**dict.fromkeys((CHEETAH, WALKER, ANT, QUADX, PANDA), 1_000_000), HOPPER: 2_000_000}


class Published(NamedTuple):
    """A mean and a standard deviation over five trials."""

    mean: float
    std: float


def _columns(*cells: tuple[float, float]) -> Mapping[str, Published]:
    return {name: Published(*cell) for name, cell in zip(COLUMNS, cells, strict=True)}


# Tables "Maximum average returns over four benchmark tasks" and "... over two real-robot-based simulation tasks".
RETURNS: Mapping[str, Mapping[str, Published]] = {
    CHEETAH: _columns((11672.74, 151.21), (11052.89, 422.84), (4181.89, 723.54), (8224.70, 337.13), (7158.19, 2821.74)),
    WALKER: _columns((4106.21, 501.45), (2710.65, 1272.01), (2403.55, 502.86), (3513.25, 295.81), (3404.03, 989.50)),
    ANT: _columns((5538.20, 209.62), (5229.39, 269.52), (1836.47, 233.91), (2368.35, 99.15), (2960.61, 212.54)),
    HOPPER: _columns((3458.22, 59.87), (3037.19, 242.06), (2204.01, 540.71), (3296.80, 356.86), (3515.30, 107.84)),
    QUADX: _columns((530.28, 29.04), (388.55, 189.51), (267.06, 32.07), (433.56, 56.03), (383.03, 145.51)),
    PANDA: _columns((-2.04, 0.18), (-2.12, 0.22), (-49.80, 0.04), (-48.57, 0.08), (-48.36, 0.10)),
}

# Table "Number of interactions required to reach the lower bound of maximum average return".
INTERACTIONS: Mapping[str, Mapping[str, int]] = {
    task: dict(zip(COLUMNS, cells, strict=True))
    for task, cells in {
        CHEETAH: (105_000, 115_000, 950_000, 135_000, 165_000),
        WALKER: (450_000, 905_000, 980_000, 815_000, 655_000),
        ANT: (225_000, 300_000, 980_000, 770_000, 280_000),
        HOPPER: (325_000, 845_000, 1_640_000, 670_000, 220_000),
    }.items()
}

BEST_TAU = 0.5  # section "Ablation study on Walker2d task"
FRICTION_STEP = 300_000  # section "Evaluation of robustness in HalfCheetah task"

# Table "Case analysis in QuadX-Waypoints-v1": counts in 1,000 rollouts of each of five trials.
CASES: Mapping[str, Mapping[str, Published]] = {
    "out_of_bounds": _columns((20.6, 11.24), (48.2, 27.54), (38.4, 17.93), (73.2, 20.5), (56.0, 18.72)),
    "collision": _columns((31.6, 10.41), (50.6, 14.36), (175.4, 4.16), (45.4, 15.01), (61.2, 24.34)),
    "env_complete": _columns((352.0, 241.57), (173.4, 230.56), (31.0, 19.67), (64.0, 68.31), (125.4, 158.86)),
}

SUCCESS_STEPS: Mapping[str, int] = {"CSAC": 600_000, "SAC": 800_000}  # near 100 % on PandaReach
NEARLY_ALL = 0.95  # of an evaluation's episodes: the paper's "nearly 100 %"


class Claim(NamedTuple):
    """A claim that `arm` is better than `other`: `ours` and `others` hold a score per seed, where higher is better."""

    text: str
    arm: Arm
    other: Arm
    ours: np.ndarray
    others: np.ndarray
    needs_whole_runs: bool = True
    """Whether only runs at least as long as the paper's can test the claim."""

    def verdict(self) -> tuple[str, str]:
        """Return the verdict and the reason, from the interval of the probability that a seed of ours is better."""
        probability = probability_of_improvement(self.ours, self.others)
        interval = bootstrap_interval(probability_of_improvement, self.ours, self.others)
        reason = f"better in {probability:.0%} of the pairs of seeds"
        if interval is None:
            return "not yet decidable", f"{reason}; fewer than five seeds"
        low, high = interval
        verdict = "reproduced" if low > 0.5 else "not reproduced" if high < 0.5 else "not yet decidable"
        reason += f", 95 % interval {low:.0%} to {high:.0%}"
        if self.needs_whole_runs and not (_is_whole(self.arm) and _is_whole(self.other)):
            return "not yet decidable", f"runs shorter than the paper's: {reason}"
        return verdict, reason


def claims(arms: Sequence[Arm]) -> list[Claim]:
    """Return the paper's claims that these arms can test: each CSAC against each other arm under the same condition."""
    found = []
    for arm in arms:
        beside = [
            o for o in arms if (o.task, o.condition) == (arm.task, arm.condition) and o is not arm and len(o.rows)
        ]
        if arm.config.algorithm == "csac" and len(arm.rows) and arm.task in RETURNS:
            for other in beside:
                found += _compared(arm, other, beside)
    return [claim for claim in found if not (np.isnan(claim.ours).all() or np.isnan(claim.others).all())]


def _is_whole(arm: Arm) -> bool:
    changes = [step for step, _ in arm.marks]
    return arm.rows["step"].max(initial=0) >= STEPS[arm.task] and all(step == FRICTION_STEP for step in changes)


def _compared(arm: Arm, other: Arm, beside: Sequence[Arm]) -> Iterator[Claim]:
    if arm.condition:
        yield from robustness(arm, other)
    elif other.config.algorithm == "csac":
        yield from weight(arm, other)
    elif other.published:
        yield from returns(arm, other)
        yield from stability(arm, other)
        yield from efficiency(arm, other, [arm, *beside])
        yield from cases(arm, other)
        yield from success(arm, other)


def returns(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claim of a higher maximum average return, where the paper reports one."""
    published = RETURNS[arm.task]
    if published["CSAC"].mean > published[other.published or ""].mean:
        yield Claim("a higher maximum average return", arm, other, arm.best()[0], other.best()[0])


def stability(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claim "more stable than SAC", taken to mean a smaller largest fall of a learning curve."""
    if other.published == "SAC":
        ours, others = ([drawdown(line) for line in evaluation_matrix(one.rows)[2]] for one in (arm, other))
        yield Claim("a smaller drawdown", arm, other, -np.array(ours), -np.array(others))


def weight(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claim that the paper's best weight gives a higher maximum average return than each other weight."""
    first, second = (one.config.hyperparameters for one in (arm, other))
    apart = [name for name in first if first[name] != second.get(name)]
    if arm.task == WALKER and apart == ["relative_entropy_weight"] and first[apart[0]] == BEST_TAU:
        yield Claim("a higher maximum average return", arm, other, arm.best()[0], other.best()[0])


def efficiency(arm: Arm, other: Arm, arms: Sequence[Arm]) -> Iterator[Claim]:
    """Yield the claim of fewer steps to the lower boundary of the maximum average returns, where the paper reports so.

    A seed that never reaches it is censored: two such seeds count as equal.
    """
    published = INTERACTIONS.get(arm.task)
    if published and published["CSAC"] < published[other.published or ""]:
        boundary, is_the_papers = lower_boundary(arms), not _has_ppo(arms)
        until = min(int(one.rows["step"].max()) for one in (arm, other))  # one may not be finished
        steps = (interactions(one, boundary) for one in (arm, other))
        ours, others = (-np.where(own <= until, own, np.inf) for own in steps)
        yield Claim("fewer steps to the lower boundary", arm, other, ours, others, not is_the_papers)


def cases(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claims of fewer crashes and more complete flights on the quadrotor, where the paper reports so."""
    for name, row in CASES.items() if arm.task == QUADX else ():
        sign = 1 if name == "env_complete" else -1
        if sign * (row["CSAC"].mean - row[other.published or ""].mean) > 0 and name in (arm.rows.dtype.names or ()):
            text = f"{'more' if sign > 0 else 'fewer'} episodes with {name}"
            yield Claim(text, arm, other, sign * _shares(arm, name), sign * _shares(other, name))


def success(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claim of success in nearly all episodes sooner than SAC, on the robot arm."""
    if arm.task == PANDA and other.published in SUCCESS_STEPS:
        ours, others = (-interactions(one, NEARLY_ALL, "success") for one in (arm, other))
        yield Claim(f"success in {NEARLY_ALL:.0%} of the episodes sooner", arm, other, ours, others)


def robustness(arm: Arm, other: Arm) -> Iterator[Claim]:
    """Yield the claims against SAC on HalfCheetah with increased friction: less loss, faster recovery, a higher end."""
    is_the_papers = arm.task == CHEETAH and all(change.startswith("friction=") for change in arm.condition)
    if not is_the_papers or other.published != "SAC":
        return
    ours, others = (list(recovery(one.rows, one.marks[0][0]).values()) for one in (arm, other))
    for text, name, sign in (
        ("loses less of its return", "relative_drop", -1),
        ("regains it sooner", "steps_to_regain", -1),
        ("ends higher", "final", 1),
    ):
        values = [sign * np.array([getattr(one, name) for one in side]) for side in (ours, others)]
        yield Claim(text, arm, other, values[0], values[1])


def lower_boundary(arms: Sequence[Arm]) -> float:
    """Return the lowest maximum average return among arms of the paper's methods, or among all arms if there are none.

    PPO has the lowest in the paper: if the paper's methods are there but not PPO, the paper's own boundary is used.
    """
    arms = [arm for arm in arms if len(arm.rows)]
    known = RETURNS.get(arms[0].task)
    if known and any(arm.published for arm in arms) and not _has_ppo(arms):
        return min(told.mean for told in known.values())
    return min(float(arm.best()[0].mean()) for arm in [arm for arm in arms if arm.published] or arms)


def _has_ppo(arms: Sequence[Arm]) -> bool:
    return any(arm.published == "PPO" for arm in arms)


def interactions(arm: Arm, threshold: float, column: str = "return") -> np.ndarray:
    """Return the steps [seed] to the first evaluation that reaches `threshold`; infinity for a seed without one."""
    rows = arm.rows.copy()
    rows["return"] = np.nan_to_num(rows[column], nan=0.0)
    steps, _, values = evaluation_matrix(rows)
    return np.array([steps_to_reach(steps, line, threshold) for line in values])


def _shares(arm: Arm, name: str) -> np.ndarray:
    rows = last_rows(arm.rows, points=3)
    return np.array([mean_over_episodes(rows[name][rows["seed"] == seed], True) for seed in np.unique(rows["seed"])])
