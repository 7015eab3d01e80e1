"""`aegis extract`: write the VLM of another program's policy as a plain Hugging Face model.

Configuration, tokenizer and processor come from the model that the policy was made from, and so do
tensors that the policy lacks.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.files import (
    check_utf8,
    folder_aside,
    load_json,
    make_folder,
    put,
    save_json,
    write_text,
)
from aegis_cli.models.backbones import model_folder
from aegis_cli.publishing import foreign_policy, tensor_files
from aegis_cli.publishing.foreign_policy import Pair
from aegis_cli.publishing.tensor_files import NAMES, TYPES
from aegis_cli.publishing.vlm_names import Asked, Spec
from aegis_cli.training import checkpoint
from aegis_cli.training.card import without_folders

SOURCE = "source"  # the dtype in which each tensor of the base is stored
_COPIED = ("config.json", "generation_config.json", "aegis.json")
_TYPE_KEYS = ("dtype", "torch_dtype")  # in transformers 5, and in earlier releases
_CARD = """# The VLM of `{policy}`

`aegis extract` has taken it out of the robot policy: {taken} of its {tensors} tensors are the
policy's, of which {moved} differ from those of `{base}`. All others, the configuration and the
processor are that model's.
"""


@dataclass(frozen=True)
class Share:
    """A group of tensors that the report describes together."""

    what: str
    why: str
    tensors: int
    parameters: int


@dataclass(frozen=True)
class ExtractReport:
    """What was extracted, and what was not.

    Attributes:
        type: LeRobot's name of the policy's type; None for another program's policy.
        prefix: the prefix of the VLM's names in the policy.
        dtype: the dtypes in which the weights are stored.
        tensors, parameters: the VLM's, of which `taken` come from the policy.
        moved: how many of those that were taken differ from the base's by more than rounding to the
            dtype in which the policy stores them.
        rounded: how many of those that were taken lost precision.
        kept: the tensors that come from the base.
        more: the policy's names under the prefix that the base does not have.
    """

    out: str
    policy: str
    type: str | None
    base: str
    prefix: str
    dtype: str
    tensors: int
    parameters: int
    taken: int
    taken_parameters: int
    moved: int
    moved_parameters: int
    rounded: int
    kept: tuple[Share, ...]
    more: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    policy: str,
    base: str,
    out: Path,
    dtype: str = SOURCE,
    on_event: OnEvent = ignore,
    prefix: str | None = None,
) -> ExtractReport:
    """Write the VLM of a policy as a folder that can be used wherever a backbone can.

    Args:
        policy: a folder, a file or a hub id of safetensors.
        base: the VLM that the policy was made from.
        out: a new folder; if this fails, nothing of it is left.
        dtype: dtype of the weights, SOURCE or one of `STORED_TYPES`.
        prefix: which VLM to take of a policy that has several, by the beginning of its names.

    Raises:
        AegisError: a policy of Aegis, or no policy; a base that is not a VLM, or not the policy's;
            a policy with several VLMs and no prefix; or a folder that already exists.
    """
    check_new(out)
    again = ("extract", policy, "--base", base, "--out", str(out))
    again += () if dtype == SOURCE else ("--dtype", dtype)
    with foreign_policy.opened(Asked(policy, base, prefix, again)) as pair:
        types = _types(pair, dtype)
        counted = _Counted(pair, types, (policy, base))
        make_folder(out.parent)
        with checkpoint.writing(out), folder_aside(out) as aside:
            _write_weights(aside, pair, types, counted, on_event)
            _copy_records(aside, pair, None if dtype == SOURCE else dtype)
            report = _report(pair, counted, types, (str(out), policy, base))
            write_text(aside / "README.md", _card(report))
            put(aside, out)
    _warn(report, pair, on_event)
    return report


def check_new(out: Path) -> None:
    """Raise AegisError if a path already exists."""
    if os.path.lexists(out):  # also a broken link
        raise AegisError(f"'{out}' is there already", "a new folder", "choose another --out")
    check_utf8(out, "choose another --out")


class _Counted:
    """Rows of the VLM's tensors, from the policy if it has them, and counts of what changed."""

    def __init__(self, pair: Pair, types: Mapping[str, str], called: tuple[str, str]) -> None:
        self._pair, self._types, self._called = pair, types, called
        self.moved: set[str] = set()
        self.rounded: set[str] = set()

    def rows(self, name: str, first: int, last: int) -> Tensor:
        """Rows to write for a tensor, by the base's name."""
        pair, dtype = self._pair, TYPES.get(self._types[name])
        before = pair.vlm.rows(name, first, last)
        if name not in pair.match.taken:
            return before if dtype is None else before.to(dtype)
        until = min(last, pair.match.rows.get(name, last))
        if until <= first:
            return before if dtype is None else before.to(dtype)
        own = pair.policy.rows(pair.match.taken[name], first, until)
        same = before[: until - first] if before.ndim else before
        if not torch.equal(own, same.to(own.dtype)):
            self.moved.add(name)
        written = own
        if dtype is not None:
            named = pair.match.taken[name], self._called[0]
            written = checked_cast(own, dtype, same, named, "extract with --dtype float32")
        if not torch.equal(written.to(own.dtype), own):
            self.rounded.add(name)
        if until < last:
            return torch.cat([written, before[until - first :].to(written.dtype)])
        return written


