"""Our reader and writer of safetensors: equal to the library's, and stricter with what is damaged."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from csac.deploy import tensors

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=5).filter(lambda s: s != "__metadata__")
ARRAYS = hnp.arrays(np.float32, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))


def equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(
        array.dtype == np.float32 and array.shape == other[name].shape and array.tobytes() == other[name].tobytes()
        for name, array in one.items()
    )


@given(st.dictionaries(NAMES, ARRAYS, max_size=4))
def test_any_arrays_are_written_and_read_as_the_library_does(arrays):
    content = tensors.encode(arrays)
    assert content == safetensors.numpy.save(arrays)
    assert equal(tensors.decode(content), arrays)
    assert equal(safetensors.numpy.load(content), arrays)


def test_the_names_of_a_policy_are_written_as_the_library_does():
    names = [
        f"{kind}.{number}.{index}.{name}"
        for kind in ("actor", "critic")
        for number in (0, 1)
        for index in range(12)
        for name in ("weight", "bias")
    ]
    arrays = {name: np.full((index % 3, 2), index, np.float32) for index, name in enumerate([*names, "log_std"])}
    assert tensors.encode(arrays) == safetensors.numpy.save(arrays)


def test_metadata_are_written_and_read_as_the_library_does():
    arrays = {"b": np.arange(6, dtype=np.float32).reshape(2, 3), "a": np.ones(1, np.float32)}
    for metadata in ({}, {"made by": "another"}, {"ü": '"'}):
        content = safetensors.numpy.save(arrays, metadata or None)
        assert tensors.encode(arrays, metadata) == content
        assert equal(tensors.decode(content), arrays)
        assert tensors.metadata_of(content) == metadata


def file(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def entry(begin: int, end: int, shape: Any = None, dtype: str = "F32") -> dict[str, Any]:
    return {"dtype": dtype, "shape": [(end - begin) // 4] if shape is None else shape, "data_offsets": [begin, end]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no header"),
        (b"\x02\0\0", "no header"),
        ((10).to_bytes(8, "little") + b"{}", "no header"),
        ((2**63).to_bytes(8, "little") + b"{}", "no header"),
        (file(b" " * 2**20 + b"{}"), "no header of a safe length"),
        (file(b"{}}"), "Extra data"),
        (file(b'{"a":\xff}'), "utf-8"),
        (file([]), "not a JSON object"),
        (file(b"[" * 200_000), "nested too deeply"),
        (file(b'{"a":' * 150_000), "nested too deeply"),
        (file(b'{"a":' + b"1" * 5000 + b"}"), "Exceeds the limit"),
        (file({"a": 1}), "the header's entry for 'a'"),
        (file({"a": {**entry(0, 4), "more": 1}}, bytes(4)), "the header's entry for 'a'"),
        (file({"a": {"dtype": "F32", "shape": [1]}}, bytes(4)), "the header's entry for 'a'"),
        (file({"a": entry(0, 4, [2], "F16")}, bytes(4)), "'a' is not float32"),
        (file({"a": entry(0, 4, [1.0])}, bytes(4)), "are not sizes"),
        (file({"a": entry(0, 4, [True])}, bytes(4)), "are not sizes"),
        (file({"a": entry(0, 4, [-1, -1])}, bytes(4)), "are not sizes"),
        (file({"a": {**entry(0, 4), "data_offsets": [0, 4, 4]}}, bytes(4)), "are not sizes"),
        (file({"a": entry(0, 4, [2])}, bytes(4)), "other bytes than its shape needs"),
        (file({"a": {**entry(0, 4), "data_offsets": [4, 0]}}, bytes(4)), "other bytes than its shape needs"),
        (file({"a": entry(4, 8)}, bytes(8)), "do not follow"),
        (file({"a": entry(0, 8)}, bytes(4)), "do not follow"),
        (file({"a": entry(0, 8), "b": entry(4, 12)}, bytes(12)), "do not follow"),
        (file({"a": entry(0, 4), "b": entry(8, 12)}, bytes(12)), "do not follow"),
        (file({"a": entry(0, 4)}, bytes(5)), "holds 5 bytes of numbers where its header has 4"),
        (file(b'{"a":%s,"a":%s}' % ((json.dumps(entry(0, 4)).encode(),) * 2), bytes(4)), "a name twice"),
        (file({"__metadata__": {"a": 1}}), "metadata"),
        (file({"__metadata__": "a"}), "metadata"),
        (file({"a": entry(0, 0, [0, 2**62, 2**62])}), "."),
    ],
)
def test_what_is_not_exactly_the_format_is_refused(content, message):
    with pytest.raises(ValueError, match=message) as caught:
        tensors.decode(content)
    assert type(caught.value) in (ValueError, json.JSONDecodeError, UnicodeDecodeError)
    assert "\n" not in str(caught.value)


@given(st.data())
def test_what_we_accept_the_library_accepts_alike(data):
    content = bytearray(tensors.encode({"a": np.ones((2, 2), np.float32), "b": np.zeros(3, np.float32)}))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        ours = tensors.decode(bytes(content))
    except ValueError:
        return
    assert equal(ours, safetensors.numpy.load(bytes(content)))
