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
_KINDS = "biuf"  # booleans, integers and floats; no objects, which would need pickle


def encode(value: Any) -> bytes:
    """A message of nested mappings, lists, texts, numbers and arrays."""
    packed = msgpack.packb(value, default=_marked)
    assert packed is not None  # it is None only for a buffering packer
    return packed


def decode(data: bytes) -> Any:
    """The contents of a message; its arrays are writable copies.

    Raises:
        AegisError: the bytes are no such message.
    """
    try:
        return msgpack.unpackb(data, object_hook=_unmarked)
    except (
        ValueError,
        TypeError,
        KeyError,
        OverflowError,
        SyntaxError,  # from a dtype's name, which NumPy may parse as Python
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
        # The buffer is the message's own read-only memory.
        array, shape = np.frombuffer(value[_DATA], _type(value[_DTYPE])), value[_SHAPE]
        if any(side < 0 for side in shape):  # NumPy would infer this dimension
            raise ValueError(f"an array of shape {shape}")
        return array.reshape(shape).copy()
    if _NUMBER in value:
        return _type(value[_DTYPE]).type(value[_DATA])
    return value


def _type(name: str) -> np.dtype:
    """The dtype of an array.

    Raises:
        ValueError, TypeError: the dtype is invalid, or not numeric.
    """
    found = np.dtype(name)
    if found.kind not in _KINDS:
        raise ValueError(f"an array of type {name}")
    return found
