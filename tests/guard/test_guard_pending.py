"""Weights that are loaded, copied or saved between the steps that one constraint covers."""

from __future__ import annotations

import copy
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import anchors_by_method, batch, make, vector
from torch import nn

from aegis_cli import Guard

OPTIONS: dict[str, dict[str, Any]] = {
    "nullspace": {"vision": "vision", "energy": 0.9, "every": 4},
    "coordinates": {"vision": "vision", "energy": 0.9, "every": 4, "keeps": "coordinates"},
    "kfac": {"protect": ("maps", "stem"), "every": 4},
}
every_method = pytest.mark.parametrize("name", OPTIONS)

Guarded = Callable[[str], tuple[nn.Module, Guard]]


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


@pytest.fixture
def guarded(anchors: dict[str, Path]) -> Guarded:
    def made(name: str, **options: Any) -> tuple[nn.Module, Guard]:
        model, method = make(), "kfac" if name == "kfac" else "nullspace"
        return model, Guard(model, anchors[method], method=method, **(OPTIONS[name] | options))

    return made


def steps(model: nn.Module, guard: Guard, count: int) -> None:
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-2)
    for seed in range(count):
        guard.backward((model(*batch(seed)) - 1).square().mean())
        guard.step(optimizer)
        optimizer.zero_grad()


def copied(model: nn.Module) -> dict[str, Any]:
    return copy.deepcopy(model.state_dict())


def said(call: Callable[[], object]) -> list[str]:
    """What a call warns of."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return [str(warning.message) for warning in found]


@every_method
def test_loading_while_steps_are_pending_warns_once(name: str, guarded: Guarded) -> None:
    model, guard = guarded(name)
    best = copied(model)
    assert said(lambda: model.load_state_dict(best)) == []
    steps(model, guard, 3)
    (text,) = said(lambda: model.load_state_dict(best))
    assert "loaded with 3 steps pending" in text and "guard.drop_pending()" in text
    assert said(lambda: model.load_state_dict(best)) == []


@pytest.mark.parametrize("where", ["a part", "a wrapper"])
def test_loading_a_part_or_a_wrapper_warns_too(where: str, guarded: Guarded) -> None:
    model, guard = guarded("nullspace")
    loaded = model.text if where == "a part" else nn.Sequential(model)
    state = copied(loaded)
    steps(model, guard, 1)
    (text,) = said(lambda: loaded.load_state_dict(state))
    assert "1 step pending" in text


@every_method
@pytest.mark.parametrize("end", ["settle", "remove"])
def test_loaded_weights_stay_if_the_pending_steps_are_dropped(
    name: str, end: str, guarded: Guarded
) -> None:
    model, guard = guarded(name)
    steps(model, guard, 4)
    best = copied(model)
    steps(model, guard, 3)
    with pytest.warns(UserWarning, match="loaded with 3 steps pending"):
        model.load_state_dict(best)
    guard.drop_pending()
    assert guard.pending == 0
    getattr(guard, end)()
    assert all(torch.equal(t, best[key]) for key, t in model.state_dict().items())


@every_method
def test_steps_after_dropped_ones_are_those_of_a_new_guard(name: str, guarded: Guarded) -> None:
    model, guard = guarded(name)
    steps(model, guard, 4)
    best = copied(model)
    steps(model, guard, 3)
    with pytest.warns(UserWarning, match="pending"):
        model.load_state_dict(best)
    guard.drop_pending()
    again, resumed = guarded(name)
    again.load_state_dict(best)
    for one, its in ((model, guard), (again, resumed)):
        steps(one, its, 6)
        its.settle()
    assert torch.equal(vector(model), vector(again))


@every_method
def test_an_average_that_is_swapped_in_and_back_changes_nothing(
    name: str, guarded: Guarded
) -> None:
    ends = []
    for swaps in (False, True):
        model, guard = guarded(name)
        average = copied(model)
        steps(model, guard, 2)
        if swaps:
            with pytest.warns(UserWarning, match="pending"):
                now = copied(model)
                model.load_state_dict(average)
                model.load_state_dict(now)
        steps(model, guard, 2)
        assert guard.pending == 0
        ends.append(vector(model))
    assert torch.equal(*ends)


@every_method
def test_a_state_taken_while_steps_are_pending_warns_once(name: str, guarded: Guarded) -> None:
    model, guard = guarded(name)
    assert said(model.state_dict) == []
    steps(model, guard, 2)
    (text,) = said(nn.Sequential(model).state_dict)
    assert "2 steps pending" in text and "guard.settle()" in text
    assert said(model.state_dict) == []


@every_method
def test_settled_weights_are_saved_and_loaded_without_a_warning(
    name: str, guarded: Guarded
) -> None:
    model, guard = guarded(name)
    steps(model, guard, 3)
    guard.settle()
    assert said(lambda: model.load_state_dict(copied(model))) == []
    model, guard = guarded(name, every=1)
    steps(model, guard, 3)
    assert said(lambda: model.load_state_dict(copied(model))) == []


def test_a_removed_guard_leaves_no_hooks(guarded: Guarded) -> None:
    model, guard = guarded("nullspace")
    steps(model, guard, 1)
    guard.remove()
    for module in model.modules():
        assert not module._state_dict_pre_hooks and not module._load_state_dict_post_hooks


@pytest.mark.parametrize("how", ["copied", "pickled"])
def test_a_copy_of_the_model_is_saved_and_loaded_without_a_warning(
    how: str, guarded: Guarded
) -> None:
    """A moving average is such a copy, and it has no guard."""
    model, guard = guarded("nullspace")
    steps(model, guard, 1)
    if how == "copied":
        other = copy.deepcopy(model)
    else:
        model.around = nn.Module.__call__  # in place of a lambda, which no pickle can contain
        file = io.BytesIO()
        torch.save(model, file)
        file.seek(0)
        other = torch.load(file, weights_only=False)
    assert said(lambda: other.load_state_dict(other.state_dict())) == []
