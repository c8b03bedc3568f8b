"""Small arrays in one row, and back."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac.training.packing import Packing, Parcel, by_name


class Tree(NamedTuple):
    bias: Any
    count: Any
    hidden: Any
    number: Any


def tree(start: float = 0.0) -> Tree:
    hidden = np.arange(200 * 200, dtype=np.float32).reshape(200, 200)
    bias = start + np.arange(6, dtype=np.float32).reshape(2, 3)
    return Tree(bias, np.int32(2**24 + 1), hidden + start, np.float32(7 + start))


def test_only_small_floats_are_in_the_row():
    row, count, hidden = Packing(tree(), 100).pack(tree())
    np.testing.assert_array_equal(row, [0, 1, 2, 3, 4, 5, 7])
    assert count.dtype == jnp.int32
    assert int(count) == 2**24 + 1
    np.testing.assert_array_equal(hidden, tree().hidden)


def test_a_tree_without_small_floats_has_an_empty_row():
    packing = Packing({"count": np.int32(3)}, 100)
    row, count = packing.pack({"count": np.int32(3)})
    assert row.shape == (0,)
    assert int(packing.unpack([row, count])["count"]) == 3


def test_a_parcel_arrives_to_the_last_bit():
    # Denormals, both zeros, an infinity and a number that is not one, and an integer that as a float is denormal.
    rows = np.array([[1.5, -0.0, 1e-45], [np.inf, np.nan, -3e38]], np.float32)
    observation = np.array([2.0, 1e-40], np.float32)
    parcel = Parcel((2, 3), (2,))
    row = parcel.pack(2**24 + 1, rows, observation)
    assert row.shape == (9,)
    again, observed, number = jax.jit(parcel.unpack)(row)
    np.testing.assert_array_equal(np.asarray(again).view(np.int32), rows.view(np.int32))
    np.testing.assert_array_equal(np.asarray(observed).view(np.int32), observation.view(np.int32))
    assert number.dtype == jnp.int32
    assert int(number) == 2**24 + 1  # which no float32 is


def test_leaves_are_named_by_fields_keys_and_places():
    given = {"state": tree(), "moments": [np.zeros(1), (np.ones(2),)]}
    named = by_name(given)
    assert set(named) == {
        *("state.bias", "state.count", "state.hidden", "state.number"),
        *("moments.0", "moments.1.0"),
    }
    assert named["moments.1.0"] is given["moments"][1][0]
    assert list(named.values()) == jax.tree.leaves(given)
