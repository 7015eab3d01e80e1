"""Every command block of the README and of docs/ runs with small settings, or says why not.

The reason is in a comment directly before it:

    <!-- not run: REASON -->      nothing of the block is tried
    <!-- parsed only: REASON -->  each command reads its options and its recipe, and no more
    <!-- needs: PACKAGE -->       it runs where that package is installed

The blocks of a page run in order in one folder, so a block finds the results of those before it.
Commands run with --json, so docs/outputs.md can be checked for every key they print.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.command_blocks import (
    FENCE,
    NEEDS,
    NOT_RUN,
    OTHERS,
    PAGES,
    PARSED,
    ROOT,
    TRIED,
    Block,
    blocks,
    commands,
    tried,
)
from samples.guarded_models import (
    measured_paligemma,
    paligemma_batches,
    save_small_paligemma,
    small_batches,
    small_vlm,
)
from samples.lerobot import ReachArm
from torch.nn import functional as F

Aegis = Callable[..., tuple[int, str, str]]  # words -> exit code, stdout, stderr

ALL = [block for page in PAGES for block in tried(page)]
RUN = [block for block in ALL if block.mark is None]
# Recipes that name their own demonstrations, so a command without any is not refused.
NAMING_DEMOS = ("recipes/paligemma2-libero.yaml",)


# --- what every block says ------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_every_block_names_a_known_language(page: str) -> None:
    unknown = [b.line for b in blocks(page) if b.language not in {*TRIED, *OTHERS}]
    assert unknown == [], f"blocks after lines {unknown} of {page} are neither tried nor plain text"
    assert PAGES[page].count("\n```") + PAGES[page].startswith("```") == 2 * len(blocks(page))


@pytest.mark.parametrize("page", PAGES)
def test_a_block_that_is_not_run_says_why(page: str) -> None:
    marked = [block for block in tried(page) if block.mark not in (None, NEEDS)]
    assert [
        b.line for b in marked if b.mark not in (NOT_RUN, PARSED) or len(b.reason or "") < 8
    ] == []
    assert [b.line for b in marked if b.mark == PARSED and b.language != "sh"] == []


def test_blocks_are_run() -> None:
    assert len(RUN) >= 15 and {block.language for block in RUN} == set(TRIED)
    assert {"README.md", "docs/first-run.md", "docs/guard.md"} <= {block.page for block in RUN}


# --- the shell ------------------------------------------------------------------------------------


SMALL_OPTIONS: dict[str, dict[str, str]] = {
    "demos": {"--episodes": "4"},
    "anchor": {"--samples": "21", "--batch-size": "21"},
    "merge": {"--samples": "21", "--frames": "20", "--questions": "21"},
    "probe": {"--questions": "21"},
    "rollout": {"--episodes": "1"},
}
_TRAINING = (
    "train.steps=3",
    "train.batch_size=4",
    "train.flow_samples=1",
    "train.warmup=1000",
    "train.validation_share=0.2",
    "expert.width=16",
    "expert.mlp_ratio=1",
)
_WHOLE = (
    "methods=[aegis, lora]",
    "demos.episodes=4",
    "anchor.samples=21",
    "anchor.batch_size=21",
    "probe.questions=21",
    "rollout.episodes=1",
)
SMALL_SETTINGS: dict[tuple[str, str], tuple[str, ...]] = {
    ("train", "policy"): _TRAINING,
    ("run", "policy"): _TRAINING + _WHOLE,
    ("train", "stream"): (
        "path=pictures",
        "order=[letters, colors]",
        "train.steps=4",
        "train.batch_size=4",
    ),
    ("pretrain", "vlm"): (
        "scenes=8",
        "probe_questions=7",
        "steps=2",
        "batch_size=4",
        "precision=float32",
        "model.width=32",
        "model.depth=2",
        "model.heads=2",
    ),
}


def made_small(words: list[str], backbone: Path) -> list[str]:
    """The same command on less data, with an untrained backbone in place of the embedded one."""
    command, *rest = words
    for option, value in SMALL_OPTIONS.get(command, {}).items():
        rest = with_option(rest, option, value) if not is_stream(rest) else rest
    if "--gate" in rest:
        rest = with_option(rest, "--max-drop", "100")  # this few questions pass no narrow gate
    rest = [str(backbone) if word == "embedded" and command != "inspect" else word for word in rest]
    if command == "anchor" and "--backbone" not in rest:
        rest += ["--backbone", str(backbone)]
    recipe = next((word for word in rest if word.startswith("recipes/")), None)
    if command in ("train", "run", "pretrain") and recipe is not None:
        kind = kind_of(recipe)
        settings = SMALL_SETTINGS.get((command, kind), ())
        # A block that starts from another run's policy names its backbone itself.
        own = any(word.startswith("backbone=runs/") for word in rest)
        settings += (f"backbone={backbone}",) if kind == "policy" and not own else ()
        rest += [word for setting in settings for word in ("--set", setting)]
    elif command == "train":
        rest += ["--set", "train.steps=5"]  # a finished run that is to take more steps
    return [command, *rest]


def with_option(words: list[str], option: str, value: str) -> list[str]:
    """The words with the option set to that value, in its place or at the end."""
    if option not in words:
        return [*words, option, value]
    place = words.index(option) + 1
    return [*words[:place], value, *words[place + 1 :]]


def is_stream(words: list[str]) -> bool:
    """Whether a command's target is the run of a stream, for which probes take no options."""
    return any(
        (Path(word) / "recipe.yaml").is_file() and kind_of(f"{word}/recipe.yaml") == "stream"
        for word in words
    )


