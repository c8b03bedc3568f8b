"""A little redundancy for a large file: what is damaged in one place of it, wherever that is, can be mended.

The parity of a file is the exclusive or of its 64 pieces, so it has a 64th of the file's size. A sector that cannot be
read, a flipped bit or a torn page damages bytes that lie together. Wherever they lie, each of them has a place of its
own in the parity, which tells by how much it is wrong; the file's checksum tells which piece it belongs to.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

PIECES = 64
SMALLEST = 8192  # bytes of a piece, or more: a damaged page of 4,096 leaves more than it may hold by chance unharmed


def parity_of(content: bytes) -> bytes:
    """Return the exclusive or of a file's pieces."""
    return np.bitwise_xor.reduce(_pieces(content, _piece_size(len(content))).view(np.uint64)).tobytes()


def mended(content: bytes, size: int, parity: bytes, is_right: Callable[[bytes], bool]) -> bytes | None:
    """Return a file as it was, or None where that cannot be had.

    Args:
        content: the file as it is now.
        size: how many bytes it had.
        parity: its `parity_of` by then.
        is_right: whether some content is what the file held.
    """
    piece = _piece_size(size)
    if len(parity) != piece or abs(len(content) - size) > piece:
        return None
    pieces = _pieces(content[:size].ljust(size, b"\0"), piece)
    error = np.bitwise_xor.reduce(pieces) ^ np.frombuffer(parity, np.uint8)
    begin = _begin_of_damage(error)
    flat = pieces.reshape(-1)
    for first in range(begin, size, piece):  # the damage begins at this place of one of the pieces
        last = min(first + piece, len(flat))
        place = np.arange(first, last)
        flat[place] ^= error[place % piece]
        if is_right(guess := flat[:size].tobytes()):
            return guess
        flat[place] ^= error[place % piece]
    return None


def _piece_size(size: int) -> int:
    """Return the bytes of a piece, whole words of eight."""
    return max(SMALLEST, -(-size // (8 * PIECES)) * 8)


def _pieces(content: bytes, size: int) -> np.ndarray:
    """Return [piece, byte], filled up with zeros."""
    whole = -(-len(content) // size) * size or size
    return np.frombuffer(content.ljust(whole, b"\0"), np.uint8).reshape(-1, size).copy()


def _begin_of_damage(error: np.ndarray) -> int:
    """Return where in a piece the damage begins: after the longest run of bytes without an error, around the end."""
    places = np.flatnonzero(error)
    if not len(places):
        return 0
    gaps = np.diff(places, prepend=places[-1] - len(error))
    return int(places[np.argmax(gaps)])
