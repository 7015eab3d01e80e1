"""Pre-training of the dual encoder: resumes to the same bytes, and reports honest results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, ignore
from aegis_cli.data.streams import corpus, embedded
from aegis_cli.evaluation import zero_shot
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded_dual import load_file
from aegis_cli.pretraining import dual
from aegis_cli.recipes import DualRecipe, Towers

RECIPE = DualRecipe(
    name="dual",
    pictures=40,
    tasks=("shapes", "digits"),
    steps=5,
    batch_size=8,
    warmup=1,
    precision="float32",
    checkpoint_every=2,
    towers=Towers(width=32, depth=1, text_depth=1, heads=2),
)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


def shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(dual, "VALIDATION_PICTURES", 30)
    patch.setattr(embedded, "COUNTS", {"train": 8, "validation": 17, "test": 8})


@pytest.fixture(scope="module")
def finished(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[dual.DualReport, list[Progress], Path]:
    out, events = tmp_path_factory.mktemp("pretrain") / "dual", []
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        return dual.run(RECIPE, out, on_event=events.append), events, out


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


def test_a_resumed_run_ends_with_the_same_bytes(finished, tmp_path: Path) -> None:
    def stop(event: Progress) -> None:
        if event.stage == "pretrain" and event.done == 4:
            raise Stop

    with pytest.raises(Stop):
        dual.run(RECIPE, tmp_path, on_event=stop)  # the checkpoint of step 2 is the last
    assert artifacts.read_header(tmp_path / "state.safetensors").meta["step"] == 2
    events: list[Progress] = []
    dual.run(RECIPE, tmp_path, resume=True, on_event=events.append)
    assert [e.done for e in events if e.stage == "pretrain"] == [2, 3, 4, 5]
    for name in ("model.safetensors", "state.safetensors"):
        assert (tmp_path / name).read_bytes() == (finished[2] / name).read_bytes()


def test_provenance_is_what_the_written_weights_score(finished) -> None:
    report, events, out = finished
    model, provenance = load_file(out / "model.safetensors")
    tasks = [embedded.task(name, 48, out / "stream", ignore) for name in RECIPE.tasks]
    scores = {task.name: zero_shot.accuracy(model, task, task.validation) for task in tasks}
    assert provenance == {
        "recipe_sha256": recipes.digest(RECIPE),
        "seed": 0,
        "steps": 5,
        "zero_shot": scores,
        "accuracy": sum(scores.values()) / 2,
        "image_to_text": report.image_to_text,
        "text_to_image": report.text_to_image,
    }
    assert (report.zero_shot, report.accuracy, report.steps) == (scores, provenance["accuracy"], 5)
    assert report.parameters == sum(p.numel() for p in model.parameters())
    assert [(e.done, e.total) for e in events if e.stage == "pretrain"] == [
        (i, 5) for i in range(6)
    ]
    header = artifacts.read_header(out / "model.safetensors")
    assert {spec.dtype for spec in header.tensors.values()} == {
        "bfloat16"
    } and header.kind == "dual-encoder"
    assert header.fingerprint == model.fingerprint() == backbones.load_dual(str(out)).fingerprint()


def test_training_moves_the_loss(tmp_path: Path) -> None:
    events: list[Progress] = []
    dual.run(replace(RECIPE, pictures=8, steps=40, lr=1e-2), tmp_path, on_event=events.append)
    losses = [e.metrics["loss"] for e in events if e.stage == "pretrain" and e.done]
    assert len(losses) == 40
    assert sum(losses[-4:]) < 0.75 * sum(losses[:4])


@pytest.mark.parametrize("seed", range(4))
def test_the_loss_is_least_where_positives_win_and_no_others_count_against_them(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    positive = torch.eye(6, dtype=torch.bool) | (torch.rand(6, 6, generator=generator) < 0.3)
    true = positive.float()
    entropy = [
        -(t * t.clamp(min=1e-9).log()).sum(1).mean()
        for t in (true / true.sum(1, keepdim=True), (true / true.sum(0)).T)
    ]
    best = dual.contrastive(torch.where(positive, 0.0, -1e4), positive)
    logits = torch.randn(6, 6, generator=generator)
    assert best <= dual.contrastive(logits, positive)
    unique = torch.eye(6, dtype=torch.bool)
    by_hand = (
        sum(torch.nn.functional.cross_entropy(x, torch.arange(6)) for x in (logits, logits.T)) / 2
    )
    torch.testing.assert_close(
        dual.contrastive(logits, unique), by_hand
    )  # equal to CLIP's own if each has one
    if (true.sum(1) == true.sum(1)[0]).all() and (true.sum(0) == true.sum(0)[0]).all():
        torch.testing.assert_close(best, sum(entropy) / 2)
    doubled = torch.cat(
        [positive, positive], dim=1
    )  # each caption twice: twice as many positives, and none of them is a negative
    costs = [dual.contrastive(torch.where(p, 0.0, -1e4), p) for p in (positive, doubled)]
    assert float(costs[1] - costs[0]) == pytest.approx(np.log(2) / 2, rel=1e-4)


def test_equal_captions_are_no_negatives_of_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is drawn, the positives are all true captions, not only the drawn ones."""
    seen: list[torch.Tensor] = []
    monkeypatch.setattr(
        dual, "contrastive", lambda logits, positive: seen.append(positive) or logits.sum() * 0
    )
    run = dual._build(replace(RECIPE, pictures=40), ignore)
    solid = np.flatnonzero(run.pictures.facts[:, 0] == list(corpus.KINDS).index("solids"))[0]
    dual._loss(
        run, np.full(16, solid), np.random.default_rng(0)
    )  # one picture, with three true captions
    assert seen[0].shape == (16, 3) and seen[0].all()
    dual._loss(run, np.arange(40), np.random.default_rng(0))
    assert seen[1].any(0).all() and seen[1].any(1).all() and not seen[1].all()


