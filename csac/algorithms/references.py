"""Which policies the relative entropy is taken towards, update by update."""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from csac.algorithms.networks import MLP, polyak

ReferencePolicy: TypeAlias = Literal["algorithm1", "previous", "periodic", "average"]


class References(NamedTuple):
    """The reference policies of one update."""

    actor: MLP | None  # of the actor's loss: π_k
    critic: MLP | None  # of the critic's target: the same, or π_{k-1}
    evaluated: MLP  # the policy that the critic's target takes the value of: the actor as it is, or π_k beside π_{k-1}


def references_before(
    choice: ReferencePolicy, kept: MLP | None, earlier: MLP | None, actor: MLP, renews: Bool[Array, ""]
) -> References:
    """Return the references of an update, given those that were kept and the actor before its gradients.

    With `periodic` the reference is the actor where the period begins anew (`renews`). Where an earlier reference is
    kept, the target is that of CVI: the value of the actor's reference, which is charged for its distance from the one
    that it took the place of. The reference of `algorithm1` is renewed at every update.
    """
    if kept is None:
        return References(None, None, actor)
    used = actor if choice == "algorithm1" else _where(renews, actor, kept) if choice == "periodic" else kept
    if earlier is None:
        return References(used, used, actor)
    return References(used, kept if choice == "algorithm1" else _where(renews, kept, earlier), used)


def reference_after(choice: ReferencePolicy, used: MLP | None, actor: MLP, rate: float) -> MLP | None:
    """Return the reference to keep, given the one that the update used and the actor before its gradients."""
    if used is not None and choice == "previous":
        return actor
    if used is not None and choice == "average":
        return polyak(used, actor, rate)
    return used


def _where(condition: Bool[Array, ""], new: MLP, old: MLP) -> MLP:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)
