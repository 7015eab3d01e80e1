"""The messages of openpi's policy servers: msgpack, with NumPy arrays as marked mappings.

An array is `{b"__ndarray__": true, b"data": bytes, b"dtype": "<f4", b"shape": [...]}`, a NumPy
number `{b"__npgeneric__": true, b"data": number, b"dtype": "<f4"}`. The format is that of
`openpi_client.msgpack_numpy` (https://github.com/Physical-Intelligence/openpi).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np

from aegis_cli.common.errors import AegisError

_ARRAY, _NUMBER = b"__ndarray__", b"__npgeneric__"
_DATA, _DTYPE, _SHAPE = b"data", b"dtype", b"shape"
_KINDS = "biuf"  # truth values, integers and floats; no objects, which would have to be programs


def encode(value: Any) -> bytes:
    """A message of nested mappings, lists, texts, numbers and arrays."""
    packed = msgpack.packb(value, default=_marked)
    assert packed is not None  # as it would be of a packer that gathers messages
    return packed


def decode(data: bytes) -> Any:
    """What a message holds; its arrays are copies that may be written to.

    Raises:
        AegisError: bytes that are no such message.
    """
    try:
        return msgpack.unpackb(data, object_hook=_unmarked)
    except (
        ValueError,
        TypeError,
        KeyError,
        OverflowError,
        SyntaxError,  # of a type's name, which NumPy reads as a piece of a program
        msgpack.UnpackException,
    ) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise AegisError(
            f"a message of {len(data)} bytes that cannot be read: {what}",
            "one observation in msgpack, arrays as openpi-client packs them",
            "send it with openpi_client.websocket_client_policy",
        ) from error


def _marked(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        shape = list(value.shape)
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: shape}
    if isinstance(value, np.generic) and value.dtype.kind in _KINDS:
        return {_NUMBER: True, _DATA: value.item(), _DTYPE: value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _unmarked(value: Mapping[Any, Any]) -> Any:
    if _ARRAY in value:
        # The buffer is the message's own memory, which may not be written to.
        array, shape = np.frombuffer(value[_DATA], _type(value[_DTYPE])), value[_SHAPE]
        if any(side < 0 for side in shape):  # which NumPy would take for "as many as there are"
            raise ValueError(f"an array of shape {shape}")
        return array.reshape(shape).copy()
    if _NUMBER in value:
        return _type(value[_DTYPE]).type(value[_DATA])
    return value


def _type(name: str) -> np.dtype:
    """The type of an array's numbers.

    Raises:
        ValueError, TypeError: a type that is none, or not of numbers.
    """
    found = np.dtype(name)
    if found.kind not in _KINDS:
        raise ValueError(f"an array of type {name}")
    return found
