"""Questions asked during training: they show what is lost, and training is unchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from samples.training_runs import (
    SETTINGS,
    STEPS,
    TIMES,
    Start,
    Told,
    assert_resumes,
    metrics,
    stop_at,
    told,
)
from samples.vqa_files import write_jsonl

from aegis_cli import recipes
from aegis_cli.common import files
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.metrics import drop_interval, score
from aegis_cli.evaluation import kept_figures
from aegis_cli.inspection import folders
from aegis_cli.models import backbones
from aegis_cli.models.asking import ask
from aegis_cli.recipes import Kfac, Nullspace, Probe, Recipe
from aegis_cli.reporting import gather
from aegis_cli.training import checkpoint, dry_run, validation_vqa

COUNT = 21
FIGURES = {f"vqa_{name}" for name in validation_vqa._FIGURES}


@pytest.fixture(scope="module")
def asking(recipe: Recipe) -> Recipe:
    """Constraints of `nullspace` and `kfac` cover four steps, and a validation falls within."""
    return replace(
        recipe,
        probe=Probe(while_training=COUNT, seed=3, batch_size=8),
        nullspace=Nullspace(every=4),
        kfac=Kfac(every=4),
    )


def without(recipe: Recipe) -> Recipe:
    return replace(recipe, probe=replace(recipe.probe, while_training=None))


@pytest.fixture(scope="module")
def asked_run(asking: Recipe, start: Start, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """A run of `naive` that asks."""
    return told(start, "naive", asking, tmp_path_factory.mktemp("asked") / "run")


@pytest.mark.parametrize("method", ["naive", "nullspace", "kfac", "lora", "aegis"])
def test_training_does_not_notice_the_questions(
    method: str,
    asking: Recipe,
    asked_run: Told,
    whole_run: Callable[[str], Path],
    start: Start,
    tmp_path: Path,
) -> None:
    asked, plain = tmp_path / "asked", tmp_path / "plain"
    if method == "naive":
        asked = asked_run.out
    else:
        start(method, asked, recipe=asking)
    if method in ("nullspace", "kfac"):  # whose settings are not those of other tests
        start(method, plain, recipe=without(asking))
    else:
        plain = whole_run(method)
    assert metrics(asked, TIMES | FIGURES) == metrics(plain, TIMES)
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        one, other = (checkpoint.last(run) / name for run in (asked, plain))
        assert one.read_bytes() == other.read_bytes()


def asked_of(model: str, recipe: Recipe, name: str = "scenes") -> list[Any]:
    """The answers of a run or a backbone to the validation questions of one set."""
    backbone = backbones.load(model)
    source = sets.read(name, ask=recipe.probe.ask)
    asked = source.choose("validation", COUNT, recipe.probe.seed, [backbone.check_text])
    return ask(backbone, asked, 64)


@pytest.mark.parametrize(
    ("method", "changes"),
    [  # `lora`'s terms are merged, and averaged; it does not affect how batches are processed
        *(("naive", each) for each in ({}, {"ema_decay": 0.6}, {"accumulate": 2})),
        *(("lora", each) for each in ({}, {"ema_decay": 0.6})),
    ],
    ids=str,
)
def test_the_figures_are_those_of_the_checkpoint(
    method: str, changes: dict[str, Any], asking: Recipe, start: Start, tmp_path: Path
) -> None:
    own = replace(asking, train=replace(SETTINGS, **changes))
    report = start(method, tmp_path / "run", recipe=own)
    before, after = (asked_of(str(m), own) for m in (own.backbone, tmp_path / "run"))
    line = metrics(tmp_path / "run")[-1]
    low, high = drop_interval(before, after)
    wanted = {
        "accuracy": score(after).accuracy,
        "cross_entropy": score(after).cross_entropy,
        "drop_points": 100 * (score(before).accuracy - score(after).accuracy),
        "drop_interval": [100 * low, 100 * high],
    }
    found = report.validation_vqa["scenes"]
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=1e-5, abs=1e-9), name
    assert score(after).cross_entropy != pytest.approx(score(before).cross_entropy, rel=1e-4)
    assert {key for key in line if key.startswith("vqa_")} == FIGURES


@pytest.mark.parametrize("knows", [False, True])
def test_a_model_that_has_nothing_to_lose_is_warned_of_before_the_first_step(
    knows: bool, asking: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if knows:

        def right(*given: Any) -> list[Any]:
            return [replace(graded, correct=True) for graded in ask(*given)]

        monkeypatch.setattr(validation_vqa, "ask", right)
    events: list[Event] = []
    start("naive", tmp_path / "run", recipe=asking, on_event=events.append)
    first = next(n for n, e in enumerate(events) if isinstance(e, Progress) and e.stage == "train")
    found = [n for n, e in enumerate(events) if isinstance(e, Warned) and "hardly lose" in e.text]
    assert len(found) == (not knows) and all(number < first for number in found)


def test_they_are_asked_with_every_validation_loss_and_no_other_time(asked_run: Told) -> None:
    events = asked_run.events
    for line in metrics(asked_run.out):
        assert ("validation_loss" in line) == FIGURES.issubset(line)
    before = [e for e in events if getattr(e, "stage", "") == "VQA before training"]
    assert [e.done for e in before if isinstance(e, Progress)] == [0, 8, 16, COUNT]
    shown = [e.metrics.get("VQA drop") for e in events if isinstance(e, Progress)]
    last = metrics(asked_run.out)[-1]
    assert shown[-1] == last["vqa_drop_points"]


@pytest.mark.parametrize(("method", "times"), [("stop-gradient", 1), ("lora", 3)])
def test_a_model_that_stands_still_is_asked_once(
    method: str,
    times: int,
    asking: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[object] = []

    def counted(*given: Any) -> Any:
        asked.append(given)
        return ask(*given)

    monkeypatch.setattr(validation_vqa, "ask", counted)
    report = start(method, tmp_path / "run", recipe=asking)
    assert len(asked) == times
    wanted = score(asked_of(str(tmp_path / "run"), asking)).cross_entropy
    assert report.validation_vqa["scenes"]["cross_entropy"] == pytest.approx(wanted, rel=1e-5)


def test_a_run_goes_on_with_the_same_answers_before(
    asking: Recipe, asked_run: Told, start: Start, tmp_path: Path
) -> None:
    assert_resumes(start, "naive", asking, tmp_path, asked_run.out)
    events: list[Event] = []
    report = start("naive", tmp_path / "cut", recipe=asking, resume=True, on_event=events.append)
    # A finished run reports its figures and asks nothing.
    assert not [e for e in events if "VQA" in getattr(e, "stage", "")]
    accuracy = metrics(asked_run.out)[-1]["vqa_accuracy"]
    assert report.validation_vqa["scenes"]["accuracy"] == accuracy


def test_a_run_may_begin_or_cease_to_ask_when_it_goes_on(
    asking: Recipe, asked_run: Told, start: Start, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(4, KeyboardInterrupt())
        start("naive", tmp_path / "run", recipe=without(asking), on_event=stop)
    start("naive", tmp_path / "run", recipe=asking, resume=True)
    one, other = (metrics(out, TIMES)[-1] for out in (tmp_path / "run", asked_run.out))
    assert one == other
    assert recipes.load(tmp_path / "run" / "recipe.yaml", kind=Recipe).probe.while_training


def test_each_set_has_figures_of_its_own(asking: Recipe, start: Start, tmp_path: Path) -> None:
    path = write_jsonl(tmp_path, images=60)
    own = replace(asking, probe=replace(asking.probe, vqa=("scenes", str(path))))
    report = start("naive", tmp_path / "run", recipe=own)
    assert list(report.validation_vqa) == ["scenes", str(path)]
    line = metrics(tmp_path / "run")[-1]
    assert {f"{name}_2" for name in FIGURES} < line.keys()
    second = score(asked_of(str(tmp_path / "run"), own, str(path)))
    assert line["vqa_cross_entropy_2"] == pytest.approx(second.cross_entropy, rel=1e-5)


def test_inspect_and_the_page_tell_them(asked_run: Told, tmp_path: Path) -> None:
    run, report = asked_run.out, asked_run.report
    found = folders.inspect(run)
    assert found.facts["validation_vqa"] == report.validation_vqa
    early = folders.inspect(run / "checkpoints" / "000004")
    line = metrics(run)[SETTINGS.validate_every - 1]
    told = early.facts["validation_vqa"]["scenes"]
    assert told["cross_entropy"] == line["vqa_cross_entropy"]
    # `aegis run` keeps the report, and reads it later for its page.
    files.save_json(tmp_path / "train.json", report.to_json())
    kept = kept_figures.read(tmp_path / "train.json", kept_figures.TrainFigures)
    assert kept["validation_vqa"] == report.validation_vqa
    drawn = gather.run_document(run).metrics
    assert [at["step"] for at in drawn if "vqa_drop_points" in at] == [3, STEPS]


@pytest.mark.parametrize(
    ("family", "changes"),
    [  # weights in any module can have masters; checkpointing, and computing in bf16
        ("smolvlm", {"weights": "bf16-master"}),
        ("smolvlm", {"weights": "bf16-master", "freeze": "vision"}),
        ("smolvlm", {"gradient_checkpointing": True}),
        ("smolvlm", {"weights": "bf16"}),
        ("qwen2_5_vl", {"gradient_checkpointing": True}),
        ("qwen2_5_vl", {"weights": "bf16"}),
    ],
    ids=str,
)
def test_models_of_the_hub_are_asked_too(
    family: str,
    changes: dict[str, Any],
    asking: Recipe,
    start: Start,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    settings = replace(SETTINGS, steps=2, validate_every=2, **changes)
    own = replace(asking, backbone=str(hf_folder(family)), train=settings)
    start("naive", tmp_path / "run", recipe=own, anchor=None)
    found = metrics(tmp_path / "run")[-1]["vqa_cross_entropy"]
    wanted = score(asked_of(str(tmp_path / "run"), own)).cross_entropy
    assert found == pytest.approx(wanted, rel=1e-2 if "weights" in changes else 1e-4)


@pytest.mark.parametrize(("limit", "times"), [(0.0, 1), (100.0, 0), (None, 0)])
def test_more_than_the_recipe_allows_is_said_once(
    limit: float | None,
    times: int,
    asking: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    figures = validation_vqa.ValidationQuestions.figures

    def lost(*given: Any) -> dict[str, float]:
        return figures(*given) | {"vqa_drop_points": 7.125}

    monkeypatch.setattr(validation_vqa.ValidationQuestions, "figures", lost)
    own = replace(asking, probe=replace(asking.probe, max_drop=limit))
    events: list[Event] = []
    start("naive", tmp_path / "run", recipe=own, on_event=events.append)
    said = [e.text for e in events if isinstance(e, Warned) and "points of VQA" in e.text]
    assert len(said) == times
    for text in said:
        assert "after step 3 7.12 points" in text and "'scenes'" in text
        assert "probe.max_drop allows 0" in text


def drops(monkeypatch: pytest.MonkeyPatch, by_validation: list[float]) -> None:
    """Replace the measured drops, one for each validation, by these and an interval of 8 points."""
    figures, left = validation_vqa.ValidationQuestions.figures, iter(by_validation)

    def told(*given: Any) -> dict[str, float]:
        drop = next(left)
        ends = {"vqa_drop_low": drop - 4.0, "vqa_drop_high": drop + 4.0}
        return figures(*given) | {"vqa_drop_points": drop} | ends

    monkeypatch.setattr(validation_vqa.ValidationQuestions, "figures", told)


def warnings_of(start: Start, method: str, recipe: Recipe, out: Path) -> list[str]:
    """What a training says of the gate on its validation questions."""
    events: list[Event] = []
    start(method, out, recipe=recipe, on_event=events.append)
    texts = [event.text for event in events if isinstance(event, Warned)]
    return [text for text in texts if "max_drop" in text]


def gated(recipe: Recipe, gate: str, **train: Any) -> Recipe:
    probe = replace(recipe.probe, max_drop=3.0, gate=gate)
    settings = replace(recipe.train, validate_every=2, checkpoint_every=2, **train)
    return replace(recipe, probe=probe, train=settings)


def test_a_vlm_that_cannot_change_loses_nothing_however_few_its_questions(
    asking: Recipe, start: Start, tmp_path: Path
) -> None:
    own = gated(asking, "upper", keep_checkpoints=1)
    assert warnings_of(start, "stop-gradient", own, tmp_path / "run") == []
    told = validation_vqa.of_line(own, metrics(tmp_path / "run")[-1])
    assert validation_vqa.past_limit(own, told)  # the interval alone would not pass


def test_too_few_questions_are_no_loss_and_a_loss_is_said_after_them(
    asking: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drops(monkeypatch, [0.0, 1.0, 7.0])
    few, lost = warnings_of(start, "naive", gated(asking, "upper"), tmp_path / "run")
    assert "after step 2 there are too few answers to tell" in few and "are lost (-" not in few
    assert "-4.00 to 4.00, whose upper end counts (probe.gate: upper)" in few
    assert "probe.while_training" in few
    assert "after step 6 7.00 points of VQA are lost (3.00 to 11.00)" in lost


def test_a_loss_that_is_said_is_not_put_in_doubt_later(
    asking: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drops(monkeypatch, [7.0, 1.0, 1.0])
    (lost,) = warnings_of(start, "naive", gated(asking, "upper"), tmp_path / "run")
    assert "7.00 points of VQA are lost" in lost


@pytest.mark.parametrize(
    ("gate", "found", "kept", "says"),
    [
        ("mean", [5.0, 6.0, 7.0], 1, "at most 3 points of VQA (probe.max_drop): the one"),
        ("upper", [0.0, 0.0, 0.0], 1, " by the upper end of its interval (probe.gate): the"),
        ("mean", [5.0, 2.0, 7.0], 1, None),
        ("mean", [5.0, 6.0, 7.0], None, None),  # all of them are there to choose from
    ],
)
def test_a_run_says_if_no_checkpoint_is_within_the_limit_and_which_is_kept(
    gate: str,
    found: list[float],
    kept: int | None,
    says: str | None,
    asking: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drops(monkeypatch, found)
    own = gated(asking, gate, keep_checkpoints=kept)
    said = warnings_of(start, "naive", own, tmp_path / "run")
    last = [text for text in said if text.startswith("no checkpoint is known")]
    assert len(last) == (says is not None)
    losses = {line["step"]: line.get("validation_loss") for line in metrics(tmp_path / "run")}
    least = min((loss, step) for step, loss in losses.items() if loss is not None)[1]
    for text in last:
        assert says is not None and says in text and f"of step {least}, has the lowest" in text
        assert least in [int(path.name) for path in checkpoint.whole(tmp_path / "run")]


# --- what is refused ------------------------------------------------------------------------------


def test_questions_that_cannot_be_asked_are_refused_before_the_first_step(
    asking: Recipe, start: Start, demos_file: Path, tmp_path: Path
) -> None:
    path = write_jsonl(tmp_path, images=1)
    own = replace(asking, probe=replace(asking.probe, vqa=str(path)))
    with pytest.raises(AegisError, match="no usable question for the validation"):
        start("naive", tmp_path / "run", recipe=own)
    assert not (tmp_path / "run" / "recipe.yaml").exists()
    with pytest.raises(AegisError, match="no usable question for the validation"):
        dry_run.run(own, "naive", demos_file, None, tmp_path / "run")


def test_answers_without_a_likelihood_end_the_run(
    asking: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = validation_vqa.ValidationQuestions.figures

    def broken(*given: Any) -> dict[str, float]:
        return figures(*given) | {"vqa_cross_entropy": float("inf")}

    monkeypatch.setattr(validation_vqa.ValidationQuestions, "figures", broken)
    with pytest.raises(Diverged, match="vqa_cross_entropy"):
        start("naive", tmp_path / "run", recipe=asking)
    assert all("vqa_cross_entropy" not in line for line in metrics(tmp_path / "run"))


@pytest.mark.fast
@pytest.mark.parametrize(
    ("recipe_file", "count", "expected"),
    [
        ("quickstart", 10**8, "at most 10,000,000"),
        ("quickstart", 0, "above 0"),
        ("igsp-robot", 7, "a stream asks its questions after each task"),
    ],
)
def test_numbers_that_cannot_be_asked_are_refused(
    recipe_file: str, count: int, expected: str
) -> None:
    with pytest.raises(AegisError) as refused:
        recipes.load_training(f"recipes/{recipe_file}.yaml", [f"probe.while_training={count}"])
    assert "probe.while_training" in refused.value.found and expected in str(refused.value)
