"""Asking a real VLM about drawn scenes gives one warning, and the stage continues."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from samples.command import refused
from samples.small_run import recipe, write
from samples.vqa_files import write_jsonl

from aegis_cli.cli import advice
from aegis_cli.common import artifacts
from aegis_cli.core import moment_sums
from aegis_cli.core.moment_sums import TraceOnly
from aegis_cli.recipes import Anchor, Cotrain, Insulate, Nullspace, Probe, StudyRecipe, shipped
from aegis_cli.recipes.studies import PolicyVariant
from aegis_cli.recipes.study_cells import load

Said = Callable[[], str]


@pytest.fixture
def real(tmp_path: Path) -> str:
    """A folder that looks like a model from the hub; nothing in it is loaded."""
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "config.json").write_text('{"model_type": "paligemma"}')
    return str(folder)


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    return lambda: capsys.readouterr().err


def test_a_real_model_is_warned_of_scenes_alone(real: str, said: Said, tiny_folder: Path) -> None:
    advice.of_questions(real, "scenes")
    text = said()
    assert text.startswith("warning: 'scenes'") and "VQAv2" in text and text.count("\n") == 1
    for model, name in ((real, "questions.jsonl"), (str(tiny_folder), "scenes"), ("none", None)):
        advice.of_questions(model, name)
    assert said() == ""


@pytest.mark.parametrize("own", [10, 3])  # the first is the default
def test_a_key_that_has_no_effect_any_more_is_told(
    own: int, said: Said, tiny_folder: Path, tmp_path: Path
) -> None:
    plain = recipe(tiny_folder)
    advice.of_settings(plain)
    assert said() == ""
    advice.of_settings(plain, [f"train.leak_every={own}"])
    text = said()
    assert "train.leak_every has no effect any more" in text and text.count("\n") == 1
    advice.of_settings(replace(plain, train=replace(plain.train, leak_energy=0.5)))
    assert "train.leak_energy has no effect any more" in said()
    path = tmp_path / "study.yaml"
    shared = f"{{backbone: {tiny_folder}, train: {{leak_every: {own}}}, anchor: {{vqa: x.jsonl}}"
    text = f"kind: study\nname: s\ntasks: [reach]\nseeds: [0]\nshared: {shared}, "
    path.write_text(text + "probe: {vqa: x.jsonl}}\nvariants:\n  a: {method: naive}\n")
    advice.of_run(load(path))
    assert said().count("train.leak_every has no effect any more") == 1


def test_a_recipe_is_warned_of_what_it_asks(real: str, said: Said) -> None:
    fine = replace(recipe(real), anchor=Anchor(vqa="x.jsonl"), probe=Probe(vqa="x.jsonl"))
    advice.of_run(fine)
    assert said() == ""
    for asking in (
        replace(fine, probe=Probe(vqa=("x.jsonl", "scenes"))),
        replace(fine, anchor=Anchor()),
        replace(fine, train=replace(fine.train, method="cotrain"), cotrain=Cotrain()),
    ):
        advice.of_run(asking)
        assert said().count("warning") == 1


def test_a_study_is_warned_of_once(real: str, said: Said) -> None:
    variants = {"a": PolicyVariant(method="naive"), "b": PolicyVariant(method="aegis")}
    shared = {"backbone": real}
    advice.of_run(StudyRecipe("s", (0, 1), variants, ("reach",), shared))
    assert said().count("warning") == 1


def test_a_training_is_warned_of_its_anchor(
    real: str, said: Said, anchor_file: Path, tmp_path: Path
) -> None:
    advice.of_training(recipe(real), anchor_file)
    assert "warning" in said()
    found = artifacts.load(anchor_file)
    path = tmp_path / "other.safetensors"
    artifacts.save(path, "anchor", found.tensors, meta={**found.header.meta, "vqa": "x.jsonl"})
    advice.of_training(recipe(real), path)
    assert said() == ""
    advice.of_training(recipe(real), tmp_path / "missing")
    assert said() == ""


def test_a_rate_that_never_falls_is_warned_of(said: Said) -> None:
    for steps, warmup, warned in ((4, 3, ""), (4, 4, "rates at 100 %"), (4, 100, "rates at 4 %")):
        advice.of_settings(recipe("embedded", steps=steps, warmup=warmup))
        text = said()
        assert warned in text and text.count("warning: train.warmup") == bool(warned)


def test_a_constant_rate_is_warned_of_where_it_is_never_reached(said: Said) -> None:
    for warmup, warned in ((4, ""), (8, "with the learning rates at 50 % of their peaks. Set")):
        advice.of_settings(recipe("embedded", steps=4, warmup=warmup, schedule="constant"))
        text = said()
        assert warned in text and text.count("warning: train.warmup") == bool(warned)


def test_a_threshold_that_another_replaces_is_warned_of(said: Said) -> None:
    both = replace(recipe("embedded"), nullspace=Nullspace(soft=1e-3, energy=0.9))
    advice.of_settings(both, methods=("naive", "nullspace"))
    assert "nullspace.soft: 0.001 changes nothing" in said()
    advice.of_settings(both)  # naive alone
    advice.of_settings(replace(both, nullspace=Nullspace(energy=0.9)), methods=("nullspace",))
    assert said() == ""


@pytest.mark.parametrize(
    ("given", "methods", "warned"),
    [
        ("train.backbone_lr=1e-3", ("stop-gradient",), True),
        ("train.backbone_lr=1e-3", ("stop-gradient", "naive"), False),
        ("train.expert_lr=1e-3", ("stop-gradient",), False),
        ("train.backbone_until=0.5", ("stop-gradient",), True),
        ("train.optimizer=sgd", ("stop-gradient",), True),
        ("train.optimizer=sgd", ("naive",), False),
        ("kfac.weight=1", ("naive", "nullspace"), True),
        ("kfac.weight=1", ("naive", "kfac"), False),
        ("moe_adapters.rank=2", ("moe-adapters",), False),
    ],
)
def test_a_key_that_no_method_reads_is_warned_of_where_it_is_given(
    given: str, methods: tuple[str, ...], warned: bool, said: Said
) -> None:
    advice.of_settings(recipe("embedded"), [given], methods)
    text = said()
    assert ("changes nothing: " + " and ".join(methods) in text) == warned
    assert bool(text) == warned


def test_what_shares_a_training_among_processes_is_warned_of_in_one(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    for processes, warned in ((1, True), (2, False)):
        monkeypatch.setenv("WORLD_SIZE", str(processes))
        advice.of_settings(recipe("embedded"), ["train.parallel=fsdp"])
        assert ("train.parallel changes nothing in one process" in said()) == warned


def test_questions_that_nothing_is_trained_on_are_warned_of(said: Said) -> None:
    unread = replace(recipe("embedded"), insulate=Insulate(questions=9, batch_size=2))
    advice.of_settings(unread, methods=("insulate",))
    text = said()
    assert "insulate.questions: 9 changes nothing" in text and "questions and batch_size" in text
    advice.of_settings(unread, methods=("naive",))
    weighed = replace(unread.insulate, vqa_weight=0.1)
    advice.of_settings(replace(unread, insulate=weighed), methods=("insulate",))
    assert said() == ""


def test_a_training_tells_of_settings_and_goes_on(
    aegis: Callable[..., tuple[int, str, str]], tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    small = write(tmp_path, tiny_folder)
    given = ("--set", "train.warmup=9", "--set", "kfac.weight=1")
    code, _, err = aegis("train", small, "--demos", demos_file, "--out", tmp_path / "run", *given)
    assert code == 0
    assert err.count("warning: train.warmup: 9") == err.count("warning: --set kfac.weight") == 1


def test_the_commands_warn_and_go_on(
    aegis: Callable[..., tuple[int, str, str]],
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    folder = hf_folder("paligemma")
    code, _, err = aegis("probe", folder, "--questions", "7", "--json")
    assert code == 0 and err.count("warning: 'scenes'") == 1
    lines = write_jsonl(tmp_path, 12)
    code, _, err = aegis("probe", folder, "--vqa", lines, "--questions", "7", "--json")
    assert code == 0 and "warning: 'scenes'" not in err
    anchor = ("anchor", "--backbone", folder, "--parts", "moments", "--samples", "7")
    code, _, err = aegis(*anchor, "--out", tmp_path / "anchor.safetensors")
    assert code == 0 and err.count("warning: 'scenes'") == 1


@pytest.mark.parametrize(
    ("questions", "options", "warned"),
    [("easy-vqa", (), 1), ("easy-vqa", ("--temperature", "4"), 0), ("scenes", (), 0)],
)
def test_the_embedded_vlm_is_sure_of_easy_vqa(
    aegis: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
    questions: str,
    options: tuple[str, ...],
    warned: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Measuring the rest of a map's inputs takes seconds and is not used here.
    monkeypatch.setattr(moment_sums, "make", lambda width, at, *_: TraceOnly(width, at))
    asked = ("anchor", "--backbone", "embedded-easy", "--vqa", questions, "--samples", "60")
    out = tmp_path / "anchor.safetensors"
    code, _, err = aegis(*asked, "--parts", "curvature", "--out", out, *options)
    assert code == 0 and err.count("--temperature 4") == warned
    temperature = 4 if options else None
    assert artifacts.read_header(out).meta.get("temperature") == temperature


def test_a_model_that_is_missing_has_one_error(aegis: Callable[..., tuple[int, str, str]]) -> None:
    assert "warning" not in refused(aegis("probe", "./nowhere"))


@pytest.mark.parametrize("name", ["paligemma2-libero", "smolvla-style"])
def test_recipes_for_real_models_name_real_questions(name: str) -> None:
    found = load(shipped.path(name))
    assert "scenes" not in (found.anchor.vqa, found.probe.vqa)
