"""`aegis insert`: put a VLM back into another program's policy, from which it was extracted."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.common.files import folder_aside, make_folder, put
from aegis_cli.publishing import foreign_policy, policy_copy, tensor_files
from aegis_cli.publishing.extract import (
    Share,
    check_new,
    checked_cast,
    count,
    lacking,
    shared,
    told,
)
from aegis_cli.publishing.foreign_policy import Pair
from aegis_cli.publishing.policy_copy import Contents
from aegis_cli.publishing.tensor_files import TYPES
from aegis_cli.publishing.vlm_names import Asked
from aegis_cli.training import checkpoint


@dataclass(frozen=True)
class InsertReport:
    """What was put into the policy.

    Attributes:
        prefix: the prefix of the VLM's names in the policy.
        tensors, parameters: the policy's, of which `put` now come from the VLM.
        changed: how many of those that were put in differ from what the policy had.
        rounded: how many of those that were put in lost precision.
        left_out: what the VLM has and the policy does not, and the policy's head if it stays.
    """

    out: str
    vlm: str
    policy: str
    prefix: str
    tensors: int
    parameters: int
    put: int
    put_parameters: int
    changed: int
    rounded: int
    left_out: tuple[Share, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    vlm: str, policy: str, out: Path, on_event: OnEvent = ignore, prefix: str | None = None
) -> InsertReport:
    """Write a copy of a policy's folder, with the tensors of a VLM in place of its own VLM's.

    They are written with the policy's dtypes and names. Unless extraction lost precision, inserting
    an unchanged VLM from `aegis extract` gives the same files again.

    Args:
        vlm: a Hugging Face model, such as an extracted one after `aegis merge`.
        policy: a folder or a hub id.
        out: a new folder; if this fails, nothing of it is left.
        prefix: as for `extract.run`; the policy's other VLMs stay as they are.

    Raises:
        AegisError: as `aegis extract` does, or a policy that is a file, or whose folder cannot be
            copied.
    """
    check_new(out)
    again = ("insert", vlm, "--into", policy, "--out", str(out))
    with foreign_policy.opened(Asked(policy, vlm, prefix, again)) as pair:
        if not pair.policy_at.is_dir():
            raise AegisError(
                f"'{policy}', a file",
                "the policy's folder, which is copied with its configuration",
                f"give '{pair.policy_at.parent}'",
            )
        if out.resolve().is_relative_to(pair.policy_at.resolve()):
            raise AegisError(
                f"--out {out}, inside of the policy that is copied",
                "a folder elsewhere",
                "choose another --out",
            )
        rows = _Rows(pair, vlm)
        beside = policy_copy.contents(pair.policy_at, {part.path for part in pair.policy.parts})
        make_folder(out.parent)
        with checkpoint.writing(out), folder_aside(out) as aside:
            policy_copy.copy(beside, pair.policy_at, aside)
            counted = told(rows.rows, "insert", len(pair.policy.specs), on_event)
            for part in pair.policy.parts:
                place = aside / part.path.relative_to(pair.policy_at)
                make_folder(place.parent)
                tensor_files.write(place, part, counted)
            put(aside, out)
        _warn(pair, rows, beside, on_event)
        return _report(pair, rows, (str(out), vlm, policy))


class _Rows:
    """Rows of the policy's tensors, from the VLM if they belong to it, and counts of changes."""

    def __init__(self, pair: Pair, called: str) -> None:
        self._pair, self._called = pair, called
        self.source = _sources(pair)
        self.changed: set[str] = set()
        self.rounded: set[str] = set()

    def rows(self, name: str, first: int, last: int) -> Tensor:
        """Rows to write for a tensor, by the policy's name."""
        pair = self._pair
        before = pair.policy.rows(name, first, last)
        source = self.source.get(name)
        until = last if source is None else min(last, pair.match.rows.get(source, last))
        if source is None or until <= first:
            return before
        own = pair.vlm.rows(source, first, until)
        dtype = TYPES.get(pair.policy.specs[name].dtype)
        same = before[: until - first] if before.ndim else before
        written = own
        if dtype is not None:
            fix = "store the policy in bfloat16 or float32, and insert into that"
            written = checked_cast(own, dtype, same, (source, self._called), fix)
        if not torch.equal(written, same):
            self.changed.add(name)
        if not torch.equal(written.to(own.dtype), own):
            self.rounded.add(name)
        return written if until == last else torch.cat([written, before[until - first :]])


def _sources(pair: Pair) -> dict[str, str]:
    """The policy's name of each tensor that the VLM has -> the VLM's name."""
    # If table and head are one tensor in the policy, they are equal in the VLM.
    found = {other: name for name, other in pair.match.taken.items()}
    if pair.match.second is not None:
        second, first = pair.match.second
        # A separately trained head stays, since the VLM has none.
        if tensor_files.equal(pair.policy, second, first):
            found[second] = found[first]
    return found


def _own_head(pair: Pair, rows: _Rows) -> tuple[str, str] | None:
    """The policy's names of a head that the VLM lacks and of the table, if the two differ."""
    second = pair.match.second
    return None if second is None or second[0] in rows.source else second


def _warn(pair: Pair, rows: _Rows, beside: Contents, on_event: OnEvent) -> None:
    """Warn of what is in the new folder, or missing there, and may surprise."""
    if (own := _own_head(pair, rows)) is not None:
        text = (
            f"'{own[0]}' stays as it was, since it differs from '{own[1]}', and the VLM has one "
            "tensor for both: what the policy computes with it does not follow the VLM"
        )
        on_event(Warned("insert", text))
    if (pair.vlm_at.parent / checkpoint.EXPERT).is_file():
        text = (
            "the VLM was trained together with another action expert, which is not put in: the "
            "policy's own expert has not learned with it. Roll the new policy out before you use it"
        )
        on_event(Warned("insert", text))
    if others := pair.match.others:
        text = (
            f"the policy has another VLM of the same names, which stays as it was: under "
            f"{few(list(map(repr, others)))}"
        )
        on_event(Warned("insert", text))
    named = {*rows.source, *rows.source.values()}
    if others := policy_copy.other_weights(beside, pair.policy_at, named):
        text = (
            "files that have tensors of the VLM's names, too, were copied unchanged: "
            f"{few(list(map(str, others)))}"
        )
        on_event(Warned("insert", text))
    if beside.stale:
        text = (
            "the state of the optimiser was not copied, since it belongs to the old weights: "
            f"{few(list(map(str, beside.stale)))}"
        )
        on_event(Warned("insert", text))


def _report(pair: Pair, rows: _Rows, named: tuple[str, str, str]) -> InsertReport:
    found, own = pair.match, pair.policy.specs
    out, vlm, policy = named
    put_rows = {name: found.rows.get(source) for name, source in rows.source.items()}
    left_out = lacking(pair, "the policy does not have it")
    if (head := _own_head(pair, rows)) is not None:
        why = f"it stays as it was, since it differs from {head[1]}, to which the VLM ties it"
        left_out.append(Share(head[0], why, 1, count(own[head[0]])))
    return InsertReport(
        out,
        vlm,
        policy,
        found.prefix,
        len(own),
        sum(map(count, own.values())),
        len(rows.source),
        sum(shared(own[name], taken) for name, taken in put_rows.items()),
        len(rows.changed),
        len(rows.rounded),
        tuple(left_out),
    )
