"""The anchor of any PyTorch model, measured on VQA passes that the user runs."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.anchors import anchor_file
from aegis_cli.anchors.curvature import CurvatureRecorder
from aegis_cli.anchors.hooks import LayerHooks, Removable, boolean, refuse_empty
from aegis_cli.anchors.inputs import InputRecorder
from aegis_cli.anchors.moments import MomentRecorder
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.methods.base import Pass
from aegis_cli.methods.known_parameters import refuse_sharded
from aegis_cli.models import structure, wrappers
from aegis_cli.models.wrappers import plain_names

PARTS = ("moments", "inputs", "curvature")


class Measurement(Removable):
    """Watches VQA passes, then saves the anchor that a guard reads.

        with Guard.measure(model, layers="model.text_model.layers") as measured:
            for batch in questions:
                with measured.watch(batch["attention_mask"], image=batch["input_ids"] == IMAGE):
                    model(**batch)
        measured.save("anchor.safetensors")

    Passes run without gradients, except for the curvature, which also needs the logits of each
    pass's answers:

                with measured.watch(batch["attention_mask"]):
                    scores = model(**batch).logits[:, :-1]
                measured.answer(scores[batch["labels"][:, 1:] != -100])

    The model must be in evaluation mode and not compiled.
    """

    def __init__(
        self,
        model: nn.Module,
        layers: str | Sequence[nn.Module] | None = None,
        *,
        part: str | None = None,
        parts: Sequence[str] = ("moments",),
        vision: str | Sequence[str] = (),
        energy: float = 0.9999,
        seed: int = 0,
    ) -> None:
        """Put hooks on the model.

        Args:
            model: the pre-trained VLM.
            layers: as for `Guard`.
            part: as for `Guard`.
            parts: `moments` for `aegis`, `inputs` for `nullspace`, `curvature` for `kfac`, or
                several; the curvature covers the maps that the answers' gradient reaches.
            vision: dotted names of the modules that read pixels, including the map from image to
                text features; everything they read counts, since text padding never reaches them.
            energy: share of each map's input energy, or curvature, up to which eigenvectors are
                kept.
            seed: seed for drawing the words of the answers.

        Raises:
            AegisError: unknown parts, layers that cannot be identified, or a model that is in
                training mode, compiled or sharded.
        """
        if not parts or set(parts) - set(PARTS):
            raise AegisError(
                f"parts {', '.join(parts) or '(none)'}",
                f"some of {', '.join(PARTS)}",
                'parts=("moments", "inputs")',
            )
        if not 0 < energy <= 1:
            raise AegisError(f"energy {energy}", "above 0 and up to 1", "energy=0.9999")
        model = structure.part_of(model, part)
        refuse_sharded(model)
        structure.refuse_offloaded(model)
        if found := structure.compiled(model):
            named = f"'{found[0]}'" if found[0] else "the model itself"
            raise AegisError(
                f"{named} under torch.compile",
                "a model not yet compiled",
                "measure first, then compile",
            )
        self._model, self._energy = model, energy
        self._layers = structure.find_layers(model, layers) if "moments" in parts else {}
        self._moments = MomentRecorder()
        self._inputs: InputRecorder | None = None
        self._curvature: CurvatureRecorder | None = None
        if "inputs" in parts:
            pixels = structure.plain_parts(model, vision)
            self._inputs = InputRecorder(model, structure.find_maps(model, pixels), pixels)
        if "curvature" in parts:
            self._curvature = CurvatureRecorder(model, structure.find_maps(model, ()), seed)
        self._hooks = LayerHooks(self._layers)  # last: an error above would leave them
        self._samples: int | None = 0  # None: the size of some pass is not known
        self._broken, self._unanswered = False, False
        self._removed = False

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None, image: Tensor | None = None) -> Generator[None]:
        """Count the forward pass inside the block.

        Args:
            mask: [B, T] over the tokens that the layers see, true for tokens that count; None:
                every token counts.
            image: [B, T] or [T], true at image tokens; needed for moments, and all false if
                prompts have no images.

        Raises:
            AegisError: a mask that does not fit, a map whose inputs cannot be told from padding, or
                a measurement whose hooks were removed.
        """
        if self._removed:
            raise AegisError(
                "a measurement that was removed",
                "one at work; a `with` block removes it where it ends",
                "watch inside the block, or make a new measurement",
            )
        if self._model.training:
            raise AegisError(
                "a model in training mode", "one that answers as it did before", "model.eval()"
            )
        if image is None and self._layers:
            raise AegisError(
                "no image mask",
                "image=: which tokens are the image's",
                "measured.watch(mask, image=...), all false for prompts without images",
            )
        self._check_answered()
        counts = None if mask is None else boolean(mask, "a mask")
        if counts is not None:
            refuse_empty(counts)
        failed_before, self._broken = self._broken, True  # unless the block ends well
        self._unanswered = self._curvature is not None
        with contextlib.ExitStack() as stack:
            # Only the curvature needs a backward pass; otherwise a graph would waste memory.
            stack.enter_context(torch.set_grad_enabled(self._curvature is not None))
            if self._layers:
                stack.enter_context(self._hooks.watch(mask, image, self._count))
            if self._inputs is not None:
                stack.enter_context(self._inputs.watch(counts))
            if self._curvature is not None:
                stack.enter_context(self._curvature.watch())
            yield
        # If layers are watched, `_count` takes the batch size from their outputs.
        if not self._layers:
            self._add_samples(None if mask is None else len(mask))
        # The sums still contain an earlier pass that failed half-way.
        self._broken = failed_before

    def note(self, layer: int | nn.Module, hidden: Tensor) -> None:
        """See `Guard.note`."""
        self._hooks.note(layer, hidden)

    def answer(self, scores: Tensor) -> None:
        """Backpropagate from a watched pass's answers, for the curvature; may be called repeatedly.

        Words are drawn from the scores themselves, so which answers are right does not matter.

        Args:
            scores: [..., V] logits with the pass's graph, at the positions that predict the words
                of answers.

        Raises:
            AegisError: scores without a graph or without a position, probabilities, or a
                measurement without curvature.
        """
        if self._curvature is None:
            raise AegisError(
                "answers for a measurement without the curvature",
                "parts with it",
                'parts=("curvature",)',
            )
        if not scores.requires_grad or scores.ndim < 2 or not scores.numel():
            found = f"scores {list(scores.shape)}"
            if not scores.requires_grad:
                found += " without a graph"
            raise AegisError(
                found,
                "scores [n, V] of a watched pass",
                "model.requires_grad_(True), and no torch.no_grad around the pass",
            )
        if _are_probabilities(scores.detach()):
            raise AegisError(
                f"scores {list(scores.shape)} that are probabilities",
                "logits [n, V], as the model's head computes them",
                "leave .softmax(-1) out; .log_softmax(-1) does no harm",
            )
        self._curvature.answer(scores.flatten(0, -2))
        self._unanswered = False

    def anchor(self) -> Anchor:
        """Return what was measured so far.

        Raises:
            AegisError: nothing was measured, or a pass failed half-way.
        """
        self._check_answered()
        if self._broken:
            raise AegisError(
                "a watched pass that failed", "whole passes", "measure again from the start"
            )
        if self._layers and not self._moments.image:
            raise AegisError(
                "no watched pass",
                "VQA passes inside `with measured.watch(mask):`",
                "run the questions first",
            )
        image, text = self._moments.image, self._moments.text
        # The sums stay, so more passes may follow and `anchor` may be called again.
        inputs = {} if self._inputs is None else self._inputs.spectra(self._energy)
        curvature = {} if self._curvature is None else self._curvature.spectra(self._energy)
        return Anchor(image, text, inputs, curvature=curvature)

    def save(self, path: str | Path) -> None:
        """Write the anchor; the weights must still be those that were measured."""
        measured = (self._layers, self._inputs is not None, self._curvature is not None)
        parts = [part for part, has in zip(PARTS, measured, strict=True) if has]
        meta: dict[str, Any] = {"parts": parts, "energy": self._energy}
        if self._samples is not None:
            meta["samples"] = self._samples
        plain = plain_names(self._model)
        if self._layers:
            meta["layers"] = [plain(name) for name in self._layers]
        if wrappers.adapted(self._model):
            # What maps read depends on adapters even if their weights are unchanged.
            meta["adapted"] = structure.fingerprint(self._model, adapters=True)
        recorders = [found for found in (self._inputs, self._curvature) if found is not None]
        if recorders:
            # With this, a guard can say why a map that it should protect is not in the anchor.
            meta["unmeasured"] = {}
            for recorder in recorders:
                meta["unmeasured"] |= {plain(n): why for n, why in recorder.unmeasured.items()}
        anchor_file.save(
            Path(path), self.anchor(), fingerprint=structure.fingerprint(self._model), meta=meta
        )

    def remove(self) -> None:
        """Remove the hooks; what was measured stays."""
        self._hooks.remove()
        self._removed = True

    def _check_answered(self) -> None:
        if self._unanswered:
            raise AegisError(
                "a watched pass without its answers",
                "measured.answer(scores) after each, for the curvature",
                "give it the scores [n, V] at the positions where the words of answers are "
                "predicted",
            )

    def _count(self, seen: Pass) -> None:
        self._moments.add(seen.hidden, seen.mask, seen.image)
        self._add_samples(len(seen.mask))

    def _add_samples(self, count: int | None) -> None:
        known = self._samples
        self._samples = None if known is None or count is None else known + count


def _are_probabilities(scores: Tensor) -> bool:
    """Whether every row sums to 1 and no entry is negative, as no head's logits do by chance."""
    off = (scores.sum(-1, dtype=torch.float32) - 1).abs().max()
    # Rounding to half precision leaves the sum off by up to about 0.004.
    return scores.shape[-1] > 1 and bool((scores.min() >= 0) & (off < 1e-2))
