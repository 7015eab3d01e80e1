"""The curvature of the answers' log-likelihood in each map's weights: two Kronecker factors."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.graph import GradientEdge, get_gradient_edge

from aegis_cli.anchors import inputs, kept_work, passes, second_moments
from aegis_cli.anchors.hooks import SharedInput, describe_use, modules_of_sites, watch_uses
from aegis_cli.anchors.second_moments import FINITE, SecondMoments
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core import moment_sums
from aegis_cli.core.numerics import widened
from aegis_cli.core.spectrum import DENSE, Spectrum
from aegis_cli.models import structure
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.wrappers import plain_names

if TYPE_CHECKING:  # the guard imports this module and needs no scene renderer
    from aegis_cli.data.vqa.dataset import VQASet

SIDES = ("inputs", "outputs")
# Nats per word. At 0.025 `kfac` protects VQA, and at 0.002 it does not: see
# docs/results/transfer.md.
_SURE = 0.01


@dataclass
class Weighed(SharedInput):
    """What linear maps have read, and how strongly the answers depend on it.

    Attributes:
        version: how often x had been changed in place when it was read.
        arrived: how many of its readers the backward pass has reached.
        weight: |g| over the outputs of all readers that it has reached, [n, 1].
    """

    version: int = 0
    arrived: int = 0
    weight: Tensor | None = None


@dataclass
class AnswerEntropy:
    """How sure a model is of the answers that a recorder has backpropagated from.

    Attributes:
        nats: entropy of the model's own distributions, summed over words.
        words: number of words.
    """

    nats: float = 0.0
    words: int = 0

    @torch.no_grad()
    def add(self, scores: Tensor) -> None:
        """Count the words that these scores [n, V] predict."""
        chances = scores.float().softmax(-1)
        self.nats += float(torch.special.entr(chances).sum())  # -p log p, and 0 where p is 0
        self.words += len(scores)

    def mean(self, ranks: Ranks = ALONE) -> float:
        """Nats a word, over the words of all processes."""
        counted = ranks.gathered((self.nats, self.words))
        return sum(nats for nats, _ in counted) / sum(words for _, words in counted)


@dataclass
class _Graph:
    """Where parameters enter the watched passes' graph: a backward pass need go no further.

    Attributes:
        entries: graph edges at the outputs of modules.
        lone: the parameters that enter it in another way.
    """

    entries: list[GradientEdge] = field(default_factory=list)
    lone: list[nn.Parameter] = field(default_factory=list)


def _refuse_changed(what: str, tensor: Tensor, version: int) -> None:
    """Raise AegisError if a tensor has been changed in place since it was read.

    Autograd itself checks the tensors that it needs, but a frozen map's input is not one of them.
    """
    if tensor._version != version:
        raise AegisError(
            f"{what}, which the model has changed in place since",
            "a pass that changes no such tensor in place",
            "x = x + y in place of x += y, and inplace=False, while the curvature is measured",
        )


class CurvatureRecorder:
    """Sums both factors of each linear map's and convolution's Fisher information.

    The factors are those of K-FAC (arXiv 1503.05671) with the partial traces of core/curvature.py
    in place of plain second moments: E[|g|^2 x x^T] [d, d] of inputs x, and E[|x|^2 g g^T] [o, o]
    of gradients g at the outputs. No mask is needed: the gradient at a token that no answer depends
    on is 0.

    Linear maps that read the same tensor one after the other (queries, keys and values; gate and
    up) share one input factor, with g over all their outputs, like the fused map that some models
    have instead.

    Attributes:
        unmeasured: maps that were used in a way that no hook sees -> how.
        entropy: entropy of the answers so far.
    """

    def __init__(
        self,
        model: nn.Module,
        maps: structure.Maps,
        seed: int,
        *,
        follow_uses: bool = True,
        whole: int = moment_sums.WHOLE,
        temperature: float = 1.0,
    ) -> None:
        """Prepare; hooks are on the model only while a pass is watched.

        Args:
            maps: the maps, of which the dense ones are measured.
            seed: seed for drawing the words of answers, unless `answer` is given numbers for it.
            follow_uses: as for `InputRecorder`.
            whole: as for `SecondMoments`.
            temperature: what the answers' scores are divided by.
        """
        self._model, self._follow_uses = model, follow_uses
        self._temperature, self.entropy = temperature, AnswerEntropy()
        self._sums = SecondMoments(whole)
        self._last: Weighed | None = None
        self._open: list[Weighed] = []  # some of whose readers a backward pass has reached
        self._graph = _Graph()
        self._generator = torch.Generator().manual_seed(seed)
        self.unmeasured: dict[str, str] = {}
        self._sites = {
            name: site
            for name, site in modules_of_sites(model, maps).items()
            if isinstance(model.get_submodule(name), DENSE)
        }
        # Found before any pass is watched, since trying out a norm also uses its parameters.
        owning = structure.owning(model).items()
        self._called = {name for name, module in owning if structure.site_kind(module) is not None}

    @property
    def names(self) -> list[str]:
        """Both factors of every map: `SITE.inputs` and `SITE.outputs`."""
        return _factors(dict.fromkeys(self._sites.values()))

    @contextlib.contextmanager
    def watch(self) -> Generator[None]:
        """Follow the maps that are called inside the block."""
        self.forget()
        self._graph.lone = []
        with contextlib.ExitStack() as hooks:
            for name, module in structure.owning(self._model).items():
                # The module is a map to measure, or its call shows where its parameters enter the
                # graph, or other modules use its parameters, which are then ends themselves.
                site = self._sites.get(name)
                if site is not None:
                    after = partial(self._follow_call, site)
                elif name in self._called:
                    after = self._note_entry
                else:
                    own = module.parameters(recurse=False)
                    self._graph.lone += [p for p in own if p.requires_grad]
                    continue
                hooks.callback(module.register_forward_hook(after, with_kwargs=True).remove)
            if self._follow_uses:
                hooks.enter_context(watch_uses(self._model, self._note_use))
            yield

    def answer(self, scores: Tensor, keep: bool = True, uniform: Tensor | None = None) -> None:
        """Backpropagate once through the graph of scores.

        The gradient is that of log p(word) summed over the words, each drawn from the model's own
        distribution. This gives the Fisher information, not the empirical one, so answers that the
        model is sure of and right about count as well. If it is sure of nearly all answers,
        gradients vanish and the few others make up the sums; a temperature above 1 draws from a
        flatter distribution, for which every question has gradients.

        Args:
            scores: [n, V] logits at the positions that predict the words of answers.
            keep: keep the graph, for other scores of the same pass.
            uniform: [n] float64 in [0, 1) for drawing the words; None: they are drawn with the
                recorder's seed, one call after the other.

        Raises:
            AegisError: scores from which no word can be drawn.
        """
        self.entropy.add(scores)
        if uniform is None:
            uniform = torch.rand(
                len(scores), dtype=torch.float64, generator=self._generator, device="cpu"
            )
        self.follow(_log_likelihood(scores / self._temperature, uniform), keep)

    def follow(self, total: Tensor, keep: bool = True) -> None:
        """Backpropagate once through the graph of a sum over independent examples."""
        # Only the gradients at the maps' outputs are needed. Asking for those at the entries avoids
        # the gradients of the parameters: half of the work, and as much memory as the model.
        ends = [*self._graph.entries, *self._graph.lone]
        # The result is dropped: the hooks on the maps' outputs have seen all they need.
        # pyrefly: ignore[no-matching-overload]: torch takes both kinds of ends in one list
        torch.autograd.grad(total, ends, retain_graph=keep, allow_unused=True)
        for reading in self._open:  # answers may not depend on all readers
            self._count_inputs(reading)
        self._open = []
        if not keep:
            self.forget()

    def forget(self) -> None:
        """Release the watched passes' graph."""
        self._last, self._open, self._graph.entries = None, [], []

    def kept(self) -> Kept:
        """The sums so far, for saving; no graph may be waiting for a backward pass."""
        sums = self._sums.kept()
        entropy = [self.entropy.nats, self.entropy.words]
        return Kept({**sums.figures, "entropy": entropy}, sums.tensors)

    def restore(self, kept: Kept, device: torch.device) -> None:
        """Continue from saved sums, before the first pass; `measure` draws the words itself."""
        self._sums.restore(kept, device)
        self.entropy.nats, self.entropy.words = kept.figures["entropy"]

    def add_up(self, ranks: Ranks) -> None:
        """Add the sums of all processes, each of which had its own passes."""
        self._sums.add_up(ranks)

    def check_complete(self) -> None:
        """Raise AegisError unless every map took part."""
        self._sums.check(self.names)

    def spectra(
        self,
        energy: float,
        release: bool = False,
        stage: str = "spectra",
        on_event: OnEvent = ignore,
    ) -> dict[str, Spectrum]:
        """Both factors of each map that took part, by its plain name.

        Args:
            energy: share of each factor's trace up to which eigenvectors are kept.
            release: release each sum once it is no longer needed.
            stage: name of the stage in progress events.

        Raises:
            AegisError: no map took part.
        """
        self.forget()
        leave_out = _factors(self.unmeasured)
        found = self._sums.spectra(energy, leave_out, release, stage, on_event)
        if not found:
            raise AegisError(
                "no map that an answer reads",
                "linear maps or convolutions that learn",
                "model.requires_grad_(True), then measure",
            )
        plain = plain_names(self._model)
        return {plain(name): spectrum for name, spectrum in found.items()}

    def _note_entry(
        self,
        module: nn.Module,
        arguments: tuple[Any, ...],
        named: Mapping[str, Any],
        output: Any,
    ) -> None:
        """Note the output of a module if only its parameters require a gradient."""
        read = [t for t in (*arguments, *named.values()) if isinstance(t, Tensor)]
        enters = not any(t.requires_grad for t in read)
        if enters and isinstance(output, Tensor) and output.requires_grad:
            # The edge is taken now, since the tensor's own changes with an in-place operation.
            self._graph.entries.append(get_gradient_edge(output))

    def _follow_call(
        self,
        site: str,
        module: nn.Module,
        arguments: tuple[Tensor, ...],
        named: Mapping[str, Tensor],
        output: Tensor,
    ) -> None:
        if not output.requires_grad:
            return
        self._note_entry(module, arguments, named, output)
        read = arguments[0] if arguments else next(iter(named.values()))
        # Readers of one tensor share its `Weighed`, and with it one input factor.
        if self._last is not None and self._last.serves(site, module, read):
            self._last.sites.append(site)
        else:
            self._last = Weighed(read, module, [site], read._version)
        output.register_hook(partial(self._count, self._last, site, module))

    @torch.no_grad()
    def _count(self, reading: Weighed, site: str, module: nn.Module, gradient: Tensor) -> None:
        """Add what one call of the module contributes, given the gradient at its output."""
        _refuse_changed(f"what '{site}' read", reading.x, reading.version)
        x = inputs.dense_rows(module, reading.x)  # [n, d], with a 1 at the end for a bias
        g = widened(_output_rows(module, gradient))  # [n, o]
        # |x|^2 g g^T is the second moment of the row |x| g; likewise for the other factor.
        self._sums.note(f"{site}.{SIDES[0]}")
        self._sums.add_rows([f"{site}.{SIDES[1]}"], g * x.norm(dim=1, keepdim=True))
        size = g.norm(dim=1, keepdim=True)
        # |(g1, g2)|^2 = |g1|^2 + |g2|^2: the outputs of all readers side by side.
        reading.weight = size if reading.weight is None else torch.hypot(reading.weight, size)
        reading.arrived += 1
        if reading.arrived == 1:
            self._open.append(reading)
        if reading.arrived == len(reading.sites):
            self._count_inputs(reading)
            self._open = [other for other in self._open if other is not reading]

    def _count_inputs(self, reading: Weighed) -> None:
        """Add |g|^2 x x^T of what was read, over the readers that a backward pass has reached."""
        assert reading.weight is not None
        rows = inputs.dense_rows(reading.module, reading.x.detach()) * reading.weight  # |g| x
        names = [f"{site}.{SIDES[0]}" for site in reading.sites]
        self._sums.add_rows(names, rows, reading.of_convolution)
        reading.arrived, reading.weight = 0, None

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
    memory: int | None = None,
    whole: int = moment_sums.WHOLE,
    ranks: Ranks = ALONE,
    temperature: float = 1.0,
    entropy: AnswerEntropy | None = None,
    work: kept_work.Work = kept_work.NOTHING,
) -> dict[str, Spectrum]:
    """Measure both factors, `site.inputs` and `site.outputs`, of each dense map of a backbone.

    Each question's words are drawn from the seed and its number in the set, so the result depends
    neither on the batch size nor on the number of groups or processes.

    Args:
        seed: seed for drawing the words of answers.
        memory: as for `inputs.measure`.
        whole: as for `SecondMoments`.
        ranks: the processes that share the passes.
        temperature: what the answers' scores are divided by before words are drawn from them.
        entropy: counts the answers of this process.
        work: as for `inputs.measure`.

    Raises:
        AegisError: modules that inputs cannot describe, or that these questions do not use.
    """
    found: dict[str, Spectrum] = {}
    entropy = entropy or AnswerEntropy()
    sized = partial(_size, whole)
    for maps, stage in passes.groups(model, "anchor curvature", memory, sized):
        piece = work.piece(stage)
        if (known := piece.finished()) is not None:
            passes.tell_known(asked, stage, on_event)
            found |= second_moments.from_kept(known)
            entropy.nats, entropy.words = known.figures["entropies"][ranks.rank]
            continue
        recorder = CurvatureRecorder(
            model, maps, seed, follow_uses=False, whole=whole, temperature=temperature
        )
        recorder.entropy = entropy
        if not recorder.names:
            continue
        done = 0
        if (begun := piece.begun()) is not None:
            recorder.restore(begun, model.device)
            done = begun.figures["done"]
            del begun  # whose copy on the CPU takes as much memory as the sums
        with recorder.watch(), torch.enable_grad(), piece.going(recorder.kept) as passed:
            for part in passes.run(model, asked, batch_size, stage, on_event, ranks, done, passed):
                # Questions about one image may share its graph: their words are drawn
                # independently, so the cross terms of their gradients are 0 on average.
                uniform = _uniform(seed, part.question)
                recorder.answer(part.scores, keep=False, uniform=uniform)
        recorder.add_up(ranks)
        recorder.check_complete()
        spectra = recorder.spectra(energy, True, f"{stage} spectra", on_event)
        # The recorder returns them in the order of the backward pass.
        spectra = {name: spectra[name] for name in recorder.names}
        kept = second_moments.to_keep(spectra)
        # Of every process, each of which has summed over all groups so far.
        entropies = ranks.gathered((entropy.nats, entropy.words))
        piece.finish(Kept({**kept.figures, "entropies": entropies}, kept.tensors))
        found |= spectra
    return found


