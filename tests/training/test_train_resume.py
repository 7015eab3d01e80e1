"""Resuming a training, refusing one that must not start, and what a bad step leaves behind."""

from __future__ import annotations

import errno
import math
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples import artifacts as artifact_samples
from samples import lerobot
from samples.tiny import make_tiny
from samples.training_runs import (
    SETTINGS,
    STEPS,
    Start,
    assert_same_run,
    contents,
    stop_at,
)
from samples.vqa_files import write_jsonl
from torch import nn

from aegis_cli import recipes
from aegis_cli.common import artifacts, devices
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, OnEvent, Progress, Warned
from aegis_cli.data.record import run as record
from aegis_cli.methods import METHODS
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Cotrain, Insulate, Lora, Probe, Recipe, Rollout
from aegis_cli.training import checkpoint, folder, loading, step, train

# --- resuming -------------------------------------------------------------------------------------


# Every method resumes from its first checkpoint; those with more state or draws from a later one.
LATER = ("aegis", "cotrain", "ewc", "kfac", "nullspace")
CUTS = [*((method, 3) for method in sorted(METHODS)), *((method, 5) for method in LATER)]


@pytest.mark.parametrize(("method", "interrupted_at"), CUTS)
def test_a_resumed_run_ends_in_the_same_bytes(
    whole_run: Callable[[str], Path],
    start: Start,
    tmp_path: Path,
    method: str,
    interrupted_at: int,
) -> None:
    """The interruption is between two checkpoints, so steps are lost and repeated."""
    with pytest.raises(KeyboardInterrupt):
        start(method, tmp_path, on_event=stop_at(interrupted_at, KeyboardInterrupt()))
    assert checkpoint.last(tmp_path).resolve().name == f"{interrupted_at - 1:06d}"
    torch.manual_seed(99)  # another process has another random state
    start(method, tmp_path, resume=True)
    assert_same_run(tmp_path, whole_run(method))


