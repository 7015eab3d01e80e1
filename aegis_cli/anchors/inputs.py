"""Second moments of what every map of a VLM reads while it answers questions."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.hooks import RemovableHandle

from aegis_cli.anchors import passes
from aegis_cli.common import device as devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.core.spectrum import (
    DENSE,
    Spectrum,
    channel_moment,
    decompose,
    lone_row,
    second_moment,
)
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.structure import rms_normed

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.data.vqa.dataset import VQASet


@torch.no_grad()
def measure(
    model: Backbone,
    asked: VQASet,
    energy: float,
    batch_size: int = passes.IMAGES,
    on_event: OnEvent = ignore,
) -> dict[str, Spectrum]:
    """The spectrum of each site's inputs over images, questions and answers, and of each tied
    head's (`site.scores`).
    """
    modules = model.site_modules()
    lone = {site: lone_row() for site in model.sites() if site not in modules}
    sums = passes.Sums()

    def watch(site: str, module: nn.Module) -> RemovableHandle:
        return module.register_forward_pre_hook(
            lambda _, arguments: sums.add(site, *moment(module, arguments[0]))
        )

    def watch_head(table: str, head: str) -> RemovableHandle:
        module = model.get_submodule(head)

        def hook(_: nn.Module, arguments: tuple[Tensor, ...], output: Tensor) -> None:
            scored = arguments[0] if isinstance(module, nn.Linear) else output
            rows = scored.flatten(0, -2)
            sums.add(f"{table}.scores", second_moment(rows, bias=False), len(rows))

        return module.register_forward_hook(hook)

    with passes.watching(model, watch), contextlib.ExitStack() as stack:
        for table, head in model.tied_heads.items():
            stack.callback(watch_head(table, head).remove)
        for _ in passes.run(model, asked, batch_size, "anchor inputs", on_event):
            pass
    sums.check(modules)
    with devices.single_threaded():
        return {site: spectrum(mean, energy) for site, mean in sums.means()} | lone


def kept_share(inputs: Mapping[str, Spectrum]) -> float | None:
    """Share of all maps' input directions whose eigenvectors are stored; a table stores none, it
    needs none.
    """
    dense = [s for s in inputs.values() if s.vectors is not None]
    directions = sum(s.values.numel() for s in dense)
    kept = sum(s.values.numel() if s.vectors.ndim == 3 else s.vectors.shape[1] for s in dense)
    return kept / directions if dense else None


def spectrum(moment: Tensor, energy: float) -> Spectrum:
    """The spectrum of a mean second moment, up to that share of its energy; of a table's counts,
    which rows are read.
    """
    if (
        moment.ndim == 1
    ):  # one look-up of a position serves any number of texts, so only whether it is read counts
        return Spectrum((moment > 0).double(), None)
    return decompose(moment, energy)


def moment(module: nn.Module, x: Tensor, keep: Tensor | None = None) -> tuple[Tensor, int]:
    """Summed second moment of what the module's parameters multiply, and the number of rows.

    Args:
        x: its input.
        keep: which rows (of a table: look-ups), one an output token, count; None: all.
    """
    if isinstance(module, nn.Embedding):
        ids = x.flatten() if keep is None else x.flatten()[keep]
        return torch.bincount(ids, minlength=module.num_embeddings).double(), ids.numel()
    rows, bias = rows_of(module, x), getattr(module, "bias", None) is not None
    rows = rows if keep is None else rows[keep]
    return (
        second_moment(rows, bias) if isinstance(module, DENSE) else channel_moment(rows, bias)
    ), len(rows)


def rows_of(module: nn.Module, x: Tensor) -> Tensor:
    """What the module's parameters multiply, one row an output token: [n, d]."""
    if isinstance(module, nn.Conv2d):
        padding = 0 if module.padding == "valid" else module.padding
        patches = F.unfold(x, module.kernel_size, module.dilation, padding, module.stride)
        return patches.transpose(1, 2).flatten(0, 1)
    if isinstance(module, nn.Conv3d):
        if tuple(x.shape[2:]) != module.kernel_size:
            raise AegisError(
                (
                    f"a 3-D convolution over {tuple(x.shape[2:])} with a kernel of "
                    f"{module.kernel_size}"
                ),
                "patches of the kernel's size",
                "leave the inputs out: aegis anchor --parts moments",
            )
        return x.flatten(1)
    if isinstance(module, nn.LayerNorm):
        return F.layer_norm(x, module.normalized_shape, eps=module.eps).flatten(0, -2)
    return (
        x.flatten(0, -2) if isinstance(module, nn.Linear) else rms_normed(module, x).flatten(0, -2)
    )
