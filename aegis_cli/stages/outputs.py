"""Second moments of the gradients that answers send to every map's outputs: how much VQA minds each direction there."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from aegis_cli.backbones.base import Backbone
from aegis_cli.core.curvature import DENSE
from aegis_cli.core.spectrum import Spectrum, decompose, second_moment
from aegis_cli.events import OnEvent, ignore
from aegis_cli.stages import device as devices
from aegis_cli.stages import vqa_passes
from aegis_cli.vqa.dataset import VQASet


def measure(model: Backbone, asked: VQASet, energy: float, seed: int, on_event: OnEvent = ignore) -> dict[str, Spectrum]:
    """The spectrum of each dense map's output gradients, a row an output token.

    The gradient is that of log p(word) summed over the answers' words, each word drawn from the model's own distribution
    (the Fisher information, not the empirical one: what the model is sure of and right about counts as well).
    """
    generator = torch.Generator().manual_seed(seed)
    sums = vqa_passes.Sums()

    def watch(site: str, module: nn.Module) -> RemovableHandle:
        def add(gradient: Tensor) -> None:
            found = rows(module, gradient)
            sums.add(site, second_moment(found, bias=False), len(found))

        def hook(_: nn.Module, __: object, output: Tensor) -> None:
            output.register_hook(add)

        return module.register_forward_hook(hook)

    learning = list(model.parameters())
    sites = [site for site, module in model.site_modules().items() if isinstance(module, DENSE)]
    with vqa_passes.watching(model, watch, sites), torch.enable_grad():
        for scores in vqa_passes.run(model, asked, "anchor outputs", on_event):
            # questions of one image may share its graph, and their drawn words are independent: a part at a time will do
            torch.autograd.grad(_log_likelihood(scores, generator), learning, retain_graph=True, allow_unused=True)
    with devices.single_threaded():
        means = sums.means(sites)  # in the order of the backward pass
        return {site: decompose(means[site], energy) for site in sites}


def rows(module: nn.Module, gradient: Tensor) -> Tensor:
    """A row an output token: [n, o]."""
    if isinstance(module, nn.Linear):
        return gradient.flatten(0, -2)
    return gradient.flatten(2).transpose(1, 2).flatten(0, 1)


def _log_likelihood(scores: Tensor, generator: torch.Generator) -> Tensor:
    """Of words drawn from the scores [n, V] themselves."""
    drawn = torch.multinomial(scores.detach().float().softmax(-1).cpu(), 1, generator=generator).to(scores.device)
    return scores.float().log_softmax(-1).gather(1, drawn).sum()
