"""How much answers mind each direction in which every map reads, and each in which it writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from aegis_cli.anchors import inputs, passes
from aegis_cli.common import device as devices
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.core.spectrum import DENSE, Spectrum, decompose, second_moment
from aegis_cli.models.backbones.base import Backbone

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.data.vqa.dataset import VQASet

SIDES = ("inputs", "outputs")


def measure(
    model: Backbone,
    asked: VQASet,
    energy: float,
    seed: int,
    batch_size: int = passes.IMAGES,
    on_event: OnEvent = ignore,
) -> dict[str, Spectrum]:
    """The two factors of each dense map's curvature (see core/curvature.py), `site.inputs` and
    `site.outputs`.

    The gradient is that of log p(word) summed over the answers' words, each word drawn from the
    model's own distribution (the Fisher information, not the empirical one: what the model is sure
    of and right about counts as well).
    """
    generator = torch.Generator().manual_seed(seed)
    sums = passes.Sums()
    learning = list(model.parameters())
    sites = [site for site, module in model.site_modules().items() if isinstance(module, DENSE)]
    with passes.watching(model, partial(watch, sums), sites), torch.enable_grad():
        for scores in passes.run(model, asked, batch_size, "anchor curvature", on_event):
            # questions of one image may share its graph, and their drawn words are independent: a
            # part at a time will do
            descend(scores, learning, generator)
    names = [f"{site}.{side}" for site in sites for side in SIDES]
    sums.check(names)
    with devices.single_threaded():
        found = {name: decompose(mean, energy) for name, mean in sums.means()}
    return {name: found[name] for name in names}  # they come in the order of the backward pass


def watch(sums: passes.Sums, site: str, module: nn.Module) -> RemovableHandle:
    """Add both factors' parts to `sums` on every way back through the module."""

    def hook(
        _: nn.Module, arguments: tuple[Tensor, ...], named: Mapping[str, Tensor], output: Tensor
    ) -> None:
        if output.requires_grad:
            read = arguments[0] if arguments else next(iter(named.values()))
            output.register_hook(partial(_count, sums, site, module, read.detach()))

    return module.register_forward_hook(hook, with_kwargs=True)


def _count(sums: passes.Sums, site: str, module: nn.Module, read: Tensor, gradient: Tensor) -> None:
    """What one call of the module, given `read`, says of its curvature by the gradient at its
    output.
    """
    x, g = inputs.rows_of(module, read), rows(module, gradient)
    for side, moment in zip(
        SIDES, moments(x, g, getattr(module, "bias", None) is not None), strict=True
    ):
        sums.add(f"{site}.{side}", moment, len(g))


def descend(scores: Tensor, learning: Sequence[nn.Parameter], generator: torch.Generator) -> None:
    """One way back through the graph of scores [n, V], from the log-likelihood of words drawn from
    them; it is kept.
    """
    torch.autograd.grad(
        _log_likelihood(scores, generator), learning, retain_graph=True, allow_unused=True
    )


@torch.no_grad()
def moments(x: Tensor, g: Tensor, bias: bool) -> tuple[Tensor, Tensor]:
    """Sums over output tokens of |g|^2 x x^T and of |x|^2 g g^T, x ending in 1 with a bias: of [n,
    d] and [n, o]; float64.
    """
    x, g = (rows.to(torch.promote_types(rows.dtype, torch.float32)) for rows in (x, g))
    if bias:
        x = torch.cat([x, x.new_ones(len(x), 1)], 1)
    sizes = g.norm(dim=1, keepdim=True), x.norm(dim=1, keepdim=True)
    return second_moment(x * sizes[0], bias=False), second_moment(g * sizes[1], bias=False)


def rows(module: nn.Module, gradient: Tensor) -> Tensor:
    """A row an output token: [n, o]."""
    if isinstance(module, nn.Linear):
        return gradient.flatten(0, -2)
    return gradient.flatten(2).transpose(1, 2).flatten(0, 1)


def _log_likelihood(scores: Tensor, generator: torch.Generator) -> Tensor:
    """Of words drawn from the scores [n, V] themselves."""
    drawn = torch.multinomial(scores.detach().float().softmax(-1).cpu(), 1, generator=generator).to(
        scores.device
    )
    return scores.float().log_softmax(-1).gather(1, drawn).sum()
