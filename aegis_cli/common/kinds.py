"""The required content of each kind of artifact: its exact tensors, and valid values."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # reading only a header does not load torch
    from torch import Tensor

Tensors = Mapping[str, "Tensor"]
# Tensor name -> (dtype, shape). A size given as a word must be the same wherever the word appears.
Layout = dict[str, tuple[str, tuple[int | str, ...]]]


@dataclass(frozen=True)
class Kind:
    """The content of a kind of file.

    Args:
        command: the command that writes it.
        layout: its exact tensors; None if the model decides and only the header's list counts.
        domain: yields the problems of the values of tensors that fit the layout.
        option: the option by which commands take it, if there is just one.
    """

    command: str
    layout: Callable[[Tensors], Layout] | None = None
    domain: Callable[[Tensors, Mapping[str, Any]], Iterable[str]] = lambda tensors, meta: ()
    option: str | None = None


def _anchor_layout(tensors: Tensors) -> Layout:
    layout: Layout = {}
    layers = sum(re.fullmatch(r"layers\.\d+\.image\.mean", name) is not None for name in tensors)
    if layers or not any(name.startswith(("inputs.", "curvature.", "fisher.")) for name in tensors):
        for i in range(max(1, layers)):
            for part in ("image.mean", "image.var", "text.mean", "text.var"):
                layout[f"layers.{i}.{part}"] = ("float64", (f"D{i}",))
        layout["count"] = ("int64", (2,))
    for name in tensors:
        if name.startswith("fisher."):
            layout[name] = ("float32", tuple(tensors[name].shape))
        elif name.startswith(("inputs.", "curvature.")) and name.endswith(".values"):
            site = name.removesuffix(".values")
            vectors, has_rest = tensors.get(f"{site}.vectors"), f"{site}.rest" in tensors
            half = vectors is not None and _is_half(vectors)
            layout |= _spectrum_layout(
                site, tensors[name].ndim, vectors is not None, half, has_rest
            )
    return layout


def _spectrum_layout(site: str, rank: int, vectors: bool, half: bool, rest: bool) -> Layout:
    """The layout of a spectrum's tensors.

    A table has only values, a dense map also k leading eigenvectors, and a normalisation all
    eigenvectors of each channel. If only leading directions were resolved, there is one value for
    each of them and one for the rest.
    """
    d, k, m = f"d of {site}", f"k of {site}", f"m of {site}"
    dtype = "float16" if half else "float32"
    if rest:
        return {
            f"{site}.values": ("float64", (k,)),
            f"{site}.rest": ("float64", (1,)),
            f"{site}.vectors": (dtype, (d, k)),
        }
    values: Layout = {f"{site}.values": ("float64", (d,) if rank == 1 else (d, m))}
    if not vectors:
        return values
    if rank == 1:
        return values | {f"{site}.vectors": (dtype, (d, k))}
    return values | {f"{site}.vectors": ("float32", (d, m, m))}


def _anchor_domain(tensors: Tensors, _: Mapping[str, Any]) -> Iterator[str]:
    count = tensors.get("count")
    # One of the two is 0 if the questions had no images.
    if count is not None and not (count.sum() > 0 and (count >= 0).all()):
        yield f"count is {count.tolist()}: the anchor saw no tokens"
    for name, tensor in tensors.items():
        is_square = name.endswith((".var", ".values", ".rest")) or name.startswith("fisher.")
        if is_square and (tensor < 0).any():
            yield f"'{name}' has a negative {'variance' if name.endswith('.var') else 'value'}"
        if name.endswith(".vectors") and not _orthonormal(tensor):
            yield f"the columns of '{name}' are not orthonormal"


def _is_half(tensor: Tensor) -> bool:
    return str(tensor.dtype) == "torch.float16"


def _orthonormal(vectors: Tensor) -> bool:
    tolerance = 1e-2 if _is_half(vectors) else 1e-4
    vectors = vectors.float()
    product = vectors.mT @ vectors
    product.diagonal(dim1=-2, dim2=-1).sub_(1)
    return bool(product.numel() == 0 or product.abs().max() < tolerance)


_DEMOS: Layout = {
    "frames": ("uint8", ("N", 64, 64, 3)),
    "proprio": ("float32", ("N", "P")),
    "actions": ("float32", ("N", "A")),
    "episode_starts": ("int64", ("E + 1",)),
    "instruction": ("int64", ("E",)),
}


def _demos_layout(tensors: Tensors) -> Layout:
    """The layout of demonstrations.

    Episodes have returns, or targets with a colour, or their task within a set of tasks.
    """
    if "returns" in tensors:
        return _DEMOS | {"returns": ("float64", ("E",))}
    if "task" in tensors:
        return _DEMOS | {"task": ("int64", ("E",))}
    return _DEMOS | {"target_color": ("int64", ("E",))}


def _are_words(value: Any, name: str) -> bool:
    """Whether a value in the metadata of demonstrations has its type, mostly a list of strings."""
    if name == "control_hz":
        return isinstance(value, int | float) and value > 0
    if name == "task":
        return isinstance(value, str)
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _demos_domain(tensors: Tensors, meta: Mapping[str, Any]) -> Iterator[str]:
    # tensors of indices, and the lists in meta that they point to
    lists = {"instruction": "instructions", "target_color": "colors", "task": "tasks"}
    pointers = {name: words for name, words in lists.items() if name in tensors}
    needed = {"task", "control_hz", "action_names", "proprio_names", *pointers.values()}
    if missing := needed - meta.keys():
        yield f"meta lacks {quoted(missing)}"
        return
    if wrong := [words for words in needed if not _are_words(meta[words], words)]:
        yield f"meta {quoted(wrong)} of another type"
        return
    starts = tensors["episode_starts"]
    frames, episodes = len(tensors["frames"]), len(tensors["instruction"])
    if episodes == 0:
        yield "0 episodes"
    rises = len(starts) == episodes + 1 and not (starts.diff() <= 0).any()
    if not rises or starts[[0, -1]].tolist() != [0, frames]:
        yield f"'episode_starts' does not rise from 0 to the {frames} frames in {episodes} steps"
    for name, words in pointers.items():
        if ((tensors[name] < 0) | (tensors[name] >= len(meta[words]))).any():
            yield f"'{name}' points outside the {len(meta[words])} {words}"
    for name, words in (("actions", "action_names"), ("proprio", "proprio_names")):
        if tensors[name].shape[1] != len(meta[words]):
            yield f"'{name}' has {tensors[name].shape[1]} columns for {len(meta[words])} {words}"


_LEDGER: Layout = {
    **dict.fromkeys(("tt", "ta", "aa"), ("float64", ("S", "G"))),
    "w2": ("float64", ("S", "L")),
    "step": ("int64", ("S",)),
}


def _ledger_domain(tensors: Tensors, meta: Mapping[str, Any]) -> Iterator[str]:
    for name, words in (("tt", "groups"), ("w2", "layers")):
        if tensors[name].shape[1] != len(meta.get(words, ())):
            columns, listed = tensors[name].shape[1], len(meta.get(words, ()))
            yield f"'{name}' has {columns} columns for {listed} {words}"
    if (tensors["step"].diff() <= 0).any():
        yield "'step' does not increase"
    for name in ("tt", "aa", "w2"):
        if (tensors[name] < 0).any():
            yield f"'{name}' is a square and has negative values"


def _experts_layout(tensors: Tensors) -> Layout:
    layout: Layout = {}
    for name in tensors:
        if found := re.fullmatch(r"(.+)\.experts\.\d+\.[ab]", name):
            site, expert = found[1], name[:-2]
            layout[f"{expert}.a"] = ("float32", (f"rank of {expert}", f"inputs of {site}"))
            layout[f"{expert}.b"] = ("float32", (f"outputs of {site}", f"rank of {expert}"))
    return layout or {"<map>.experts.<number>.a": ("float32", ("rank", "inputs"))}


def _experts_domain(tensors: Tensors, meta: Mapping[str, Any]) -> Iterator[str]:
    listed = {
        f"{site}.experts.{n}"
        for site, said in meta.get("structure", {}).items()
        for n in said["experts"]
    }
    if listed != {name[:-2] for name in tensors}:
        yield "meta 'structure' does not list these experts"


def _routing_layout(tensors: Tensors) -> Layout:
    """The layout of the routers' tensors.

    Each router has its experts' numbers with mean weight and load, its scale, and the parameters of
    its logits if it has a choice.
    """
    layout: Layout = {}
    found = (re.fullmatch(r"(.+\.routers\.\d+)\.\w+", name) for name in tensors)
    for router in sorted({match[1] for match in found if match}):
        count = f"experts of {router}"
        layout[f"{router}.experts"] = ("int64", (count,))
        layout[f"{router}.scale"] = ("float32", ())
        layout[f"{router}.mass"] = layout[f"{router}.load"] = ("float64", (count,))
        if f"{router}.read" in tensors:
            layout[f"{router}.read"] = ("float32", (count, f"width of {router}"))
        if f"{router}.bias" in tensors:
            layout[f"{router}.bias"] = ("float32", (count,))
    if any(name.startswith("tasks.") for name in tensors):
        layout |= {
            "tasks.mean": ("float64", ("T", "D")),
            "tasks.directions": ("float64", ("T", "D", "r")),
            "tasks.variances": ("float64", ("T", "r")),
            "tasks.noise": ("float64", ("T",)),
            "tasks.threshold": ("float64", ("T",)),
        }
    return layout or {"<map>.routers.<task>.scale": ("float32", ())}


def _routing_domain(tensors: Tensors, _: Mapping[str, Any]) -> Iterator[str]:
    for name, tensor in tensors.items():
        if name.endswith((".mass", ".load")) and (tensor < 0).any():
            yield f"'{name}' has a negative share"
        # All 0 is valid for a map that no loss reads.
        if name.endswith(".mass") and tensor.any() and abs(float(tensor.sum()) - 1) > 1e-4:
            yield f"'{name}' sums to {float(tensor.sum()):g} instead of 1"
        if name.endswith(".experts"):
            if (tensor.diff() <= 0).any() or (tensor < 0).any():
                yield f"'{name}' does not increase from 0 on"
            router = name.removesuffix("experts")
            logits = {router + "read", router + "bias"} & tensors.keys()
            if (len(tensor) > 1) != bool(logits):
                yield f"'{name}' lists {len(tensor)} experts, which does not fit its logits"
    for name in {"tasks.variances", "tasks.noise"} & tensors.keys():
        if (tensors[name] <= 0).any():
            yield f"'{name}' is not positive"


_STREAM_TASK: Layout = {"images": ("uint8", ("N", "S", "S", 3)), "labels": ("int64", ("N",))}


def _stream_task_domain(tensors: Tensors, meta: Mapping[str, Any]) -> Iterator[str]:
    if missing := {"name", "classes", "templates", "parts"} - meta.keys():
        yield f"meta lacks {quoted(missing)}"
        return
    parts, labels = sum(meta["parts"].values()), tensors["labels"]
    if parts != len(labels):
        yield f"parts of {parts} images together, but {len(labels)} labels"
    if ((labels < 0) | (labels >= len(meta["classes"]))).any():
        yield f"'labels' points outside the {len(meta['classes'])} classes"


KINDS: dict[str, Kind] = {
    "anchor": Kind("aegis anchor", _anchor_layout, _anchor_domain, "--anchor"),
    "demos": Kind("aegis demos", _demos_layout, _demos_domain, "--demos"),
    "backbone": Kind("aegis pretrain"),
    "expert": Kind("aegis train"),
    "policy": Kind("aegis export"),
    "ledger": Kind("aegis train", lambda _: _LEDGER, _ledger_domain),
    "training-state": Kind("aegis train"),
    "experts": Kind("aegis train", _experts_layout, _experts_domain),
    "routing": Kind("aegis train", _routing_layout, _routing_domain),
    "dual-encoder": Kind("aegis pretrain"),
    "stream-task": Kind("aegis pretrain", lambda _: _STREAM_TASK, _stream_task_domain),
}


def layout_problems(kind: str, tensors: Tensors) -> Iterator[str]:
    """Where `tensors` differ from the kind's layout in name, dtype or shape."""
    find = KINDS[kind].layout
    if find is None:
        if not tensors:
            yield "no tensors"
        return
    layout = find(tensors)
    if missing := layout.keys() - tensors.keys():
        yield f"{quoted(missing)} missing"
    if extra := tensors.keys() - layout.keys():
        yield f"{quoted(extra)} not part of it"
    sizes: dict[str, int] = {}
    for name in sorted(layout.keys() & tensors.keys()):
        dtype, shape = layout[name]
        found = tensors[name]
        if f"torch.{dtype}" != str(found.dtype) or not _fits(found.shape, shape, sizes):
            known = [sizes.get(size, size) if isinstance(size, str) else size for size in shape]
            is_now, wanted = describe(found.dtype, found.shape), describe(dtype, known)
            yield f"'{name}' is {is_now} instead of {wanted}"


def is_finite(tensor: Tensor) -> bool:
    """Whether no value of a tensor is NaN or infinite."""
    if not tensor.is_floating_point():
        return True
    # One non-finite value makes the sum non-finite, which is faster to check. But the sum of finite
    # values may overflow too.
    return math.isfinite(tensor.sum().item()) or bool(tensor.isfinite().all())


def quoted(names: Iterable[str]) -> str:
    """The names in alphabetical order: 'a', 'b'."""
    return ", ".join(f"'{name}'" for name in sorted(names))


def describe(dtype: object, shape: Iterable[int | str]) -> str:
    """A tensor's dtype and shape, such as float32 [N, 3]."""
    return f"{str(dtype).removeprefix('torch.')} [{', '.join(map(str, shape))}]"


def _fits(found: tuple[int, ...], shape: tuple[int | str, ...], sizes: dict[str, int]) -> bool:
    """Whether the sizes agree; a word that appears for the first time takes the size found."""
    if len(found) != len(shape):
        return False
    for number, size in zip(found, shape, strict=True):
        expected = sizes.setdefault(size, number) if isinstance(size, str) else size
        if number != expected:
            return False
    return True
