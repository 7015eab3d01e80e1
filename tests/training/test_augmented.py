"""Training on augmented frames: resuming gives the same bytes, and nothing else is augmented."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from samples.command import refused
from samples.training_runs import Start, assert_same_run, contents, metrics, stop_at

from aegis_cli import recipes
from aegis_cli.data import augment
from aegis_cli.recipes import Recipe
from aegis_cli.training import train

ALL = tuple(augment.TRANSFORMATIONS)


def changed(recipe: Recipe, **keys: Any) -> Recipe:
    return replace(recipe, train=replace(recipe.train, **keys))


@pytest.mark.parametrize("stopped_at", [3, 4])
def test_a_resumed_run_ends_in_the_same_bytes(
    stopped_at: int, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    augmented = changed(recipe, augment=ALL)
    start("naive", tmp_path / "whole", recipe=augmented)
    with pytest.raises(KeyboardInterrupt):
        listener = stop_at(stopped_at, KeyboardInterrupt())
        start("naive", tmp_path / "cut", recipe=augmented, on_event=listener)
    start("naive", tmp_path / "cut", recipe=augmented, resume=True)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


def test_it_changes_the_training_and_the_order_of_passes_does_not(
    recipe: Recipe, start: Start, naive_run: Path, tmp_path: Path
) -> None:
    augmented = changed(recipe, augment=("brightness",))
    start("naive", tmp_path / "one", recipe=augmented)
    start("naive", tmp_path / "two", recipe=changed(augmented, accumulate=2))
    expert = "checkpoints/000006/expert.safetensors"
    assert contents(tmp_path / "one")[expert] != contents(naive_run)[expert]
    one, two = (metrics(tmp_path / name)[-1]["loss"] for name in ("one", "two"))
    assert one == pytest.approx(two, rel=1e-5)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_a_batch_larger_than_the_dataset_has_no_picture_twice(
    accumulate: int,
    recipe: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[bytes] = []
    original = augment.augmented

    def noting(*given: Any) -> Any:
        images = original(*given)
        drawn.extend(image.numpy().tobytes() for image in images)
        return images

    monkeypatch.setattr(train.augment, "augmented", noting)
    large = changed(recipe, augment=ALL, batch_size=600, steps=1, accumulate=accumulate)
    start("naive", tmp_path / "run", recipe=large)
    assert len(drawn) == 600 and len(set(drawn)) == 600


def test_the_validation_loss_sees_frames_as_they_are(
    recipe: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = changed(recipe, backbone_lr=0.0, expert_lr=0.0, weight_decay=0.0, steps=3)
    seen: list[int] = []
    original = augment.augmented

    def noting(images: Any, frames: Any, *rest: Any) -> Any:
        seen.extend(frames)
        return original(images, frames, *rest)

    monkeypatch.setattr(train.augment, "augmented", noting)
    start("naive", tmp_path / "plain", recipe=still)
    assert seen == []
    start("naive", tmp_path / "augmented", recipe=changed(still, augment=ALL))
    assert len(seen) == 3 * recipe.train.batch_size
    plain, augmented = (metrics(tmp_path / name)[-1] for name in ("plain", "augmented"))
    assert plain["validation_loss"] == augmented["validation_loss"]
    assert plain["loss"] != augmented["loss"]


def test_records_from_before_the_key_still_hold(recipe: Recipe) -> None:
    part = recipes.training_part(recipe)["train"]
    assert not {"augment", "augment_count"} & part.keys()
    augmented = recipes.training_part(changed(recipe, augment=("hue",)))["train"]
    assert augmented["augment"] == ("hue",)


def test_a_count_without_transformations_is_refused(aegis: Any, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("kind: policy\nname: r\ntrain:\n  augment_count: 2\n")
    assert "train.augment" in refused(aegis("inspect", path))
    path.write_text("kind: policy\nname: r\ntrain:\n  augment: [blur]\n")
    assert "brightness" in refused(aegis("inspect", path))
