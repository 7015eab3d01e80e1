"""A run that is trained for longer, and one that starts with another run's expert."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples import small_run
from samples.training_runs import STEPS, Start, assert_same_run, contents, stop_at

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.models import lerobot_folder
from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint

LONGER = STEPS + 4


def of(recipe: Recipe, **changes: object) -> Recipe:
    """The recipe with changed keys of `train`."""
    return replace(recipe, train=replace(recipe.train, **changes))


@pytest.mark.parametrize(
    ("method", "schedule"),
    [
        ("naive", "constant"),
        ("aegis", "cosine"),
        ("nullspace", "cosine"),
        ("kfac", "linear"),
    ],
)
def test_a_longer_run_ends_in_the_bytes_of_one_planned_so(
    method: str, schedule: str, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    """This holds if the added steps are interrupted, and if it is made longer twice."""
    recipe = of(recipe, schedule=schedule)
    twice = of(recipe, steps=LONGER + 3)
    start(method, tmp_path / "grown", recipe=recipe)
    with pytest.raises(KeyboardInterrupt):
        start(
            method,
            tmp_path / "grown",
            recipe=of(recipe, steps=LONGER),
            resume=True,
            on_event=stop_at(STEPS + 3, KeyboardInterrupt()),
        )
    start(method, tmp_path / "grown", recipe=of(recipe, steps=LONGER), resume=True)
    assert start(method, tmp_path / "grown", recipe=twice, resume=True).steps == LONGER + 3
    start(method, tmp_path / "planned", recipe=of(twice, extended_from=(STEPS, LONGER)))
    assert_same_run(tmp_path / "grown", tmp_path / "planned")
    kept = recipes.load(tmp_path / "grown" / "recipe.yaml")
    assert kept.train.extended_from == (STEPS, LONGER) and kept.train.steps == LONGER + 3


@pytest.mark.parametrize(
    ("schedule", "rates"), [("linear", "rise again to"), ("constant", "stay at 100 %")]
)
def test_what_is_said_and_kept(
    schedule: str, rates: str, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    recipe = of(recipe, schedule=schedule)
    start("naive", tmp_path, recipe=recipe)
    said: list[Event] = []
    longer = of(recipe, steps=LONGER)
    start("naive", tmp_path, recipe=longer, resume=True, on_event=said.append)
    (warned,) = [event.text for event in said if isinstance(event, Warned)]
    assert f"from step {STEPS} to {LONGER}; the learning rates {rates}" in warned
    before = contents(tmp_path)
    start("naive", tmp_path, recipe=longer, resume=True)
    assert contents(tmp_path) == before


def unfinished(recipe: Recipe, start: Start, out: Path) -> Recipe:
    with pytest.raises(KeyboardInterrupt):
        start("naive", out, on_event=stop_at(3, KeyboardInterrupt()))
    return of(recipe, steps=LONGER)


def shorter(recipe: Recipe, start: Start, out: Path) -> Recipe:
    start("naive", out)
    return of(recipe, steps=STEPS - 1)


def of_a_job(recipe: Recipe, start: Start, out: Path) -> Recipe:
    start("naive", out)
    (out / "train.json").write_text("{}")
    return of(recipe, steps=LONGER)


def otherwise_too(recipe: Recipe, start: Start, out: Path) -> Recipe:
    start("naive", out)
    return of(recipe, steps=LONGER, backbone_lr=2e-3)


def stands_still(recipe: Recipe, start: Start, out: Path) -> Recipe:
    start("naive", out, recipe=of(recipe, backbone_until=0.5))
    return of(recipe, steps=LONGER, backbone_until=0.5)


@pytest.mark.parametrize(
    ("begin", "found"),
    [
        (unfinished, f"has taken 2 of {STEPS} steps"),
        (shorter, f"train.steps: {STEPS} there, {STEPS - 1} here"),
        (of_a_job, "belongs to a job"),
        (otherwise_too, "backbone_lr"),
        (stands_still, "is frozen by now"),
    ],
)
def test_what_is_not_made_longer(
    begin: Callable[[Recipe, Start, Path], Recipe],
    found: str,
    recipe: Recipe,
    start: Start,
    tmp_path: Path,
) -> None:
    asked = begin(recipe, start, tmp_path)
    before = contents(tmp_path)
    with pytest.raises(AegisError, match=found):
        start("naive", tmp_path, recipe=asked, resume=True)
    assert contents(tmp_path) == before


def beginning_with(recipe: Recipe, run: Path, **changes: object) -> Recipe:
    """The recipe of a run that starts with another run's backbone and expert."""
    expert = replace(recipe.expert, start=str(run), **changes)
    return replace(recipe, backbone=str(run), expert=expert)


