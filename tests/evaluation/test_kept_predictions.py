"""Predictions are kept batch by batch: an interrupted evaluation goes on, to the same report."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.training_runs import small_policy

from aegis_cli.common import artifacts, cache, devices, prefetch, version
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, OnEvent, Progress, ignore
from aegis_cli.data import demonstrations
from aegis_cli.evaluation import open_loop
from aegis_cli.models import backbones
from aegis_cli.models.action_errors import predict
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.training import checkpoint

BATCH, FRAMES = 4, 22
EPISODES = range(8)

Evaluate = Callable[..., str]


class Stopped(Exception):
    """Whoever evaluates is stopped."""


@pytest.fixture
def evaluate(naive_run: Path, demos_file: Path) -> Evaluate:
    def evaluated(on_event: OnEvent = ignore, **changed: Any) -> str:
        asked: dict[str, Any] = {"frames": FRAMES, "batch_size": BATCH, "seed": 3, **changed}
        data = asked.pop("data", demos_file)
        torch.manual_seed(torch.seed())  # another process has another random state
        report = open_loop.run(naive_run, data, EPISODES, on_event=on_event, **asked)
        return json.dumps(report.to_json())

    return evaluated


@pytest.fixture
def predicted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many frames each forward pass has predicted at."""
    seen: list[int] = []
    plain = Policy.act_from

    def counted(self: Policy, images: Any, *given: Any) -> torch.Tensor:
        seen.append(len(images))
        return plain(self, images, *given)

    monkeypatch.setattr(Policy, "act_from", counted)
    return seen


def stop_after(batches: int, evaluate: Evaluate, **changed: Any) -> None:
    def stop(event: Event) -> None:
        told = isinstance(event, Progress) and event.unit == "frames"
        if told and event.done >= min(FRAMES, batches * BATCH):
            raise Stopped

    with pytest.raises(Stopped):
        evaluate(stop, **changed)


def store() -> Path:
    (path,) = cache.folder("predictions").glob("*.jsonl")
    return path


@pytest.mark.parametrize("places", [(1,), (2, 4), (5, 6), (6,)])
def test_an_interrupted_evaluation_goes_on_to_the_same_report(
    places: tuple[int, ...], evaluate: Evaluate, predicted: list[int]
) -> None:
    for batches in places:
        stop_after(batches, evaluate)
    done = min(FRAMES, places[-1] * BATCH)
    assert sum(predicted) == done
    events: list[Event] = []
    found = evaluate(events.append)
    assert sum(predicted) == FRAMES
    told = [(e.done, e.total) for e in events if isinstance(e, Progress) and e.unit == "frames"]
    assert told[0] == (done, FRAMES) and told[-1] == (FRAMES, FRAMES)
    store().unlink()
    assert evaluate() == found


@pytest.mark.parametrize(
    "change", [{"seed": 4}, {"batch_size": 5}, {"frames": 21}, {"code": "other"}, {"data": None}]
)
def test_another_evaluation_takes_nothing(
    change: dict[str, Any],
    evaluate: Evaluate,
    predicted: list[int],
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop_after(3, evaluate)
    del predicted[:]
    if "code" in change:
        monkeypatch.setattr(version, "code", lambda: "other")
        change = {}
    if "data" in change:
        recorded, change = artifacts.load(demos_file), {"data": tmp_path / "other.safetensors"}
        moved = recorded.tensors | {"proprio": recorded.tensors["proprio"] + 0.01}
        artifacts.save(change["data"], "demos", moved, meta=recorded.header.meta)
    evaluate(**change)
    assert sum(predicted) == change.get("frames", FRAMES)


def test_another_policy_takes_nothing(
    evaluate: Evaluate, predicted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_after(3, evaluate)
    del predicted[:]
    plain = checkpoint.load_policy

    def trained_on(place: Path) -> tuple[Policy, PolicyMeta]:
        policy, meta = plain(place)
        next(policy.expert.parameters()).data.add_(1e-3)
        return policy, meta

    monkeypatch.setattr(checkpoint, "load_policy", trained_on)
    evaluate()
    assert sum(predicted) == FRAMES


def test_what_is_damaged_is_predicted_again(evaluate: Evaluate, predicted: list[int]) -> None:
    wanted = evaluate()
    lines = [json.loads(line) for line in store().read_bytes().splitlines()]
    del predicted[:]
    said = lines[0]["predicted"]["bytes"]
    lines[0]["predicted"]["bytes"] = said[:5] + ("B" if said[5] != "B" else "C") + said[6:]
    lines[1]["predicted"]["shape"] = [3]
    del lines[2]["first"]
    lines[3]["first"] = 1  # where no batch begins
    kept = "".join(json.dumps(line) + "\n" for line in lines)
    store().write_text(kept[:-30])
    assert evaluate() == wanted
    assert sum(predicted) == 4 * BATCH + FRAMES % BATCH


# --- threads that prepare the next batches --------------------------------------------------------


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU is treated as a GPU, for which threads prepare."""
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)


@pytest.fixture
def processed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of threads for each batch that was processed; the loading processes one too."""
    seen: list[str] = []
    plain = EmbeddedVLM.process

    def noted(self: EmbeddedVLM, *given: Any) -> Any:
        seen.append(threading.current_thread().name)
        return plain(self, *given)

    monkeypatch.setattr(EmbeddedVLM, "process", noted)
    return seen


def test_threads_prepare_the_batches_of_a_gpu_for_the_same_report(
    evaluate: Evaluate, processed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = evaluate()
    assert not any(name.startswith("prefetch") for name in processed)
    store().unlink()
    del processed[:]
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    with prefetch.using(3):
        assert evaluate() == wanted
    assert sum(name.startswith("prefetch") for name in processed) == 6


def test_no_batch_that_is_kept_is_prepared_again(
    evaluate: Evaluate, processed: list[str], waits: None
) -> None:
    stop_after(4, evaluate)
    del processed[:]
    found = evaluate()
    assert sum(name.startswith("prefetch") for name in processed) == 2
    store().unlink()
    assert evaluate() == found


@pytest.mark.parametrize("family", ["smolvlm", "paligemma"])
def test_a_hugging_face_model_predicts_the_same_from_what_threads_prepare(
    family: str,
    hf_folder: Callable[[str], Path],
    demos_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    backbone = backbones.load(str(hf_folder(family)))
    shown = demonstrations.load(demos_file, 0.5, 0)
    policy = small_policy(backbone, shown).eval()
    given = policy, shown, shown.validation[:7], 5, 3, "predict"
    alone = predict(*given)
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    with prefetch.using(2):
        assert torch.equal(predict(*given), alone)


def test_what_fails_in_a_thread_is_raised_and_no_thread_goes_on(
    evaluate: Evaluate, waits: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(*_: object) -> None:
        raise AegisError("a damaged video", "a whole one", "get it again")

    monkeypatch.setattr(EmbeddedVLM, "process", damaged)
    with pytest.raises(AegisError, match="a damaged video"):
        evaluate()
    assert not any(thread.name.startswith("prefetch") for thread in threading.enumerate())


def test_an_interrupt_ends_the_threads(evaluate: Evaluate, waits: None) -> None:
    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.unit == "frames" and event.done == 2 * BATCH:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(stop)
    assert not any(thread.name.startswith("prefetch") for thread in threading.enumerate())