def warn_of_sure_answers(
    entropy: float, temperature: float, stage: str, effect: str, on_event: OnEvent
) -> None:
    """Warn of a curvature that depends on the few answers that the backbone is not sure of.

    Args:
        entropy: entropy of the backbone's own answers, in nats per word.
        effect: what follows from it, and what helps.
    """
    if entropy < _SURE and temperature == 1:
        text = (
            f"the backbone is nearly sure of these answers ({entropy:.4f} nats a word), so their "
            f"curvature hangs on a few questions, and {effect}"
        )
        on_event(Warned(stage, text))


def _size(whole: int, module: nn.Module) -> int:
    """Bytes of the sums of both factors."""
    width = inputs.dense_width(module)
    if width is None:
        return 0
    assert isinstance(module, DENSE)
    of_inputs = moment_sums.size(width, not isinstance(module, nn.Linear), whole)
    return of_inputs + moment_sums.size(len(module.weight), whole=whole)


def _factors(sites: Iterable[str]) -> list[str]:
    return [f"{site}.{side}" for site in sites for side in SIDES]


def _output_rows(module: nn.Module, gradient: Tensor) -> Tensor:
    """One row per output token: [n, o]."""
    if isinstance(module, nn.Linear):
        return gradient.flatten(0, -2)
    # A convolution's are [B, o, ...]; the rows come in the order of `inputs.rows_of`.
    return gradient.flatten(2).transpose(1, 2).flatten(0, 1)


