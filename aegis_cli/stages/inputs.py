"""Second moments of what every map of a VLM reads while it answers questions."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.hooks import RemovableHandle

from aegis_cli.backbones.base import Backbone
from aegis_cli.core.spectrum import Spectrum, channel_moment, decompose, second_moment
from aegis_cli.events import OnEvent, ignore
from aegis_cli.stages import device as devices
from aegis_cli.stages import vqa_passes

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.vqa.dataset import VQASet


@torch.no_grad()
def measure(model: Backbone, asked: VQASet, energy: float, on_event: OnEvent = ignore) -> dict[str, Spectrum]:
    """The spectrum of each site's inputs over images, questions and answers, and of each tied head's (`site.scores`)."""
    sums = vqa_passes.Sums()

    def watch(site: str, module: nn.Module) -> RemovableHandle:
        return module.register_forward_pre_hook(lambda _, arguments: sums.add(site, *moment(module, arguments[0])))

    def watch_head(table: str, head: str) -> RemovableHandle:
        def hook(_: nn.Module, __: tuple[Tensor, ...], output: Tensor) -> None:
            rows = output.flatten(0, -2)
            sums.add(f"{table}.scores", second_moment(rows, bias=False), len(rows))

        return model.get_submodule(head).register_forward_hook(hook)

    with vqa_passes.watching(model, watch), contextlib.ExitStack() as stack:
        for table, head in model.tied_heads.items():
            stack.callback(watch_head(table, head).remove)
        for _ in vqa_passes.run(model, asked, "anchor inputs", on_event):
            pass
    with devices.single_threaded():
        return {site: spectrum(mean, energy) for site, mean in sums.means(list(model.sites())).items()}


def kept_share(inputs: Mapping[str, Spectrum]) -> float | None:
    """Share of all maps' input directions whose eigenvectors are stored; a table stores none, it needs none."""
    dense = [s for s in inputs.values() if s.vectors is not None]
    directions = sum(s.values.numel() for s in dense)
    kept = sum(s.values.numel() if s.vectors.ndim == 3 else s.vectors.shape[1] for s in dense)
    return kept / directions if dense else None


def spectrum(moment: Tensor, energy: float) -> Spectrum:
    """The spectrum of a mean second moment, up to that share of its energy; of a table's counts, which rows are read."""
    if moment.ndim == 1:  # one look-up of a position serves any number of texts, so only whether it is read counts
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
    rows, bias = _rows(module, x), module.bias is not None
    rows = rows if keep is None else rows[keep]
    return (channel_moment(rows, bias) if isinstance(module, nn.LayerNorm) else second_moment(rows, bias)), len(rows)


def _rows(module: nn.Module, x: Tensor) -> Tensor:
    """What the module's parameters multiply, one row an output token: [n, d]."""
    if isinstance(module, nn.Conv2d):
        if module.groups != 1 or module.padding_mode != "zeros" or isinstance(module.padding, str):
            raise NotImplementedError(f"inputs of {module}")
        patches = F.unfold(x, module.kernel_size, module.dilation, module.padding, module.stride)
        return patches.transpose(1, 2).flatten(0, 1)
    if isinstance(module, nn.LayerNorm):
        return F.layer_norm(x, module.normalized_shape, eps=module.eps).flatten(0, -2)
    return x.flatten(0, -2)
