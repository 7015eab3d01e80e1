"""A callback of Hugging Face's Trainer, which makes a guard automatic for as long as it trains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import nn

from aegis_cli.common.errors import AegisError
from aegis_cli.guard.automatic import Source
from aegis_cli.models import structure

if TYPE_CHECKING:
    from transformers import TrainerCallback

    from aegis_cli.guard.guard import Guard


def trainer_callback(
    guard: Guard, model: nn.Module, mask: Source, image: Source
) -> TrainerCallback:
    """What a Trainer takes among its `callbacks`.

    Args:
        guard: made before the Trainer.
        model: what it guards.
        mask: as for `Guard.automatic`.
        image: as for `Guard.automatic`.

    Raises:
        AegisError: transformers is not installed, or not beside a peft that it works with.
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
        """Begins with the training, and settles before a checkpoint or an evaluation."""

        def on_train_begin(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            _check_model(given["model"], model)
            if not guard.is_automatic:
                # Accelerate's optimizer knows the scaler that its loop uses.
                scaler = getattr(given.get("optimizer"), "scaler", None)
                guard.automatic(mask=mask, image=image, scaler=scaler)
            else:
                # A Trainer begins again with smaller batches where the memory did not suffice.
                guard.discard()

        def on_step_end(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            if control.should_save or control.should_evaluate:
                guard.settle()

        def on_epoch_end(self, args: Any, state: Any, control: Any, **given: Any) -> None:
            # Whether it saves or evaluates now, a callback after this one may still decide.
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