def _uniform(seed: int, question: Tensor) -> Tensor:
    """A number in [0, 1) for each word of the answers to some questions, [n] float64.

    Args:
        question: [n], the number of the question to which each word belongs.
    """
    own, words = question.unique_consecutive(return_counts=True)  # a question's words are together
    found = []
    for number, count in zip(own.tolist(), words.tolist(), strict=True):
        found.append(np.random.default_rng((seed, number)).random(count))
    return torch.from_numpy(np.concatenate(found))


def _log_likelihood(scores: Tensor, uniform: Tensor) -> Tensor:
    """The log-likelihood of words drawn from the scores [n, V] themselves.

    The drawn word is the first one at which the cumulative probability exceeds its number in
    [0, 1). Rounding changes the sums little, so batches of another size have the same words.

    Args:
        uniform: [n] float64 in [0, 1), on the CPU.
    """
    # Drawn on the CPU, so that the words are the same on every device.
    chances = scores.detach().float().softmax(-1).cpu()
    if not chances.isfinite().all():
        raise AegisError(
            f"scores of {len(scores)} words, some of which are not finite",
            "finite scores; minus infinity for a word that is never said",
            f"{FINITE}, and see that its weights are finite",
        )
    below = chances.double().cumsum(-1)  # [n, V]
    # Divided by the last sum, which rounding may leave below 1, so that every number finds a word.
    # `right`, so that a word of probability 0 is never drawn, not even by the number 0.
    drawn = torch.searchsorted(below / below[:, -1:], uniform[:, None], right=True)  # [n, 1]
    drawn = drawn.to(scores.device)
    return scores.float().log_softmax(-1).gather(1, drawn).sum()