def checked_cast(
    own: Tensor, dtype: torch.dtype, other: Tensor, named: tuple[str, str], fix: str
) -> Tensor:
    """A tensor in another dtype.

    Args:
        other: the same tensor of the other model, which may have infinite values too, as masks do.
        named: the tensor's name, and that of its model.
        fix: what to do about numbers that the dtype is too small for.

    Raises:
        AegisError: numbers that are not finite, before or after the conversion.
    """
    written = own.to(dtype)
    if written.isfinite().all():
        return written
    name, called = named
    if own.isfinite().all():
        said = str(dtype).removeprefix("torch.")
        raise AegisError(
            f"'{name}' of '{called}' has numbers that {said} is too small for",
            "a type that holds them",
            fix,
        )
    if torch.equal(own, other.to(own.dtype)):
        return written
    raise AegisError(
        f"'{name}' of '{called}' has NaN or infinite values",
        "finite numbers",
        "take a checkpoint of before its training diverged",
    )


def _types(pair: Pair, dtype: str) -> dict[str, str]:
    """safetensors' name of the dtype in which each tensor is written."""
    wanted = NAMES.get(dtype)
    return {
        name: wanted if wanted is not None and spec.is_float else spec.dtype
        for name, spec in pair.vlm.specs.items()
    }


def _write_weights(
    folder: Path,
    pair: Pair,
    types: Mapping[str, str],
    counted: _Counted,
    on_event: OnEvent,
) -> None:
    """Write files with the base's file names, and their index, if there is one."""
    rows = told(counted.rows, "extract", len(pair.vlm.specs), on_event)
    size = 0
    for part in pair.vlm.parts:
        new = tensor_files.retyped(part, types)
        size += sum(tensor_files.nbytes(spec) for spec in new.specs.values())
        place = folder / part.path.relative_to(pair.vlm_at)
        make_folder(place.parent)
        tensor_files.write(place, new, rows)
    names = {part.path.relative_to(pair.vlm_at).as_posix() for part in pair.vlm.parts}
    for index in sorted(pair.vlm_at.glob("*.safetensors.index.json")):
        said = load_json(index)
        if isinstance(said, dict) and set((said.get("weight_map") or {}).values()) == names:
            metadata = {**(said.get("metadata") or {}), "total_size": size}
            save_json(folder / index.name, {**said, "metadata": metadata})


def told(
    rows: Callable[[str, int, int], Tensor], stage: str, total: int, on_event: OnEvent
) -> Callable[[str, int, int], Tensor]:
    """The same rows, with a progress event at the first rows of each tensor."""
    done = 0
    on_event(Progress(stage, 0, total, "tensors"))

    def counting(name: str, first: int, last: int) -> Tensor:
        nonlocal done
        found = rows(name, first, last)
        if first == 0:
            done += 1
            on_event(Progress(stage, done, total, "tensors"))
        return found

    return counting


def _copy_records(folder: Path, pair: Pair, dtype: str | None) -> None:
    """Copy the base's other files; the copied configuration names the dtype of the weights."""
    for name, content in model_folder.processor_files(pair.vlm_at).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    for name in _COPIED:
        if (pair.vlm_at / name).is_file():
            shutil.copyfile(pair.vlm_at / name, folder / name)
    if dtype is not None:
        config = load_json(folder / "config.json")
        for part in (config, *(each for each in config.values() if isinstance(each, dict))):
            part |= {key: dtype for key in _TYPE_KEYS if isinstance(part.get(key), str)}
        save_json(folder / "config.json", config)
    if pair.layers is not None:
        model_folder.remember_layers(folder, pair.layers)


