"""Several processes train like a single one, for any number of them and every method."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples import processes
from samples.parallel_runs import Averaging, Job, Measuring, free_ports, lose_one, run_together
from samples.training_runs import TIMES, metrics
from torch import multiprocessing
from torch.utils import _pytree as pytree

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.common.ranks import Ranks
from aegis_cli.core.attention import KeyValue
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.methods import METHODS
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Batch, Encoding
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import Recipe
from aegis_cli.training import assemble, checkpoint, loading, parallel, step
from aegis_cli.training.train import LEDGER

Make = Callable[..., Job]
BATCH, STEPS, SAVED = 8, 4, 2  # three processes have 2, 3 and 3 frames of a batch
SHORT = {"steps": SAVED}  # if it is enough to take steps up to the first checkpoint


@pytest.fixture(scope="module")
def make(recipe: Recipe, demos_file: Path, anchor_file: Path) -> Make:
    def job(method: str, out: Path, **settings: Any) -> Job:
        own = {
            "method": method,
            "steps": STEPS,
            "batch_size": BATCH,
            "checkpoint_every": SAVED,
            "validate_every": 2,
        }
        changed = replace(recipe.train, **own | settings)
        asked = replace(recipe.cotrain, batch_size=BATCH)
        wanted = replace(recipe, train=changed, cotrain=asked)
        return Job(wanted, method, demos_file, anchor_file, out)

    return job


def assert_same_training(one: Path, other: Path) -> None:
    """Losses and the ledger agree up to rounding."""
    for here, there in zip(metrics(one, TIMES), metrics(other, TIMES), strict=True):
        assert here == pytest.approx(there, rel=1e-5, abs=1e-7)
    rows, its = (artifacts.load(run / LEDGER, "ledger").tensors for run in (one, other))
    for name, values in rows.items():
        # The inner product of two gradients is a difference of larger numbers.
        torch.testing.assert_close(values, its[name], rtol=1e-4, atol=1e-9)


# Together they use every feature: a second backward pass, their own losses, constrained updates.
OF_THREE = (
    ("ddp", "aegis"),
    ("ddp", "distill"),
    ("ddp", "cotrain"),
    ("fsdp", "aegis"),
    ("fsdp", "kfac"),
)
OF_TWO = (("ddp", "nullspace"), ("fsdp", "nullspace"), ("fsdp", "ewc"), ("fsdp", "lora"))
FROZEN = (("ddp", "aegis"), ("fsdp", "aegis"), ("fsdp", "nullspace"))  # parts of the backbone are
OF_TWO_IN_BF16 = (("ddp", "aegis"), ("fsdp", "aegis"), ("fsdp", "nullspace"), ("fsdp", "kfac"))


def watched(job: Job) -> Job:
    """The same training, which asks, acts and predicts with every validation loss.

    Three processes ask 2, 2 and 3 of the questions if each has whole weights. Only the first one
    acts and predicts. Whole chunks are executed, so an episode takes few predictions.
    """
    recipe = job.recipe
    watching = replace(
        recipe,
        train=replace(recipe.train, validate_actions=6),
        probe=replace(recipe.probe, while_training=7),
        rollout=replace(recipe.rollout, while_training=1, replan=recipe.train.chunk),
    )
    return replace(job, recipe=watching)


@pytest.fixture(scope="module")
def hugging_face(
    make: Make, hf_folder: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> Job:
    out = tmp_path_factory.mktemp("hf") / "run"
    job = make("naive", out, parallel="fsdp", gradient_checkpointing=True, steps=2)
    recipe = replace(job.recipe, backbone=str(hf_folder("paligemma")))
    return replace(job, recipe=recipe, anchor=None)


@pytest.fixture(scope="module")
def shared_runs(
    make: Make, hugging_face: Job, tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[object, Any]:
    """Trainings by three processes and by two, and one that three began and two finished.

    Starting the processes takes longer than their work, so they do all of it.
    """
    out = tmp_path_factory.mktemp("shared")
    three, two = (
        {(way, name): make(name, out / way / name, parallel=way) for way, name in each}
        for each in (OF_THREE, OF_TWO)
    )
    changes = {"accumulate": 2, "ema_decay": 0.6}
    for key in (("ddp", "distill"), ("fsdp", "aegis")):
        three[key] = watched(three[key])
    begun = make("aegis", out / "begun", parallel="fsdp", **changes)
    ended = make("aegis", out / "begun", parallel="ddp", **changes)
    # Its expert also reads the last layer's keys and values, besides that layer's output.
    two["fsdp", "hf"] = watched(hugging_face)
    average = make("nullspace", out / "average", parallel="fsdp", ema_decay=0.6)
    two["fsdp", "nullspace", "average"] = watched(average)
    for way, name in FROZEN:
        held = {"parallel": way, "freeze": ("stem", "layers.0"), **SHORT}
        two[way, name, "frozen"] = make(name, out / way / f"{name}-frozen", **held)
    tower = replace(hugging_face.recipe.train, freeze="vision")
    two["fsdp", "hf", "frozen"] = replace(
        hugging_face, recipe=replace(hugging_face.recipe, train=tower), out=out / "hf-frozen"
    )
    for way, name in OF_TWO_IN_BF16:
        two[way, name, "bf16"] = make(
            name, out / way / f"{name}-bf16", parallel=way, precision="bf16", **SHORT
        )
    changed = replace(hugging_face.recipe.train, precision="bf16")
    two["fsdp", "hf", "bf16"] = replace(
        hugging_face, recipe=replace(hugging_face.recipe, train=changed), out=out / "hf-bf16"
    )
    for way in ("ddp", "fsdp"):
        job = make("naive", out / f"averaging-{way}", parallel=way, **SHORT)
        two[way, "averaging"] = Averaging(**vars(replace(job, anchor=None)))
    # The others notice that it is gone, and one of them may be reported first.
    gone = (multiprocessing.ProcessExitedException, multiprocessing.ProcessRaisedException)
    with pytest.raises(gone):
        run_together(3, [*three.values(), replace(begun, killed_after=SAVED + 1)])
    measuring = Measuring(tiny_folder, out / "measured")
    run_together(2, [replace(ended, resume=True), *two.values(), measuring])
    found: dict[object, Any] = {"resumed": ended, "measured": measuring}
    for count, done in ((3, three), (2, two)):
        found |= {(count, *key): job for key, job in done.items()}
    return found


@pytest.mark.parametrize(
    "key", [*((3, *k) for k in OF_THREE), *((2, *k) for k in (*OF_TWO, ("fsdp", "hf")))]
)
def test_processes_train_what_one_trains(
    shared_runs: dict[object, Any], tmp_path: Path, key: tuple[int, str, str]
) -> None:
    job = shared_runs[key]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    assert_same_training(job.out, alone.out)
    if job.recipe.probe.while_training:
        figures = {"vqa_accuracy", "vqa_cross_entropy", "rollout_success", "action_error"}
        assert all(figures <= line.keys() for line in metrics(job.out, TIMES)[1::2])


@pytest.mark.parametrize("key", [*FROZEN, ("fsdp", "hf")])
def test_parts_that_are_frozen_stay_so_in_every_process(
    shared_runs: dict[object, Any], tmp_path: Path, key: tuple[str, str]
) -> None:
    job = shared_runs[2, *key, "frozen"]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    assert_same_training(job.out, alone.out)
    before, after = (
        dict(backbones.load(str(at)).named_parameters()) for at in (job.recipe.backbone, job.out)
    )
    parts = ("stem.", "layers.0.", "vlm.model.vision", "vlm.model.multi_modal")
    still = {name for name in before if name.startswith(parts)}
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert still and moved and not moved & still


@pytest.mark.parametrize("key", [*OF_TWO_IN_BF16, ("fsdp", "hf")])
def test_processes_train_in_bf16_what_one_trains(
    shared_runs: dict[object, Any], tmp_path: Path, key: tuple[str, str]
) -> None:
    """They agree up to rounding: each process rounds the gradient of its own frames."""
    job = shared_runs[2, *key, "bf16"]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    here, there = metrics(job.out, TIMES), metrics(alone.out, TIMES)
    assert here[0]["loss"] == pytest.approx(there[0]["loss"], rel=1e-5)
    for one, other in zip(here, there, strict=True):
        assert one["loss"] == pytest.approx(other["loss"], rel=2e-3)
    if job.anchor is not None and METHODS[job.method].compares_layers:
        rows, its = (artifacts.load(run / LEDGER, "ledger").tensors for run in (job.out, alone.out))
        for name in ("tt", "aa", "w2"):
            assert (rows[name].sum(1) > 0).all()
            torch.testing.assert_close(rows[name].sum(1), its[name].sum(1), rtol=2e-2, atol=0)


def test_weights_gathered_in_bf16_are_those_that_autocast_makes(
    shared_runs: dict[object, Any],
) -> None:
    """Sharded or not: the same products, the same float32 norms, the same sums."""
    whole, sharded = (shared_runs[2, way, "aegis", "bf16"].out for way in ("ddp", "fsdp"))
    assert_same_training(sharded, whole)


def test_only_what_enters_products_is_gathered_in_bf16(tiny_folder: Path) -> None:
    from torch.distributed.fsdp import MixedPrecisionPolicy

    blocks = parallel._blocks(backbones.load(str(tiny_folder)))
    found = parallel._halved(blocks)
    half = {module for module, policy in found.items() if policy.param_dtype == torch.bfloat16}
    assert half == set(blocks)
    apart = [module for module in found if module not in half]
    assert apart and all(isinstance(module, torch.nn.LayerNorm) for module in apart)
    assert all(found[module] == MixedPrecisionPolicy() for module in apart)


def test_what_three_began_two_finish(shared_runs: dict[object, Any], tmp_path: Path) -> None:
    """This includes weights that were sharded before the interruption and are whole after it."""
    job = shared_runs["resumed"]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    assert_same_training(job.out, alone.out)
    assert_same_policy(job.out, alone.out)


def assert_same_policy(one: Path, other: Path) -> None:
    policy, plain = (checkpoint.load_policy(out)[0] for out in (one, other))
    for parameter, its in zip(policy.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(parameter, its, rtol=1e-3, atol=1e-4)


def test_the_average_of_sharded_weights_is_written_whole(
    shared_runs: dict[object, Any], tmp_path: Path
) -> None:
    job = shared_runs[2, "fsdp", "nullspace", "average"]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    assert_same_training(job.out, alone.out)
    assert_same_policy(job.out, alone.out)


@pytest.mark.parametrize("way", ["ddp", "fsdp"])
def test_batch_normalisations_average_the_frames_of_all_processes(
    shared_runs: dict[object, Any], tmp_path: Path, way: str
) -> None:
    job = shared_runs[2, way, "averaging"]
    alone = replace(job, out=tmp_path / "alone")
    alone.run()
    # Each has half of a batch, so the mean of both averages equals that of one process, up to
    # PyTorch's rounding of a sum over so many pixels. The average of one of the two is a fifth off.
    both, one = (artifacts.load(checkpoint.last(j.out) / checkpoint.STATE) for j in (job, alone))
    mean = "buffer.backbone.stem.norm.running_mean"
    torch.testing.assert_close(both.tensors[mean], one.tensors[mean], rtol=1e-3, atol=0)


def test_two_processes_measure_what_one_measures(
    shared_runs: dict[object, Any], tmp_path: Path
) -> None:
    both = shared_runs["measured"]
    alone = replace(both, out=tmp_path / "alone")
    alone.run()
    here, there = (
        artifacts.load(each.out / "anchor.safetensors", "anchor") for each in (both, alone)
    )
    assert here.header.meta == there.header.meta and here.tensors.keys() == there.tensors.keys()
    for name, values in here.tensors.items():
        other = there.tensors[name]
        if name.endswith(".values"):  # the smallest are only rounding
            assert (values - other).abs().max() <= 1e-5 * other.abs().max(), name
        elif not name.endswith(".vectors"):  # which have no sign
            torch.testing.assert_close(values, other, rtol=1e-5, atol=1e-7)
    said, expected = (
        [json.loads(line) for line in (each.out / "predictions.jsonl").read_text().splitlines()]
        for each in (both, alone)
    )
    for one, other in zip(said, expected, strict=True):
        assert one.pop("cross_entropy") == pytest.approx(other.pop("cross_entropy"), rel=1e-5)
        assert one == other


def test_one_process_accumulates_the_same_gradient(make: Make, tmp_path: Path) -> None:
    runs = [make("naive", tmp_path / str(passes), accumulate=passes) for passes in (1, 3)]
    for job in runs:
        job.run()
    assert_same_training(*(job.out for job in runs))


def test_a_validation_passes_no_more_frames_at_once_than_a_step(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, seen = make("naive", tmp_path / "run", accumulate=3), []
    encode = EmbeddedVLM.encode

    def noting(self: EmbeddedVLM, batch: Batch) -> Any:
        seen.append(len(batch.ids))
        return encode(self, batch)

    monkeypatch.setattr(EmbeddedVLM, "encode", noting)
    job.run()
    assert max(seen) <= -(-job.recipe.train.batch_size // 3)


@pytest.mark.parametrize(
    ("number", "wanted"), [(0, ["decide and load", "wait"]), (1, ["wait", "load"])]
)
def test_one_process_of_a_machine_decodes_and_the_others_find_the_frames(
    number: int,
    wanted: list[str],
    make: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It also decides whether the disk has room for them: two might decide differently."""
    order: list[str] = []
    load = loading.load_demonstrations

    def noted(*given: Any, decides: bool = True) -> Demonstrations:
        order.append("decide and load" if decides else "load")
        return load(*given, decides=decides)

    monkeypatch.setenv("LOCAL_RANK", str(number))
    monkeypatch.setattr(Ranks, "wait", lambda _: order.append("wait"))
    monkeypatch.setattr(loading, "load_demonstrations", noted)
    job = make("naive", tmp_path / "run")
    method = METHODS["naive"]
    assemble.build(job.recipe, method, job.demos, job.anchor, job.out, ignore)
    assert order == wanted