def kind_of(recipe: str) -> str:
    """The kind of a recipe, by the keys that only such a recipe has."""
    keys = set(re.findall(r"^(\w+):", Path(recipe).read_text(encoding="utf-8"), re.MULTILINE))
    if "variants" in keys:
        return "study"
    if keys & {"stream", "tasks"}:
        return "stream"
    return "vlm" if "scenes" in keys else "dual" if "pictures" in keys else "policy"


class Shell:
    """The few commands that blocks consist of, in this process: others take seconds to start."""

    def __init__(self, backbone: Path, aegis: Aegis) -> None:
        self.backbone, self.aegis = backbone, aegis
        self.said: list[Any] = []  # the reports of all commands

    def run(self, block: Block) -> None:
        """Run all commands of the block except those for the environment, `pip` and `pytest`."""
        done = 0
        for command in commands(block):
            match command.words:
                case ["pip", "install", *_] | ["pytest", *_] | ["set", "-e"]:
                    continue
                case ["mkdir", "-p", folder]:
                    Path(folder).mkdir(parents=True, exist_ok=True)
                case ["cp", source, target]:
                    shutil.copy(source, target)
                case ["aegis", *words]:
                    small = made_small(words, self.backbone)
                    said = small if "--json" in small else [*small, "--json"]
                    code, out, err = self.aegis(*said)
                    assert code == 0, f"{shlex.join(command.words)}\n{out}{err}"
                    self.said.append(json.loads(out))
                    if command.output is not None:
                        Path(command.output).write_text(out, encoding="utf-8")
                case _:
                    pytest.fail(
                        f"{shlex.join(command.words)}: mark the block, or teach the test this"
                    )
            done += 1
        assert done > 0, "nothing of this block is run: mark it"

    def parse(self, block: Block) -> None:
        """Run each `aegis` of the block with something that is refused after its recipe is read."""
        found = [command.words[1:] for command in commands(block) if command.words[0] == "aegis"]
        assert found, "no aegis command in this block: mark it as not run"
        for words in found:
            refused, said = refused_after_reading(words)
            code, out, err = self.aegis(*refused)
            assert (code, said in out + err) == (0 if refused[-1] == "--help" else 2, True), (
                f"{shlex.join(words)}\n{out}{err}"
            )

    def read_recipe(self, block: Block) -> None:
        """Read the block as a recipe, which must be valid."""
        Path("block.yaml").write_text(block.text, encoding="utf-8")
        code, out, err = self.aegis("inspect", "block.yaml")
        assert code == 0, f"{block.page}:{block.line}\n{out}{err}"


