"""What brings rewards to a common scale, by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from equations import batch_of, transition

from csac.algorithms import CSAC, SAC
from csac.algorithms.memory import Replay, pack
from csac.algorithms.statistics import ReturnScale
from csac.types import Spec

END = {"terminated": 1.0}


def test_rewards_are_divided_by_the_spread_of_the_returns_of_each_environment():
    # Two environments, one step of each after the other, discount 1/2. The first earns 2, then 3: its returns are 2 and
    # 3 + 2/2 = 4. The second earns 4, ends, and earns 2: its returns are 4 and 2. Mean 3, variance 1.
    spec, steps = Spec(1, 1, 2), [(2.0, {}), (4.0, END), (3.0, {}), (2.0, {})]
    ring = Replay.create(4, spec, 2, discount=0.5, scale_rewards=True)
    for turn in (0, 2):
        rows = pack(batch_of(*(transition(reward=reward, **ended) for reward, ended in steps[turn : turn + 2])))
        ring = ring.measure(jnp.asarray(rows), spec).add(jnp.asarray(rows), jnp.int32(turn))
    assert ring.returns is not None
    np.testing.assert_allclose([ring.returns.statistics.mean, ring.returns.statistics.variance], [3.0, 1.0])
    np.testing.assert_allclose(ring.returns.running, [4.0, 2.0])
    scaled = ring.returns._replace(statistics=ring.returns.statistics._replace(std=jnp.float32(4.0)))
    drawn = Replay(ring.rows, returns=scaled).sample(jax.random.key(0), jnp.int32(4), 64, spec)
    assert set(np.asarray(drawn.reward).tolist()) == {0.5, 0.75, 1.0}


def test_divided_rewards_are_bounded_as_a_new_scale_may_be_tiny():
    rows = jnp.asarray(pack(batch_of(transition(reward=-3.0))))
    ring = (
        Replay.create(1, Spec(1, 1), discount=0.5, scale_rewards=True).measure(rows, Spec(1, 1)).add(rows, jnp.int32(0))
    )
    assert ring.sample(jax.random.key(0), jnp.int32(1), 1, Spec(1, 1)).reward == -10.0


def test_a_scale_that_has_seen_nothing_is_1():
    assert ReturnScale.create(1).statistics.std == 1.0


def test_the_entropy_to_aim_at_counts_action_dimensions_unless_it_is_given():
    assert SAC(target_entropy_per_dimension=-0.5).entropy_target(6) == -3.0
    assert CSAC(target_entropy_per_dimension=-0.5, target_entropy=-2.0).entropy_target(6) == -2.0
