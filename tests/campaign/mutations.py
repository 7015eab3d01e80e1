"""Random damage to a file: equal seeds do equal damage."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import safetensors.torch
import torch

# Values in place of the expected ones.
_NASTY: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    2**31,
    2**63,
    -(2**63) - 1,
    10**400,
    0.5,
    1e300,
    -0.0,
    float("nan"),
    float("inf"),
    "",
    " ",
    "nan",
    "\x1b[31m\x1b]0;title\x07",
    "a\nb\tc\x00d",
    "\ud800",
    "x" * 5000,
    "../../outside",
    "/dev/null",
    "{chunk_index:100000000d}",
    "%s%n{0.__class__}",
    [],
    {},
    [[]],
    {"": None},
    [1, "a", None],
)
# Pieces of text with a meaning in YAML or JSON.
_TOKENS = (
    '!!int ""',
    "!!bool maybe",
    "!!python/object/apply:os.system [id]",
    "&a [*a, *a]",
    "*nothing",
    "<<: *x",
    "? {a: b}",
    "---",
    "...",
    "\t",
    "\x00",
    "\ufeff",
    "\r",
    "{" * 3000,
    "[" * 3000,
    "- " * 500,
    "'",
    '"',
    "0x1F",
    "1e999",
    "2026-11-23",
    ": : :",
    "%TAG ! x",
)
_DTYPES = ("F64", "F32", "F16", "BF16", "I64", "I32", "U8", "BOOL", "F8_E4M3", "X9")


@dataclass(frozen=True)
class Damage:
    """The damage that was done to a file.

    Attributes:
        sealed: whether a digest of the undamaged content is still in the file, if there was one.
    """

    name: str
    sealed: bool = True


Change = Callable[[Random, bytes], bytes]


def damage(rng: Random, path: Path) -> Damage:
    """Damage a file in a way that suits its format."""
    if rng.random() < 0.06:
        name = rng.choice(sorted(_KINDS))
        _KINDS[name](path)
        return Damage(name)
    data = path.read_bytes()
    name, change = _draw(rng, path.suffix, data)
    changed = change(rng, data)
    path.unlink()  # it may be linked to from elsewhere
    path.write_bytes(changed)
    return Damage(name, sealed=not name.endswith("no digest"))


def _draw(rng: Random, suffix: str, data: bytes) -> tuple[str, Change]:
    """A change that fits the format; plain bytes fit all."""
    fitting: dict[str, Change] = dict(_BYTES)
    if suffix == ".safetensors":
        fitting |= _SAFETENSORS
    elif suffix in (".json", ".jsonl"):
        fitting |= _TEXT | _JSON
    elif suffix in (".yaml", ".yml"):
        fitting |= _TEXT
    names = sorted(fitting)
    # Changes that know the format are as likely as others.
    own = [name for name in names if name not in _BYTES]
    name = rng.choice(own if own and rng.random() < 0.6 else names)
    return name, fitting[name]


# --- bytes ----------------------------------------------------------------------------------------


def _place(rng: Random, data: bytes) -> int:
    """A position, half the time in the first thousand bytes, where headers are."""
    end = min(1000, len(data)) if rng.random() < 0.5 else len(data)
    return rng.randrange(end) if end else 0


def _span(rng: Random, data: bytes) -> slice:
    start = _place(rng, data)
    return slice(start, start + rng.choice((1, 2, 8, 64, 1000)))


def _flip(rng: Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        if changed:
            changed[_place(rng, data)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(rng: Random, data: bytes) -> bytes:
    where = _span(rng, data)
    return data[: where.start] + rng.randbytes(where.stop - where.start) + data[where.stop :]


def _zero(rng: Random, data: bytes) -> bytes:
    where = _span(rng, data)
    return data[: where.start] + bytes(len(data[where])) + data[where.stop :]


def _delete(rng: Random, data: bytes) -> bytes:
    where = _span(rng, data)
    return data[: where.start] + data[where.stop :]


def _repeat(rng: Random, data: bytes) -> bytes:
    where = _span(rng, data)
    return data[: where.stop] + data[where.start :]


def _swap(rng: Random, data: bytes) -> bytes:
    first, second = sorted((_place(rng, data), _place(rng, data)))
    size = min(16, second - first)
    a, b = data[first : first + size], data[second : second + size]
    return data[:first] + b + data[first + size : second] + a + data[second + size :]


def _truncate(rng: Random, data: bytes) -> bytes:
    return data[: _place(rng, data)]


def _extend(rng: Random, data: bytes) -> bytes:
    return data + rng.choice((b"\0", b"\n", b" ", rng.randbytes(9), data[:100]))


def _empty(rng: Random, data: bytes) -> bytes:
    return b""


_BYTES: dict[str, Change] = {
    "flipped bits": _flip,
    "overwritten": _overwrite,
    "zeroed": _zero,
    "bytes deleted": _delete,
    "bytes repeated": _repeat,
    "bytes swapped": _swap,
    "truncated": _truncate,
    "extended": _extend,
    "emptied": _empty,
}


# --- text and JSON --------------------------------------------------------------------------------


def _line(rng: Random, data: bytes) -> bytes:
    """One line left out, doubled, or exchanged with another."""
    lines = data.splitlines(keepends=True) or [b""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(3)
    if what == 0:
        del lines[at]
    elif what == 1:
        lines.insert(at, lines[at])
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"".join(lines)


def _token(rng: Random, data: bytes) -> bytes:
    """A meaningful piece of text, in the middle of a line or as a key's value."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    token = rng.choice(_TOKENS).encode()
    key, colon, _ = lines[at].partition(b":")
    middle = rng.randrange(len(lines[at]) + 1)
    inserted = lines[at][:middle] + token + lines[at][middle:]
    lines[at] = key + b": " + token if colon and rng.random() < 0.6 else inserted
    return b"\n".join(lines)


