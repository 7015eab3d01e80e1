"""A callback for Hugging Face's Trainer that makes a guard automatic during training."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from torch import nn

from aegis_cli.common.errors import AegisError
from aegis_cli.guard.automatic import Source
from aegis_cli.models import structure

if TYPE_CHECKING:
    from transformers import TrainerCallback

    from aegis_cli.guard.guard import Guard


def trainer_callback(
    guard: Guard,
    model: nn.Module,
    mask: Source,
    image: Source,
    untrained: Callable[[], bool],
) -> TrainerCallback:
    """A callback for the `callbacks` of a Trainer.

    Args:
        guard: created before the Trainer.
        model: the guarded model.
        mask: as for `Guard.automatic`.
        image: as for `Guard.automatic`.
        untrained: whether the model has exactly its pre-trained weights.

    Raises:
        AegisError: transformers is not installed, or only with an incompatible peft.
    """
    try:
        from transformers import TrainerCallback
    except ImportError as error:
        raise AegisError(
            f"guard.callback without transformers ({error})",
            "the extras 'hf' and 'loops'",
            "pip install 'aegis-vla[hf,loops]'",
        ) from error

    class GuardCallback(TrainerCallback):
        """Starts the guard with the training, and settles before a checkpoint or an evaluation."""

        def on_train_begin(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            _check_model(given["model"], model)
            if state.global_step > 0:
                _check_resumed(state.global_step, untrained())
            if not guard.is_automatic:
                # Accelerate's optimizer knows the scaler that its loop uses.
                scaler = getattr(given.get("optimizer"), "scaler", None)
                guard.automatic(mask=mask, image=image, scaler=scaler)
            else:
                # A Trainer starts again with smaller batches if it ran out of memory.
                guard.discard()

        def on_step_end(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            if control.should_save or control.should_evaluate:
                guard.settle()

        def on_epoch_end(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            # A later callback may still decide to save or evaluate now.
            guard.settle()

        def on_train_end(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            guard.settle()

    return GuardCallback()


def _check_model(trained: nn.Module, guarded: nn.Module) -> None:
    known = {id(p) for p in trained.parameters()}
    if any(id(p) not in known for p in structure.learning(guarded).values()):
        raise AegisError(
            f"a Trainer of a {type(trained).__name__} that the guard does not know",
            "the guarded model, or one that it is a part of",
            "give Trainer(model=...) the same model that the guard was made of; with model_init=, "
            "make the guard in it",
        )


def _check_resumed(step: int, untrained: bool) -> None:
    """Raise AegisError if a Trainer resumes a training but has not loaded what it learned."""
    if untrained:
        raise AegisError(
            f"a Trainer that resumes at step {step} with the pre-trained weights: it has loaded "
            "none of the checkpoint's",
            "the weights of the checkpoint",
            "after Guard(...), load them yourself: model.load_state_dict("
            "type(model).from_pretrained(checkpoint).state_dict()); then call the same "
            "trainer.train(resume_from_checkpoint=checkpoint)",
        )
