"""Pre-training: resumes to the same bytes, is honest, and careful with existing files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, ignore
from aegis_cli.common.files import canonical
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.dataset import Rendered, load_scenes
from aegis_cli.data.vqa.metrics import by_family, grade, score
from aegis_cli.data.vqa.questions import FAMILIES
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded import EmbeddedVLM, load_file
from aegis_cli.models.backbones.tokenizer import SPECIAL
from aegis_cli.pretraining import loop, vlm
from aegis_cli.recipes import Model, PretrainRecipe

RECIPE = PretrainRecipe(
    name="vlm",
    scenes=24,
    probe_questions=21,
    steps=5,
    batch_size=4,
    warmup=1,
    precision="float32",
    checkpoint_every=2,
    model=Model(width=32, depth=2, heads=2),
)


whole_easy_training = cache(vlm.easy_training)  # decodes thousands of pictures


@cache
def few_easy_pictures() -> Rendered:
    """More pictures of easy-VQA than a run's steps show here."""
    whole, few = whole_easy_training(), slice(60)
    return Rendered(whole.images[few], whole.cells[few], whole.questions[few])


@pytest.fixture(autouse=True, scope="module")
def little_to_read() -> Iterator[None]:
    """A run asks few questions during training, and does not read all of easy-VQA again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vlm, "VALIDATION_QUESTIONS", 14)
        patch.setattr(vlm, "easy_training", few_easy_pictures)
        yield


@pytest.fixture(scope="module")
def finished(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[vlm.PretrainReport, list[Progress], Path]:
    out, events = tmp_path_factory.mktemp("pretrain") / "vlm", []
    return vlm.run(RECIPE, out, on_event=events.append), events, out


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


def stop_at(step: int):
    def listen(event: Progress) -> None:
        if event.stage == "pretrain" and event.done == step:
            raise Stop

    return listen


def test_a_resumed_run_ends_with_the_same_bytes(finished, tmp_path: Path) -> None:
    with pytest.raises(Stop):
        vlm.run(RECIPE, tmp_path, on_event=stop_at(4))  # the checkpoint of step 2 is the last
    assert artifacts.read_header(tmp_path / "state.safetensors").meta["step"] == 2
    events: list[Progress] = []
    vlm.run(RECIPE, tmp_path, resume=True, on_event=events.append)
    assert [e.done for e in events if e.stage == "pretrain"] == [2, 3, 4, 5]
    for name in ("model.safetensors", "state.safetensors"):
        assert (tmp_path / name).read_bytes() == (finished[2] / name).read_bytes()


def test_progress_tells_loss_and_validation(finished) -> None:
    steps = [e for e in finished[1] if e.stage == "pretrain"]
    assert [(e.done, e.total) for e in steps] == [(i, 5) for i in range(6)]
    assert all(e.metrics["loss"] > 0 for e in steps[1:])
    assert [e.done for e in steps if "validation" in e.metrics] == [2, 4]


def test_provenance_is_what_the_shipped_weights_score(finished) -> None:
    report, _, out = finished
    model, provenance = load_file(out / "model.safetensors")
    graded = grade(model.answers, load_scenes("probe", 21), 8)
    assert provenance == {
        "recipe_sha256": recipes.digest(RECIPE),
        "seed": 0,
        "steps": 5,
        "questions": 21,
        "accuracy": score(graded).accuracy,
        "cross_entropy": pytest.approx(score(graded).cross_entropy, rel=1e-4),
        "families": {name: s.accuracy for name, s in by_family(graded).items()},
    }
    assert set(provenance["families"]) == set(FAMILIES)
    assert (report.accuracy, report.families, report.steps) == (
        provenance["accuracy"],
        provenance["families"],
        5,
    )
    assert report.out == str(out / "model.safetensors")
    assert report.parameters == sum(p.numel() for p in model.parameters())


def test_the_checkpoint_is_a_backbone_in_bfloat16(finished) -> None:
    path = finished[2] / "model.safetensors"
    assert {spec.dtype for spec in artifacts.read_header(path).tensors.values()} == {"bfloat16"}
    model = backbones.load(str(finished[2]))
    assert isinstance(model, EmbeddedVLM) and (model.width, model.depth) == (32, 2)
    assert artifacts.read_header(path).fingerprint == model.fingerprint()


def test_training_moves_the_loss(tmp_path: Path) -> None:
    """Forty steps on the same few scenes: the answers' loss falls by more than chance explains."""
    events: list[Progress] = []
    recipe = replace(RECIPE, scenes=4, steps=40, lr=1e-2, checkpoint_every=40)
    vlm.run(recipe, tmp_path, on_event=events.append)
    losses = [e.metrics["loss"] for e in events if e.stage == "pretrain" and e.done]
    assert len(losses) == 40
    assert sum(losses[-4:]) < 0.75 * sum(losses[:4])


