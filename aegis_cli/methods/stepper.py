"""The optimizer's steps under a method that may constrain the applied update."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from aegis_cli.methods.base import Parts, Update
from aegis_cli.methods.known_parameters import KnownParameters
from aegis_cli.models import structure


class Stepper:
    """Takes an optimizer's steps and lets the method constrain them, `every` steps at a time.

    The training loop and the guard take their steps through it. They differ in how a step moves the
    weights, so `step` takes that as `move`: training owns its optimizer and sets the learning rate
    of each parameter beforehand; the guard leaves a user's optimizer as it is and interpolates
    afterwards.

    Attributes:
        known: the parameters that the method was started with.
        pending: steps since the method last constrained them.
    """

    def __init__(self, model: nn.Module, parts: Parts, may_shard: bool = False) -> None:
        """Create a stepper that has taken no step yet.

        Args:
            model: the adapted backbone; the parameters that are trainable now are constrained.
            parts: the started method.
            may_shard: whether the method supports sharded weights and these are already sharded.

        Raises:
            AegisError: the weights are sharded, and `may_shard` is false.
        """
        self.known = KnownParameters(model, may_shard)
        self._parts = parts
        self._learning = structure.learning(model)
        # A model without trainable parameters still has a device.
        parameters = (*self._learning.values(), *model.parameters())
        self._device = next(iter(parameters)).device.type
        self._before: dict[str, Tensor] = {}
        self._anchor: Mapping[str, Tensor] = {}
        self._rate_left: float | Tensor = 1.0
        self._moved: int | Tensor = 0
        self.pending = 0

    def step(
        self,
        number: int,
        move: Callable[[], None],
        anchor: Mapping[str, Tensor],
        rate_left: float = 1.0,
        moves: Tensor | None = None,
    ) -> None:
        """Move the weights once; after every `parts.every`-th step the method constrains.

        Args:
            number: number of the step, from 1, so that a resumed run constrains after the same
                steps as an uninterrupted one.
            move: takes the optimizer's step.
            anchor: gradient of the method's penalty before the step, by the parameters' names; the
                method gets that of the last step.
            rate_left: the learning rate at this step as a fraction of its peak; the method gets
                that of the last step that moves the weights.
            moves: 1, or 0 if `move` leaves all weights as they are; [] on their device, because
                reading it would force a sync. None: it moves them.

        Raises:
            AegisError: parameters learn that the method does not know; nothing has moved.
        """
        self.begin(anchor, rate_left, moves)
        move()
        self.end(number)

    def begin(
        self,
        anchor: Mapping[str, Tensor],
        rate_left: float = 1.0,
        moves: Tensor | None = None,
    ) -> None:
        """Prepare for a step that the caller takes before `end`; arguments as in `step`."""
        self.known.check()
        # Only at the first of the steps that one constraint covers: it compares with these values.
        if not self.pending and self._parts.copies:
            self._before = self._copies()
        if not self.pending and self._parts.begin is not None:
            self._parts.begin()
        self._anchor = anchor
        if moves is None:
            self._moved, self._rate_left = self._moved + 1, rate_left
        else:
            self._moved = self._moved + moves
            # Chosen by arithmetic, because branching on `moves` would read it.
            self._rate_left = moves * rate_left + (1 - moves) * self._rate_left
        self.pending += 1

    def end(self, number: int) -> None:
        """Constrain what has moved since `begin`, if it is time."""
        if number % self._parts.every == 0:
            self.settle()

    def cancel(self) -> None:
        """Undo `begin` for a step that has moved nothing."""
        self.pending -= 1
        self._moved = self._moved - 1
        if not self.pending:
            self._before, self._anchor = {}, {}

    def settle(self) -> None:
        """Let the method constrain the pending steps now; if there are none, nothing happens."""
        begun, update = self.pending, self._update()
        # Before the method, so that the step is over even if it raises.
        self.drop_pending()
        if begun and self._parts.constrain is not None:
            # A loop may step inside an autocast of its own.
            with torch.autocast(self._device, enabled=False):
                self._parts.constrain(update)

    def drop_pending(self) -> None:
        """Forget the pending steps, which the method then never constrains."""
        self._before, self._anchor, self._moved, self.pending = {}, {}, 0, 0

    def _update(self) -> Update:
        """What the pending steps have done."""
        return Update(
            before=self._before,
            anchor_gradient=self._anchor,
            steps=self._moved,
            rate_left=self._rate_left,
        )

    def _copies(self) -> dict[str, Tensor]:
        """The parameters' values by all their names, each copied once."""
        # By id: tied weights have several names but need only one copy.
        own = {id(p): p for p in self._learning.values()}
        copies = {one: torch.empty_like(p, requires_grad=False) for one, p in own.items()}
        structure.copy_all(list(copies.values()), [p.detach() for p in own.values()])
        return {name: copies[id(p)] for name, p in self._learning.items()}
