"""The guard in trainers: the result is that of the guard's own loop.

Hugging Face's Trainer, accelerate and Lightning, each skipped if it is not installed.
"""

from __future__ import annotations

import sys
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import (
    LAYERS,
    Vlm,
    anchors_by_method,
    batch,
    make,
    vector,
)
from torch import Tensor, nn
from torch.utils.data import DataLoader

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError

STEPS, SIZE, RATE = 3, 4, 1e-2
METHODS: dict[str, dict[str, Any]] = {
    "aegis": {"layers": LAYERS},
    "nullspace": {"vision": "vision", "energy": 0.9, "every": 2},
    "kfac": {"protect": ("maps",)},
}
every_method = pytest.mark.parametrize("method", METHODS)
# Trainers raise many warnings of their own: about workers, loggers, schedulers.
pytestmark = pytest.mark.filterwarnings("default")

Rows = list[dict[str, Tensor]]


class Robot(nn.Module):
    """The model as a Trainer calls it: keyword arguments in, a mapping with the loss out."""

    def __init__(self, vlm: Vlm) -> None:
        super().__init__()
        self.vlm = vlm

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> dict[str, Tensor]:
        return {"loss": loss_of(self.vlm, {"pixels": pixels, "ids": ids, "mask": mask})}


def loss_of(model: nn.Module, given: dict[str, Tensor]) -> Tensor:
    found = model(given["pixels"], given["ids"], given["mask"])
    return (found - 1).square().mean(-1)[given["mask"]].mean()


def rows() -> Rows:
    """The frames of all steps, one by one."""
    found = []
    for seed in range(STEPS):
        pixels, ids, mask = batch(seed, SIZE)
        for i in range(SIZE):
            found.append({"pixels": pixels[i], "ids": ids[i], "mask": mask[i]})
    return found


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The anchor that each method reads."""
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


Guarded = Callable[[str], tuple[Vlm, Guard]]


@pytest.fixture
def guarded(anchors: dict[str, Path]) -> Guarded:
    def made(method: str) -> tuple[Vlm, Guard]:
        model = make()
        return model, Guard(model, anchors[method], method=method, **METHODS[method])

    return made


def by_hand(model: Vlm, guard: Guard | None) -> Tensor:
    """The weights after the guard's own loop, or after a naive one if there is no guard."""
    optimizer = torch.optim.SGD(model.parameters(), lr=RATE)
    for given in DataLoader(rows(), SIZE):
        if guard is None:
            loss_of(model, given).backward()
            optimizer.step()
        else:
            with guard.watch(given["mask"]):
                loss = loss_of(model, given)
            guard.backward(loss)
            guard.step(optimizer)
        optimizer.zero_grad()
    if guard is not None:
        guard.settle()
    return vector(model)


def check(model: Vlm, guard: Guard, method: str, guarded: Guarded) -> None:
    """The trainer's result for the model is that of the guard's loop."""
    other, its = guarded(method)
    guard.settle()
    torch.testing.assert_close(vector(model), by_hand(other, its), rtol=1e-9, atol=1e-9)
    assert not torch.allclose(vector(model), by_hand(make(), None), atol=1e-6)
    found, expected = guard.ledger.tensors(), its.ledger.tensors()
    assert len(guard.ledger) == (STEPS if method == "aegis" else 0)
    for name, values in expected.items():
        torch.testing.assert_close(found[name], values)


# --- Hugging Face's Trainer -----------------------------------------------------------------------


def trainer(model: nn.Module, folder: Path, callbacks: list[Any], **settings: Any) -> Any:
    pytest.importorskip("accelerate")
    transformers = pytest.importorskip("transformers")
    settings = {
        "num_train_epochs": 1,
        "per_device_train_batch_size": SIZE,
        "max_grad_norm": 0.0,
        "lr_scheduler_type": "constant",
        "learning_rate": RATE,
        "optim": "sgd",
        "report_to": [],
        "save_strategy": "no",
        "logging_strategy": "no",
        "disable_tqdm": True,
        "use_cpu": True,
        "train_sampling_strategy": "sequential",
    } | settings
    return transformers.Trainer(
        Robot(model),
        transformers.TrainingArguments(str(folder), **settings),
        train_dataset=rows(),
        eval_dataset=rows()[:SIZE],
        callbacks=callbacks,
    )


@every_method
def test_a_trainer_with_the_callback(method: str, guarded: Guarded, tmp_path: Path) -> None:
    model, guard = guarded(method)
    trainer(model, tmp_path, [guard.callback(mask="mask")]).train()
    check(model, guard, method, guarded)


def test_a_trainer_in_passes_of_a_part_of_the_batch(guarded: Guarded, tmp_path: Path) -> None:
    """The sum of their gradients is projected, as in one pass; the anchor gradient is the mean."""
    model, guard = guarded("aegis")
    settings = {"per_device_train_batch_size": 2, "gradient_accumulation_steps": 2}
    trainer(model, tmp_path, [guard.callback(mask="mask")], **settings).train()
    assert len(guard.ledger) == STEPS
    assert not torch.allclose(vector(model), by_hand(make(), None), atol=1e-6)


@pytest.mark.parametrize(
    ("when", "times"),
    [({"eval_strategy": "steps", "eval_steps": 1}, 3), ({"eval_strategy": "epoch"}, 1)],
)
def test_a_trainer_settles_before_it_evaluates(
    when: dict[str, Any], times: int, guarded: Guarded, tmp_path: Path
) -> None:
    model, guard = guarded("nullspace")  # it constrains every second step; three are taken
    given = trainer(model, tmp_path, [guard.callback()], **when)
    pending = []
    evaluate = given.evaluate
    given.evaluate = lambda *a, **k: (pending.append(guard.pending), evaluate(*a, **k))[1]
    given.train()
    assert pending == [0] * times


