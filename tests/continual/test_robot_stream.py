"""Streams of robot tasks: how much of earlier tasks is kept, and what is resumed and reported."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import datasets
import pytest
import torch
from samples.interrupted import at_each, stop
from samples.robots import STEPS, Make
from samples.training import CHUNK, RobotBatch, images, make_policy, same_bits, snapshot
from samples.training_runs import contents
from samples.vqa_files import hub_rows, write_jsonl

from aegis_cli import inspection, recipes, sim
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.files import sha256_value
from aegis_cli.continual import (
    files,
    loop,
    probe,
    robot_demos,
    robot_evaluators,
    robots,
    state,
    train,
)
from aegis_cli.continual.report import RobotStreamReport
from aegis_cli.continual.robot_evaluators import ClosedLoopEvaluator
from aegis_cli.continual.robots import RobotStreamRun
from aegis_cli.core.accuracy_matrix import seen_scores
from aegis_cli.data import demonstrations
from aegis_cli.data import record as demos
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.vqa.dataset import load_scenes
from aegis_cli.deploy import load_acting, load_policy
from aegis_cli.evaluation import rollout
from aegis_cli.models import backbones
from aegis_cli.models.acting import Acting
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import (
    ROBOT_LEARNERS,
    Probe,
    RobotDemos,
    RobotRollout,
    RobotStreamRecipe,
    Sequential,
    load_training,
    to_yaml,
)
from aegis_cli.recipes.strict_yaml import dump

Done = Callable[[str], tuple[RobotStreamReport, Path]]
Aegis = Callable[..., tuple[int, str, str]]
SIZES = {"reach": 6, "point": 2}


@pytest.fixture(scope="module")
def done(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """A finished run of a learner; read-only."""
    made: dict[str, tuple[RobotStreamReport, Path]] = {}

    def get(method: str) -> tuple[RobotStreamReport, Path]:
        if method not in made:
            out = tmp_path_factory.mktemp("robot") / method
            made[method] = train.run(make(method), out), out
        return made[method]

    return get


def chunks(run: RobotStreamRun, task: int) -> torch.Tensor:
    """The actions of a task's policy, always on the same pictures and positions."""
    size = SIZES[run.names[task]]
    proprio = torch.randn(3, size, generator=torch.Generator().manual_seed(1))
    run.activate(task)
    return run.policies[task].act(
        images(3), ["go to the red target"] * 3, proprio, torch.Generator().manual_seed(2)
    )


@pytest.mark.parametrize("where", ["validation", "vqa"])
def test_a_task_that_ends_in_no_numbers_ends_the_stream(
    where: str, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluator = ClosedLoopEvaluator
    monkeypatch.setattr(evaluator, "row", lambda self, done: [0.0] * (done + 1))
    if where == "validation":
        monkeypatch.setattr(robots.train, "validation_loss", lambda *_, **__: math.nan)
    else:
        found = iter([[0.5, 1.0], [0.5, math.inf]])  # before the first task and after it
        monkeypatch.setattr(evaluator, "vqa", lambda self: next(found))
    with pytest.raises(Diverged, match="after task 'reach'") as caught:
        train.run(make("sequential"), tmp_path / "run")
    assert caught.value.good_steps == STEPS and not (tmp_path / "run" / "stream.json").exists()
    assert caught.value.fix == "try a lower sequential.lr or train.expert_lr"


@pytest.mark.parametrize(
    ("method", "task", "keys"),
    [
        ("sequential", 0, "sequential.lr or train.expert_lr"),
        ("isolated-lora", 0, "train.expert_lr or train.lr or train.router_lr"),
        ("isolated-lora", 1, "train.lr or train.router_lr"),  # the action expert is frozen then
    ],
)
def test_what_to_lower_are_the_rates_of_what_learns(
    method: str, task: int, keys: str, make: Make, tmp_path: Path
) -> None:
    built = train.build(make(method), tmp_path)
    learn(built, task)
    assert loop.prepare(built, [], None).slower == f"try a lower {keys}"


# --- what is kept ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "keeps"), [("igsp", True), ("isolated-lora", True), ("sequential", False)]
)
@pytest.mark.parametrize("order", [("reach", "point"), ("point", "reach")])
def test_a_learned_tasks_actions_are_bit_identical_after_the_next(
    method: str, keeps: bool, order: tuple[str, ...], make: Make, tmp_path: Path
) -> None:
    """This holds even if the second task has more positions than the first."""
    built = train.build(make(method, order), tmp_path)
    learn(built, 1)
    first, own = chunks(built, 0), snapshot(iter(robots.own_parameters(built.model.expert).items()))
    learn(built, 2)
    assert torch.equal(first, chunks(built, 0)) == keeps
    assert (
        all(same_bits(own[n], p) for n, p in robots.own_parameters(built.model.expert).items())
        == keeps
    )
    assert not torch.equal(chunks(built, 1), first)


