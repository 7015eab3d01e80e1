"""Which steps a constraint covers, and what it is told about them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.methods.base import Parts, Update
from aegis_cli.methods.stepper import Stepper


def make(every: int, compares: bool = True) -> tuple[nn.Linear, Stepper, list[Update]]:
    """A map whose weights count its steps, and the updates passed to its constraint."""
    model, seen = nn.Linear(1, 1, bias=False), list[Update]()
    nn.init.zeros_(model.weight)
    parts = Parts(constrain=seen.append, compares=compares, every=every)
    return model, Stepper(model, parts), seen


def moving(model: nn.Linear) -> Callable[[], None]:
    """A step that adds 1 to the weight."""

    def move() -> None:
        with torch.no_grad():
            model.weight.add_(1)

    return move


def anchor(number: int) -> dict[str, Tensor]:
    return {"weight": torch.tensor([[float(number)]])}


def take(model: nn.Linear, stepper: Stepper, first: int, last: int) -> None:
    """Take the steps with these numbers, both included."""
    for number in range(first, last + 1):
        stepper.step(number, moving(model), anchor(number))


@pytest.mark.parametrize("every", [1, 3])
def test_a_constraint_covers_so_many_steps(every: int) -> None:
    model, stepper, seen = make(every)
    take(model, stepper, 1, 7)
    assert [update.steps for update in seen] == [every] * (7 // every)
    assert stepper.pending == 7 % every
    starts = [update.before["weight"].item() for update in seen]
    assert starts == [every * i for i in range(7 // every)]


def test_it_is_told_the_last_steps_anchor_gradient() -> None:
    model, stepper, seen = make(every=3)
    take(model, stepper, 1, 3)
    assert seen[0].anchor_gradient["weight"].item() == 3


def test_it_is_told_what_the_last_step_had_left_of_the_rate() -> None:
    model, stepper, seen = make(every=2)
    for number, left in enumerate((1.0, 0.5, 0.25, 0.125), 1):
        stepper.step(number, moving(model), {}, left)
    assert [update.rate_left for update in seen] == [0.5, 0.125]


def test_steps_that_move_nothing_do_not_count() -> None:
    """Their learning rates do not count either."""
    model, stepper, seen = make(every=2)
    for number, (moves, left) in enumerate(
        zip((1, 1, 1, 0, 0, 0), (1, 0.8, 0.6, 0.4, 0.2, 0.1)), 1
    ):
        flag = torch.tensor(float(moves), dtype=torch.float64)
        stepper.step(number, moving(model) if moves else lambda: None, {}, left, flag)
    assert [float(update.steps) for update in seen] == [2, 1, 0]
    assert [float(update.rate_left) for update in seen[:2]] == [0.8, 0.6]


def test_settling_moves_no_later_turn() -> None:
    """A checkpoint between two turns does not shift the turns."""
    model, stepper, seen = make(every=3)
    take(model, stepper, 1, 2)
    stepper.settle()
    take(model, stepper, 3, 6)
    assert [update.steps for update in seen] == [2, 1, 3]


def test_a_resumed_run_constrains_after_the_same_steps() -> None:
    model, stepper, seen = make(every=4)
    take(model, stepper, 7, 9)
    assert [update.steps for update in seen] == [2] and stepper.pending == 1


def test_settling_without_a_step_does_nothing() -> None:
    model, stepper, seen = make(every=2)
    stepper.settle()
    take(model, stepper, 1, 2)
    stepper.settle()
    assert len(seen) == 1


def test_nothing_is_copied_for_a_method_that_does_not_compare() -> None:
    model, stepper, seen = make(every=1, compares=False)
    take(model, stepper, 1, 1)
    assert seen[0].before == {}


def test_a_constraint_runs_outside_of_autocast() -> None:
    model, dtypes = nn.Linear(2, 2), list[torch.dtype]()
    parts = Parts(constrain=lambda _: dtypes.append((model.weight @ model.weight).dtype))
    stepper = Stepper(model, parts)
    with torch.autocast("cpu", torch.bfloat16):
        stepper.step(1, lambda: None, {})
        assert (model.weight @ model.weight).dtype == torch.bfloat16
    assert dtypes == [torch.float32]


def test_parameters_with_two_names_are_copied_once() -> None:
    model = nn.ModuleDict({"one": nn.Linear(2, 2), "other": nn.Linear(2, 2)})
    model["other"].weight = model["one"].weight
    seen = list[Update]()
    Stepper(model, Parts(constrain=seen.append)).step(1, lambda: None, {})
    assert seen[0].before["one.weight"] is seen[0].before["other.weight"]
