"""`aegis train --dry-run`, and the shipped recipes for Hugging Face models on small models."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from samples.command import refused
from samples.parallel_runs import Job, Planning, run_together
from samples.small_run import recipe as small
from samples.small_run import write
from samples.tiny import make_tiny
from torch import nn

from aegis_cli import recipes
from aegis_cli.common import devices
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes.keys import LARGEST
from aegis_cli.training import checkpoint, dry_run, train
from aegis_cli.training.dry_run import DryRunReport

ROOT = Path(__file__).parent.parent.parent
Made, Command = Callable[[str], Path], Callable[..., Any]

SMALL = [
    "train.steps=2",
    "train.batch_size=2",
    "train.checkpoint_every=2",
    "train.precision=float32",
    "train.validation_share=0.2",
    "expert.width=16",
    "expert.mlp_ratio=1",
]


def shipped(name: str, backbone: Path) -> list[str]:
    settings = [f"backbone={backbone}", *SMALL]
    return [
        str(ROOT / "recipes" / f"{name}.yaml"),
        *(word for s in settings for word in ("--set", s)),
    ]


@pytest.mark.parametrize(
    ("name", "family"), [("paligemma2-libero", "paligemma"), ("smolvla-style", "smolvlm")]
)
def test_the_shipped_recipes_run_on_small_stand_ins(
    name: str, family: str, hf_folder: Made, hf_anchor: Made, tmp_path: Path, aegis: Command
) -> None:
    dataset = tmp_path / "dataset"
    code, _, err = aegis(
        "demos", "reach", "--episodes", "6", "--format", "lerobot", "--out", dataset
    )
    assert code == 0, err
    given = [
        *shipped(name, hf_folder(family)),
        "--set",
        "demos.camera=observation.images.top",
        "--set",
        "task=reach",
        "--demos",
        dataset,
    ]
    given += ["--anchor", hf_anchor(family), "--json"]
    for method in recipes.load(ROOT / "recipes" / f"{name}.yaml").methods[-2:]:
        out = tmp_path / method
        code, text, err = aegis("train", *given, "--method", method, "--out", out, "--dry-run")
        assert code == 0 and not out.exists(), err
        plan = json.loads(text)
        assert (plan["steps"], plan["method"], plan["checkpoints"]) == (2, method, 1)
        code, text, err = aegis("train", *given, "--method", method, "--out", out)
        assert code == 0 and json.loads(text)["steps"] == 2, err
        files = (out / "checkpoints" / "000002").rglob("*.safetensors")
        written = sum(t.nbytes for path in files for t in load_file(path).values()) / 1e6
        # parameters without a gradient (an unused head, say) have no optimizer state: the plan
        # is an upper bound
        assert written <= 1.001 * plan["disk_mb"] and (
            method != "stop-gradient" or written >= 0.999 * plan["disk_mb"]
        )


Plan = Callable[..., dry_run.DryRunReport]


@pytest.fixture(scope="module")
def plan(
    hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Plan:
    """The plan of a small Hugging Face model for the method and the settings; made once.

    Some tests compare the same plans, each of which takes two seconds.
    """
    out = tmp_path_factory.mktemp("plan") / "out"

    @cache
    def made(method: str, keeps: str = "weights", **settings: Any) -> dry_run.DryRunReport:
        chosen = replace(
            small(hf_folder("smolvlm"), **settings), nullspace=recipes.Nullspace(keeps=keeps)
        )
        anchor = None if method in ("naive", "l2sp") else hf_anchor("smolvlm")
        planned = dry_run.run(chosen, method, demos_file, anchor, out)
        assert not out.exists()
        return planned

    return made


def test_a_dry_run_counts_what_there_is(plan: Plan, hf_folder: Made) -> None:
    plans = {method: plan(method) for method in ("naive", "aegis", "stop-gradient", "nullspace")}
    plain = plans["naive"]
    backbone = backbones.load(str(hf_folder("smolvlm")))
    assert sum(plain.groups.values()) == sum(p.numel() for p in backbone.parameters())
    assert list(plain.groups) == list(backbone.parameter_groups())
    assert plain.trainable == plain.parameters > plans["stop-gradient"].trainable > 0
    assert plain.memory_mb["gradients"] == pytest.approx(4e-6 * plain.trainable)
    assert plain.memory_mb["optimizer"] == pytest.approx(8e-6 * plain.trainable)
    assert plain.memory_mb["anchor gradient"] == 0 < plans["aegis"].memory_mb["anchor gradient"]
    assert (
        plain.memory_mb["weights before the step"]
        == 0
        < plans["nullspace"].memory_mb["weights before the step"]
    )
    assert plain.memory_mb["method"] < plans["nullspace"].memory_mb["method"]
    assert plain.memory_mb["activations"] > plans["stop-gradient"].memory_mb["activations"] > 0
    assert (
        plain.memory_total_mb == pytest.approx(sum(plain.memory_mb.values())) and plain.memory_fits
    )
    assert plain.memory_mb["method"] == 0
    held = plan("l2sp")
    assert held.memory_mb["method"] == pytest.approx(
        4e-6 * sum(held.groups.values())
    )  # one copy of the weights
    bigger = plan("naive", batch_size=8)
    twice = pytest.approx(2 * plain.memory_mb["activations"], rel=0.01)
    assert bigger.memory_mb["activations"] == twice
    assert bigger.epochs == pytest.approx(2 * plain.epochs)


def test_a_dry_run_counts_a_checkpoints_copy_and_what_a_projection_remembers(
    plan: Plan, hf_folder: Made
) -> None:
    lora = plan("lora").memory_mb
    whole = plan("nullspace").memory_mb
    coordinates = plan("nullspace", keeps="coordinates").memory_mb
    # A copy of the plain backbone is written, in place of a step's activations.
    plain = sum(p.nbytes for p in backbones.load(str(hf_folder("smolvlm"))).parameters()) / 1e6
    assert lora["activations"] + lora["checkpoint"] > plain
    assert 0 < coordinates["weights before the step"] < whole["weights before the step"]


def test_processes_plan_what_each_of_them_needs(
    plan: Plan, hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings, out = small(hf_folder("smolvlm")), tmp_path / "out"
    anchors, plans = hf_anchor("smolvlm"), {}
    for way in ("ddp", "fsdp"):
        shared = replace(settings, train=replace(settings.train, parallel=way))
        job = Job(shared, "nullspace", demos_file, anchors, out)
        plans[way] = Planning(job, tmp_path / way)
    watched = replace(
        settings,
        train=replace(settings.train, validate_actions=8),
        probe=replace(settings.probe, while_training=8),
        rollout=replace(settings.rollout, while_training=2),
    )
    watching = []
    for way in plans:
        shared = replace(watched, train=replace(watched.train, parallel=way))
        job = Job(shared, "nullspace", demos_file, anchors, out)
        watching.append(Planning(job, tmp_path / f"{way}-watched"))
    run_together(2, [*plans.values(), *watching])
    alone = plan("nullspace")
    weights = 4e-6 * alone.parameters
    for way, planned in plans.items():
        first, second = (json.loads((planned.said / f"{k}.json").read_text()) for k in (0, 1))
        # These depend on the process's own clock and moment.
        ours = ("step_s", "data_s", "prepare_s", "validation_s", "hours", "memory_free_mb")
        assert [k for k in first if first[k] != second[k] and k not in ours] == []
        assert (first["processes"], first["memory_fits"]) == (2, True)
        assert first["memory_together_mb"] > first["memory_measured_mb"] > 0 < first["hours"]
        used = first["memory_mb"]
        assert used["activations"] == pytest.approx(alone.memory_mb["activations"] / 2, rel=0.2)
        # Its own rows, and in the first process also the whole weights that it writes.
        share = 1.5 if way == "fsdp" else 1
        assert used["weights"] == pytest.approx(share * weights, rel=0.02)
        share = 0.5 if way == "fsdp" else 1
        for part in ("gradients", "optimizer", "weights before the step"):
            assert used[part] == pytest.approx(share * alone.memory_mb[part], rel=0.02)
        assert first["disk_mb"] == pytest.approx(alone.disk_mb)
        assert first["groups"] == alone.groups and first["parameters"] == alone.parameters
        assert first["validation_s"].keys() == {"loss"}
    # Only the first process asks, acts and predicts, and the others report what it found.
    for each in watching:
        first, second = (json.loads((each.said / f"{k}.json").read_text()) for k in (0, 1))
        found = first["validation_s"]
        assert found.keys() == {"loss", "questions", "episodes", "actions"}
        assert found.items() - second["validation_s"].items() <= {("loss", found["loss"])}
        assert all(seconds > 0 for seconds in found.values())
    assert not out.exists()


def test_what_is_free_is_asked_before_the_dry_run_takes_some(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the weights would count twice: in the plan, and in the missing memory."""
    order: list[str] = []
    build, free = dry_run.assemble.build, dry_run.memory.free
    monkeypatch.setattr(
        dry_run.assemble, "build", lambda *args: order.append("build") or build(*args)
    )
    monkeypatch.setattr(dry_run.memory, "free", lambda device: order.append("free") or free(device))
    dry_run.run(small(tiny_folder), "naive", demos_file, None, tmp_path / "out")
    assert order == ["free", "build"]


