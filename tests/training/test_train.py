"""`aegis train` from the first step to the last: its folder, its figures, and naive in PyTorch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
from samples.graphs import Keeper, backward_through, outputs_kept
from samples.tiny import make_tiny
from samples.training_runs import (
    EVERY,
    SETTINGS,
    STEPS,
    TIMES,
    Start,
    contents,
    metrics,
    protected_shares,
    small_policy,
)
from torch import nn

from aegis_cli.anchors import anchor_file as anchor_files
from aegis_cli.common import artifacts, devices, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.core.anchor import Anchor
from aegis_cli.data import demonstrations
from aegis_cli.data.batch import RobotBatch
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Parts
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.models.expert import ActionExpert
from aegis_cli.recipes import Nullspace, Recipe
from aegis_cli.training import checkpoint, dry_run, loading, schedule, train

FIGURES = {"step", "loss", "lr_expert"} | TIMES


# --- a run from first step to last ----------------------------------------------------------------


def test_the_run_folder(finished: tuple[str, Path]) -> None:
    _, out = finished
    parts = ["backbone/model.safetensors", "expert.safetensors", "training_state/state.safetensors"]
    steps = [f"{n:06d}" for n in range(EVERY, STEPS + 1, EVERY)]
    expected = {f"checkpoints/{n}/{part}" for n in steps for part in parts}
    assert contents(out).keys() == expected | {
        "checkpoints/last",
        "inputs.json",
        "ledger.safetensors",
        "machine.json",
        "recipe.yaml",
    }
    assert (out / "checkpoints" / "last").readlink() == Path(
        steps[-1]
    )  # relative: the run may be moved


def test_a_run_says_what_precision_its_automatic_one_was(
    start: Start,
    recipe: Recipe,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    automatic = replace(recipe, train=replace(recipe.train, precision="auto", steps=2))
    for multiplies, taken in ((True, "bf16"), (False, "float32")):
        monkeypatch.setattr(devices, "multiplies_bf16", lambda _, found=multiplies: found)
        planned = dry_run.run(automatic, "naive", demos_file, None, tmp_path / "dry")
        start("naive", tmp_path / taken, recipe=automatic)
        assert files.load_json(tmp_path / taken / "machine.json")["precision"] == taken
        assert planned.precision == taken


def test_a_training_and_its_dry_run_warn_of_bf16_that_the_processor_has_nothing_for(
    recipe: Recipe, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = replace(recipe, train=replace(recipe.train, precision="bf16", steps=1))
    for has in (True, False):
        listed = {"amx_bf16": False, "avx512_bf16": has}
        found = partial(dict, listed)
        monkeypatch.setattr(torch.cpu, "get_capabilities", found, raising=False)
        for stage in (dry_run, train):
            said: list[Event] = []
            given = (wanted, "naive", demos_file, None, tmp_path / f"{stage.__name__} {has}")
            stage.run(*given, on_event=said.append)
            warned = [event.text for event in said if isinstance(event, Warned)]
            assert any("train.precision=auto" in text for text in warned) is not has


@pytest.mark.parametrize(
    ("weight", "rate", "step", "method", "said_so"),
    [
        (0.6, 1e-3, "proximal", "kfac", True),
        (0.4, 1e-3, "proximal", "kfac", False),
        (0.6, 0.0, "proximal", "kfac", False),
        (0.6, 1e-3, "gradient", "kfac", False),
        (0.6, 1e-3, "proximal", "naive", False),
    ],
)
def test_a_training_and_its_dry_run_warn_of_a_pull_that_leaves_nothing_to_learn(
    weight: float, rate: float, step: str, method: str, said_so: bool, start: Start, recipe: Recipe,
    demos_file: Path, anchor_file: Path, tmp_path: Path,
) -> None:  # fmt: skip
    chosen = replace(recipe, kfac=replace(recipe.kfac, weight=weight, step=step))
    wanted = replace(chosen, train=replace(chosen.train, steps=1, backbone_lr=rate))
    for stage in (dry_run, train):
        said: list[Event] = []
        given = (wanted, method, demos_file, anchor_file, tmp_path / stage.__name__)
        stage.run(*given, on_event=said.append)
        found = [e.text for e in said if isinstance(e, Warned) and "weight of kfac" in e.text]
        assert bool(found) == said_so
        # 600 times the rate of 1e-3, where 15 times would be 0.015.
        words = ("600 times the backbone's learning rate 0.001", "--set kfac.weight=0.015")
        assert all(word in text for text in found for word in words)


def of_energy(anchor: Path, energy: float, path: Path) -> Path:
    """A copy of an anchor that says to store this share of the energy."""
    saved = artifacts.load(anchor, "anchor")
    head = saved.header
    own = {"seed": head.seed, "inputs": head.inputs, "fingerprint": head.fingerprint}
    artifacts.save(path, "anchor", saved.tensors, **own, meta=head.meta | {"energy": energy})
    return path


@pytest.mark.parametrize(
    ("soft", "energy", "method", "said_so"),
    [
        (1e-4, None, "nullspace", False),  # the defaults
        (1e-5, None, "nullspace", True),
        (1e-5, 0.9, "nullspace", False),
        (1e-5, None, "naive", False),
    ],
)
def test_directions_that_the_anchor_does_not_store_are_said_to_be_free(
    soft: float, energy: float | None, method: str, said_so: bool, recipe: Recipe,
    demos_file: Path, anchor_file: Path, tmp_path: Path,
) -> None:  # fmt: skip
    chosen = replace(recipe, nullspace=replace(recipe.nullspace, soft=soft, energy=energy))
    wanted = replace(chosen, train=replace(chosen.train, steps=1))
    said: list[Event] = []
    anchor = of_energy(anchor_file, 0.9999, tmp_path / "anchor.safetensors")
    train.run(wanted, method, demos_file, anchor, tmp_path / "run", on_event=said.append)
    found = [e.text for e in said if isinstance(e, Warned) and "does not store" in e.text]
    assert bool(found) == said_so and all("--energy 0.999999," in text for text in found)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_no_graph_outlives_its_step(
    method: str, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    """Nor the validation after the last one."""
    short = replace(recipe, train=replace(SETTINGS, steps=SETTINGS.validate_every))
    made, kept = outputs_kept(lambda: start(method, tmp_path / "run", recipe=short))
    assert made > 0 == kept


def test_a_graph_that_outlives_its_step_is_found() -> None:
    assert outputs_kept(lambda: backward_through(Keeper())) == (1, 1)
    assert outputs_kept(lambda: backward_through(nn.Linear(2, 1))) == (1, 0)


def test_every_figure_is_logged(finished: tuple[str, Path]) -> None:
    method, out = finished
    own = set() if method == "stop-gradient" else {"lr_backbone"}
    own |= {"energy_shed", "conflict"} if METHODS[method].compares_layers else set()
    lines = metrics(out)
    assert [line["step"] for line in lines] == list(range(1, STEPS + 1))
    for line in lines:
        judged = {"validation_loss"} if line["step"] % SETTINGS.validate_every == 0 else set()
        assert line.keys() == FIGURES | own | judged
        assert all(math.isfinite(value) for value in line.values())
        assert line["step_s"] == pytest.approx(line["data_s"] + line["update_s"])
        assert line["samples_per_s"] == pytest.approx(SETTINGS.batch_size / line["step_s"])


def test_the_ledger_has_a_row_a_step(finished: tuple[str, Path]) -> None:
    method, out = finished
    ledger = artifacts.load(out / "ledger.safetensors", "ledger")
    groups, layers = ledger.header.meta["groups"], ledger.header.meta["layers"]
    if not METHODS[method].compares_layers:
        assert groups == layers == [] and len(ledger.tensors["step"]) == 0
        return
    assert groups == list(make_tiny().parameter_groups()) and layers == ["layers.0", "layers.1"]
    assert ledger.tensors["step"].tolist() == list(range(1, STEPS + 1))
    assert ledger.tensors["tt"].shape == (STEPS, len(groups)) and ledger.tensors["w2"].shape == (
        STEPS,
        2,
    )
    shed = ledger.tensors["ta"].clamp(max=0).square() / ledger.tensors["aa"].where(
        ledger.tensors["aa"] > 0, 1.0
    )
    by_step = shed.sum(1) / ledger.tensors["tt"].sum(1)
    assert [line["energy_shed"] for line in metrics(out)] == pytest.approx(by_step.tolist())
    conflicts = (ledger.tensors["ta"] < 0).double().mean(1)
    assert [line["conflict"] for line in metrics(out)] == pytest.approx(conflicts.tolist())


def test_a_checkpoint_is_a_plain_vlm_and_its_policy(
    finished: tuple[str, Path], tiny_folder: Path
) -> None:
    method, out = finished
    given, trained = backbones.load(str(tiny_folder)), backbones.load(str(out))
    assert [(n, t.shape) for n, t in trained.state_dict().items()] == [
        (n, t.shape) for n, t in given.state_dict().items()
    ]
    assert (trained.fingerprint() == given.fingerprint()) == (method == "stop-gradient")
    policy, meta = checkpoint.load_policy(out)
    assert meta["method"] == method and meta["task"] == "reach"
    assert policy.backbone.fingerprint() == trained.fingerprint()


def test_the_report(start: Start, tmp_path: Path) -> None:
    events: list[Progress] = []
    report = start("aegis", tmp_path, on_event=events.append)
    lines = metrics(tmp_path)
    assert (report.method, report.steps, report.out) == ("aegis", STEPS, str(tmp_path))
    assert (report.loss, report.validation_loss) == (
        lines[-1]["loss"],
        lines[-1]["validation_loss"],
    )
    assert report.energy_shed_mean == pytest.approx(
        np.mean([line["energy_shed"] for line in lines])
    )
    told = [f"{event.stage} {event.done}/{event.total}" for event in events]
    loading = ["train (loading) 0/1", "train (loading) 1/1"]
    assert told == loading + [f"train {done}/{STEPS}" for done in range(STEPS + 1)]
    assert report.to_json()["step_s"] > 0


def test_a_training_says_that_it_loads_before_it_does(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a pipe nothing else would be printed: a large model and many frames take minutes."""
    events: list[Event] = []

    def load(name: str) -> NoReturn:
        raise AegisError(f"no model '{name}' after {len(events)} events", "one", "make one")

    monkeypatch.setattr(loading.backbones, "load", load)
    with pytest.raises(AegisError, match="after 1 events"):
        start("naive", tmp_path, on_event=events.append)
    assert events == [Progress("train (loading)", 0, 1, "model")]


