"""The arithmetic limit: the products of an update by hand, and the share of the limit from measurements."""

from __future__ import annotations

import pytest

from benchmarks.limit import share
from benchmarks.products import Network, Product, operations, update_products


def shared(updates_per_second: float, one_core_rate: float) -> dict:
    measured = {"updates_per_second": updates_per_second, "one_core_rate": one_core_rate}
    setting = {"setting": "training, one seed, 2 cores", "algorithm": "csac", "cores": 2}
    return {**setting, **measured, "giga_operations_per_update": 0.5}


def test_the_products_of_a_small_network_by_hand():
    network = Network((3, 5, 2))
    assert network.forward(7) == {Product(7, 3, 5): 1, Product(7, 5, 2): 1}
    assert network.weight_gradient(7) == {Product(3, 7, 5): 1, Product(5, 7, 2): 1}
    assert network.input_gradient(7) == {Product(7, 2, 5): 1}  # the network's own inputs are data
    assert network.input_gradient(7, 1) == {Product(7, 2, 5): 1, Product(7, 5, 1): 1}
    assert operations(dict(network.forward(7))) == 2 * 7 * (3 * 5 + 5 * 2)


@pytest.mark.parametrize(("algorithm", "hidden"), [("csac", 16), ("sac", 16), ("td3", 11.5)])
def test_the_products_of_an_update(algorithm, hidden):
    # By hand, in hidden products of one network: forward 1, learning 3, a gradient through a critic 2.
    # SAC, and CSAC whose reference is the actor: target 1 + 2, critics 3 + 3, actor 3 + 2 + 2.
    # TD3: target 1 + 2, critics 3 + 3, and every other time actor 3 and one critic 2.
    counts = update_products(algorithm)
    assert counts[Product(256, 256, 256)] == hidden
    assert 1 < operations(counts) / (hidden * Product(256, 256, 256).operations) < 1.1  # the edges are small


def test_an_algorithm_whose_products_are_not_counted_is_refused():
    with pytest.raises(ValueError, match="the products of ppo are not counted"):
        update_products("ppo")


def test_the_share_is_of_all_cores():
    assert share(shared(200, 100)) == 50  # 200 updates of half a 10⁹ operations, on two cores of 100 each