def test_an_earlier_run_and_another_recipe(finished) -> None:
    before = {p.name: p.read_bytes() for p in finished[2].glob("*.safetensors")}
    with pytest.raises(AegisError, match="from an earlier run") as caught:
        dual.run(RECIPE, finished[2])
    assert "--resume" in caught.value.fix
    for change, key in (
        ({"seed": 1}, "seed"),
        ({"steps": 6}, "steps"),
        ({"towers": Towers(width=64)}, "towers.width"),
    ):
        with pytest.raises(AegisError, match=rf"another recipe: .*{key}: \d+ there, \d+ here"):
            dual.run(replace(RECIPE, **change), finished[2], resume=True)
    assert {p.name: p.read_bytes() for p in finished[2].glob("*.safetensors")} == before


def test_a_loss_that_is_not_finite_stops_with_the_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses = iter([1.0, 1.0, 1.0, float("nan")])
    real = dual._loss
    monkeypatch.setattr(dual, "_loss", lambda *args: real(*args) * next(losses))
    with pytest.raises(AegisError, match="loss nan at step 3"):
        dual.run(RECIPE, tmp_path)
    assert artifacts.load(tmp_path / "state.safetensors", "training-state").header.meta["step"] == 2
    assert not (tmp_path / "model.safetensors").exists()


def test_through_the_command_line(aegis, finished, tmp_path: Path) -> None:
    path = tmp_path / "dual.yaml"
    path.write_text(recipes.to_yaml(RECIPE))
    code, out, err = aegis("pretrain", path, "--out", tmp_path / "x", "--json")
    assert (
        code == 0
        and json.loads(out)["zero_shot"] == finished[0].zero_shot
        and "pretrain: 5/5 steps" in err
    )
    code, out, err = aegis("pretrain", path, "--out", tmp_path / "x")
    assert (code, out) == (2, "") and "--resume" in err
    code, out, _ = aegis("pretrain", path, "--out", tmp_path / "x", "--resume")
    assert code == 0 and "shapes" in out and "image to text" in out


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            "model.safetensors",
            ("dual-encoder", "image_to_text", "recipe_sha256", "shapes 0.", "text_depth 1"),
        ),
        (
            "stream/shapes.safetensors",
            ("stream-task", "crescent", "a photo of a {}", "train 8, validation 17", "48 x 48"),
        ),
    ],
)
def test_inspect_says_what_the_files_are(
    file: str, words: tuple[str, ...], finished, aegis
) -> None:
    code, out, _ = aegis("inspect", finished[2] / file, "--tensors")
    assert code == 0 and [word for word in words if word not in " ".join(out.split())] == [], out


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("tasks=[colours]", ("'colors'", "tasks")),
        ("pictures=0", ("pictures", "above 0")),
        ("towers.heads=3", ("towers.width", "divide")),
        ("scenes=9", ("'scenes'", "pictures")),
        ("towers.text_deph=1", ("'towers.text_depth'",)),
    ],
)
def test_bad_keys_are_one_error(setting: str, says: tuple[str, ...], aegis, tmp_path: Path) -> None:
    path = tmp_path / "dual.yaml"
    path.write_text(recipes.to_yaml(RECIPE))
    code, out, err = aegis("pretrain", path, "--out", tmp_path / "x", "--set", setting)
    assert (
        (code, out) == (2, "")
        and "Traceback" not in err
        and [w for w in says if w not in err] == []
    )
    assert not (tmp_path / "x").exists()