def _report(
    pair: Pair, counted: _Counted, types: Mapping[str, str], named: tuple[str, str, str]
) -> ExtractReport:
    found, specs = pair.match, pair.vlm.specs
    out, policy, base = named
    stored = {types[name] for name, spec in specs.items() if spec.is_float}
    long = {short: long for long, short in NAMES.items()}
    taken = {name: shared(specs[name], found.rows.get(name)) for name in found.taken}
    return ExtractReport(
        out,
        policy,
        model_folder.foreign_policy(pair.policy_at),
        base,
        found.prefix,
        ", ".join(sorted(long[each] for each in stored)),
        len(specs),
        sum(map(count, specs.values())),
        len(found.taken),
        sum(taken.values()),
        len(counted.moved),
        sum(taken[name] for name in counted.moved),
        len(counted.rounded),
        tuple(lacking(pair)),
        _more(pair),
    )


def lacking(pair: Pair, why: str | None = None) -> list[Share]:
    """The VLM's tensors, and rows of its tables, that the policy does not have.

    Args:
        why: the reason to give for whole tensors; None: what that means for their training.
    """
    found, specs = pair.match, pair.vlm.specs
    shares = []
    for each in found.kept:
        parameters = sum(count(specs[name]) for name in each.names)
        shares.append(Share(each.what, why or each.why, len(each.names), parameters))
    for name, rows in found.rows.items():
        left = specs[name].shape[0] - rows
        if left > 0:
            parameters = count(specs[name]) - shared(specs[name], rows)
            what = f"the last {left:,} rows of {name}"
            shares.append(Share(what, "the policy's vocabulary ends before them", 0, parameters))
    return shares


def _more(pair: Pair) -> tuple[str, ...]:
    """Names of tensors and rows of the policy's VLM that the base does not have."""
    found, own = pair.match, pair.policy
    more = list(found.more)
    for name, rows in found.rows.items():
        other = found.taken[name]
        if rows < own.specs[other].shape[0]:
            more.append(f"{other} (rows {rows:,} to {own.specs[other].shape[0] - 1:,})")
    # The base has one tensor for both; if the policy's two are equal, nothing is missing.
    if found.second is not None and not tensor_files.equal(own, *found.second):
        more.append(f"{found.second[0]} (which the base ties to {found.second[1]})")
    return tuple(more)


def count(spec: Spec) -> int:
    """How many numbers a tensor has."""
    return math.prod(spec.shape)


def shared(spec: Spec, rows: int | None) -> int:
    """How many numbers of a tensor are in its first rows."""
    return count(spec) if rows is None else rows * count(spec) // max(1, spec.shape[0])


def _card(report: ExtractReport) -> str:
    places = {"policy": without_folders(report.policy), "base": without_folders(report.base)}
    return _CARD.format(**{**asdict(report), **places})


def _warn(report: ExtractReport, pair: Pair, on_event: OnEvent) -> None:
    """Warn of what a probe would not show."""
    if report.rounded:
        on_event(
            Warned(
                "extract",
                f"{report.rounded} of the policy's tensors have lost digits, since the base is "
                f"stored in {report.dtype}; --dtype float32 keeps them",
            )
        )
    if report.moved == 0 and report.more:
        on_event(
            Warned(
                "extract",
                "none of the policy's tensors differs from the base's, but others are left out, "
                f"which the base does not have: {few(report.more)}; whatever they learned is not "
                "in the extracted VLM",
            )
        )
    elif report.moved == 0:
        on_event(
            Warned(
                "extract",
                "none of the policy's tensors differs from the base's: its VLM was frozen, and has "
                "nothing to forget",
            )
        )
    for name in pair.match.rows:
        own = pair.policy.specs[pair.match.taken[name]].shape[0]
        theirs = pair.vlm.specs[name].shape[0]
        on_event(
            Warned(
                "extract",
                f"{own:,} rows of the vocabulary in the policy and {theirs:,} in the base's "
                f"{name}: the first {min(own, theirs):,} are taken for the same words",
            )
        )