def test_an_earlier_run_is_not_overwritten(finished) -> None:
    before = (finished[2] / "model.safetensors").read_bytes()
    with pytest.raises(AegisError, match="from an earlier run") as caught:
        vlm.run(RECIPE, finished[2])
    assert (
        "--resume" in caught.value.fix
        and (finished[2] / "model.safetensors").read_bytes() == before
    )


@pytest.mark.parametrize("change", [{"seed": 1}, {"steps": 6}, {"lr": 1e-3}])
def test_another_recipe_does_not_continue_it(change: dict, finished) -> None:
    state = (finished[2] / "state.safetensors").read_bytes()
    (name, value), *_ = change.items()
    with pytest.raises(
        AegisError, match=f"another recipe: {name}: {getattr(RECIPE, name)} there, {value} here\n"
    ):
        vlm.run(replace(RECIPE, **change), finished[2], resume=True)
    assert (finished[2] / "state.safetensors").read_bytes() == state


def test_a_damaged_state_is_refused(finished, tmp_path: Path) -> None:
    data = (finished[2] / "state.safetensors").read_bytes()
    (tmp_path / "state.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(AegisError, match="truncated"):
        vlm.run(RECIPE, tmp_path, resume=True)


def test_a_loss_that_is_not_finite_stops_with_the_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = vlm._loss
    monkeypatch.setattr(
        vlm,
        "_loss",
        lambda run, rows, flip: real(run, rows, flip) * (torch.nan if rows[0] == nan_row else 1),
    )
    nan_row = vlm.BatchOrder(RECIPE.scenes, RECIPE.batch_size, RECIPE.seed).rows(3)[0]
    with pytest.raises(AegisError, match="loss nan at step"):
        vlm.run(RECIPE, tmp_path)
    saved = artifacts.load(
        tmp_path / "state.safetensors", "training-state"
    )  # from the last good checkpoint
    assert saved.header.meta["step"] == 2 and not (tmp_path / "model.safetensors").exists()


def test_a_gradient_that_is_not_finite_moves_nothing() -> None:
    model = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(model.weight)
    optimizers = [torch.optim.AdamW(model.parameters())]
    run = SimpleNamespace(model=model, optimizers=optimizers)
    with pytest.raises(AegisError, match="gradient norm inf at step 3"):
        loop._step(run, model.weight.sqrt().sum(), 3)
    assert model.weight.item() == 0


def test_through_the_command_line(aegis, finished, tmp_path: Path) -> None:
    path = tmp_path / "vlm.yaml"
    path.write_text(recipes.to_yaml(RECIPE))
    code, out, err = aegis("pretrain", path, "--out", tmp_path / "vlm", "--json")
    report = json.loads(out)
    assert code == 0 and report["families"] == finished[0].families and "pretrain: 5/5 steps" in err
    code, out, err = aegis("pretrain", path, "--out", tmp_path / "vlm")
    assert (code, out) == (2, "") and "--resume" in err
    code, out, _ = aegis("pretrain", path, "--out", tmp_path / "vlm", "--resume")
    assert code == 0 and "where" in out


# --- with easy-VQA ------------------------------------------------------------------------------


EASY = replace(RECIPE, name="easy", easy_vqa=3)


@pytest.fixture(scope="module")
def finished_easy(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[vlm.PretrainReport, list[Progress], Path]:
    out, events = tmp_path_factory.mktemp("pretrain") / "easy", []
    return vlm.run(EASY, out, on_event=events.append), events, out


def test_easy_vqa_adds_its_words_its_figures_and_nothing_else(finished, finished_easy) -> None:
    report, events, out = finished_easy
    model, provenance = load_file(out / "model.safetensors")
    assert model.tokenizer.vocabulary == (*SPECIAL, *wide_vocabulary())
    asked = sets.read("easy-vqa").choose("probe", 21, 0).sized(64)
    graded = grade(model.answers, asked, 8)
    assert report.easy_vqa is not None and report.easy_vqa.questions == 21
    assert report.easy_vqa.accuracy == score(graded).accuracy
    assert provenance["easy-vqa"] == dataclasses.asdict(report.easy_vqa)
    assert set(provenance) == {*load_file(finished[2] / "model.safetensors")[1], "easy-vqa"}
    steps = [e for e in events if e.stage == "pretrain"]
    assert [e.done for e in steps if "easy-vqa" in e.metrics] == [2, 4]
    assert finished[0].easy_vqa is None


def test_a_resumed_run_with_easy_vqa_ends_with_the_same_bytes(
    finished_easy, tmp_path: Path
) -> None:
    with pytest.raises(Stop):
        vlm.run(EASY, tmp_path, on_event=stop_at(4))
    vlm.run(EASY, tmp_path, resume=True)
    for name in ("model.safetensors", "state.safetensors"):
        assert (tmp_path / name).read_bytes() == (finished_easy[2] / name).read_bytes()


def test_every_training_question_of_easy_vqa_is_in_one_row_with_its_picture() -> None:
    asked = sets.read("easy-vqa").choose("train", 10**6, 0).sized(64)
    rows = whole_easy_training()
    assert max(map(len, rows.questions)) <= vlm.BLOCKS and min(map(len, rows.questions)) >= 1
    assert (rows.cells == vlm.UNKNOWN_CELL).all() and rows.cells.shape == (len(rows.images), 64)
    assert sorted(q.id for own in rows.questions for q in own) == sorted(
        q.id for q in asked.questions
    )
    image_of = dict(zip((q.id for q in asked.questions), asked.image_of))
    for row in range(0, len(rows.images), 500):
        images = {image_of[q.id] for q in rows.questions[row]}
        assert len(images) == 1
        np.testing.assert_array_equal(rows.images[row], asked.images[np.array([*images])][0])


def test_cells_are_learned_from_scenes_alone() -> None:
    run = vlm._build(replace(EASY, scenes=8), ignore)
    gradients = []
    for rows in (np.array([6, 7]), np.array([6, 7, 8, 9, 10])):  # the scenes come first
        run.cell_head.zero_grad()
        vlm._loss(run, rows, np.zeros(len(rows), bool)).backward()
        gradients.append(run.cell_head.weight.grad)
    assert gradients[0].abs().sum() > 0
    torch.testing.assert_close(gradients[0], gradients[1])


# --- from learned weights ------------------------------------------------------------------------


def test_a_run_begins_with_learned_weights_and_draws_those_of_new_words(finished) -> None:
    start = load_file(finished[2] / "model.safetensors")[0]
    begun = vlm._build(replace(EASY, start=str(finished[2])), ignore).model
    drawn = vlm._build(EASY, ignore).model
    here, there = begun.tokenizer.vocabulary, start.tokenizer.vocabulary
    for row, word in enumerate(here):
        source = start.words.weight[there.index(word)] if word in there else drawn.words.weight[row]
        torch.testing.assert_close(begun.words.weight[row], source, rtol=0, atol=0)
    state, expected = begun.state_dict(), start.state_dict()
    for name in state.keys() - {"words.weight"}:
        torch.testing.assert_close(state[name], expected[name], rtol=0, atol=0)


def test_a_run_from_learned_weights_resumes_to_the_same_bytes(finished, tmp_path: Path) -> None:
    recipe = replace(EASY, start=str(finished[2]))
    vlm.run(recipe, tmp_path / "whole")
    with pytest.raises(Stop):
        vlm.run(recipe, tmp_path / "cut", on_event=stop_at(4))
    vlm.run(recipe, tmp_path / "cut", resume=True)
    whole, cut = (tmp_path / name / "model.safetensors" for name in ("whole", "cut"))
    assert whole.read_bytes() == cut.read_bytes()


@pytest.mark.parametrize(("start", "says"), [("embedded", "start: embedded"), ("typo", "typo")])
def test_a_start_that_does_not_fit_is_refused_before_any_work(
    start: str, says: str, tmp_path: Path
) -> None:
    events: list[Progress] = []
    with pytest.raises(AegisError, match=says):
        vlm.run(replace(RECIPE, start=start), tmp_path, on_event=events.append)
    assert not events


def test_digests_are_older_than_the_keys_of_easy_vqa_and_of_a_start() -> None:
    values = dataclasses.asdict(RECIPE)
    del values["easy_vqa"], values["start"]
    assert recipes.digest(RECIPE) == hashlib.sha256(canonical(values).encode()).hexdigest()
    assert len({recipes.digest(r) for r in (RECIPE, EASY, replace(RECIPE, start="x"))}) == 3


@pytest.mark.parametrize("name", ["pretrain-embedded", "pretrain-embedded-easy"])
def test_the_recipe_that_ships_loads(name: str) -> None:
    recipe = recipes.load(
        Path(__file__).parent.parent.parent / "recipes" / f"{name}.yaml",
        kind=PretrainRecipe,
    )
    assert recipe.probe_questions >= 5000 and recipe.model.width % recipe.model.heads == 0