def learn(run: RobotStreamRun, tasks: int) -> None:
    """Train until this many tasks are learned, and evaluate none."""
    (run.out / "metrics.jsonl").touch()
    while run.current.task < tasks:
        loop.learn(run, [], None, lambda event: None)
        run.current = run.current.next_task()


@pytest.mark.parametrize("method", ["igsp", "isolated-lora"])
def test_with_no_task_active_the_vlm_is_what_it_was(
    method: str, done: Done, tiny_folder: Path
) -> None:
    report, out = done(method)
    assert list(report.vqa) == [report.vqa[0]] * 3 and report.vqa[0].drop_points == 0
    run, bare = robots.load_to_act(out), backbones.load(str(tiny_folder))
    inputs = bare.prepare(images(3), ["go to the red target"] * 3)
    run.activate(None)
    assert torch.equal(run.model.backbone.encode(inputs).hidden[-1], bare.encode(inputs).hidden[-1])
    run.activate(1)
    assert not torch.equal(
        run.model.backbone.encode(inputs).hidden[-1], bare.encode(inputs).hidden[-1]
    )


def test_sequential_changes_the_vlm(done: Done) -> None:
    report, out = done("sequential")
    assert len({k.cross_entropy for k in report.vqa}) == 3
    assert not robots.load_to_act(out).sites and not (out / "experts.safetensors").exists()


@pytest.mark.parametrize("method", ["igsp", "isolated-lora"])
def test_which_maps_get_experts_and_what_learns_when(method: str, done: Done) -> None:
    report, _ = done(method)
    maps = [{site.site for site in record.sites} for record in report.records]
    # not layer 1, the last: its maps come after the last keys and values, and no action reads
    # them
    assert maps[0] == {f"backbone.layers.0.{name}" for name in ("out", "up", "down")}
    layers = {
        f"expert.layers.{i}.{name}" for i in range(2) for name in ("qkv", "out", "up", "down")
    }
    assert maps[1] >= maps[0] | layers | {
        "expert.action_in",
        "expert.proprio_in",
        "expert.action_out",
    }
    assert all(name.startswith("expert.") for name in maps[1] - maps[0])
    own = sum(
        p.numel()
        for p in robots.own_parameters(robots.load_to_act(done(method)[1]).model.expert).values()
    )
    first, second = report.records
    assert all(
        sum(s.mass) == pytest.approx(1)
        for record in report.records
        for s in record.sites
        if s.experts
    )
    assert first.trained == own + sum(s.trained for s in first.sites)
    assert second.trained == sum(s.trained for s in second.sites)
    if method == "igsp":
        assert first.trained_phase1 == own + sum(s.trained_phase1 for s in first.sites)
        assert second.trained_phase1 == sum(s.trained_phase1 for s in second.sites)
        assert 0 < second.phase1_steps <= STEPS / 2
    scales = [2 * (SIZES[task] + 2) for task in report.tasks]
    assert first.added == own + sum(s.added for s in first.sites) + scales[0]
    assert report.parameters == own + sum(s.added for r in report.records for s in r.sites) + sum(
        scales
    )


@pytest.mark.parametrize("freeze", ["stem", ("words", "layers.0")])
def test_what_is_frozen_stays_bit_for_bit_where_all_weights_learn(
    freeze: str | tuple[str, ...], make: Make, tiny_folder: Path, tmp_path: Path
) -> None:
    built = train.build(make("sequential", freeze=freeze), tmp_path)
    learn(built, 2)
    parts = (freeze,) if isinstance(freeze, str) else freeze
    after = dict(built.model.backbone.named_parameters())
    for name, before in backbones.load(str(tiny_folder)).named_parameters():
        held = name.startswith(tuple(f"{part}." for part in parts))
        # Whatever comes after the parts that the action expert reads has no gradient.
        if held or name in ("layers.1.qkv.weight", "stem.halve.0.weight", "words.weight"):
            assert same_bits(before, after[name]) == held, name