def test_a_run_begins_with_anothers_policy(
    recipe: Recipe, start: Start, naive_run: Path, tmp_path: Path
) -> None:
    still = of(beginning_with(recipe, naive_run), steps=1, backbone_lr=1e-30, expert_lr=1e-30)
    start("naive", tmp_path / "again", recipe=still, anchor=None)
    there, _ = checkpoint.load_policy(naive_run)
    here, _ = checkpoint.load_policy(tmp_path / "again")
    for name, tensor in there.state_dict().items():
        torch.testing.assert_close(here.state_dict()[name], tensor)
    header = artifacts.read_header(checkpoint.last(tmp_path / "again") / checkpoint.EXPERT)
    assert header.inputs["expert"] == checkpoint.expert_sha256(naive_run)
    # Resuming requires the same expert.
    start("naive", tmp_path / "again", recipe=still, anchor=None, resume=True)


@pytest.mark.parametrize(
    ("changes", "found"),
    [({"width": 32}, "width 16 instead of 32"), ({"mlp_ratio": 2}, "mlp_ratio 4 instead of 2")],
)
def test_an_expert_of_another_shape_is_refused(
    changes: dict[str, int],
    found: str,
    recipe: Recipe,
    start: Start,
    naive_run: Path,
    tmp_path: Path,
) -> None:
    other = beginning_with(recipe, naive_run, **changes)
    with pytest.raises(AegisError, match=found):
        start("naive", tmp_path / "new", recipe=other, anchor=None)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("key", "found"),
    [("action_names", "dy, dx, in this order"), ("proprio_names", "in this order")],
)
def test_an_expert_of_joints_in_another_order_is_refused(
    key: str, found: str, recipe: Recipe, start: Start, naive_run: Path, tmp_path: Path
) -> None:
    policy, meta = checkpoint.load_policy(naive_run)
    (tmp_path / "turned").mkdir()
    names = meta[key]
    lerobot_folder.write(tmp_path / "turned", policy, {**meta, key: names[1:] + names[:1]})
    other = replace(recipe, expert=replace(recipe.expert, start=str(tmp_path / "turned")))
    with pytest.raises(AegisError, match="in another place than the expert") as raised:
        start("naive", tmp_path / "new", recipe=other, anchor=None)
    assert found in str(raised.value)
    assert not (tmp_path / "new").exists()


def test_a_job_looks_for_the_expert_before_it_records_anything(
    aegis: Callable[..., tuple[int, str, str]], tiny_folder: Path, tmp_path: Path
) -> None:
    settings = small_run.write(tmp_path, tiny_folder)
    given = ("--set", f"expert.start={tmp_path / 'none'}", "--out", tmp_path / "runs")
    code, _, err = aegis("run", settings, *given)
    assert code == 2 and f"no checkpoint in '{tmp_path / 'none'}'" in err
    assert not list((tmp_path / "runs").rglob("*.safetensors"))


@pytest.mark.parametrize(
    ("known", "told"),
    [
        ({}, []),
        ({"normalization": "quantiles"}, ["on a different scale here; --set train.normalization="]),
        ({"fps": 30.0}, ["trained on 30 frames a second, and these demonstrations have 10"]),
    ],
)
def test_an_expert_of_other_units_is_told(
    known: dict[str, object],
    told: list[str],
    recipe: Recipe,
    start: Start,
    naive_run: Path,
    tmp_path: Path,
) -> None:
    policy, meta = checkpoint.load_policy(naive_run)
    (tmp_path / "other").mkdir()
    lerobot_folder.write(tmp_path / "other", policy, {**meta, **known})
    begun = replace(recipe, expert=replace(recipe.expert, start=str(tmp_path / "other")))
    events: list[Event] = []
    start("naive", tmp_path / "new", recipe=of(begun, steps=1), on_event=events.append)
    said = [event.text for event in events if isinstance(event, Warned)]
    assert len(said) == len(told) and all(map(str.__contains__, said, told))
