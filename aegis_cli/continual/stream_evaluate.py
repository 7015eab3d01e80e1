"""Accuracy on every task's test part, or what stands in its place, with the task told and with the
task inferred.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from aegis_cli.continual.learners.base import Learner
from aegis_cli.core.gaussians import NONE, Gaussian, infer
from aegis_cli.core.routing import Routed, activate
from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.models.backbones.dual import DualEncoder, class_weights

BATCH = 256


class Evaluator:
    """Predictions of one encoder. What the bare encoder says of an image never changes, and is
    computed once; so is what serves a learned task of a learner that freezes it, until the last
    row, which is computed anew.

    Of a learner that trains the model itself there is no bare encoder any more: what a router of
    None means is then the current weights, and nothing is kept.
    """

    def __init__(
        self, encoder: DualEncoder, sites: Routed, tasks: Sequence[StreamTask], learner: Learner
    ) -> None:
        self.encoder, self.sites, self.tasks, self.learner = encoder, sites, tasks, learner
        self._bare: dict[int, Tensor] = {}
        self._looks: dict[int, Tensor] = {}
        self._known: dict[tuple[int, int | None], Tensor] = {}  # by task and router

    @torch.inference_mode()
    def row(self, done: int, gaussians: Sequence[Gaussian]) -> tuple[list[float], list[float]]:
        """R[t, :] after tasks 0 to t = `done`: the task told, and inferred.

        A task that has not come yet is served, told or not told, by what there is: the bare
        encoder, or where one state serves all, that. Inferring chooses among the tasks so far and
        the bare encoder, image by image; the classes to choose among are the task's own in both.
        """
        if done == len(self.tasks) - 1:  # so that what is said of forgetting at the end is measured
            self._known = {key: answers for key, answers in self._known.items() if key[1] is None}
        told, inferred = [], []
        for i, task in enumerate(self.tasks):
            labels = task.test.labels
            state = self._state(i, done)
            answers = self._answers(i, state)
            told.append(_accuracy(answers, labels))
            if not self.learner.shared:
                answers = self._inferred(i, state, answers, infer(self._test_looks(i), gaussians))
            inferred.append(_accuracy(answers, labels))
        return told, inferred

    def bare(self, part: Part) -> Tensor:
        """Features [N, D] of a part's images in the bare encoder."""
        return self._features(part, None, torch.arange(len(part)))

    def looks(self, part: Part) -> Tensor:
        """What the bare encoder's image tower makes of a part's images early on [N, W], on the CPU:
        tasks are told by it.
        """
        return self._read(self.encoder.looks, part, None, torch.arange(len(part))).cpu()

    def _test_looks(self, i: int) -> Tensor:
        if i not in self._looks:
            self._looks[i] = self.looks(self.tasks[i].test)
        return self._looks[i]

    def bare_test(self, i: int) -> Tensor:
        if self.learner.trains == "model":
            return self.bare(self.tasks[i].test)
        if i not in self._bare:
            self._bare[i] = self.bare(self.tasks[i].test)
        return self._bare[i]

    def _state(self, i: int, done: int) -> int | None:
        """The router that serves task i, if one does."""
        known = self.learner.shared or i <= done
        return self.learner.router(i) if known and self.learner.trains == "experts" else None

    def _answers(self, i: int, router: int | None) -> Tensor:
        """Classes [N] that all test images of a task are given."""
        if (i, router) in self._known:
            return self._known[i, router]
        features = (
            self.bare_test(i)
            if router is None
            else self._features(self.tasks[i].test, router, None)
        )
        answers = self._classify(i, router, features)
        if self.learner.frozen or (router is None and self.learner.trains != "model"):
            self._known[i, router] = answers
        return answers

    def _inferred(self, i: int, own: int | None, answers: Tensor, chosen: Tensor) -> Tensor:
        """Classes [N] where each image goes through the router that was `chosen` [N] for it."""
        mixed = torch.empty_like(answers)
        for task in chosen.unique().tolist():
            rows = (chosen == task).nonzero().flatten()
            router = None if task == NONE else self.learner.router(task)
            if router == own:
                mixed[rows] = answers[rows]
            elif router is None:
                mixed[rows] = self._answers(i, None)[rows]
            else:
                mixed[rows] = self._classify(
                    i, router, self._features(self.tasks[i].test, router, rows)
                )
        return mixed

    def _features(self, part: Part, router: int | None, rows: Tensor | None) -> Tensor:
        return self._read(
            self.encoder.image_features,
            part,
            router,
            torch.arange(len(part)) if rows is None else rows,
        )

    @torch.inference_mode()
    def _read(
        self, tower: Callable[[Tensor], Tensor], part: Part, router: int | None, rows: Tensor
    ) -> Tensor:
        activate(self.sites, router)
        self.encoder.eval()
        return torch.cat(
            [tower(self.encoder.pixels(part.images(chunk))) for chunk in rows.split(BATCH)]
        )

    def _classify(self, i: int, router: int | None, features: Tensor) -> Tensor:
        activate(self.sites, router)
        weights = class_weights(self.encoder, self.tasks[i].classes, self.tasks[i].templates)
        return (features @ weights.T).argmax(1).cpu()


def _accuracy(answers: Tensor, labels: Tensor) -> float:
    return int((answers == labels).sum()) / len(labels)
