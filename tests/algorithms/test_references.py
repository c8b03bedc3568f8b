"""Which policies an update takes as references: actors are numbers here, actor k the one before update k."""

from typing import Any

import jax.numpy as jnp
import pytest

from csac.algorithms.references import reference_after, references_before


def references(choice, keeps_earlier, updates=8, period=3, rate=0.5):
    kept: Any = jnp.zeros(())  # copies of actor 0
    earlier: Any = kept
    found = []
    for k in range(updates):
        actor: Any = jnp.float32(k)
        renews = jnp.asarray(k % period == 0)
        used: Any = references_before(choice, kept, earlier if keeps_earlier else None, actor, renews)
        found.append((float(used.actor), float(used.critic)))
        assert used.evaluated is (used.actor if keeps_earlier else actor)
        kept, earlier = reference_after(choice, used.actor, actor, rate), used.critic
    return found


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        ("algorithm1", [0, 1, 2, 3, 4, 5, 6, 7]),
        ("previous", [0, 0, 1, 2, 3, 4, 5, 6]),
        ("periodic", [0, 0, 0, 3, 3, 3, 6, 6]),
        ("average", [0, 0, 0.5, 1.25, 2.125, 3.0625, 4.03125, 5.015625]),  # the mean of the last one and its actor
    ],
)
def test_actor_and_critic_share_their_reference(choice, expected):
    assert references(choice, keeps_earlier=False) == [(one, one) for one in expected]


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        # The actor's π_k is the actor itself, and the critic's π_{k-1} the one before the last update.
        ("algorithm1", [(0, 0), (1, 0), (2, 1), (3, 2), (4, 3), (5, 4), (6, 5), (7, 6)]),
        ("periodic", [(0, 0), (0, 0), (0, 0), (3, 0), (3, 0), (3, 0), (6, 3), (6, 3)]),
    ],
)
def test_the_critic_has_the_reference_that_the_actor_s_replaced(choice, expected):
    assert references(choice, keeps_earlier=True) == expected


def test_without_a_reference_none_is_kept():
    actor: Any = jnp.ones(())
    used = references_before("average", None, None, actor, jnp.asarray(True))
    assert used == (None, None, actor)
    assert reference_after("average", used.actor, actor, 0.5) is None