def test_running_averages_of_a_resumed_run_go_on_from_where_they_were(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No known family has any, but a model from the hub may."""
    load, save = loading.backbones.load, checkpoint.save
    found: dict[str, torch.Tensor] = {}

    def with_averages(name: str) -> Backbone:
        backbone = load(name)
        backbone.stem.norm = nn.BatchNorm2d(3)
        backbone.stem.register_forward_pre_hook(lambda stem, given: stem.norm(*given))
        return backbone

    def saved(folder: Path, step: int, policy: Policy, *rest: Any, **more: Any) -> Path:
        norm = policy.backbone.stem.norm
        assert norm.num_batches_tracked == step  # validation passes do not count
        found[folder.name] = norm.running_mean.clone()  # finally that of the last checkpoint
        return save(folder, step, policy, *rest, **more)

    monkeypatch.setattr(loading.backbones, "load", with_averages)
    monkeypatch.setattr(checkpoint, "save", saved)
    start("naive", tmp_path / "whole", anchor=None)
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(3, KeyboardInterrupt())
        start("naive", tmp_path / "cut", anchor=None, on_event=stop)
    start("naive", tmp_path / "cut", anchor=None, resume=True)
    assert torch.equal(found["whole"], found["cut"])


def test_a_run_interrupted_before_its_first_checkpoint_begins_again(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path, on_event=stop_at(1, KeyboardInterrupt()))
    start("naive", tmp_path, resume=True)
    assert_same_run(tmp_path, naive_run)


@pytest.mark.parametrize("same", [True, False])
def test_a_run_that_goes_on_in_another_precision_says_so(
    same: bool,
    start: Start,
    recipe: Recipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on hardware where `auto` differs; machine.json describes only the start."""
    automatic = replace(recipe, train=replace(recipe.train, precision="auto"))
    monkeypatch.setattr(devices, "multiplies_bf16", lambda _: True)
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(3, KeyboardInterrupt())
        start("naive", tmp_path, recipe=automatic, anchor=None, on_event=stop)
    monkeypatch.setattr(devices, "multiplies_bf16", lambda _: same)
    told: list[Event] = []
    for _ in range(2):  # for a finished run there is nothing to say
        start("naive", tmp_path, recipe=automatic, anchor=None, resume=True, on_event=told.append)
    said = [event.text for event in told if isinstance(event, Warned)]
    assert len(said) == (not same)
    assert same or "products in bf16" in said[0] and "goes on in float32" in said[0]


def test_resuming_a_finished_run_changes_nothing(start: Start, tmp_path: Path) -> None:
    first = start("aegis", tmp_path)
    before = contents(tmp_path)
    assert start("aegis", tmp_path, resume=True) == first
    assert contents(tmp_path) == before


def test_a_run_on_demonstrations_that_have_grown_says_so_and_how_another_begins_with_its_policy(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """More episodes in the same folder are other demonstrations, though the path is the same."""
    made = [replace(e, instruction=lerobot.TEXTS[0]) for e in lerobot.episodes(8)]
    data, run = lerobot.save(tmp_path / "arm", made[:6]), tmp_path / "run"
    train.run(recipe, "naive", data, None, run)
    shutil.rmtree(data)
    lerobot.save(data, made)
    with pytest.raises(AegisError) as caught:
        train.run(recipe, "naive", data, None, run, resume=True)
    assert "arm' have changed since the run" in caught.value.found
    assert f"--set backbone={run} --set expert.start={run}" in caught.value.fix
    begun = replace(recipe, backbone=str(run), expert=replace(recipe.expert, start=str(run)))
    assert warned_of_learned_episodes(begun, data, tmp_path / "next")
    again = replace(begun, backbone=str(tmp_path / "next"))
    again = replace(again, expert=replace(again.expert, start=str(tmp_path / "next")))
    assert not warned_of_learned_episodes(again, data, tmp_path / "after")
    other = replace(again, train=replace(again.train, validation_share=0.4))
    assert warned_of_learned_episodes(other, data, tmp_path / "other")


def warned_of_learned_episodes(recipe: Recipe, data: Path, out: Path) -> bool:
    """Whether a training warns that its policy may have learned from held-out episodes."""
    told: list[Event] = []
    train.run(recipe, "naive", data, None, out, on_event=told.append)
    texts = [event.text for event in told if isinstance(event, Warned)]
    return any("may have learned from episodes that are held out now" in text for text in texts)


def test_a_run_that_is_given_another_camera_says_which_it_began_with(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    made = lerobot.episodes(6, cameras=("top", "side"))
    data = lerobot.save(tmp_path / "arm", [replace(e, instruction=lerobot.TEXTS[0]) for e in made])
    top, side = (replace(recipe, demos=replace(recipe.demos, camera=c)) for c in ("top", "side"))
    train.run(top, "naive", data, None, tmp_path / "run")
    with pytest.raises(AegisError, match="demos.camera: top there, side here"):
        train.run(side, "naive", data, None, tmp_path / "run", resume=True)


def test_resume_without_a_run_begins_one(naive_run: Path, start: Start, tmp_path: Path) -> None:
    start("naive", tmp_path / "new", resume=True)
    assert_same_run(tmp_path / "new", naive_run)


def test_checkpoints_without_their_link_are_not_begun_anew(start: Start, tmp_path: Path) -> None:
    """As after a copy with a tool that leaves out links."""
    start("naive", tmp_path)
    link = tmp_path / "checkpoints" / "last"
    for target in (None, "000005"):  # no link, and one to a missing target
        link.unlink(missing_ok=True)
        if target is not None:
            link.symlink_to(target)
        error = refused("3 checkpoints", start, "naive", tmp_path, resume=True)
        assert f"ln -sfn 000006 '{link}'" in error.fix
    link.unlink()
    link.symlink_to("000006")
    assert start("naive", tmp_path, resume=True).steps == STEPS


def test_the_newest_checkpoint_is_that_of_most_steps_however_many_digits_it_has(
    start: Start, tmp_path: Path
) -> None:
    start("naive", tmp_path)
    folder = tmp_path / "checkpoints"
    link, older, newer = folder / "last", folder / "999998", folder / "1000000"
    (folder / "000004").rename(older)
    (folder / "000006").rename(newer)
    assert checkpoint.whole(tmp_path) == [folder / "000002", older, newer]
    link.unlink()
    error = refused("3 checkpoints", start, "naive", tmp_path, resume=True)
    assert f"ln -sfn 1000000 '{link}'" in error.fix
    link.symlink_to(newer.name)
    (newer / checkpoint.STATE).write_bytes(b"")
    error = refused("truncated", start, "naive", tmp_path, resume=True)
    assert f"ln -sfn 999998 '{link}'" in error.fix


# --- refusals -------------------------------------------------------------------------------------


def refused(found: str, start: Start, method: str, out: Path, **changes: Any) -> AegisError:
    """The AegisError, containing `found`, of a training that must not start and writes nothing."""
    before = contents(out) if out.exists() else None
    with pytest.raises(AegisError) as caught:
        start(method, out, **changes)
    assert found in caught.value.found
    assert (contents(out) if out.exists() else None) == before
    return caught.value


def test_an_existing_run_is_not_overwritten(naive_run: Path, start: Start) -> None:
    assert "--resume" in refused("existing run", start, "naive", naive_run).fix


def test_a_run_is_overwritten_on_request(
    naive_run: Path, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    longer = replace(recipe, train=replace(SETTINGS, steps=STEPS + 1), seed=1)
    start("aegis", tmp_path, recipe=longer)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "probe-scenes.json").write_text("{}")
    start("naive", tmp_path, overwrite=True)
    assert_same_run(tmp_path, naive_run)
    start("naive", tmp_path / "new", overwrite=True)
    assert_same_run(tmp_path / "new", naive_run)


@pytest.mark.parametrize("left", [None, ".ledger.safetensors.12345.tmp"])
def test_an_overwriting_that_was_cut_short_can_be_repeated(
    left: str | None,
    naive_run: Path,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This includes a killed process that was about to write a file."""
    start("naive", tmp_path)
    if left is not None:
        (tmp_path / left).write_bytes(b"half")

    def cut(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        # An order in which the recipe comes before the files that take long to remove.
        listed = sorted(tmp_path.iterdir(), reverse=True)
        patched.setattr(Path, "iterdir", lambda _: iter(listed))
        patched.setattr(folder.shutil, "rmtree", cut)
        with pytest.raises(KeyboardInterrupt):
            start("naive", tmp_path, overwrite=True)
    start("naive", tmp_path, overwrite=True)
    assert_same_run(tmp_path, naive_run)


def test_a_run_that_was_killed_before_its_recipe_was_whole_begins(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    (tmp_path / ".recipe.yaml.12345.tmp").write_bytes(b"half")
    start("naive", tmp_path)
    assert_same_run(tmp_path, naive_run)


def test_nothing_is_overwritten_where_something_is_wrong(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    refused("no file", start, "naive", naive_run, overwrite=True, demos=tmp_path / "none")
    run = tmp_path / "run"
    start("naive", run)
    (run / "thesis.tex").write_text("years of work")
    assert "thesis.tex" in refused("did not write", start, "naive", run, overwrite=True).fix
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("years of work")
    refused("not a run", start, "naive", tmp_path / "other", overwrite=True)


@pytest.mark.parametrize("what", ["backbone", "expert", "demos", "anchor"])
def test_nothing_is_overwritten_that_the_new_run_is_made_from(
    what: str, start: Start, recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    run, link = tmp_path / "run", tmp_path / "link"
    start("naive", run)
    link.symlink_to(run)
    given = {"demos": link / "expert.safetensors", "anchor": link / "state.safetensors"}
    shutil.copy(demos_file, given["demos"])
    shutil.copy(anchor_file, given["anchor"])
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    changed: dict[str, Any] = {}
    if what in given:
        changed[what] = given[what]
    elif what == "backbone":
        changed["recipe"] = replace(recipe, backbone=str(link))
    else:
        changed["recipe"] = replace(recipe, expert=replace(recipe.expert, start=str(link)))
    error = refused("which is to be overwritten", start, "aegis", run, overwrite=True, **changed)
    assert "another --out" in error.fix
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_somebodys_artifact_in_a_run_is_not_removed_with_it(start: Start, tmp_path: Path) -> None:
    start("naive", tmp_path)
    shutil.copy(tmp_path / "ledger.safetensors", tmp_path / "anchor.safetensors")
    refused("did not write", start, "naive", tmp_path, overwrite=True)
    assert (tmp_path / "anchor.safetensors").is_file()


def test_a_folder_with_other_things_is_not_a_run(start: Start, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    refused("not a run", start, "naive", tmp_path)
    refused("not a run", start, "naive", tmp_path, resume=True)


def test_a_run_goes_on_with_its_own_settings_only(
    naive_run: Path, start: Start, recipe: Recipe
) -> None:
    shorter = replace(recipe, train=replace(SETTINGS, steps=STEPS - 1))
    seeded = replace(shorter, seed=1, train=replace(shorter.train, weight_decay=0.5))
    says = {
        f"train.steps: {STEPS} there, {STEPS - 1} here": shorter,
        "seed: 0 there, 1 here; train.steps: ": seeded,
    }
    for found, changed in says.items():
        assert (
            "other settings"
            in refused(found, start, "naive", naive_run, resume=True, recipe=changed).found
        )
    method = refused(
        "other settings: train.method: naive there, lora here",
        start,
        "lora",
        naive_run,
        resume=True,
    )
    assert method.found.endswith("lora here")  # and nothing about lora's options, which naive lacks


def test_what_does_not_shape_training_may_change_and_the_run_says_so(
    naive_run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(naive_run, tmp_path / "run", symlinks=True))
    other = replace(recipe, name="other", lora=Lora(rank=2), rollout=Rollout(episodes=3, replan=1))
    other = replace(other, probe=Probe(max_drop=2.0))
    assert start("naive", run, recipe=other, resume=True).steps == STEPS
    kept = recipes.load(run / "recipe.yaml")
    assert kept == replace(other, train=replace(SETTINGS, method="naive"))
    before, now = contents(naive_run), contents(run)
    assert {name for name in now if now[name] != before[name]} == {"recipe.yaml"}


@pytest.mark.parametrize("ensemble", [None, 0.1])
def test_chunks_are_executed_as_the_runs_recipe_says_by_now(
    ensemble: float | None, naive_run: Path, recipe: Recipe, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(naive_run, tmp_path / "run", symlinks=True))
    trained = checkpoint.load_policy(run)[1]
    other = replace(recipe, rollout=Rollout(replan=1, ensemble=ensemble))
    folder.renew_recipe(run, other)
    taken = Path(shutil.copytree(run / "checkpoints" / "last", tmp_path / "taken"))
    assert checkpoint.load_policy(taken)[1] == trained and trained["replan"] != 1
    for path in (run, run / "checkpoints" / "last"):
        now = checkpoint.load_policy(path)[1]
        assert (now["replan"], now.get("ensemble")) == (1, ensemble)
        assert now == trained | {n: now[n] for n in ("replan", "ensemble") if n in now}
    folder.renew_recipe(run, recipe)
    assert checkpoint.load_policy(run)[1] == trained


def test_a_damaged_line_of_the_log_is_refused(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    run = shutil.copytree(naive_run, tmp_path / "run", symlinks=True)
    log = run / "metrics.jsonl"
    log.write_text(log.read_text() + '{"step": 3, "lo\n')
    refused(f"is damaged: line {STEPS + 1}", start, "naive", run, resume=True)


def test_a_run_goes_on_with_its_own_demonstrations_only(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    record("reach", 2, 1, tmp_path / "other.safetensors", workers=1)
    refused(
        "a different demos",
        start,
        "naive",
        naive_run,
        resume=True,
        demos=tmp_path / "other.safetensors",
    )


def test_a_run_goes_on_with_its_own_backbone_only(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    make_tiny(0).save(tmp_path / "vlm")
    ours = replace(recipe, backbone=str(tmp_path / "vlm"))
    start("naive", tmp_path / "run", recipe=ours, anchor=None)
    make_tiny(1).save(tmp_path / "vlm")
    refused(
        f"a different backbone than the run in '{tmp_path / 'run'}' began with: "
        f"'{tmp_path / 'vlm'}' has changed since",
        start,
        "naive",
        tmp_path / "run",
        recipe=ours,
        anchor=None,
        resume=True,
    )


@pytest.mark.parametrize("method", ["cotrain", "insulate"])
def test_a_run_goes_on_with_its_own_questions_only(
    method: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    asked = write_jsonl(tmp_path)
    own: dict[str, Any] = {"vqa": str(asked), "questions": 20, "batch_size": 4}
    insulate = Insulate(**own, vqa_weight=0.1)
    ours = replace(recipe, cotrain=Cotrain(**own), insulate=insulate)
    with pytest.raises(KeyboardInterrupt):
        start(
            method,
            tmp_path / "run",
            recipe=ours,
            anchor=None,
            on_event=stop_at(3, KeyboardInterrupt()),
        )
    asked.write_text(asked.read_text().replace('"red"', '"green"'))
    refused(
        "a different vqa/set.jsonl",
        start,
        method,
        tmp_path / "run",
        recipe=ours,
        anchor=None,
        resume=True,
    )


def test_an_anchor_of_another_backbone(start: Start, recipe: Recipe, tmp_path: Path) -> None:
    make_tiny(1).save(tmp_path / "vlm")
    error = refused(
        "backbone",
        start,
        "aegis",
        tmp_path / "run",
        recipe=replace(recipe, backbone=str(tmp_path / "vlm")),
    )
    assert "anchor" in error.found and "aegis anchor" in error.fix


@pytest.mark.parametrize("method", [name for name in sorted(METHODS) if METHODS[name].needs])
def test_a_method_that_reads_an_anchor_needs_one(start: Start, tmp_path: Path, method: str) -> None:
    assert "--anchor" in refused(f"'{method}'", start, method, tmp_path / "run", anchor=None).fix


def test_the_others_need_none(start: Start, tmp_path: Path) -> None:
    for method in (name for name in METHODS if not METHODS[name].needs):
        start(method, tmp_path / method, anchor=None)


def test_demonstrations_of_another_task(start: Start, recipe: Recipe, tmp_path: Path) -> None:
    error = refused(
        "'reach'", start, "naive", tmp_path / "run", recipe=replace(recipe, task="point")
    )
    assert "'point'" in error.found and "task=reach" in error.fix


def test_a_single_episode_cannot_be_split(start: Start, tmp_path: Path) -> None:
    sample = artifact_samples.demos()
    sample["tensors"] |= {
        "episode_starts": torch.tensor([0, 5]),
        "instruction": torch.tensor([0]),
        "target_color": torch.tensor([0]),
    }
    artifacts.save(tmp_path / "one.safetensors", "demos", **sample)
    refused("1 episode", start, "naive", tmp_path / "run", demos=tmp_path / "one.safetensors")


def test_missing_and_foreign_files(
    start: Start, recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    refused("nowhere", start, "naive", out, demos=tmp_path / "nowhere")
    refused("nowhere", start, "naive", out, anchor=tmp_path / "nowhere")
    refused(
        "nowhere", start, "naive", out, recipe=replace(recipe, backbone=str(tmp_path / "nowhere"))
    )
    refused("'anchor'", start, "naive", out, demos=anchor_file)
    refused("'demos'", start, "aegis", out, anchor=demos_file)
    refused("'sorcery'", start, "sorcery", out)
    (tmp_path / "file").write_text("")
    refused("folder", start, "naive", tmp_path / "file" / "run")


# --- steps that go wrong --------------------------------------------------------------------------


def test_the_largest_seed_can_be_trained_with(start: Start, recipe: Recipe, tmp_path: Path) -> None:
    settings = replace(SETTINGS, steps=1, warmup=0)
    assert (
        start("naive", tmp_path, recipe=replace(recipe, seed=2**32 - 1, train=settings)).steps == 1
    )


def finite(folder: Path) -> bool:
    files = [
        folder / "backbone" / "model.safetensors",
        folder / checkpoint.EXPERT,
        folder / checkpoint.STATE,
    ]
    return all(
        t.isfinite().all()
        for f in files
        for t in artifacts.load(f).tensors.values()
        if t.is_floating_point()
    )


@pytest.mark.parametrize("rates", [{"backbone_lr": 1e18, "expert_lr": 1e18}, {"backbone_lr": 1e18}])
@pytest.mark.parametrize("method", sorted(METHODS))
def test_an_enormous_learning_rate(
    start: Start, recipe: Recipe, tmp_path: Path, method: str, rates: dict[str, float]
) -> None:
    """Whatever diverges first, the run ends with one clear error or completes.

    That may be the loss, a gradient, W2 or an inner product.
    """
    settings = replace(SETTINGS, warmup=0, checkpoint_every=STEPS, **rates)
    try:
        start(method, tmp_path, recipe=replace(recipe, train=settings))
    except AegisError as error:
        assert "step" in error.found and "lr" in error.fix
    else:
        assert len(rates) == 1  # a layer's norm accepts inputs of any scale
    assert finite(checkpoint.last(tmp_path))


@pytest.mark.parametrize("where", ["loss", "gradient", "ledger"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_step_that_is_not_finite_is_not_taken(
    whole_run: Callable[[str], Path],
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    bad: float,
) -> None:
    """Step 4 goes wrong: the checkpoint is that of step 3, and the run can resume from it."""
    out = tmp_path / "run"  # as deep as the whole run, to which its inputs are relative
    with monkeypatch.context() as patch:
        patch.setattr(step, "compute_gradients", spoiled(where, bad, at=4))
        with pytest.raises(AegisError) as caught:
            start("aegis", out)
    assert "step 4" in caught.value.found and "3 good steps" in caught.value.fix
    assert checkpoint.last(out).resolve().name == "000003"
    assert finite(checkpoint.last(out))
    assert artifacts.load(out / "ledger.safetensors").tensors["step"].tolist() == [1, 2, 3]
    start("aegis", out, resume=True)
    extra = {name for name in contents(out) if name.startswith("checkpoints/000003/")}
    assert extra
    rest = {name: value for name, value in contents(out).items() if name not in extra}
    assert rest == contents(whole_run("aegis"))


def test_a_divergence_right_after_a_checkpoint_leaves_it_alone(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step 3 goes wrong, and the checkpoint of step 2 is not written again.

    So a checkpoint exists at every moment.
    """
    seen = []

    def look(event: Progress) -> None:
        if event.stage == "train" and event.done == 2:
            seen.append((checkpoint.last(tmp_path) / checkpoint.STATE).stat())

    monkeypatch.setattr(step, "compute_gradients", spoiled("loss", math.nan, at=3))
    with pytest.raises(Diverged, match="step 3"):
        start("aegis", tmp_path, on_event=look)
    assert [(checkpoint.last(tmp_path) / checkpoint.STATE).stat().st_ino] == [
        stat.st_ino for stat in seen
    ]


@pytest.fixture(scope="module")
def third(recipe: Recipe, start: Start, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a checkpoint at each validation; read-only."""
    out = tmp_path_factory.mktemp("third") / "run"
    start("naive", out, recipe=of_thirds(recipe))
    return out


def of_thirds(recipe: Recipe) -> Recipe:
    return replace(recipe, train=replace(recipe.train, checkpoint_every=3))


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("at", [3, STEPS])
@pytest.mark.parametrize("relative", [True, False])
def test_a_run_interrupted_while_it_validates_keeps_the_checkpoint_of_that_step(
    relative: bool,
    at: int,
    times: int,
    third: Path,
    recipe: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted once or twice in the same validation, after a step that has a checkpoint."""
    monkeypatch.chdir(tmp_path)
    every, out = of_thirds(recipe), Path("run") if relative else tmp_path / "run"
    measure = train.validation_loss

    def interrupt(*given: Any) -> float:
        if len(list((out / "checkpoints").glob("0*"))) * 3 < at - 3:
            return measure(*given)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(train, "validation_loss", interrupt)
        for _ in range(times):
            with pytest.raises(KeyboardInterrupt):
                start("naive", out, recipe=every, resume=True)
            assert checkpoint.last(out).resolve().name == f"{at:06d}"
    start("naive", out, recipe=every, resume=True)
    assert_same_run(out, third)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_validation_loss_that_is_not_finite_ends_the_run(
    start: Start, naive_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: float
) -> None:
    """Finite steps may give a broken model: nothing of step 3 is kept or reported."""
    with monkeypatch.context() as patch:
        patch.setattr(train, "validation_loss", lambda *_: bad)
        for _ in range(2):  # a resumed run ends the same way
            with pytest.raises(Diverged, match=f"validation loss {bad:g} after step 3") as caught:
                start("naive", tmp_path, resume=True)
            assert caught.value.good_steps == 3 and "lower train.backbone_lr" in caught.value.fix
            assert checkpoint.last(tmp_path).resolve().name == "000002"
            assert "validation" not in (tmp_path / "metrics.jsonl").read_text()
    start("naive", tmp_path, resume=True)
    assert_same_run(tmp_path, naive_run)


def spoiled(where: str, bad: float, at: int) -> Callable[..., step.StepGradients]:
    """`compute_gradients` with one value replaced in call number `at`."""
    compute, calls = step.compute_gradients, []

    def spoil(policy: Policy, *args: Any, **options: Any) -> step.StepGradients:
        result = compute(policy, *args, **options)
        calls.append(None)
        if len(calls) != at:
            return result
        if where == "loss":
            return replace(result, loss=torch.tensor(bad))
        if where == "ledger":
            return replace(result, row=replace(result.row, w2=torch.full_like(result.row.w2, bad)))
        policy.expert.action_out.weight.grad[0, 0] = bad
        return result

    return spoil


MODEL_FILE = "checkpoints/000002/backbone/model.safetensors"
STATE_FILE = f"checkpoints/000002/{checkpoint.STATE}"


@pytest.mark.parametrize("file", ["metrics.jsonl", "ledger.safetensors", MODEL_FILE, STATE_FILE])
def test_a_full_disk_leaves_what_was_complete(
    whole_run: Callable[[str], Path], start: Start, tmp_path: Path, file: str
) -> None:
    """The disk is full from step 3 on, so `file` no longer fits."""
    reference = whole_run("aegis")
    limit = (reference / file).stat().st_size - 1
    with pytest.raises(AegisError) as caught, largest_file_from(limit, after=3) as on_event:
        start("aegis", tmp_path, on_event=on_event)
    assert "write" in caught.value.found and "space" in caught.value.expected + caught.value.fix
    assert not [p for p in tmp_path.rglob("*") if "tmp" in p.name]
    assert checkpoint.last(tmp_path).resolve().name == "000002"
    before = {
        name: value
        for name, value in contents(reference).items()
        if name.startswith("checkpoints/000002/")
    }
    after = contents(tmp_path)
    assert {
        name: value for name, value in after.items() if name.startswith("checkpoints/0")
    } == before
    start("aegis", tmp_path, resume=True)
    assert_same_run(tmp_path, reference)


@contextmanager
def largest_file_from(size: int, after: int) -> Iterator[OnEvent]:
    """A listener that fills the disk once step `after` is done.

    No file can grow beyond `size` bytes.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def on_event(event: Progress) -> None:
        if (event.stage, event.done) == ("train", after):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))

    try:
        yield on_event
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_listener_that_fails_is_heard(start: Start, tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        start("naive", tmp_path, on_event=stop_at(2, ZeroDivisionError()))


@pytest.mark.parametrize(
    ("code", "cure"),
    [
        (errno.ENOSPC, "free space"),
        (errno.EDQUOT, "free space"),
        (errno.EROFS, "writable"),
        (errno.EIO, "choose another output"),
        (errno.ENAMETOOLONG, "choose another output"),
    ],
)
def test_a_disk_that_refuses_is_told_with_a_cure_for_that(
    code: int, cure: str, tmp_path: Path
) -> None:
    with pytest.raises(AegisError) as caught, checkpoint.writing(tmp_path):
        raise OSError(code, os.strerror(code))
    assert os.strerror(code) in caught.value.found and cure in caught.value.fix
    assert ("free" in caught.value.fix) == (code in (errno.ENOSPC, errno.EDQUOT))
