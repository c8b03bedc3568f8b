"""Layouts of trees of arrays: packed into few buffers, with or without an axis of seeds, and by name in files."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


class Packing:
    """Converts a tree to buffers and back: one row of all small float leaves, then the other leaves in their order.

    Each buffer passed to or from a program costs time, however small it is. A leaf of fewer than `below` elements is
    small; `tree` may hold shapes instead of arrays.
    """

    def __init__(self, tree: Any, below: int) -> None:
        leaves, self._structure = jax.tree.flatten(tree)
        self._shapes = [leaf.shape for leaf in leaves]
        self._is_small = [leaf.dtype == jnp.float32 and leaf.size < below for leaf in leaves]

    def pack(self, tree: Any) -> list[jax.Array]:
        """Return the buffers: a row of all small floats, then the other leaves as they are."""
        leaves = jax.tree.leaves(tree)
        small = [leaf.ravel() for leaf, is_small in zip(leaves, self._is_small, strict=True) if is_small]
        others = [leaf for leaf, is_small in zip(leaves, self._is_small, strict=True) if not is_small]
        return [jnp.concatenate([jnp.zeros(0), *small]), *others]

    def unpack(self, buffers: Sequence[Any]) -> Any:
        """Return the tree; its leaves have the leading axes of the buffers. NumPy buffers give views."""
        row, others = buffers[0], iter(buffers[1:])
        leaves, end = [], 0
        for shape, is_small in zip(self._shapes, self._is_small, strict=True):
            if is_small:
                begin, end = end, end + int(np.prod(shape))
                leaves.append(row[..., begin:end].reshape(row.shape[:-1] + shape))
            else:
                leaves.append(next(others))
        return jax.tree.unflatten(self._structure, leaves)


class Parcel:
    """Packs float32 arrays and an integer into one row on the host, and unpacks them in a program.

    Each array is a separate transfer to a GPU, which takes time however small it is. The row is int32, since integers
    arrive unchanged, while a float with the bits of a small integer might be flushed to zero.
    """

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        ends = np.cumsum([0, *map(math.prod, shapes)]).tolist()
        self._parts = [(shape, slice(*ends[i : i + 2])) for i, shape in enumerate(shapes)]

    def pack(self, number: int, *arrays: np.ndarray) -> np.ndarray:
        """Return the row, int32: the bits of the arrays, then the number."""
        row = np.empty(self._parts[-1][1].stop + 1, np.int32)
        floats = row.view(np.float32)
        for (shape, place), array in zip(self._parts, arrays, strict=True):
            floats[place].reshape(shape)[...] = array
        row[-1] = number
        return row

    def unpack(self, row: jax.Array) -> list[jax.Array]:
        """Return the arrays, then the number."""
        floats = jax.lax.bitcast_convert_type(row[:-1], jnp.float32)
        return [*(floats[place].reshape(shape) for shape, place in self._parts), row[-1]]


class SeedAxis:
    """The axis of seeds: the leading one of all arrays, left out if there is only one seed.

    With an axis of size one XLA transposes the weight gradients, which costs 4-8 % of an update.
    """

    def __init__(self, seeds: int) -> None:
        self.seeds, self._is_alone = seeds, seeds == 1

    def map(self, program: Callable, in_axes: Any = 0) -> Callable:
        """Return a program of one seed mapped over all seeds; `in_axes` as for `jax.vmap`."""
        return program if self._is_alone else jax.vmap(program, in_axes)

    def stack(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Stack one array per seed into one array."""
        return arrays[0] if self._is_alone else np.stack(arrays)

    def of(self, tree: Any, index: int) -> Any:
        """Return the part of a tree that belongs to the seed at this index; NumPy arrays give views."""
        return tree if self._is_alone else jax.tree.map(lambda leaf: leaf[index], tree)

    def strip(self, array: np.ndarray) -> np.ndarray:
        """Return an array [seed, ...] in the form that the programs of `map` take."""
        return array[0] if self._is_alone else array

    def restore(self, array: np.ndarray) -> np.ndarray:
        """Return an array that the programs of `map` returned as [seed, ...]."""
        return array[None] if self._is_alone else array


def by_name(tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree by their path, such as `actor.layers.0.weight`: their names in checkpoints."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
