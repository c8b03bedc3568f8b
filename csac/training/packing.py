"""Many small arrays as one: each buffer that enters and leaves a program costs, however little is in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence


class Packing:
    """How the leaves of a tree become buffers: the small floats in one row, then the other leaves in their order.

    Args:
        tree: a tree of arrays, or of their shapes, such as those that will be packed.
        below: how many elements a leaf has that is no longer small.
    """

    def __init__(self, tree: Any, below: int) -> None:
        leaves, self._structure = jax.tree.flatten(tree)
        self._shapes = [leaf.shape for leaf in leaves]
        self._is_small = [leaf.dtype == jnp.float32 and leaf.size < below for leaf in leaves]

    def pack(self, tree: Any) -> list[jax.Array]:
        """Return the buffers: a row of all small floats, [their number], then the other leaves as they are."""
        leaves = jax.tree.leaves(tree)
        small = [leaf.ravel() for leaf, is_small in zip(leaves, self._is_small, strict=True) if is_small]
        others = [leaf for leaf, is_small in zip(leaves, self._is_small, strict=True) if not is_small]
        return [jnp.concatenate([jnp.zeros(0), *small]), *others]

    def unpack(self, buffers: Sequence[Any]) -> Any:
        """Return the tree; leading axes of the buffers are those of its leaves. NumPy arrays give views."""
        row, others = buffers[0], iter(buffers[1:])
        leaves, end = [], 0
        for shape, is_small in zip(self._shapes, self._is_small, strict=True):
            if is_small:
                begin, end = end, end + int(np.prod(shape))
                leaves.append(row[..., begin:end].reshape(row.shape[:-1] + shape))
            else:
                leaves.append(next(others))
        return jax.tree.unflatten(self._structure, leaves)
