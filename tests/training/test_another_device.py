"""Every stage on a device besides the CPU: nothing is left behind, and no step waits for it.

Without a GPU, the stand-in `samples.second_device` refuses what a GPU refuses.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from samples import processes
from samples.second_device import NAME, POSSIBLE, said, said_there
from samples.training_runs import SETTINGS, TIMES, metrics

from aegis_cli.methods import METHODS
from aegis_cli.recipes import Cotrain, Expert, Recipe, to_yaml

OTHERS = [NAME] * POSSIBLE + ["cuda"] * torch.cuda.is_available()
pytestmark = pytest.mark.skipif(not OTHERS, reason="this torch takes no device of others' making")
ANCHOR, RECIPE = "anchor.safetensors", "recipe.yaml"
STEPS = 2
PARTS = "moments,inputs,curvature,fisher"
# Whether parameters without a task gradient move depends on a weight: one wait per step to read it.
WAITS = {"aegis": {"methods/backward.py:combine_gradients": STEPS}}
# It decides by a sign, which rounding of a gradient may flip.
TURNS = "maps"
OF_HF = ("naive", "aegis", "insulate", "distill", "cotrain")


@dataclass(frozen=True)
class Run:
    """Commands that ran in a folder; the output of each, and where the steps of each waited."""

    folder: Path
    said: dict[str, dict[str, Any]]
    waits: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Both:
    """The same commands on the CPU and on the other device."""

    cpu: Run
    other: Run


def recipe(backbone: Path) -> Recipe:
    return Recipe(
        name="test",
        backbone=str(backbone),
        train=replace(SETTINGS, steps=STEPS, checkpoint_every=STEPS),
        expert=Expert(width=16),
        cotrain=Cotrain(questions=14, batch_size=3),
    )


def commands(backbone: Path, demos: Path, methods: Sequence[str]) -> dict[str, list[str]]:
    """The commands from the anchor to the evaluations of a policy and of a merged one."""
    given = ["--demos", str(demos), "--anchor", ANCHOR]
    found = {"anchor": measuring(backbone, PARTS, ANCHOR)}
    for method in methods:
        found[method] = ["train", RECIPE, "--method", method, *given, "--out", method]
    asked = ["--baseline", str(backbone), "--questions", "14"]
    found["probe"] = ["probe", "naive", *asked, "--anchor", ANCHOR]
    found["evaluate"] = ["evaluate", "naive", "--demos", str(demos)]
    found["merge"] = ["merge", "naive", *given, "--strength", "1", "--frames", "16"]
    found["merge"] += ["--out", "merged"]
    return {name: [*arguments, "--json"] for name, arguments in found.items()}


def measuring(backbone: Path, parts: str, out: str) -> list[str]:
    asked = ["--samples", "6", "--batch-size", "3", "--parts", parts, "--out", out]
    return ["anchor", "--backbone", str(backbone), *asked]


def run(folder: Path, jobs: dict[str, list[str]], device: str, kind: str) -> Run:
    if device == "cpu":
        with contextlib.chdir(folder):
            found = said(list(jobs.values()))
    else:  # in a process of its own, since a process that has the stand-in keeps it
        found = processes.alone(said_there, folder, list(jobs.values()), device, kind)
    each = dict(zip(jobs, found, strict=True))
    told = {name: one["said"] for name, one in each.items()}
    return Run(folder, told, {name: one["waits"] for name, one in each.items()})


@pytest.fixture(scope="module")
def both(
    tmp_path_factory: pytest.TempPathFactory,
    tiny_folder: Path,
    hf_folder: Callable[[str], Path],
    demos_file: Path,
) -> Callable[[str, str], Both]:
    """Results for a kind of backbone on the CPU and on another device; each is made once."""

    @cache
    def on(device: str, kind: str) -> Run:
        backbone, methods = tiny_folder, sorted(METHODS)
        earlier: dict[str, list[str]] = {}
        if kind == "hugging_face":
            backbone, methods = hf_folder("smolvlm"), list(OF_HF)
            # An earlier command with another backbone leaves no trace.
            earlier["earlier"] = [
                *measuring(tiny_folder, "moments", "earlier.safetensors"),
                "--json",
            ]
        folder = tmp_path_factory.mktemp(device)
        (folder / RECIPE).write_text(to_yaml(recipe(backbone)))
        jobs = {**earlier, **commands(backbone, demos_file, methods)}
        return run(folder, jobs, device, kind)

    return lambda device, kind: Both(on("cpu", kind), on(device, kind))


@pytest.fixture(params=itertools.product(OTHERS, ("embedded", "hugging_face")), ids="-".join)
def ran(request: pytest.FixtureRequest, both: Callable[[str, str], Both]) -> Both:
    return both(*request.param)


# --- the same figures -----------------------------------------------------------------------------


def test_anchors_are_the_same(ran: Both) -> None:
    expected, found = (load_file(one.folder / ANCHOR) for one in (ran.cpu, ran.other))
    assert expected.keys() == found.keys()
    for name, tensor in expected.items():
        if name.endswith(".vectors"):  # with few samples, rounding chooses between some directions
            continue
        torch.testing.assert_close(found[name], tensor, rtol=1e-4, atol=1e-5, msg=name)


def test_every_step_is_the_same(ran: Both) -> None:
    """Losses, norms and distances; not every weight, since Adam moves a bias by rounding alone."""
    for name in ran.cpu.said.keys() & METHODS.keys():
        bound = 2e-2 if name == TURNS else 1e-3
        expected, found = (metrics(one.folder / name, TIMES) for one in (ran.cpu, ran.other))
        assert len(expected) == STEPS
        for own, other in zip(expected, found, strict=True):
            assert other == pytest.approx(own, rel=bound, abs=1e-6), name


def test_what_is_told_is_the_same(ran: Both) -> None:
    for name in ("probe", "evaluate", "merge"):
        expected, found = (one.said[name] for one in (ran.cpu, ran.other))
        numbers = {key for key, value in expected.items() if isinstance(value, float)}
        assert numbers
        for key in numbers:
            assert found[key] == pytest.approx(expected[key], rel=1e-3), (name, key)


# --- no wait --------------------------------------------------------------------------------------


@pytest.mark.skipif(not POSSIBLE, reason="the stand-in alone counts")
@pytest.mark.parametrize("kind", ["embedded", "hugging_face"])
def test_no_step_waits_for_the_device(kind: str, both: Callable[[str, str], Both]) -> None:
    """Reads in a model's own code are not ours to change."""
    ran = both(NAME, kind)
    for name, places in ran.other.waits.items():
        assert places == WAITS.get(name, {}), name