def _value(rng: Random, data: bytes) -> bytes:
    """Another value somewhere in a line of YAML."""
    lines = data.split(b"\n")
    keyed = [number for number, line in enumerate(lines) if b":" in line]
    if not keyed:
        return _token(rng, data)
    at = rng.choice(keyed)
    key = lines[at].partition(b":")[0]
    lines[at] = key + b": " + json.dumps(rng.choice(_NASTY)).encode()
    return b"\n".join(lines)


_TEXT: dict[str, Change] = {"lines": _line, "token": _token, "value": _value}


def damaged_json(rng: Random, data: bytes) -> bytes:
    """A damaged document, or a file of JSON lines with one of them damaged."""
    try:
        return json.dumps(_damaged(rng, json.loads(data))).encode()
    except ValueError:
        pass
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    try:
        lines[at] = json.dumps(_damaged(rng, json.loads(lines[at]))).encode()
    except ValueError:
        return _token(rng, data)
    return b"\n".join(lines)


def _nested(rng: Random, data: bytes) -> bytes:
    """Brackets nested too deeply for any recursion, in place of a value."""
    depth = rng.choice((500, 5000, 200_000))
    deep = b"[" * depth + b"]" * depth
    before, colon, after = data.partition(b":")
    return before + colon + deep + b"," + after if colon else deep


_JSON: dict[str, Change] = {"JSON value": damaged_json, "JSON of great depth": _nested}


def _damaged(rng: Random, document: Any) -> Any:
    """The document with one of its values replaced, left out, renamed or moved."""
    holders = list(_holders(document))
    if not holders or rng.random() < 0.03:
        return rng.choice(_NASTY)
    holder, key = rng.choice(holders)
    what = rng.randrange(5)
    other, its = rng.choice(holders)
    if what == 0:
        del holder[key]
    elif what == 1 and isinstance(holder, dict):
        holder[str(rng.choice(_NASTY))[:50]] = holder.pop(key)
    elif what == 2:
        holder[key] = copy.deepcopy(other[its])  # which may contain it
    elif isinstance(holder[key], int | float) and what == 3:
        holder[key] = rng.choice((-holder[key], holder[key] + 1, str(holder[key]), [holder[key]]))
    else:
        holder[key] = rng.choice(_NASTY)
    return document


def _holders(document: Any) -> Iterator[tuple[Any, Any]]:
    """Every place of a value: its container, and its key or index there."""
    if isinstance(document, dict):
        places: Sequence[Any] = list(document)
    elif isinstance(document, list):
        places = range(len(document))
    else:
        return
    for place in places:
        yield document, place
        yield from _holders(document[place])


# --- safetensors ----------------------------------------------------------------------------------


def _parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The table of a safetensors file, and what follows it."""
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def _joined(table: Any, rest: bytes) -> bytes:
    raw = json.dumps(table).encode()
    raw += b" " * (-len(raw) % 8)
    return len(raw).to_bytes(8, "little") + raw + rest


def _header(rng: Random, data: bytes) -> bytes:
    """Another value in Aegis' own part of the header."""
    table, rest = _parts(data)
    aegis = table.get("__metadata__", {}).get("aegis")
    if aegis is None:
        return _flip(rng, data)
    table["__metadata__"]["aegis"] = json.dumps(_damaged(rng, json.loads(aegis)))
    return _joined(table, rest)


