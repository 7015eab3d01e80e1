"""The curvature of the answers' log-likelihood in each map's weights, as two Kronecker factors."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from aegis_cli.anchors import inputs, passes
from aegis_cli.anchors.hooks import describe_use, modules_of_sites, watch_uses
from aegis_cli.anchors.second_moments import SecondMoments
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.core.spectrum import DENSE, Spectrum, second_moment
from aegis_cli.models import structure
from aegis_cli.models.backbones.base import Backbone

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.data.vqa.dataset import VQASet

SIDES = ("inputs", "outputs")


class CurvatureRecorder:
    """Sums both factors of each linear map's and convolution's Fisher information.

    The factors are those of K-FAC (arXiv 1503.05671) with the partial traces of core/curvature.py
    in place of plain second moments: E[|g|^2 x x^T] [d, d] of inputs x, and E[|x|^2 g g^T] [o, o]
    of gradients g at the outputs. No mask is needed: the gradient at a token that no answer reads
    is 0.

    Attributes:
        unmeasured: maps that have been used in a way that no hook sees -> how.
    """

    def __init__(
        self, model: nn.Module, maps: structure.Maps, seed: int, *, follow_uses: bool = True
    ) -> None:
        """Prepare; hooks are on the model only while a pass is watched.

        Args:
            maps: those that are measured, as far as they are dense.
            seed: of the words that answers are drawn as.
            follow_uses: as for `InputRecorder`.
        """
        self._model, self._follow_uses = model, follow_uses
        self._sums = SecondMoments()
        self._generator = torch.Generator().manual_seed(seed)
        self.unmeasured: dict[str, str] = {}
        self._sites = {
            name: site
            for name, site in modules_of_sites(model, maps).items()
            if isinstance(model.get_submodule(name), DENSE)
        }

    @property
    def names(self) -> list[str]:
        """Both factors of every map: `SITE.inputs` and `SITE.outputs`."""
        return _factors(dict.fromkeys(self._sites.values()))

    @contextlib.contextmanager
    def watch(self) -> Iterator[None]:
        """Follow the maps that are called inside the block."""
        with contextlib.ExitStack() as hooks:
            for name, site in self._sites.items():
                module, after = self._model.get_submodule(name), partial(self._follow_call, site)
                hooks.callback(module.register_forward_hook(after, with_kwargs=True).remove)
            if self._follow_uses:
                hooks.enter_context(watch_uses(self._model, self._note_use))
            yield

    def answer(self, scores: Tensor) -> None:
        """Go back once through the graph of scores, which is kept.

        The gradient is that of log p(word) summed over the words, each drawn from the model's own
        distribution: the Fisher information, not the empirical one, so that what the model is sure
        of and right about counts as well.

        Args:
            scores: [n, V] unnormalised, of the positions where answers' words are predicted.
        """
        learning = [p for p in self._model.parameters() if p.requires_grad]
        likelihood = _log_likelihood(scores, self._generator)
        torch.autograd.grad(likelihood, learning, retain_graph=True, allow_unused=True)

    def check_complete(self) -> None:
        """Raise AegisError unless every map took part."""
        self._sums.check(self.names)

    def spectra(self, energy: float) -> dict[str, Spectrum]:
        """Both factors of each map that took part, by its name without torch.compile.

        Args:
            energy: share of each factor's trace up to which eigenvectors are kept.

        Raises:
            AegisError: no map took part.
        """
        found = self._sums.spectra(energy, _factors(self.unmeasured))
        if not found:
            raise AegisError(
                "no map that an answer reads",
                "linear maps or convolutions that learn",
                "model.requires_grad_(True), then measure",
            )
        return found

    def _follow_call(
        self,
        site: str,
        module: nn.Module,
        arguments: tuple[Tensor, ...],
        named: Mapping[str, Tensor],
        output: Tensor,
    ) -> None:
        if output.requires_grad:
            read = arguments[0] if arguments else next(iter(named.values()))
            output.register_hook(partial(self._count, site, module, read.detach()))

    def _count(self, site: str, module: nn.Module, read: Tensor, gradient: Tensor) -> None:
        """Add what one call of the module, given `read`, says by the gradient at its output."""
        x, g = inputs.rows_of(module, read), _output_rows(module, gradient)
        both = _factor_sums(x, g, getattr(module, "bias", None) is not None)
        for side, moment in zip(SIDES, both, strict=True):
            self._sums.add(f"{site}.{side}", moment, len(g))

    def _note_use(
        self,
        function: Callable[..., Any],
        _: nn.Parameter,
        names: Sequence[str],
        __: tuple[Any, ...],
    ) -> None:
        for site in {self._sites[name] for name in names if name in self._sites}:
            self.unmeasured[site] = describe_use(function)


def measure(
    model: Backbone,
    asked: VQASet,
    energy: float,
    seed: int,
    batch_size: int = passes.IMAGES,
    on_event: OnEvent = ignore,
) -> dict[str, Spectrum]:
    """Both factors, `site.inputs` and `site.outputs`, of each dense map of one of our backbones.

    Raises:
        AegisError: modules that no inputs describe, or that these questions do not use.
    """
    recorder = CurvatureRecorder(model, passes.maps_of(model), seed, follow_uses=False)
    with recorder.watch(), torch.enable_grad():
        for scores in passes.run(model, asked, batch_size, "anchor curvature", on_event):
            # Questions of one image may share its graph, and their drawn words are independent: a
            # part at a time will do.
            recorder.answer(scores)
    recorder.check_complete()
    found = recorder.spectra(energy)
    return {name: found[name] for name in recorder.names}  # they come in the backward pass's order


def _factors(sites: Iterable[str]) -> list[str]:
    return [f"{site}.{side}" for site in sites for side in SIDES]


@torch.no_grad()
def _factor_sums(x: Tensor, g: Tensor, bias: bool) -> tuple[Tensor, Tensor]:
    """Sums over output tokens of |g|^2 x x^T and of |x|^2 g g^T, x ending in 1 with a bias.

    Args:
        x: [n, d] what the map read.
        g: [n, o] gradients at its output.

    Returns:
        [d, d] (or [d + 1, d + 1] with a bias) and [o, o], float64.
    """
    x, g = (rows.to(torch.promote_types(rows.dtype, torch.float32)) for rows in (x, g))
    if bias:
        x = torch.cat([x, x.new_ones(len(x), 1)], 1)
    size_of_g, size_of_x = g.norm(dim=1, keepdim=True), x.norm(dim=1, keepdim=True)  # [n, 1] each
    # |g|^2 x x^T is the second moment of the row |g| x, and so for the other factor.
    of_inputs = second_moment(x * size_of_g, bias=False)
    of_outputs = second_moment(g * size_of_x, bias=False)
    return of_inputs, of_outputs


def _output_rows(module: nn.Module, gradient: Tensor) -> Tensor:
    """One row per output token: [n, o]."""
    if isinstance(module, nn.Linear):
        return gradient.flatten(0, -2)
    # A convolution's are [B, o, ...]; the rows come in the order of `inputs.rows_of`.
    return gradient.flatten(2).transpose(1, 2).flatten(0, 1)


def _log_likelihood(scores: Tensor, generator: torch.Generator) -> Tensor:
    """The log-likelihood of words drawn from the scores [n, V] themselves."""
    # Drawn on the CPU, where the generator is, so that the words are the same on every device.
    chances = scores.detach().float().softmax(-1).cpu()
    drawn = torch.multinomial(chances, 1, generator=generator).to(scores.device)  # [n, 1]
    return scores.float().log_softmax(-1).gather(1, drawn).sum()