@pytest.mark.parametrize("method", ["igsp", "isolated-lora"])
def test_no_experts_stand_beside_what_is_frozen(method: str, make: Make, tmp_path: Path) -> None:
    recipe = make(method, freeze=("layers.0.up", "layers.0.down", "stem"))
    report, out = train.run(recipe, tmp_path / "run"), tmp_path / "run"
    for record in report.records:
        maps = {s.site for s in record.sites if s.site.startswith("backbone.")}
        assert maps == {"backbone.layers.0.out"}
    run = robots.load_to_act(out)
    assert "backbone.layers.0.out" in run.sites and "backbone.layers.0.up" not in run.sites


@pytest.mark.parametrize(
    ("method", "freeze", "says"),
    [
        ("igsp", "stem", "with method 'igsp', which trains none of it anyway"),
        ("isolated-lora", "layers.1", "which trains none of it anyway"),
        ("igsp", "layers.0", "nothing of the backbone is left to learn"),
        ("sequential", "*", "nothing of the backbone is left to learn"),
        ("sequential", "vision", "'vision', but no part of the backbone has that name"),
    ],
)
def test_to_freeze_what_would_not_learn_or_everything_is_refused_before_anything_is_recorded(
    method: str,
    freeze: str,
    says: str,
    make: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        robot_demos, "load", lambda *_: pytest.fail("demonstrations were looked for")
    )
    with pytest.raises(AegisError) as caught:
        train.build(make(method, freeze=freeze), tmp_path / "run")
    assert caught.value.found.startswith("train.freeze: ") and says in caught.value.found


# --- what is learned and told ---------------------------------------------------------------------


@pytest.mark.parametrize("method", ROBOT_LEARNERS)
def test_what_is_missing_of_a_robot_is_zero_and_not_learned(
    method: str, make: Make, tmp_path: Path
) -> None:
    """Two positions in an expert for six: no loss reads the other columns and noise."""
    built = train.build(make(method), tmp_path / "run")
    assert built.model.expert.shape.proprio == 6
    assert [len(p.proprio_scale.mean) for p in built.policies] == [6, 2]
    expert = built.model.expert.requires_grad_(True)
    frames = built.objective(1)
    frames.loss(frames.fetch(torch.arange(4)), 0).backward()
    weight = expert.proprio_in.base if built.sites else expert.proprio_in
    assert not weight.weight.grad[:, 2:].any() and weight.weight.grad[:, :2].any()


@pytest.mark.parametrize("actions", [1, 2, 3])
def test_actions_that_a_robot_lacks_do_not_dilute_its_loss(actions: int) -> None:
    """A policy of `actions` in an expert for three, whose other outputs are arbitrary."""
    torch.manual_seed(0)
    wide = make_policy()
    shape = dataclasses.replace(wide.expert.shape, actions=3)
    expert = type(wide.expert)(shape)
    scale = type(wide.action_scale)(torch.zeros(actions), torch.ones(actions))
    policy = Policy(wide.backbone, expert, wide.proprio_scale, scale)
    frames, texts, is_pad = (
        images(4),
        ["touch the blue ball"] * 4,
        torch.zeros(4, CHUNK, dtype=torch.bool),
    )
    batch = RobotBatch(frames, texts, torch.randn(4, 3), torch.randn(4, CHUNK, actions), is_pad)
    losses = []
    for bias in (0.0, 100.0):
        with torch.no_grad():
            expert.action_out.bias[actions:] = bias
        encoding = policy.encode(batch.images, batch.instructions)
        losses.append(policy.flow_loss(batch, encoding, 2, torch.Generator().manual_seed(0)).item())
    assert losses[0] == losses[1]
    assert policy.act(frames, texts, batch.proprio, torch.Generator()).shape == (4, CHUNK, actions)


