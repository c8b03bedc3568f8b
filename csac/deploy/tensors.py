"""The safetensors format for float32 arrays, by NumPy alone: https://github.com/huggingface/safetensors#format.

A file is the length of its header (8 bytes, little endian), the header (JSON: name -> dtype, shape, and where its bytes
begin and end; `__metadata__` -> texts by name), then the bytes. What is written is byte for byte what the library
`safetensors` writes.
"""

from __future__ import annotations

import json
import math
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

LONGEST_HEADER = 2**20  # bytes; a policy needs about a hundred for each array

_FLOAT32 = np.dtype("<f4")
_FIELDS = {"dtype", "shape", "data_offsets"}
_METADATA = "__metadata__"


def encode(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """Return the file that holds these float32 arrays, and texts by name."""
    header: dict[str, Any] = {_METADATA: dict(metadata)} if metadata else {}
    parts, end = [], 0
    for name, array in sorted(tensors.items()):
        part = np.asarray(array, _FLOAT32).tobytes()
        begin, end = end, end + len(part)
        header[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": [begin, end]}
        parts.append(part)
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join([len(text).to_bytes(8, "little"), text, *parts])


def decode(content: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a file, each float32 and read-only.

    Raises:
        ValueError: anything that is not exactly this format, or arrays that are not float32; the message is one line.
    """
    header, data = _parts(content)
    header.pop(_METADATA, None)
    spans = {name: _span(name, entry) for name, entry in header.items()}
    tensors, end = {}, 0
    for name, (begin, after, shape) in sorted(spans.items(), key=lambda item: item[1][:2]):
        if begin != end or after > len(data):
            raise ValueError(f"the bytes of {name!r} do not follow those before")
        tensors[name], end = np.frombuffer(data[begin:after], _FLOAT32).reshape(shape), after
    if end != len(data):
        raise ValueError(f"it holds {len(data)} bytes of numbers where its header has {end}")
    return tensors


def metadata_of(content: bytes) -> dict[str, str]:
    """Return the texts of a file by name. Raises ValueError for a header that is not of this format."""
    return _parts(content)[0].get(_METADATA, {})


def _parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return a file's header, whose metadata are texts where it has any, and what follows it."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or not 2 <= length <= min(LONGEST_HEADER, len(content) - 8):
        raise ValueError("it has no header of a safe length")
    try:
        header = json.loads(content[8 : 8 + length].decode(), object_pairs_hook=_without_duplicates)
    except RecursionError:
        raise ValueError("its header is nested too deeply") from None
    if not isinstance(header, dict):
        raise ValueError("its header is not a JSON object")
    metadata = header.get(_METADATA, {})
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise ValueError("its metadata are not texts by name")
    return header, content[8 + length :]


def _span(name: str, entry: Any) -> tuple[int, int, list[int]]:
    """Return where an array's bytes begin and end, and its shape."""
    if not isinstance(entry, dict) or entry.keys() != _FIELDS:
        raise ValueError(f"the header's entry for {name!r} is not one of an array")
    if entry["dtype"] != "F32":
        raise ValueError(f"{name!r} is not float32")
    shape, offsets = entry["shape"], entry["data_offsets"]
    if not (_are_sizes(shape) and _are_sizes(offsets) and len(offsets) == 2):
        raise ValueError(f"shape or offsets of {name!r} are not sizes")
    if offsets[1] - offsets[0] != math.prod(shape) * _FLOAT32.itemsize:
        raise ValueError(f"{name!r} has other bytes than its shape needs")
    return offsets[0], offsets[1], shape


def _are_sizes(numbers: Any) -> bool:
    return isinstance(numbers, list) and all(type(number) is int and 0 <= number < 2**63 for number in numbers)


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise ValueError("its header has a name twice")
    return entries
