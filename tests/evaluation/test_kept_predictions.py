"""Predictions are kept batch by batch: an interrupted evaluation goes on, to the same report."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from aegis_cli.common import artifacts, cache, version
from aegis_cli.common.events import Event, OnEvent, Progress, ignore
from aegis_cli.evaluation import open_loop
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
    number = "B" if lines[0]["chunks"][5] != "B" else "C"
    lines[0]["chunks"] = lines[0]["chunks"][:5] + number + lines[0]["chunks"][6:]
    lines[1]["shape"] = [3]
    del lines[2]["first"]
    lines[3]["first"] = 1  # where no batch begins
    kept = "".join(json.dumps(line) + "\n" for line in lines)
    store().write_text(kept[:-30])
    assert evaluate() == wanted
    assert sum(predicted) == 4 * BATCH + FRAMES % BATCH