def refused_after_reading(words: list[str]) -> tuple[list[str], str]:
    """The command with one thing that it refuses after reading its recipe, and the error's text.

    A command without a recipe shows its help instead, which it does only for options that it knows.
    """
    command, *rest = words
    recipe = next((word for word in rest if word.startswith("recipes/")), None)
    if command not in ("train", "run", "pretrain") or recipe is None:
        return [*words, "--help"], "Usage"
    kind = kind_of(recipe)
    if command == "train" and kind == "stream":
        return [*words, "--demos", "none"], "--demos"
    if command == "train":
        if recipe in NAMING_DEMOS:  # its model is missing too, and is reported first
            return words, "no folder 'models/"
        assert "--demos" in rest, words
        while "--demos" in rest:
            place = rest.index("--demos")
            del rest[place : place + 2]
        return [command, *rest], "no --demos"
    if kind == "policy":
        return [*words, "--workers", "2"], "--workers"
    return [*words, "--out", "a-file/runs"], "a-file"


# --- Python ---------------------------------------------------------------------------------------


def given(namespace: Mapping[str, Any]) -> dict[str, Any]:
    """What a block takes as given and no page makes: an optimizer of the current model."""
    model = namespace["model"]
    learning = [p for p in model.parameters() if p.requires_grad]
    return {"optimizer": torch.optim.AdamW(learning, lr=1e-3)}


# --- the pages ------------------------------------------------------------------------------------


@pytest.fixture
def page_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a page's blocks run: with the shipped recipes, without a user's cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "cache"))
    (tmp_path / "recipes").symlink_to(ROOT / "recipes")
    (tmp_path / "a-file").write_text("")
    save_pictures(tmp_path / "pictures")
    return tmp_path


def save_pictures(root: Path) -> None:
    """Two classification tasks as image folders, in words that the embedded dual encoder knows."""
    from PIL import Image

    rng = np.random.default_rng(0)
    tasks = {
        "letters": (("a", "b"), "a photo of the letter {}"),
        "colors": (("red", "blue"), "a photo of a {} object"),
    }
    for task, (classes, sentence) in tasks.items():
        for part, name, number in itertools.product(("train", "test"), classes, range(4)):
            path = root / task / part / name / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(rng.integers(0, 256, (48, 48, 3), np.uint8)).save(path)
        (root / task / "templates.txt").write_text(sentence)


@pytest.mark.parametrize("page", sorted({b.page for b in ALL if b.mark != NOT_RUN}))
def test_the_blocks_of_a_page(
    page: str, page_folder: Path, tiny_folder: Path, aegis: Aegis
) -> None:
    shell = Shell(tiny_folder, aegis)
    namespace = own_names(page, page_folder)
    for block in blocks(page):
        if block.language == "yaml":
            shell.read_recipe(block)
        elif block.mark == PARSED:
            shell.parse(block)
        elif block.mark is None and block.language == "sh":
            shell.run(block)
        elif is_run(block) and block.language == "python":
            if "LAYERS).automatic(" in block.text or "guard.callback()" in block.text:
                # Each example of a trainer starts with the measured model.
                namespace |= {"model": measured_paligemma(page_folder)}
            namespace |= given(namespace) if "model" in namespace else {}
            with warnings.catch_warnings():
                if block.mark == NEEDS:
                    warnings.simplefilter("ignore")  # what others' trainers warn of is theirs
                exec(compile(block.text, f"{page}:{block.line}", "exec"), namespace)
    assert undocumented([*shell.said, *documents(page_folder)]) == set()
    if page == "docs/own-robot.md":
        robot = namespace["robot"]
        loops = 2  # as it is, and while the robot moves
        assert (len(robot.sent), robot.is_connected) == (loops * namespace["steps"], False)


def is_run(block: Block) -> bool:
    """Whether the whole block is run, since everything that it needs exists."""
    if block.mark == NEEDS:
        return importlib.util.find_spec(block.reason or "") is not None
    return block.mark is None