def test_learning_rates_warm_up_and_fall(naive_run: Path) -> None:
    """Two steps of warm-up, then a cosine decay to a tenth over the remaining four."""
    factors = [0.5, 1.0] + [0.1 + 0.9 * (1 + math.cos(math.pi * i / 4)) / 2 for i in range(4)]
    for name, peak in (("lr_backbone", SETTINGS.backbone_lr), ("lr_expert", SETTINGS.expert_lr)):
        assert [line[name] for line in metrics(naive_run)] == pytest.approx(
            [peak * f for f in factors]
        )


def test_a_line_of_metrics_covers_the_steps_since_the_one_before(
    start: Start, recipe: Recipe, naive_run: Path, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, log_every=3, checkpoint_every=STEPS)
    start("naive", tmp_path, recipe=replace(recipe, train=settings))
    every = [line["loss"] for line in metrics(naive_run)]
    assert [line["loss"] for line in metrics(tmp_path)] == pytest.approx(
        [np.mean(every[:3]), np.mean(every[3:])]
    )


@pytest.mark.parametrize("freeze", [None, "stem.norm"])
def test_running_averages_that_move_are_told_once_with_what_keeps_them(
    freeze: str | None,
    recipe: Recipe,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No known family has any, but a model from the hub may."""
    load = loading.backbones.load

    def with_averages(name: str) -> Backbone:
        backbone = load(name)
        backbone.stem.norm = nn.BatchNorm2d(3)
        backbone.stem.register_forward_pre_hook(lambda stem, given: stem.norm(*given))
        return backbone

    monkeypatch.setattr(loading.backbones, "load", with_averages)
    chosen = replace(recipe, train=replace(SETTINGS, steps=2, checkpoint_every=2, freeze=freeze))
    for run in (train.run, dry_run.run):
        told: list[str] = []

        def hear(event: Event, told: list[str] = told) -> None:
            told += [event.text] if isinstance(event, Warned) else []

        run(chosen, "naive", demos_file, None, tmp_path / run.__module__, on_event=hear)
        assert len(told) == (freeze is None)
        for text in told:
            assert "buffers of 'stem.norm', as BatchNorm" in text and "train.freeze" in text


def test_all_methods_begin_with_the_same_expert(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    still = replace(SETTINGS, steps=1, expert_lr=0.0, weight_decay=0.0)
    for method in METHODS:
        start(method, tmp_path / method, recipe=replace(recipe, train=still))
    experts = [
        artifacts.load(checkpoint.last(tmp_path / m) / "expert.safetensors", "expert").tensors
        for m in METHODS
    ]
    assert all(torch.equal(other[name], t) for other in experts for name, t in experts[0].items())
    assert len({metrics(tmp_path / m)[0]["loss"] for m in METHODS}) == 1


def test_seeds_give_different_runs(
    start: Start, recipe: Recipe, naive_run: Path, tmp_path: Path
) -> None:
    start("naive", tmp_path, recipe=replace(recipe, seed=1))
    assert metrics(tmp_path)[-1]["loss"] != metrics(naive_run)[-1]["loss"]


# While tracing a graph, torch.compile accesses a field for which PyTorch warns.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_a_compiled_policy_trains_alike(
    start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both backward passes use the compiled graph.

    To keep this test quick, the backend generates no code and the validation has a single batch:
    another size would be compiled again.
    """
    monkeypatch.setattr(train, "VALIDATION_FRAMES", SETTINGS.batch_size)
    torch._dynamo.reset()  # beside an earlier test's graphs these would be dynamic, and slower
    called: list[str] = []

    def quickly(real: Callable[..., None], part: Any) -> None:
        called.append(real.__name__)
        real(part, "aot_eager")

    for owner, name in ((EmbeddedVLM, "compile_passes"), (ActionExpert, "compile_layers")):
        real = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda part, real=real: quickly(real, part))
    runs = []
    for compiled in (False, True):
        out = tmp_path / str(compiled)
        settings = replace(SETTINGS, steps=2, checkpoint_every=2, compile=compiled)
        start("aegis", out, recipe=replace(recipe, train=settings))
        runs.append(
            (
                artifacts.load(out / "ledger.safetensors").tensors,
                backbones.load(str(out)).state_dict(),
            )
        )
    assert called == ["compile_passes", "compile_layers"]
    for plain, compiled in zip(*runs, strict=True):
        for name, tensor in plain.items():
            torch.testing.assert_close(compiled[name], tensor, rtol=1e-4, atol=1e-6)