def test_a_trainer_saves_settled_weights(guarded: Guarded, tmp_path: Path) -> None:
    """So the guard does not warn that the state is taken while steps are pending."""
    model, guard = guarded("nullspace")  # it constrains every second step; three are taken
    given = trainer(model, tmp_path, [guard.callback()], save_strategy="steps", save_steps=1)
    saved = []

    def save(folder: str, **_: Any) -> None:
        """In place of safetensors, which refuses the tied head of this model."""
        Path(folder).mkdir()
        saved.append(given.model.state_dict())

    given.save_model = save
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        given.train()
    assert [str(w.message) for w in said if "pending" in str(w.message)] == []
    assert len(saved) == STEPS


@pytest.mark.parametrize("loads", [True, False])
def test_a_trainer_that_resumes_without_the_learned_weights_is_refused(
    loads: bool, guarded: Guarded, tmp_path: Path
) -> None:
    """As one does whose names in the file are not those of the model, which it only warns of."""
    model, guard = guarded("nullspace")
    given = trainer(model, tmp_path, [guard.callback()], save_strategy="steps", save_steps=1)
    given.save_model = lambda folder, **_: Path(folder).mkdir()
    given.train()
    other, its = guarded("nullspace")
    given = trainer(other, tmp_path, [its.callback()], num_train_epochs=2)
    given._load_from_checkpoint = lambda *_: other.load_state_dict(
        model.state_dict() if loads else {}, strict=loads
    )
    checkpoint = str(tmp_path / f"checkpoint-{STEPS}")
    if loads:
        given.train(resume_from_checkpoint=checkpoint)
        assert given.state.global_step == 2 * STEPS
        return
    with pytest.raises(AegisError, match=f"resumes at step {STEPS} with the pre-trained weights"):
        given.train(resume_from_checkpoint=checkpoint)


@every_method
def test_a_trainer_beside_a_guard_is_refused(method: str, guarded: Guarded, tmp_path: Path) -> None:
    model, _guard = guarded(method)
    before = vector(model)
    with pytest.raises(AegisError, match=r"guard\.automatic|callbacks=\[guard"):
        trainer(model, tmp_path, []).train()
    assert torch.equal(vector(model), before)


def test_a_trainer_of_another_model(guarded: Guarded, tmp_path: Path) -> None:
    _, guard = guarded("aegis")
    with pytest.raises(AegisError, match="a Trainer of a Robot that the guard does not know"):
        trainer(make(), tmp_path, [guard.callback(mask="mask")]).train()


def test_a_callback_says_why_transformers_cannot_be_imported(
    guarded: Guarded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a peft that imports names of an older version from it."""
    _, guard = guarded("aegis")
    monkeypatch.setitem(sys.modules, "transformers", types.ModuleType("transformers"))
    with pytest.raises(AegisError) as caught:
        guard.callback()
    said = str(caught.value)
    assert "cannot import name 'TrainerCallback'" in said and "aegis-vla[hf,loops]" in said


# --- accelerate -----------------------------------------------------------------------------------


@every_method
def test_accelerate(method: str, guarded: Guarded) -> None:
    accelerate = pytest.importorskip("accelerate")
    model, guard = guarded(method)
    accelerator = accelerate.Accelerator(cpu=True)
    optimizer = torch.optim.SGD(model.parameters(), lr=RATE)
    prepared, optimizer, loader = accelerator.prepare(model, optimizer, DataLoader(rows(), SIZE))
    guard.automatic(mask="mask", scaler=accelerator.scaler)
    for given in loader:
        accelerator.backward(loss_of(prepared, given))
        optimizer.step()
        optimizer.zero_grad()
    check(model, guard, method, guarded)


# --- Lightning ------------------------------------------------------------------------------------


def fit(model: nn.Module, by_itself: bool, **settings: Any) -> None:
    lightning = pytest.importorskip("lightning")

    class Module(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.vlm, self.automatic_optimization = model, by_itself

        def training_step(self, given: dict[str, Tensor], index: int) -> Tensor:
            loss = loss_of(self.vlm, given)
            if not by_itself:
                optimizer = self.optimizers()
                optimizer.zero_grad()
                self.manual_backward(loss)
                optimizer.step()
            return loss

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.vlm.parameters(), lr=RATE)

    quiet = ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary")
    trainer = lightning.Trainer(
        max_epochs=1, accelerator="cpu", devices=1, **dict.fromkeys(quiet, False), **settings
    )
    trainer.fit(Module(), DataLoader(rows(), SIZE))


@every_method
@pytest.mark.parametrize("by_itself", [True, False])
def test_lightning(method: str, by_itself: bool, guarded: Guarded) -> None:
    model, guard = guarded(method)
    guard.automatic(mask="mask")
    fit(model, by_itself)
    check(model, guard, method, guarded)


@every_method
@pytest.mark.parametrize("by_itself", [True, False])
def test_lightning_beside_a_guard_is_refused(
    method: str, by_itself: bool, guarded: Guarded
) -> None:
    model, _guard = guarded(method)
    before = vector(model)
    with pytest.raises(AegisError, match=r"guard\.automatic"):
        fit(model, by_itself)
    assert torch.equal(vector(model), before)


def test_lightning_clips_what_is_projected(guarded: Guarded) -> None:
    """Accumulated and clipped, its ledger still has one row per step."""
    model, guard = guarded("aegis")
    guard.automatic(mask="mask")
    fit(model, True, gradient_clip_val=0.01, accumulate_grad_batches=2)
    assert len(guard.ledger) == 2
