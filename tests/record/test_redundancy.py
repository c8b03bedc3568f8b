"""Damage in one place is mended, wherever it lies and however the file ends; anything else is left as it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csac.record.redundancy import PIECES, SMALLEST, mended, parity_of


def random_bytes(size: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def damaged(content: bytes, begin: int, length: int) -> bytes:
    """Other bytes in one place."""
    end = min(begin + length, len(content))
    other = bytes(byte ^ 1 + i % 255 for i, byte in enumerate(content[begin:end]))
    return content[:begin] + other + content[end:]


def test_the_parity_of_known_bytes():
    first, second = bytes([1] * SMALLEST), bytes([3] * SMALLEST)
    assert parity_of(first) == first
    assert parity_of(first + second) == bytes([2] * SMALLEST)
    assert parity_of(first + second[:1]) == bytes([2]) + first[1:]


def test_the_parity_of_a_large_file_is_a_64th_of_it():
    assert len(parity_of(bytes(PIECES * 80_000))) == 80_000


@settings(max_examples=40)
@given(st.integers(1, 3_000_000), st.floats(0, 1, exclude_max=True), st.floats(0, 1), st.integers(0, 9))
def test_bytes_that_lie_together_are_mended(size, where, share, seed):
    content = random_bytes(size, seed)
    parity = parity_of(content)
    most = len(parity) - 8  # a piece but for a word, more than the 4,096 bytes that are promised
    assert most >= 4096
    spoiled = damaged(content, int(where * size), max(1, int(share * most)))
    assert spoiled != content
    assert mended(spoiled, size, parity, lambda guess: guess == content) == content


@pytest.mark.parametrize("begin", [0, 1, 4095, 4103, 8193, 12_000])
def test_a_page_that_begins_anywhere_in_a_small_file_is_mended(begin):
    content = random_bytes(16_386)
    spoiled = damaged(content, begin, 4096)
    assert mended(spoiled, len(content), parity_of(content), lambda guess: guess == content) == content


@pytest.mark.parametrize("length", [1, 4096])
def test_a_lost_end_is_mended(length):
    content = random_bytes(700_000)
    assert mended(content[:-length], len(content), parity_of(content), lambda guess: guess == content) == content
    assert mended(content + b"x" * length, len(content), parity_of(content), lambda guess: guess == content) == content


def test_two_places_far_apart_are_not_mended():
    content = random_bytes(700_000)
    spoiled = damaged(damaged(content, 100, 10), 650_000, 10)
    assert mended(spoiled, len(content), parity_of(content), lambda guess: guess == content) is None


def test_a_parity_that_is_damaged_mends_nothing():
    content = random_bytes(700_000)
    spoiled, parity = damaged(content, 300_000, 10), damaged(parity_of(content), 5_000, 1)
    assert mended(spoiled, len(content), parity, lambda guess: guess == content) is None
    assert mended(spoiled, len(content), parity[:-1], lambda guess: guess == content) is None


def test_a_size_that_nothing_bears_out_allocates_nothing():
    assert mended(b"", 10**15, b"", lambda guess: True) is None