def test_training_reads_no_question(
    start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("training read questions")

    places = "dataset.load_scenes", "dataset.render_training", "sets.read"
    for place in places:
        monkeypatch.setattr(f"aegis_cli.data.vqa.{place}", forbidden)
    short = replace(recipe, train=replace(SETTINGS, steps=2, validate_every=2))
    for name in (name for name in METHODS if name != "cotrain"):
        start(name, tmp_path / name, recipe=short)


def test_a_constraint_covers_all_the_steps_since_the_last(
    start: Start, recipe: Recipe, anchor_file: Path, tmp_path: Path
) -> None:
    """At every checkpoint nothing has moved along the protected directions, whatever the turn."""
    settings = replace(SETTINGS, weight_decay=0.5)
    start("naive", tmp_path / "lost", recipe=replace(recipe, train=settings))
    assert min(protected_shares(tmp_path / "lost", anchor_file, 0.9)) > 0.01
    for every in (1, 3, 4):
        kept = replace(recipe, train=settings, nullspace=Nullspace(energy=0.9, every=every))
        out = tmp_path / f"kept {every}"
        start("nullspace", out, recipe=kept)
        assert max(protected_shares(out, anchor_file, 0.9)) < 1e-8, every


def test_kfac_reads_the_curvature_alone(start: Start, anchor_file: Path, tmp_path: Path) -> None:
    fingerprint = make_tiny().fingerprint()
    wanted = anchor_files.Wanted(fingerprint, "tiny", "--backbone ")
    curvature = anchor_files.load(anchor_file, wanted).curvature
    anchor_files.save(
        tmp_path / "alone.safetensors",
        Anchor(curvature=curvature),
        fingerprint=fingerprint,
        meta={},
    )
    start("kfac", tmp_path / "with-more")
    start("kfac", tmp_path / "alone", anchor=tmp_path / "alone.safetensors")
    one, other = (
        backbones.load(str(tmp_path / name)).fingerprint() for name in ("with-more", "alone")
    )
    assert one == other != fingerprint


def test_a_parameter_takes_the_share_of_each_step_that_the_method_leaves_it(
    start: Start,
    recipe: Recipe,
    naive_run: Path,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A share of 1 is naive, bit for bit. At a share of 0 not even weight decay moves it."""
    chosen = "layers.0.up.weight"
    for share in (1.0, 0.0):

        def begin(context: MethodContext, share: float = share) -> Parts:
            return Parts(shares=lambda: {context.learning()[chosen]: share})

        monkeypatch.setitem(METHODS, "naive", replace(METHODS["naive"], start=begin))
        start("naive", tmp_path / str(share))
    given, naive, whole, none = (
        backbones.load(str(place)).state_dict()
        for place in (tiny_folder, naive_run, tmp_path / "1.0", tmp_path / "0.0")
    )
    assert all(torch.equal(whole[name], t) for name, t in naive.items())
    assert torch.equal(none[chosen], given[chosen]) and not torch.equal(
        naive[chosen], given[chosen]
    )
    assert not torch.equal(none["layers.0.down.weight"], given["layers.0.down.weight"])
    rates = [
        [line["lr_backbone"] for line in metrics(run)] for run in (naive_run, tmp_path / "0.0")
    ]
    assert rates[0] == rates[1]


# --- naive is plain PyTorch -----------------------------------------------------------------------


Make = Callable[[dict[str, Any]], torch.optim.Optimizer]
WITHOUT_MOMENTUM = {"momentum": 0.0}
ADAMW_AS_IN_OPENPI = {"betas": (0.9, 0.95), "eps": 1e-6}


def adamw(group: dict[str, Any], **options: Any) -> torch.optim.Optimizer:
    decay = SETTINGS.weight_decay
    return torch.optim.AdamW([group], weight_decay=decay, fused=True, **options)


def sgd(group: dict[str, Any], momentum: float = 0.9) -> torch.optim.Optimizer:
    return torch.optim.SGD([group], momentum=momentum, weight_decay=SETTINGS.weight_decay)


@pytest.mark.parametrize(
    ("changes", "of_backbone", "of_expert"),
    [
        ({"schedule": "cosine"}, adamw, adamw),
        ({"schedule": "linear", "final_lr_share": 0.0}, adamw, adamw),
        ({"schedule": "constant"}, adamw, adamw),
        (ADAMW_AS_IN_OPENPI, *[partial(adamw, **ADAMW_AS_IN_OPENPI)] * 2),
        ({"optimizer": "sgd"}, sgd, adamw),
        ({"optimizer": "sgd", **WITHOUT_MOMENTUM}, partial(sgd, **WITHOUT_MOMENTUM), adamw),
        ({"optimizer": "sgd", **ADAMW_AS_IN_OPENPI}, sgd, partial(adamw, **ADAMW_AS_IN_OPENPI)),
    ],
)
def test_naive_equals_a_plain_training_loop(
    start: Start,
    recipe: Recipe,
    demos_file: Path,
    tiny_folder: Path,
    tmp_path: Path,
    changes: dict[str, Any],
    of_backbone: Make,
    of_expert: Make,
) -> None:
    """A loop without stages, methods or ledgers reaches the same bits."""
    chosen = replace(SETTINGS, **changes)
    start("naive", tmp_path, recipe=replace(recipe, train=chosen))
    demos = demonstrations.load(demos_file, SETTINGS.validation_share, recipe.seed)
    backbone = backbones.load(str(tiny_folder))
    torch.manual_seed(recipe.seed)
    policy = small_policy(backbone, demos).train()
    expert = policy.expert
    learning = [*backbone.parameters(), *expert.parameters()]
    optimizers = [
        of_backbone({"params": backbone.parameters(), "lr": SETTINGS.backbone_lr}),
        of_expert({"params": expert.parameters(), "lr": SETTINGS.expert_lr}),
    ]
    schedulers = [
        torch.optim.lr_scheduler.LambdaLR(o, lambda i: schedule.rate_factor(i, chosen))
        for o in optimizers
    ]
    losses = []
    for batch, generator in batches(demos, recipe.seed):
        policy.zero_grad()
        encoding = policy.encode(batch.images, batch.instructions)
        loss = policy.flow_loss(batch, encoding, SETTINGS.flow_samples, generator)
        loss.backward()
        nn.utils.clip_grad_norm_(learning, SETTINGS.clip_norm)
        for stepping in (*optimizers, *schedulers):
            stepping.step()
        losses.append(loss.item())
    trained, _ = checkpoint.load_policy(tmp_path)
    assert losses == [line["loss"] for line in metrics(tmp_path)]
    for (site, got), expected in zip(trained.named_parameters(), policy.parameters(), strict=True):
        assert torch.equal(got, expected), site


def batches(
    demos: demonstrations.Demonstrations, seed: int
) -> Iterator[tuple[RobotBatch, torch.Generator]]:
    """The batches of the run's steps: one shuffle of the frames per epoch, one generator a step."""
    frames = np.random.default_rng([seed, 0]).permutation(len(demos.train))
    for i in range(STEPS):
        rows = demos.train[frames[i * SETTINGS.batch_size : (i + 1) * SETTINGS.batch_size]]
        yield (
            demos.batch(rows, SETTINGS.chunk),
            torch.Generator().manual_seed((seed * 1_000_003 + i) * 4 + 1),
        )


@pytest.mark.parametrize(
    ("asked", "wanted", "method", "warned"),
    [
        ("{} shortly", "{}", "aegis", True),
        ("{}", "{} shortly", "aegis", True),
        ("{} shortly", "{} shortly", "aegis", False),
        ("{} shortly", "{}", "naive", False),
    ],
)
def test_an_anchor_whose_questions_were_asked_in_another_way_is_told(
    asked: str,
    wanted: str,
    method: str,
    warned: bool,
    start: Start,
    recipe: Recipe,
    anchor_file: Path,
    tmp_path: Path,
) -> None:
    saved = artifacts.load(anchor_file, "anchor")
    meta = {**saved.header.meta, "vqa": "questions.jsonl", "ask": asked}
    other = tmp_path / "anchor.safetensors"
    artifacts.save(other, "anchor", saved.tensors, fingerprint=saved.header.fingerprint, meta=meta)
    told = replace(recipe, anchor=replace(recipe.anchor, ask=wanted))
    said: list[Event] = []
    start(method, tmp_path / "run", recipe=told, anchor=other, on_event=said.append)
    texts = [event.text for event in said if isinstance(event, Warned)]
    assert [f"asked as '{asked}'" in text and f"--ask '{wanted}'" in text for text in texts] == (
        [True] if warned else []
    )
