"""lmms-eval's model `aegis`, with stand-ins for the three classes that lmms-eval provides.

lmms-eval itself is no dependency of the tests: it installs some sixty packages. Its own run of the
model is in docs/benchmarks.md.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import sets
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone

MODULE = "aegis_cli.evaluation.lmms_model"
TASK, SPLIT = "my_vqa", "test"


@dataclass
class _Instance:
    args: tuple[Any, ...]
    metadata: dict[str, Any] = field(default_factory=dict)


class _Lmms:
    def __init__(self) -> None:
        self._rank, self._world_size = 0, 1
        self.task_dict: dict[str, Any] = {}

    @property
    def rank(self) -> int:
        return self._rank


@dataclass(frozen=True)
class _ModelManifest:
    model_id: str
    simple_class_path: str | None = None


@pytest.fixture(scope="module")
def lmms_model() -> Iterator[ModuleType]:
    lent: dict[str, dict[str, Any]] = {
        "lmms_eval": {},
        "lmms_eval.api": {},
        "lmms_eval.api.instance": {"Instance": _Instance},
        "lmms_eval.api.model": {"lmms": _Lmms},
        "lmms_eval.models": {},
        "lmms_eval.models.registry_v2": {"ModelManifest": _ModelManifest},
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, members in lent.items():
            module = ModuleType(name)
            vars(module).update(members)
            patch.setitem(sys.modules, name, module)
        patch.delitem(sys.modules, MODULE, raising=False)
        yield importlib.import_module(MODULE)
        sys.modules.pop(MODULE, None)


Answers = Callable[..., list[str]]


@pytest.fixture
def answers(lmms_model: ModuleType) -> Answers:
    """The model's answers to (text, images) pairs, asked as lmms-eval does."""

    def say(
        asked: list[tuple[str, list[Any]]],
        settings: Mapping[str, Any] = {},
        **model_args: Any,
    ) -> list[str]:
        model = lmms_model.AegisModel(**model_args)
        model.task_dict = {TASK: {SPLIT: [images for _, images in asked]}}
        requests = [
            _Instance((text, dict(settings), lambda images: images, number, TASK, SPLIT))
            for number, (text, _) in enumerate(asked)
        ]
        return model.generate_until(requests)

    return say


def pictures(count: int, seed: int = 0) -> list[Image.Image]:
    """Pictures of several sizes."""
    rng = np.random.default_rng(seed)
    sizes = [(32, 32), (48, 32), (32, 64)]
    return [
        Image.fromarray(rng.integers(0, 255, (*sizes[i % 3], 3), dtype=np.uint8))
        for i in range(count)
    ]


def test_lmms_eval_is_told_where_the_model_is(lmms_model: ModuleType) -> None:
    told = lmms_model.manifest()
    module, _, name = told.simple_class_path.rpartition(".")
    assert told.model_id == "aegis"
    assert getattr(importlib.import_module(module), name) is lmms_model.AegisModel


def test_the_embedded_model_answers_as_in_a_probe(answers: Answers) -> None:
    asked = sets.read("scenes").choose("probe", 24, 0, ())
    model: Backbone = backbones.load("embedded").eval()
    expected: list[str] = []
    given: list[tuple[str, list[Any]]] = []
    for images, questions in asked.batches(8):
        texts = [question.text for question in questions]
        expected += model.answer(torch.from_numpy(np.asarray(images)), texts)
        shown = [[Image.fromarray(image)] for image in np.asarray(images)]
        given += zip(texts, shown, strict=True)
    said = answers([(f"<image> {text}", images) for text, images in given], pretrained="embedded")
    assert said == expected
    assert len(set(said)) > 3


@pytest.mark.parametrize("family", ("paligemma", "idefics3"))
def test_answers_do_not_depend_on_what_else_is_asked(
    hf_folder: Callable[[str], Path], answers: Answers, family: str
) -> None:
    one, other = pictures(2), pictures(2, seed=1)
    asked: list[tuple[str, list[Any]]] = [
        ("what color is it", [one[0]]),
        ("is the disc to the left of the ring, and how many are there", [other[0]]),
        ("which of them is larger", [one[1], other[1]]),
        ("what color is it", [other[0]]),
    ]
    settings = {"max_new_tokens": 5, "do_sample": False, "temperature": 0}
    folder = str(hf_folder(family))
    alone = answers(asked, settings, pretrained=folder)
    together = answers(asked, settings, pretrained=folder, batch_size="4")
    assert alone == together
    assert all(alone) and len(set(alone)) > 1


def test_an_answer_is_as_long_as_its_task_says(
    hf_folder: Callable[[str], Path], answers: Answers
) -> None:
    folder = str(hf_folder("paligemma"))
    asked: list[tuple[str, list[Any]]] = [("what color is it", pictures(1))]
    (long,) = answers(asked, {"max_new_tokens": 40}, pretrained=folder)
    (short,) = answers(asked, {"max_new_tokens": 3}, pretrained=folder)
    assert long.startswith(short) and len(long) > len(short)
    end = long[2]
    (cut,) = answers(asked, {"max_new_tokens": 40, "until": ["\n\n", end]}, pretrained=folder)
    assert cut == long.split(end)[0]


@pytest.mark.parametrize(
    ("settings", "images", "said"),
    [
        ({"do_sample": True, "temperature": 0.7}, pictures(1), "do_sample"),
        ({"temperature": 0.7}, pictures(1), "do_sample"),
        ({"num_beams": 4}, pictures(1), "num_beams"),
        ({}, [], "about no image"),
        ({}, ["film.mp4"], "asks about str"),
        ({}, pictures(2), "asks about 2 images at once"),
    ],
)
def test_what_it_cannot_answer_is_refused_by_the_tasks_name(
    answers: Answers, settings: dict[str, Any], images: list[Any], said: str
) -> None:
    with pytest.raises(AegisError, match=f"the task '{TASK}'") as raised:
        answers([("what color is it", images)], settings, pretrained="embedded")
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"pretrained": "embedded", "dtype": "int4"}, "dtype=int4"),
        ({"pretrained": "embedded", "dtype": "bfloat16"}, "with this backbone"),
        ({"pretrained": "embedded", "batch_size": "auto"}, "--batch_size auto"),
        ({"pretrained": "embedded", "use_flash": True}, "use_flash"),
        ({"pretrained": "models/none"}, "models/none"),
    ],
)
def test_bad_arguments_are_refused(answers: Answers, arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(AegisError) as raised:
        answers([("what color is it", pictures(1))], **arguments)
    assert said in str(raised.value)


def test_bfloat16_is_another_type_of_the_same_model(
    hf_folder: Callable[[str], Path], lmms_model: ModuleType
) -> None:
    model = lmms_model.AegisModel(str(hf_folder("paligemma")), dtype="bfloat16")
    assert {weight.dtype for weight in model._backbone.parameters()} == {torch.bfloat16}


@pytest.mark.parametrize("kind", ("loglikelihood", "generate_until_multi_round"))
def test_other_kinds_of_tasks_are_refused(lmms_model: ModuleType, kind: str) -> None:
    model = lmms_model.AegisModel("embedded")
    request = _Instance(("a", "b", None, 0, TASK, SPLIT))
    with pytest.raises(AegisError, match=f"the task '{TASK}'"):
        getattr(model, kind)([request])