def _old_header(rng: Random, data: bytes) -> bytes:
    """The same in a file that looks as if it were from before digests."""
    table, rest = _parts(data)
    aegis = json.loads(table["__metadata__"]["aegis"])
    aegis.pop("digest", None)
    table["__metadata__"]["aegis"] = json.dumps(_damaged(rng, aegis))
    return _joined(table, rest)


def _header_text(rng: Random, data: bytes) -> bytes:
    """Text in place of the header, or one nested too deeply for recursion."""
    table, rest = _parts(data)
    deep = "[" * rng.choice((900, 100_000))
    nasty = ("", "null", "[]", "{", deep, '{"kind":"demos"}', "\x1b[2J")
    table["__metadata__"] = rng.choice(({"aegis": rng.choice(nasty)}, {}, {"other": "x"}))
    return _joined(table, rest)


def _table(rng: Random, data: bytes) -> bytes:
    """Another shape, dtype or offset of a tensor."""
    table, rest = _parts(data)
    names = sorted(name for name in table if name != "__metadata__")
    said = table[rng.choice(names)]
    what = rng.randrange(4)
    if what == 0:
        said["dtype"] = rng.choice(_DTYPES)
    elif what == 1:
        said["shape"] = rng.choice(
            ([], [1], [0], [2**40], [*said["shape"], 1], said["shape"][::-1])
        )
    elif what == 2:
        said["data_offsets"] = rng.choice(([0, 0], [0, 2**50], [8, 0], said["data_offsets"][::-1]))
    else:
        table[rng.choice(("other", names[0] + "x", ""))] = said
    # The same table written differently would be the same file, with another digest.
    return _flip(rng, data) if table == _parts(data)[0] else _joined(table, rest)


def _length(rng: Random, data: bytes) -> bytes:
    """Another length of the table."""
    sizes = (0, 1, 8, 2**31, 2**63, int.from_bytes(data[:8], "little") + rng.choice((-8, -1, 1, 8)))
    return (rng.choice(sizes) % 2**64).to_bytes(8, "little") + data[8:]


def _forged(rng: Random, data: bytes) -> bytes:
    """Another tensor in a file that looks as if it were from before digests."""
    tensors = safetensors.torch.load(data)
    table, _ = _parts(data)
    aegis = json.loads(table["__metadata__"]["aegis"])
    aegis.pop("digest", None)
    name = rng.choice(sorted(tensors))
    tensors[name] = _other_tensor(rng, tensors[name])
    if rng.random() < 0.5:  # the header is adapted
        dtype = str(tensors[name].dtype).removeprefix("torch.")
        aegis["tensors"][name] |= {"shape": list(tensors[name].shape), "dtype": dtype}
    if rng.random() < 0.1:
        tensors.pop(name)
        aegis["tensors"].pop(name)
    return safetensors.torch.save(tensors, {"aegis": json.dumps(aegis)})


def _other_tensor(rng: Random, tensor: torch.Tensor) -> torch.Tensor:
    what = rng.randrange(6)
    if what == 0:
        return torch.zeros(rng.choice(((), (1,), (0,), (3, 1), (*tensor.shape, 2))))
    if what == 1:
        return tensor.to(rng.choice((torch.float64, torch.float16, torch.int64, torch.uint8)))
    if what == 2:
        return tensor.reshape(-1)[: tensor.numel() // 2].clone()
    if not tensor.numel():
        return torch.ones(1)
    changed = tensor.clone().reshape(-1)
    at = rng.randrange(len(changed))
    if tensor.is_floating_point():
        changed[at] = rng.choice((float("nan"), float("inf"), -1e30, 1e30, 0.0))
    elif tensor.dtype != torch.bool:
        changed[at] = rng.choice((0, 1, 127))
    return changed.reshape(tensor.shape)


_SAFETENSORS: dict[str, Change] = {
    "header value": _header,
    "header value, no digest": _old_header,
    "header text": _header_text,
    "table": _table,
    "length": _length,
    "other tensors, no digest": _forged,
}


# --- something else in its place ------------------------------------------------------------------


def _missing(path: Path) -> None:
    path.unlink()


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _link(target: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        path.unlink()
        path.symlink_to(target.format(name=path.name))

    return change


def _text_in_place(path: Path) -> None:
    shutil.copyfile(__file__, path)


_KINDS: dict[str, Callable[[Path], None]] = {
    "missing": _missing,
    "a folder": _folder,
    "a pipe": _pipe,
    "a link to nothing": _link("nothing"),
    "a link to itself": _link("{name}"),
    "an endless device": _link("/dev/zero"),
    "an empty device": _link("/dev/null"),
    "another program's text": _text_in_place,
}