@pytest.mark.parametrize(
    ("method", "still", "rates"),
    [
        ("igsp", "own", {"expert_lr": 0.0}),
        ("igsp", ".experts.", {"lr": 0.0}),
        ("igsp", ".routers.", {"router_lr": 0.0}),
        ("sequential", "backbone.", {"sequential": Sequential(lr=0.0)}),
        ("sequential", "expert.", {"expert_lr": 0.0}),
    ],
)
def test_each_part_learns_at_its_own_rate(
    method: str, still: str, rates: dict[str, Any], make: Make, tmp_path: Path
) -> None:
    built = train.build(make(method, **rates), tmp_path)
    objective, arrived = built.objective(0), loop.prepare(built, [], None)
    before = snapshot(iter(built.parameters().items()))
    for step in range(3):
        loop.take(built, arrived, step, objective.fetch(torch.arange(4)))
    moved = {name for name, p in built.parameters().items() if not same_bits(before[name], p)}
    inside = {
        n
        for n in before
        if (n.startswith("expert.") and not robots.is_added(n) if still == "own" else still in n)
    }
    assert inside and moved and not inside & moved
    if method == "sequential":
        assert {name.split(".")[0] for name in moved} == {"backbone", "expert"} - {still[:-1]}


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_the_loss_falls(method: str, make: Make, tmp_path: Path) -> None:
    """In both tasks, over more steps than the stream's other tests."""
    built = train.build(make(method, steps=24, batch_size=16, checkpoint_every=24), tmp_path)
    learn(built, 2)
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    for task in range(2):
        losses = [line["loss"] for line in lines if line["task"] == task]
        assert sum(losses[-8:]) < 0.97 * sum(losses[:8])


@pytest.mark.parametrize("method", ROBOT_LEARNERS)
def test_the_report_is_in_the_files(method: str, done: Done) -> None:
    report, out = done(method)
    assert [len(row) for row in report.success] == [1, 2]
    assert report.scores == seen_scores(report.success)
    assert dataclasses.replace(files.read(out), minutes=report.minutes) == report
    matrix, counts = (
        json.loads((out / name).read_text()) for name in ("success_matrix.json", "parameters.json")
    )
    assert matrix["success"] == [list(row) for row in report.success] and len(matrix["vqa"]) == 3
    assert counts["parameters"] == report.parameters == sum(t["added"] for t in counts["tasks"])
    own = {"backbone"} if method == "sequential" else {"experts.safetensors", "routing.safetensors"}
    always = {
        "recipe.yaml",
        "metrics.jsonl",
        "expert.safetensors",
        "success_matrix.json",
        "parameters.json",
        "stream.json",
        "inputs.json",
    }
    assert {p.name for p in out.iterdir()} == own | always
    assert (
        len(
            [
                line
                for line in (out / "metrics.jsonl").read_text().splitlines()
                if "validation_loss" in line
            ]
        )
        == 2
    )


@pytest.mark.parametrize("method", ROBOT_LEARNERS)
def test_a_probe_of_the_files_gives_the_same_figures(method: str, done: Done) -> None:
    report, out = done(method)
    before = contents(out)
    (out / "success_matrix.json").unlink()
    found = probe.run(out)
    assert found.largest_difference == 0
    assert (found.success, found.vqa) == (report.success, report.vqa)
    assert found.measured == (1 if method == "sequential" else 2) and contents(out) == before