def test_all_wait_until_a_checkpoint_is_written(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, written = make("naive", tmp_path / "run"), []
    monkeypatch.setattr(Ranks, "wait", lambda _: written.append(len(checkpoint.whole(job.out))))
    job.run()
    # The first process waits for the frames.
    assert written == list(range(len(checkpoint.whole(job.out)) + 1))


def test_a_process_that_is_gone_is_one_error() -> None:
    processes.start(lose_one, (2, *free_ports(1)), 2)


@pytest.mark.parametrize("accumulate", [1, 2, 3])
def test_a_pass_has_the_same_frames_whatever_the_number_of_processes(accumulate: int) -> None:
    frames = np.random.default_rng(0).permutation(100)[:16]
    expected = np.split(frames, [16 * (i + 1) // accumulate for i in range(accumulate - 1)])
    for count in (1, 2, 3, 5):
        found: list[list[int]] = [[] for _ in range(accumulate)]
        for rank in range(count):
            own = step.own_rows(frames, Ranks(rank, count), accumulate).tolist()
            for number, share in enumerate(step.shares(Ranks(rank, count), accumulate)):
                rows = share.rows(len(frames))
                found[number] += [own.pop(0) for _ in range(rows.stop - rows.start)]
        assert found == [part.tolist() for part in expected]


@pytest.mark.parametrize(
    ("method", "settings", "said"),
    [
        ("naive", {"batch_size": 5, "accumulate": 2}, r"train\.batch_size: 5 in 2 passes of 3"),
        ("cotrain", {"accumulate": 3}, r"train\.batch_size: 8 in 3 passes of 3"),
        ("distill", {"parallel": "fsdp"}, "fsdp with method 'distill'"),
        ("naive", {"parallel": "fsdp", "compile": True}, "fsdp with train.compile"),
    ],
)
def test_what_cannot_be_shared_is_refused(
    make: Make, tmp_path: Path, method: str, settings: dict[str, Any], said: str
) -> None:
    recipe = make(method, tmp_path, **settings).recipe
    with pytest.raises(AegisError, match=said):
        parallel.check(recipe, METHODS[method], Ranks(1, 3))


def test_a_part_of_each_share_is_no_part_of_the_batch(make: Make, tmp_path: Path) -> None:
    recipe = make("aegis", tmp_path).recipe
    recipe = replace(recipe, aegis=replace(recipe.aegis, fraction=0.5))
    parallel.check(recipe, METHODS["aegis"], Ranks())
    with pytest.raises(AegisError, match=r"aegis\.fraction: 0\.5 in 2 processes"):
        parallel.check(recipe, METHODS["aegis"], Ranks(0, 2))


def test_pytorch_finds_every_tensor_of_an_encoding() -> None:
    """FSDP uses them to gather sharded weights for backward; before 2.13 it has to be told them."""
    parallel._tell_of_encodings()
    tensors = [torch.full((1,), float(i)) for i in range(5)]
    hidden, key, value, mask, image = tensors
    encoding = Encoding((hidden,), (KeyValue(key, value),), mask, image)
    leaves, shape = pytree.tree_flatten(encoding)
    assert [leaf for leaf in leaves if leaf is not None] == tensors
    assert pytree.tree_unflatten(leaves, shape) == encoding
