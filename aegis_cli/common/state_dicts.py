"""Checks of all tensors against a model before any of them is copied into it.

Copying checks too little: a tensor of shape [1] is broadcast, a missing one leaves the old values,
and an optimizer writes out of bounds if a state is smaller than its parameter.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.kinds import describe, is_finite, quoted

AS_WRITTEN = "bring back the file as Aegis wrote it, or make it again"
_NAMED = 3  # problems that an error names
_LARGEST = 2**20  # largest size that a model may have
Shape = TypeVar("Shape")


def check_state(
    source: str, found: Mapping[str, Tensor], wanted: Mapping[str, Tensor], *, exact: bool = True
) -> None:
    """Raise AegisError unless `found` has exactly the tensors of `wanted`, in shape and dtype.

    Args:
        source: where they were read from, for the error.
        exact: whether dtypes must be the same; otherwise any floating-point dtype is accepted for
            another.

    Raises:
        AegisError: a name, shape or dtype differs, or values are not finite.
    """
    problems = []
    if missing := wanted.keys() - found.keys():
        problems.append(f"{_quoted(missing)} missing")
    if extra := found.keys() - wanted.keys():
        problems.append(f"{_quoted(extra)} not part of it")
    for name in sorted(wanted.keys() & found.keys()):
        one, other = found[name], wanted[name]
        alike = one.dtype == other.dtype
        if not exact:
            alike = one.is_floating_point() == other.is_floating_point()
        if one.shape != other.shape or not alike:
            is_now, should = (describe(t.dtype, t.shape) for t in (one, other))
            problems.append(f"'{name}' is {is_now} instead of {should}")
        elif not is_finite(one):
            problems.append(f"'{name}' has NaN or infinite values")
    if problems:
        more = f"; ... {len(problems)} problems in all" if len(problems) > _NAMED else ""
        raise AegisError(
            f"{source} does not fit the model: {'; '.join(problems[:_NAMED])}{more}",
            "exactly the model's tensors",
            AS_WRITTEN,
        )


def _quoted(names: set[str]) -> str:
    """The first few names in quotes, and the total count if there are more."""
    return few([f"'{name}'" for name in sorted(names)])


@contextlib.contextmanager
def reading_meta(path: Path) -> Generator[None]:
    """Turn exceptions from wrong types, missing keys or impossible sizes into an AegisError."""
    try:
        yield
    except (
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        IndexError,
        ArithmeticError,
        AssertionError,
    ) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise AegisError(
            f"the header of '{path}' is damaged: {what}",
            "the header as Aegis wrote it",
            AS_WRITTEN,
        ) from error


def shape_from(kind: type[Shape], raw: Any, path: Path, tensors: int) -> Shape:
    """A dataclass of a model's sizes, from a header.

    Args:
        tensors: number of tensors in the file, which bounds the number of layers.

    Raises:
        AegisError: the keys differ from those of the dataclass, or a size is impossible.
    """
    with reading_meta(path):
        sizes = {str(name): value for name, value in raw.items()}
        known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
        needed = {name for name, field in known.items() if field.default is MISSING}
        if not needed <= sizes.keys() <= known.keys():
            raise ValueError(f"sizes {quoted(sizes)} instead of {quoted(known)}")
        for name, value in sizes.items():
            absent = value is None and known[name].default is None
            whole = isinstance(value, int) and not isinstance(value, bool)
            # A damaged depth could ask for a million layers, which would take long to create.
            most = tensors if name.endswith("depth") else _LARGEST
            if not absent and not (whole and 1 <= value <= most):
                raise ValueError(f"'{name}' is {value!r}")
        return kind(**sizes)


def check_heads(width: int, heads: int) -> None:
    """Raise ValueError unless a width is divisible by the number of attention heads."""
    if width % heads:
        raise ValueError(f"a width of {width} for {heads} heads")


class _NothingDrawn(TorchFunctionMode):
    """Skips the initialisation of weights, which have no memory here.

    It saves a third of the time, and torch would import its compiler to initialise tables.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__module__", None) == nn.init.__name__:
            return args[0] if args else kwargs["tensor"]
        return func(*args, **kwargs)


@contextlib.contextmanager
def outline(path: Path) -> Generator[None]:
    """Create modules without memory inside the block, to check a file against them before use.

    Raises:
        AegisError: no model has these sizes.
    """
    with reading_meta(path):
        try:
            with torch.device("meta"), _NothingDrawn():
                yield
        except RuntimeError as error:
            raise ValueError(str(error)) from error