def test_success_is_what_closed_loops_say(
    done: Done, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every entry is a rollout of its task with its own policy, with the recipe's settings."""
    played = []

    def play(
        acting: Acting, episodes: int, colors: str, split: int, **_: object
    ) -> rollout.RolloutReport:
        task, positions = acting.task, len(acting.policy.proprio_scale.mean)
        played.append((task, positions, episodes, colors, acting.replan, split))
        return rollout.RolloutReport(
            task=task, success=len(played) / 10, episodes=episodes, episodes_per_s=1.0
        )

    monkeypatch.setattr(robot_evaluators, "play", play)
    settings = RobotRollout(episodes=3, colors="held-out", replan=2, split="validation")
    report = train.run(make("isolated-lora", steps=1, rollout=settings), tmp_path / "run")
    assert played == [
        (task, SIZES[task], 3, "held-out", 2, 2) for task in ("reach", "reach", "point")
    ]
    assert report.success == ((0.1,), (0.2, 0.3)) and report.scores.forgetting == 0
    assert report.scores.last == pytest.approx(0.25) and report.scores.average == pytest.approx(0.2)


@pytest.mark.parametrize(("split", "part"), [("evaluation", "probe"), ("validation", "validation")])
def test_settings_are_chosen_by_other_questions_than_the_probes(
    split: str, part: str, done: Done
) -> None:
    run = robots.load_to_act(done("igsp")[1])
    run.recipe = dataclasses.replace(run.recipe, rollout=RobotRollout(split=split))
    asked = ClosedLoopEvaluator(run, robots.questions(run.recipe))._asked
    images = {name: load_scenes(name, 7, 0).images for name in ("probe", "validation")}
    assert not (images["probe"] == images["validation"]).all()
    assert len(asked.questions) == 7 and (asked.images == images[part]).all()


def test_questions_that_were_edited_are_not_set_beside_the_old_ones(
    make: Make, tmp_path: Path
) -> None:
    """This holds for a probe of the run and for its continuation."""
    lines = write_jsonl(tmp_path / "asked", 40)
    asking = make("sequential", steps=1, probe=Probe(vqa=str(lines), questions=7))
    train.run(asking, tmp_path / "done")
    with pytest.raises(KeyboardInterrupt):
        train.run(asking, tmp_path / "cut", on_event=partial(stop, "stream", 1))
    assert probe.run(tmp_path / "done").largest_difference == 0
    before = contents(tmp_path / "done")
    write_jsonl(tmp_path / "asked", 41)
    with pytest.raises(AegisError, match="different questions than the run"):
        probe.run(tmp_path / "done")
    with pytest.raises(AegisError, match="a different vqa/set.jsonl than the run"):
        train.run(asking, tmp_path / "cut", resume=True)
    assert contents(tmp_path / "done") == before


def test_a_question_file_that_is_gone_is_named(make: Make, tmp_path: Path) -> None:
    """A data set with several files can lose one, and is then another set."""
    rows = datasets.Dataset.from_dict(hub_rows(60))
    asked = tmp_path / "asked"
    asked.mkdir()
    for number, half in enumerate((range(60), range(60, 120))):
        rows.select(half).to_parquet(str(asked / f"train-0000{number}-of-00002.parquet"))
    asking = make("sequential", steps=1, probe=Probe(vqa=str(asked), questions=7))
    train.run(asking, tmp_path / "done")
    with pytest.raises(KeyboardInterrupt):
        train.run(asking, tmp_path / "cut", on_event=partial(stop, "stream", 1))
    (asked / "train-00001-of-00002.parquet").unlink()
    gone = "vqa/train-00001-of-00002.parquet"
    with pytest.raises(AegisError, match=f"different questions than the run .*: {gone}"):
        probe.run(tmp_path / "done")
    with pytest.raises(AegisError, match=f"a different {gone} than the run"):
        train.run(asking, tmp_path / "cut", resume=True)


@pytest.mark.parametrize("method", ["igsp", "sequential"])
@pytest.mark.parametrize("number", [0, 1])
def test_a_rollout_of_the_run_acts_as_the_training_did(
    method: str, number: int, done: Done
) -> None:
    report, out = done(method)
    policy, task, replan, *_ = robots.load_policy(out, report.tasks[number])
    run = robots.load_to_act(out)
    assert (task, replan) == (report.tasks[number], 20)
    proprio = torch.randn(2, SIZES[task], generator=torch.Generator().manual_seed(1))
    run.activate(number)
    same = [
        p.act(images(2), ["go to the red target"] * 2, proprio, torch.Generator().manual_seed(2))
        for p in (policy, run.policies[number])
    ]
    assert torch.equal(*same)
    assert rollout.run(out, task, 1, "seen", load=load_acting).success == report.success[-1][number]


@pytest.fixture(scope="module")
def of_any_size(
    make: Make, hf_folder: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[tuple[int, ...]]]:
    """A stream whose backbone accepts any size, and the sizes it saw in rollouts."""
    out, shown = tmp_path_factory.mktemp("any") / "run", []
    wanted = make("sequential", steps=1, backbone=str(hf_folder("paligemma")))
    load, act, sizes = demonstrations.load, Policy.act, {"reach": (40, 60), "point": (48, 48)}

    def otherwise(*given: Any, **options: Any) -> Demonstrations:
        found = load(*given, **options)
        return found.fitted([sizes[str(found.task)]])

    def watched(self: Policy, pictures: torch.Tensor, *rest: Any) -> torch.Tensor:
        shown.append(tuple(pictures.shape[1:3]))
        return act(self, pictures, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demonstrations, "load", otherwise)
        patch.setattr(Policy, "act", watched)
        train.run(wanted, out)
    return out, shown


def test_rollouts_of_a_stream_show_pictures_in_the_sizes_of_each_tasks_training(
    of_any_size: tuple[Path, list[tuple[int, ...]]],
) -> None:
    """During training, in `aegis rollout` and in `load_policy`."""
    out, shown = of_any_size
    assert set(shown) == {(40, 60), (48, 48)}
    for task, size in (("reach", (40, 60)), ("point", (48, 48))):
        assert load_acting(out, task).sizes == (size,)
        assert load_policy(out, task).sizes == (size,)


def test_a_damaged_view_is_one_error(
    of_any_size: tuple[Path, list[tuple[int, ...]]], tmp_path: Path
) -> None:
    shutil.copytree(of_any_size[0], tmp_path / "run")
    path = tmp_path / "run" / "expert.safetensors"
    saved = artifacts.load(path)
    own = {"seed": saved.header.seed, "inputs": saved.header.inputs}
    for views in ([], [{}], [{}, {"pictures": [[0, 4]]}], [{}, 3]):
        meta = {**saved.header.meta, "views": views}
        fingerprint = saved.header.fingerprint
        artifacts.save(path, "expert", saved.tensors, fingerprint=fingerprint, meta=meta, **own)
        with pytest.raises(AegisError, match="is damaged"):
            robots.load_to_act(tmp_path / "run")


def test_a_stream_acts_by_the_camera_that_its_demonstrations_were_seen_by(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a policy of one task; other names of the only camera are the task's own."""
    monkeypatch.setattr(sim, "cameras", lambda name: ("top", "side"))
    load = demonstrations.load

    def seen_by(*given: Any, **options: Any) -> Demonstrations:
        found = load(*given, **options)
        camera = {"reach": "side", "point": "webcam"}[str(found.task)]
        return dataclasses.replace(found, cameras=(f"observation.images.{camera}",))

    monkeypatch.setattr(demonstrations, "load", seen_by)
    built = train.build(make("sequential"), tmp_path / "run")
    assert [built.acting(task).cameras for task in (0, 1)] == [("side",), ()]


# --- interrupted ----------------------------------------------------------------------------------


ONE, TWO = "task 1 reach", "task 2 point"
PLACES = {
    # In phases 1 and 2 of either task, while the first is evaluated, and after each.
    "igsp": (
        (ONE, 1),
        (ONE, 5),
        ("rollout seen reach", 1),
        ("stream", 1),
        (TWO, 2),
        (TWO, 5),
        ("stream", 2),
    ),
    "sequential": ((ONE, 5), ("stream", 1)),
    "isolated-lora": ((TWO, 5),),
}


@pytest.mark.parametrize("method", PLACES)
def test_interrupted_anywhere_and_resumed_it_ends_in_the_same_bytes(
    method: str, make: Make, done: Done, tmp_path: Path
) -> None:
    begin = partial(train.run, make(method), tmp_path / "run")
    for place in at_each(PLACES[method], begin):
        if place == ("stream", 1):
            assert_learned_and_tried(tmp_path / "run", done(method)[1])
    report = begin(resume=True)
    wanted, out = done(method)
    assert contents(tmp_path / "run") == contents(out)
    assert dataclasses.replace(report, minutes=0, out="") == dataclasses.replace(
        wanted, minutes=0, out=""
    )
    assert not (tmp_path / "run" / state.STATE).exists()
    again = begin(resume=True)
    assert again.success == report.success and contents(tmp_path / "run") == contents(out)


def assert_learned_and_tried(cut: Path, whole: Path) -> None:
    """The first task of an interrupted stream is not done again."""
    saved = artifacts.read_header(cut / state.STATE).meta["place"]
    assert (saved["task"], saved["step"]) == (1, 0)
    assert (len(saved["records"]), len(saved["vqa"])) == (1, 2)
    matrix = "success_matrix.json"
    so_far, all_of_it = (json.loads((folder / matrix).read_text()) for folder in (cut, whole))
    for name, count in (("tasks", 1), ("success", 1), ("vqa", 2)):
        assert so_far[name] == all_of_it[name][:count] and len(all_of_it[name]) == count + 1
    assert so_far["scores"]["last"] == all_of_it["success"][0][0]
    found = inspection.run(cut)
    assert isinstance(found, inspection.UnfinishedStream)
    assert (found.learned, found.step, found.tasks) == (1, 0, ("reach", "point"))
    assert json.loads(json.dumps(found.to_json()["matrix"])) == so_far


LATER = (("train", "freeze"), ("probe", "while_training"))


@pytest.fixture(scope="module")
def cut_in_the_second_task(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interrupted run of igsp; read-only."""
    out = tmp_path_factory.mktemp("cut") / "run"
    with pytest.raises(KeyboardInterrupt):
        train.run(make("igsp"), out, on_event=partial(stop, TWO, 3))
    return out


@pytest.mark.parametrize("unknown", [(), LATER[1:], LATER])
def test_a_run_that_an_earlier_version_began_goes_on_to_the_same_bytes(
    unknown: tuple[tuple[str, str], ...],
    cut_in_the_second_task: Path,
    make: Make,
    done: Done,
    tmp_path: Path,
) -> None:
    """That version wrote all keys it knew into the recipe, and digested all of some sections."""
    recipe, out = make("igsp"), tmp_path / "run"
    shutil.copytree(cut_in_the_second_task, out, symlinks=True)
    everything = dataclasses.asdict(recipe)
    written = json.loads(json.dumps(recipes.read(out / "recipe.yaml")[0]))
    for section, key in unknown:
        del everything[section][key], written[section][key]
    (out / "recipe.yaml").write_text(dump(written))
    part = {name: everything[name] for name in ("tasks", "backbone", "seed", "train", "expert")}
    part |= {"probe": everything["probe"], "rollout": recipes.recorded(recipe.rollout)}
    began_with(out, sha256_value(part | {"igsp": everything["igsp"]}))
    train.run(recipe, out, resume=True)
    (out / "recipe.yaml").write_text(to_yaml(recipe))
    assert contents(out) == contents(done("igsp")[1])


def test_a_state_of_another_recipe_is_refused(make: Make, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train.run(make("igsp"), out, on_event=partial(stop, ONE, 3))
    began_with(out, sha256_value(recipes.training_part(make("igsp", lr=2e-2))))
    with pytest.raises(AegisError, match="a different recipe than the run"):
        train.run(make("igsp"), out, resume=True)


def began_with(run: Path, digest: str) -> None:
    """Make the state of an interrupted run say that its recipe had this digest.

    As in an earlier version's, there is no digest of the settings that may not change.
    """
    saved = artifacts.load(run / state.STATE)
    inputs = {**saved.header.inputs, "recipe": digest}
    assert inputs != saved.header.inputs
    artifacts.save(
        run / state.STATE,
        "training-state",
        saved.tensors,
        seed=saved.header.seed,
        inputs=inputs,
        fingerprint=saved.header.fingerprint,
        meta={key: value for key, value in saved.header.meta.items() if key != "learns"},
    )


def test_other_demonstrations_do_not_continue_a_run(make: Make, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(make(), tmp_path / "run", on_event=partial(stop, ONE, 3))
    demos.run("reach", 5, 1, tmp_path / "other.safetensors", workers=1)
    point = make().demos.paths[1]
    other = make(demos=RobotDemos(paths=(str(tmp_path / "other.safetensors"), point)))
    with pytest.raises(AegisError, match="a different demos of reach"):
        train.run(other, tmp_path / "run", resume=True)


def test_other_demonstrations_are_not_those_of_a_finished_run(make: Make, tmp_path: Path) -> None:
    recorded = make(demos=RobotDemos(episodes=3))
    train.run(recorded, tmp_path / "run")
    before = contents(tmp_path / "run")
    other = dataclasses.replace(recorded, demos=RobotDemos(episodes=4))
    with pytest.raises(AegisError, match="(?s)different demonstrations than.*episodes 3"):
        train.run(other, tmp_path / "run", resume=True)
    assert train.run(recorded, tmp_path / "run", resume=True).success
    assert contents(tmp_path / "run") == before


# --- the command line -----------------------------------------------------------------------------


@pytest.fixture
def place(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "robot.yaml").write_text(to_yaml(make("isolated-lora", steps=2)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


TRAIN = ("train", "robot.yaml", "--out", "run")


def test_train_inspect_probe_and_rollout(
    aegis: Aegis, place: Path, bad: Callable[..., None]
) -> None:
    code, out, _ = aegis(*TRAIN)
    assert code == 0 and "small: isolated-lora on reach, point" in out
    for word in (
        "Success %",
        "VQA %",
        "before",
        "after reach",
        "after point",
        "Forgetting (points)",
        "stored beside",
    ):
        assert word in out
    code, out, _ = aegis("inspect", "run", "--plot", "routing.png")
    assert code == 0 and "after point" in out and "expert.proprio_in" in out
    assert (place / "routing.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = aegis("probe", "run")
    assert code == 0 and "measured again: 2 of 2 rows, largest difference 0" in out
    code, out, _ = aegis("rollout", "run", "--task", "point", "--episodes", "2", "--json")
    assert code == 0 and json.loads(out)["task"] == "point"
    bad("rollout", "run", says=("no --task", "reach, point"))
    bad("rollout", "run", "--task", "suite/cartpole-swingup", says=("cartpole", "reach, point"))
    bad("probe", "run", "--baseline", "embedded", says=("--baseline with the stream",))
    bad(*TRAIN, says=("an existing run", "--resume"))
    bad(*TRAIN, "--resume", "--set", "rollout.episodes=3", says=("other settings",))
    for name in ("expert", "experts", "routing"):
        path = place / "run" / f"{name}.safetensors"
        kept = path.read_bytes()
        path.write_bytes(kept[:-40])
        bad("rollout", "run", "--task", "reach", says=("truncated", path.name))
        path.write_bytes(kept)
    (place / "run" / "stream.json").unlink()
    for command in (("probe", "run"), ("rollout", "run", "--task", "reach")):
        bad(*command, says=("is not finished",))


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (
            ("--method", "zero-shot"),
            ("train.method: 'zero-shot'", "sequential, isolated-lora, igsp"),
        ),
        (("--method", "naive"), ("train.method: 'naive'",)),
        (
            ("--set", "probe.max_drop=1"),
            ("probe.max_drop: 1 with a stream", "delete probe.max_drop"),
        ),
        (("--demos", "x"), ("--demos with the stream of 'small'",)),
        (("--set", "tasks=[reach]"), ("demos.paths: 2 with 1 tasks",)),
        (("--set", "tasks=[reach, paint]"), ("tasks", "reach, point")),
        (("--set", "tasks=[point, reach]"), ("demonstrations of 'reach'", "for the task 'point'")),
        (("--set", "rollout.replan=21"), ("rollout.replan: 21 with train.chunk: 20",)),
        (("--set", "rollout.split=test"), ("rollout.split", "evaluation, validation")),
        (("--set", "demos.paths=[a, b]"), ("'a'",)),
        (("--set", "igsp.kapa=1"), ("did you mean 'igsp.kappa'?",)),
        (("--set", "backbone=nowhere"), ("nowhere",)),
        (("--set", "probe.vqa=nowhere.jsonl", "--set", "demos.paths=null"), ("nowhere.jsonl",)),
        (
            ("--set", "tasks=[suite/cartpole-swingup, reach]", "--set", "rollout.colors=held-out"),
            ("rollout.colors",),
        ),
        (
            ("--set", "tasks=[reach, suite/walker-walk]", "--set", "demos.paths=null"),
            ("'make the walker walk'",),
        ),  # first of all
    ],
)
def test_what_cannot_be_trained(
    bad: Callable[..., None], args: tuple[str, ...], says: tuple[str, ...]
) -> None:
    bad(*TRAIN, *args, says=says)


def test_recipes_are_told_apart(place: Path, bad: Callable[..., None], make: Make) -> None:
    assert load_training(place / "robot.yaml") == make("isolated-lora", steps=2)
    shipped = load_training(Path(__file__).parent.parent.parent / "recipes" / "igsp-robot.yaml")
    assert isinstance(shipped, RobotStreamRecipe) and shipped.tasks == ("reach", "point")
    (place / "typo.yaml").write_text(
        "kind: robot-stream\nname: x\ntaks: [reach, point]\nbackbone: embedded\nigsp: {rank: 2}\n"
    )
    bad("train", "typo.yaml", "--out", "run", says=("did you mean 'tasks'?",))
    bad("run", "robot.yaml", says=("a stream of robot tasks", "aegis train robot.yaml"))


def test_demonstrations_are_recorded_once_for_all_runs_beside_each_other(
    make: Make, tmp_path: Path
) -> None:
    recipe = make("isolated-lora", steps=1, demos=RobotDemos(episodes=2))
    seen: list[str] = []
    for name in ("a", "b"):
        train.run(recipe, tmp_path / name, on_event=lambda event: seen.append(event.stage))
    recorded = sorted(p.name for p in (tmp_path / "demos").glob("*.safetensors"))
    assert len(recorded) == 2
    assert all(word in name for word, name in zip(("point", "reach"), recorded, strict=True))
    assert sum("(up to date)" in stage for stage in seen) == 2
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