def own_names(page: str, folder: Path) -> dict[str, Any]:
    """The names that a page's Python blocks leave to the reader."""
    names: dict[str, Any] = {"frame": np.zeros((48, 64, 3), np.uint8), "positions": [0.0] * 6}
    names |= {"robot": ReachArm(), "steps": 3}
    if not any(
        block.language == "python" and "Guard" in block.text
        for block in tried(page)
        if block.mark is None
    ):
        return names
    names |= {
        "model": small_vlm(folder / "anchor.safetensors"),
        "loader": small_batches(2),
        "my_loss": F.mse_loss,
    }
    if any("path/to/paligemma2" in block.text for block in tried(page)):
        save_small_paligemma(folder / "path" / "to" / "paligemma2")
        robot = paligemma_batches(4)
        frames = [{name: t[i] for name, t in one.items()} for one in robot for i in range(3)]
        names |= {"questions": paligemma_batches(3), "robot_batches": robot}
        names |= {"robot_frames": frames}
    return names


def test_a_failed_gate_ends_the_block_for_ci(tmp_path: Path) -> None:
    """If a stand-in for `aegis` has a failing probe, nothing after the probe runs."""
    (block,) = [b for b in tried("docs/ci.md") if b.text.startswith("set -e\n")]
    stand_in = tmp_path / "aegis"
    stand_in.write_text('#!/bin/sh\necho "$1" >> calls.txt\ntest "$1" != probe\n')
    stand_in.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    ended = subprocess.run(
        ["bash", "-c", block.text], cwd=tmp_path, env=os.environ | {"PATH": path}
    )
    assert ended.returncode == 1
    assert (tmp_path / "calls.txt").read_text().split() == ["demos", "anchor", "train", "probe"]


# --- what the blocks have written -----------------------------------------------------------------

# Keys below these are names of things: methods, layers, groups, files.
NAMES_BELOW = {"families", "inputs", "outputs", "seconds", "groups", "memory_mb", "statistics"}
NAMES_BELOW |= {"trainings", "parts"}
# Values below these are not ours: a recipe's keys, and a header's facts about its kind.
OPAQUE = {"recipe", "facts"}


@cache
def documented() -> frozenset[str]:
    """Every word that docs/outputs.md formats as code."""
    spans = re.findall(r"`([^`\n]+)`", PAGES["docs/outputs.md"])
    return frozenset(word for span in spans for word in re.findall(r"[\w-]+", span))


def documents(folder: Path) -> Iterator[Any]:
    """What the JSON files below a folder hold; a model's and LeRobot's own files are theirs."""
    for path in [*folder.rglob("*.json"), *folder.rglob("metrics.jsonl")]:
        lerobots = path.parent.name == "meta" or (path.parent / "policy_preprocessor.json").exists()
        if not path.is_relative_to(folder / "path") and not lerobots:
            lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
            yield from map(json.loads, lines)


def undocumented(reports: list[Any]) -> set[str]:
    """Their keys that docs/outputs.md does not name, except names of stages and digests."""
    found = {key for report in reports for key in keys(report)}
    return {key for key in found if not re.search(r"[/ ]|^[0-9a-f]{64}$", key)} - documented()


def keys(value: Any, names: bool = False) -> set[str]:
    """The keys of nested mappings, except those that are names, or are below something opaque."""
    if isinstance(value, list):
        return {key for item in value for key in keys(item)}
    if not isinstance(value, dict):
        return set()
    own = set() if names else set(value)
    return own | {
        key
        for name, item in value.items()
        if name not in OPAQUE
        for key in keys(item, name in NAMES_BELOW)
    }


def test_keys_of_nested_mappings_are_found() -> None:
    report = {
        "families": {"color": {"accuracy": 1}},
        "layers": [{"w2": 0.5}],
        "recipe": {"name": "x"},
    }
    assert keys(report) == {"families", "accuracy", "layers", "w2", "recipe"}


def test_the_reader_of_blocks_sees_marks_and_commands() -> None:
    line = "pip install x && aegis run y > z  # why\n"
    page = f"<!-- not run: needs weights -->\n```sh\na\n```\n\n```sh\n{line}```\n"
    found = [(m["mark"], m["language"]) for m in FENCE.finditer(page)]
    assert found == [("not run", "sh"), (None, "sh")]
    block = Block("page", 7, "sh", line, None, None)
    assert [(c.words, c.output) for c in commands(block)] == [
        (["pip", "install", "x"], None),
        (["aegis", "run", "y"], "z"),
    ]