def test_a_dry_run_tells_the_steps_that_it_takes(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    events: list[Event] = []
    settings = small(tiny_folder)
    dry_run.run(settings, "naive", demos_file, None, tmp_path / "out", on_event=events.append)
    told = [e for e in events if isinstance(e, Progress) and e.stage == "dry run"]
    assert [e.done for e in told] == list(range(told[0].total + 1))


def test_a_dry_run_tells_what_it_does_before_its_first_step(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a pipe nothing else would be printed: a large model takes minutes to load and run once."""
    told: list[str] = []

    def noted(stage: Callable[..., Any], name: str) -> Callable[..., Any]:
        return lambda *given: told.append(name) or stage(*given)

    def heard(event: Event) -> None:
        if isinstance(event, Progress):
            told.append(f"{event.stage} {event.done}/{event.total}")

    monkeypatch.setattr(dry_run.assemble, "build", noted(dry_run.assemble.build, "build"))
    monkeypatch.setattr(dry_run, "_pass_some", noted(dry_run._pass_some, "pass"))
    dry_run.run(small(tiny_folder), "naive", demos_file, None, tmp_path / "out", on_event=heard)
    assert told[:7] == [
        "dry run (loading) 0/1",
        "build",
        "dry run (loading) 1/1",
        "dry run (memory) 0/2",
        "pass",
        "dry run (memory) 1/2",
        "pass",
    ]


def seconds(plan: DryRunReport, steps: int, validations: int) -> float:
    """How long this many steps and validations take according to a plan."""
    assert plan.step_s is not None and plan.step_s > 0 and plan.validation_s is not None
    assert plan.validation_s.keys() == {"loss"} and plan.validation_s["loss"] > 0
    return steps * plan.step_s + validations * plan.validation_s["loss"]


def test_hours_are_those_of_the_steps_that_are_left_and_their_validations(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings, run = small(tiny_folder, steps=6, validate_every=2), tmp_path / "run"
    plan = dry_run.run(settings, "naive", demos_file, None, run)
    assert plan.hours == pytest.approx(seconds(plan, 6, 3) / 3600)

    def stop(event: Progress) -> None:
        if event.stage == "train" and event.done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train.run(settings, "naive", demos_file, None, run, on_event=stop)
    later = dry_run.run(settings, "naive", demos_file, None, run, resume=True)
    assert later.hours == pytest.approx(seconds(later, 2, 1) / 3600)


@pytest.mark.parametrize(("method", "steps"), [("naive", 4), ("nullspace", 5)])
def test_steps_are_timed_as_training_takes_them_and_the_memory_is_not_theirs(
    method: str,
    steps: int,
    tiny_folder: Path,
    demos_file: Path,
    anchor_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = small(tiny_folder, steps=9)
    given = (method, demos_file, anchor_file, tmp_path / "out")
    taken: list[int] = []
    update = train.update

    def noting(run: Any, index: int, *rest: Any) -> None:
        taken.append(index)
        update(run, index, *rest)

    monkeypatch.setattr(train, "update", noting)
    timed = dry_run.run(settings, *given)
    assert taken == list(range(steps))
    monkeypatch.setattr(dry_run, "_timed", lambda *_: dry_run.Timed(0.0, 0.0, 0.0))
    assert dry_run.run(settings, *given).memory_mb == timed.memory_mb
    short = dataclasses.replace(settings, train=dataclasses.replace(settings.train, steps=1))
    assert dry_run.run(short, *given).step_s == 0.0


def test_what_a_gpu_has_no_memory_for_is_reported_and_no_error(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(train, "update", full)
    plan = dry_run.run(small(tiny_folder), "naive", demos_file, None, tmp_path / "out")
    assert plan.memory_fits is False and plan.memory_measured_mb is None
    assert (plan.step_s, plan.hours) == (None, None)
    assert "more memory than the estimate of" in str(dry_run.shortage(plan))


@pytest.mark.parametrize("kind", ["tiny", "smolvlm"])
def test_what_a_pass_keeps_is_gone_before_the_steps_are_measured(
    kind: str,
    tiny_folder: Path,
    hf_folder: Made,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An operation that saves its own result would keep its graph alive forever."""
    passed, left = dry_run.pass_kept, []

    def alive() -> int:
        return sum(storage.nbytes() for storage in dry_run._alive(torch.device("cpu")).values())

    def watched(*given: Any) -> tuple[int, int]:
        before = alive()
        found = passed(*given)
        left.append(alive() - before)
        return found

    monkeypatch.setattr(dry_run, "pass_kept", watched)
    backbone = tiny_folder if kind == "tiny" else hf_folder(kind)
    dry_run.run(small(backbone), "naive", demos_file, None, tmp_path / "out")
    assert left == [0]


def test_rounded_weights_count_once_and_not_for_each_frame(plan: Plan) -> None:
    fixed = {}
    for precision in ("float32", "bf16"):
        given = {} if precision == "float32" else {"precision": precision}
        four, eight = plan("naive", **given), plan("naive", batch_size=8, **given)
        fixed[precision] = 2 * four.memory_mb["activations"] - eight.memory_mb["activations"]
    # Maps, at two bytes per number; tables and norms stay float32.
    rounded = fixed["bf16"] - fixed["float32"]
    assert 1e-6 * four.trainable < rounded < 2e-6 * four.trainable


def test_what_a_pass_has_shrinks_with_passes(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    plans = [
        dry_run.run(small(tiny_folder, accumulate=k), "naive", demos_file, None, tmp_path / "out")
        for k in (1, 2)
    ]
    whole, halved = (plan.memory_mb["activations"] for plan in plans)
    assert halved == pytest.approx(whole / 2, rel=0.01)


def test_no_step_is_taken_where_memory_does_not_suffice(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dry_run.memory, "free", lambda _: 1)
    monkeypatch.setattr(train, "update", lambda *_: pytest.fail("took a step"))
    plan = dry_run.run(small(tiny_folder), "naive", demos_file, None, tmp_path / "out")
    assert plan.memory_fits is False and (plan.step_s, plan.hours) == (None, None)
    assert plan.memory_measured_mb is None


def test_what_the_steps_take_decides_where_they_could_be_taken(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = small(tiny_folder)

    def planned(taken: int) -> dry_run.DryRunReport:
        monkeypatch.setattr(dry_run.memory, "peak", lambda _: 10**8 + taken)
        return dry_run.run(settings, "naive", demos_file, None, tmp_path / "out")

    monkeypatch.setattr(dry_run.memory, "restart_peak", lambda _: 10**8)
    monkeypatch.setattr(dry_run.memory, "free", lambda _: 10**9)
    small_one, large_one = planned(5 * 10**8), planned(2 * 10**9)
    assert small_one.memory_fits and small_one.memory_measured_mb == pytest.approx(500)
    assert large_one.memory_fits is False and large_one.memory_needed_mb == pytest.approx(2000)
    assert "about 2,000 MB of memory" in str(dry_run.shortage(large_one))
    monkeypatch.setattr(dry_run, "_while_saving", lambda _: 3 * 10**8)
    saved = planned(5 * 10**8)
    assert 0 < saved.memory_mb["checkpoint"] == pytest.approx(saved.memory_measured_mb - 500)


def test_a_dry_run_counts_the_checkpoints_to_come(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings, run = small(tiny_folder, steps=5, checkpoint_every=2), tmp_path / "run"
    assert dry_run.run(settings, "naive", demos_file, None, run).checkpoints == 3

    def stop(event: Progress) -> None:
        if event.stage == "train" and event.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train.run(settings, "naive", demos_file, None, run, on_event=stop)
    assert dry_run.run(settings, "naive", demos_file, None, run, resume=True).checkpoints == 2
    train.run(settings, "naive", demos_file, None, run, resume=True)
    assert dry_run.run(settings, "naive", demos_file, None, run, resume=True).checkpoints == 0


@pytest.mark.parametrize("steps", [5, 6, LARGEST])
@pytest.mark.parametrize("done", [0, 2, 3, 5, 6])
def test_the_checkpoints_to_come_are_those_of_the_steps_that_are_left(
    steps: int, done: int, tiny_folder: Path
) -> None:
    settings = small(tiny_folder, steps=steps, checkpoint_every=2)
    written = [Path(str(done))] if done else []
    known = {5: {2, 4, 5}, 6: {2, 4, 6}}.get(steps)
    expected = LARGEST // 2 - done // 2 if known is None else sum(at > done for at in known)
    assert dry_run._to_come(settings, written) == expected


def test_as_many_steps_are_done_as_the_checkpoint_of_most_steps_says(tmp_path: Path) -> None:
    for name in ("999500", "1000000"):
        folder = tmp_path / "checkpoints" / name
        folder.mkdir(parents=True)
        (folder / checkpoint.EXPERT).touch()
    assert dry_run._done(checkpoint.whole(tmp_path)) == 1_000_000


def test_a_dry_run_refuses_what_a_training_would(
    hf_folder: Made, demos_file: Path, tmp_path: Path, aegis: Command
) -> None:
    recipe = write(tmp_path, hf_folder("smolvlm"))
    given = ["train", recipe, "--demos", demos_file, "--out", tmp_path / "out", "--dry-run"]
    err = refused(aegis(*given, "--method", "aegis"))
    measured = "--samples 14 --batch-size 14 --parts moments --out FILE"
    assert "no anchor" in err
    assert f"aegis anchor --backbone {hf_folder('smolvlm')} {measured}" in err
    assert "no file" in refused(
        aegis("train", recipe, "--demos", tmp_path / "none", "--out", tmp_path / "out", "--dry-run")
    )
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thing").write_text("")
    assert "not empty" in refused(aegis(*given, "--method", "naive"))


def test_what_does_not_fit_is_a_failed_gate(
    tiny_folder: Path,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    aegis: Command,
) -> None:
    given = [
        "train",
        write(tmp_path, tiny_folder),
        "--method",
        "naive",
        "--demos",
        demos_file,
        "--out",
        tmp_path / "out",
    ]
    monkeypatch.setattr(dry_run.memory, "free", lambda _: 10**12)
    code, text, err = aegis(*given, "--dry-run", "--json")
    plan = json.loads(text)
    assert (code, plan["memory_fits"], plan["disk_fits"]) == (
        0,
        True,
        True,
    ) and "gate failed" not in err
    assert plan["training_frames"] and plan["epochs"] and plan["tokens_per_frame"]
    assert plan["tokens_a_frame"] == plan["tokens_per_frame"]  # the older key
    weights = plan["memory_total_mb"] - plan["memory_mb"]["activations"]
    for free_mb, says in (
        (plan["memory_total_mb"] - 0.1, "lower train.batch_size"),
        (weights / 2, "a smaller backbone"),
    ):
        monkeypatch.setattr(dry_run.memory, "free", lambda _, free=free_mb: int(1e6 * free))
        code, text, err = aegis(*given, "--dry-run")
        assert (
            code == 1
            and "training frames" in text
            and "tokens per frame" in text
            and "epochs" in text
        )
        assert (
            f"gate failed: training needs about {plan['memory_total_mb']:,.0f} MB of memory" in err
            and says in err
        )
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(dry_run.shutil, "disk_usage", lambda _: usage)
    code, _, err = aegis(*given, "--dry-run", "--json")
    assert code == 1 and "; the checkpoints need" in err and "train.checkpoint_every" in err
    assert (
        len([line for line in err.splitlines() if "gate failed" in line]) == 1
        and not (tmp_path / "out").exists()
    )


def test_a_dry_run_of_the_embedded_backbone(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    plan = dry_run.run(small(tiny_folder), "naive", demos_file, None, tmp_path / "out")
    assert sum(plan.groups.values()) == sum(p.numel() for p in make_tiny().parameters())


def test_modules_under_an_unused_name_are_not_kept() -> None:
    """Disk space is counted once for a weight with two names."""
    module = nn.ModuleDict({"a": nn.Linear(2, 2, bias=False)})
    module["b"] = module["a"]
    assert dry_run._bytes(dry_run._tensors(module)) == 16


def slower(real: Callable[..., Any], seconds: float) -> Callable[..., Any]:
    """A function that takes at least so long, however busy the machine is."""

    def slowly(*given: Any) -> Any:
        time.sleep(seconds)
        return real(*given)

    return slowly


@pytest.mark.parametrize("slow_s", [0.0, 0.5])
def test_a_dry_run_says_if_steps_wait_for_threads_that_prepare_their_batches(
    slow_s: float,
    tiny_folder: Path,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And its hours include it."""
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    monkeypatch.setattr(EmbeddedVLM, "process", slower(EmbeddedVLM.process, slow_s))
    if not slow_s:
        monkeypatch.setattr(train, "update", slower(train.update, 0.3))
    settings, notes = small(tiny_folder), list[Event]()
    steps = 20
    settings = replace(settings, train=replace(settings.train, workers=2, steps=steps))
    report = dry_run.run(
        settings, "naive", demos_file, None, tmp_path / "out", on_event=notes.append
    )
    assert report.workers == 2 and report.prepare_s is not None and report.step_s is not None
    told = [e.text for e in notes if isinstance(e, Warned) and "train.workers" in e.text]
    assert report.prepare_s >= slow_s and len(told) == (1 if slow_s else 0)
    if slow_s:
        # Two threads prepare two batches in that time.
        assert 0.7 * slow_s / 2 < report.step_s < slow_s
        assert report.data_s is not None and 0.2 * report.step_s < report.data_s < report.step_s
        assert "docs/performance.md" in told[0] and "there are 2" in told[0]
        assert report.hours is not None and report.hours * 3600 > steps * slow_s / 2 * 0.7


def test_a_dry_run_says_if_preparing_batches_takes_most_of_a_step_on_a_cpu(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told() -> list[str]:
        notes: list[Event] = []
        report = dry_run.run(
            small(tiny_folder), "naive", demos_file, None, tmp_path / "out", on_event=notes.append
        )
        assert report.workers is None
        return [e.text for e in notes if isinstance(e, Warned) and "preparing" in e.text]

    with monkeypatch.context() as patch:
        patch.setattr(train, "update", slower(train.update, 0.3))
        assert told() == []
    monkeypatch.setattr(EmbeddedVLM, "process", slower(EmbeddedVLM.process, 0.5))
    (text,) = told()
    assert "splits images" in text
