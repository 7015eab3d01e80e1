"""Messages in both directions are openpi's, and arrays survive them unchanged."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest

from aegis_cli.common.errors import AegisError
from aegis_cli.serving import wire

ARRAYS = [
    np.arange(6, dtype=np.float32).reshape(2, 3),
    np.arange(6, dtype=np.int64).reshape(2, 3).T,  # its numbers are not contiguous
    np.zeros((0, 4), np.uint8),
    np.array(3.5),
    np.array([True, False]),
    np.array([1, 2], ">i2"),
]


@pytest.mark.parametrize("name", ["f4,(", "no type", "O", ""])
def test_a_type_that_is_none_is_one_error(name: str) -> None:
    marked = {b"__ndarray__": True, b"data": b"", b"dtype": name, b"shape": [0]}
    with pytest.raises(AegisError, match="that cannot be read"):
        wire.decode(msgpack.packb(marked))


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype}{array.shape}")
def test_arrays_survive(array: np.ndarray) -> None:
    found = wire.decode(wire.encode({"a": [array]}))["a"][0]
    np.testing.assert_array_equal(found, array)
    assert (found.dtype, found.shape) == (array.dtype, array.shape) and found.flags.writeable


def test_everything_else_survives() -> None:
    plain = {"text": "grüße", "none": None, "list": [1, 2.5, True], "in": {"bytes": b"\0\xff"}}
    assert wire.decode(wire.encode(plain)) == plain
    number = wire.decode(wire.encode(np.float32(0.1)))
    assert number == np.float32(0.1) and number.dtype == np.float32


@pytest.mark.parametrize("value", [object(), np.array([None]), np.array([1j]), {1, 2}])
def test_what_has_no_form_is_not_sent(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be sent"):
        wire.encode(value)


def test_an_array_is_the_mapping_that_openpi_defines() -> None:
    raw = msgpack.unpackb(wire.encode(np.array([[1.0]], np.float32)))
    one = b"\x00\x00\x80\x3f"
    marked = {b"__ndarray__": True, b"data": one, b"dtype": "<f4", b"shape": [1, 1]}
    assert raw == marked


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype}{array.shape}")
def test_openpis_own_packing_is_read_and_reads_ours(array: np.ndarray) -> None:
    openpi = pytest.importorskip("openpi_client.msgpack_numpy")
    message = {"x": array, "n": np.float64(2.5), "prompt": "go"}
    here, there = wire.decode(openpi.packb(message)), openpi.unpackb(wire.encode(message))
    for found in (here, there):
        np.testing.assert_array_equal(found["x"], array)
        assert found["x"].dtype == array.dtype and (found["n"], found["prompt"]) == (2.5, "go")
