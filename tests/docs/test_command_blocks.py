"""Every command block of the README and of docs/ runs with small settings, or says in a comment before it why not.

    <!-- not run: REASON -->      nothing of the block is tried
    <!-- parsed only: REASON -->  each command reads its options and its recipe, and is refused before any work

The blocks of a page run in their order in one folder, so that a block finds what those before it have made.
"""

from __future__ import annotations

import itertools
import json
import re
import shlex
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli import Guard
from aegis_cli.__main__ import main

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md")))
}
TRIED = ("sh", "python")  # languages of blocks that somebody may want to copy
OTHERS = {"text", "json", "yaml"}
NOT_RUN, PARSED = "not run", "parsed only"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page and what the comment before it says."""

    page: str
    line: int
    language: str
    text: str
    mark: str | None
    reason: str | None


_FENCE = re.compile(
    r"(?:^<!-- (?P<mark>[a-z ]+): (?P<reason>[^\n]+) -->\n)?"
    r"^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


def blocks(page: str) -> list[Block]:
    """The page's blocks in their order."""
    text = PAGES[page]
    return [
        Block(page, text.count("\n", 0, m.start("text")), m["language"], m["text"], m["mark"], m["reason"])
        for m in _FENCE.finditer(text)
    ]


def tried(page: str) -> list[Block]:
    return [block for block in blocks(page) if block.language in TRIED]


ALL = [block for page in PAGES for block in tried(page)]
RUN = [block for block in ALL if block.mark is None]


# --- what every block says ------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_every_block_names_a_known_language(page: str) -> None:
    unknown = [b.line for b in blocks(page) if b.language not in {*TRIED, *OTHERS}]
    assert unknown == [], f"blocks after lines {unknown} of {page} are neither tried nor plain text"
    assert PAGES[page].count("\n```") + PAGES[page].startswith("```") == 2 * len(blocks(page))


@pytest.mark.parametrize("page", PAGES)
def test_a_block_that_is_not_run_says_why(page: str) -> None:
    marked = [block for block in tried(page) if block.mark is not None]
    assert [b.line for b in marked if b.mark not in (NOT_RUN, PARSED) or len(b.reason or "") < 8] == []
    assert [b.line for b in marked if b.mark == PARSED and b.language != "sh"] == []


def test_blocks_are_run() -> None:
    assert len(RUN) >= 15 and {block.language for block in RUN} == set(TRIED)
    assert {"README.md", "docs/first-run.md", "docs/guard.md"} <= {block.page for block in RUN}


# --- the shell ------------------------------------------------------------------------------------


@dataclass
class Command:
    """One command of a shell line, and the file that its output goes to."""

    words: list[str]
    output: str | None = None


def commands(block: Block) -> Iterator[Command]:
    """The commands of a block's lines, without comments."""
    for line in re.sub(r"\\\n\s*", " ", block.text).splitlines():
        tokens = shlex.shlex(line, posix=True, punctuation_chars=True)
        tokens.whitespace_split = True
        found = Command([])
        for token in tokens:
            if token in ("&&", ";"):
                yield found
                found = Command([])
            elif token == ">":
                found.output = next(iter(tokens))
            else:
                found.words.append(token)
        if found.words:
            yield found


SMALL_OPTIONS: dict[str, dict[str, str]] = {
    "demos": {"--episodes": "4"},
    "anchor": {"--samples": "21", "--batch-size": "21"},
    "probe": {"--questions": "21"},
    "rollout": {"--episodes": "1"},
}
_TRAINING = (
    "train.steps=3", "train.batch_size=4", "train.flow_samples=1", "train.warmup=1000",
    "train.validation_share=0.2", "expert.width=16", "expert.mlp_ratio=1",
)  # fmt: skip
_WHOLE = (
    "methods=[aegis, lora]", "demos.episodes=4", "anchor.samples=21", "anchor.batch_size=21",
    "probe.questions=21", "rollout.episodes=1",
)  # fmt: skip
SMALL_SETTINGS: dict[tuple[str, str], tuple[str, ...]] = {
    ("train", "policy"): _TRAINING,
    ("run", "policy"): _TRAINING + _WHOLE,
    ("train", "stream"): ("path=pictures", "order=[letters, colors]", "train.steps=4", "train.batch_size=4"),
    ("pretrain", "vlm"): (
        "scenes=8", "probe_questions=7", "steps=2", "batch_size=4", "precision=float32",
        "model.width=32", "model.depth=2", "model.heads=2",
    ),
}  # fmt: skip


def made_small(words: list[str], backbone: Path) -> list[str]:
    """The same command on less, with an untrained backbone of two layers in the place of the embedded one."""
    command, *rest = words
    for option, value in SMALL_OPTIONS.get(command, {}).items():
        rest = with_option(rest, option, value) if not is_stream(rest) else rest
    rest = [str(backbone) if word == "embedded" and command != "inspect" else word for word in rest]
    if command == "anchor" and "--backbone" not in rest:
        rest += ["--backbone", str(backbone)]
    recipe = next((word for word in rest if word.startswith("recipes/")), None)
    if command in ("train", "run", "pretrain") and recipe is not None:
        kind = kind_of(recipe)
        settings = SMALL_SETTINGS[command, kind]
        settings += (f"backbone={backbone}",) if kind == "policy" else ()
        rest += [word for setting in settings for word in ("--set", setting)]
    return [command, *rest]


def with_option(words: list[str], option: str, value: str) -> list[str]:
    """The words with the option at that value, in its place or at the end."""
    if option not in words:
        return [*words, option, value]
    place = words.index(option) + 1
    return [*words[:place], value, *words[place + 1 :]]


def is_stream(words: list[str]) -> bool:
    """Whether a command's target is the run of a stream, of which probes take no options."""
    return any((Path(word) / "recipe.yaml").is_file() and kind_of(f"{word}/recipe.yaml") == "stream" for word in words)


def kind_of(recipe: str) -> str:
    """What the recipe is of, by the keys that only such a recipe has."""
    keys = set(re.findall(r"^(\w+):", Path(recipe).read_text(encoding="utf-8"), re.MULTILINE))
    if "variants" in keys:
        return "study"
    if keys & {"stream", "tasks"}:
        return "stream"
    return "vlm" if "scenes" in keys else "dual" if "pictures" in keys else "policy"


class Shell:
    """The few commands that blocks are made of, in this process: starting Python for each would take minutes."""

    def __init__(self, backbone: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self.backbone, self._capsys, self._monkeypatch = backbone, capsys, monkeypatch
        self.said: list[Any] = []  # the reports of all commands

    def run(self, block: Block) -> None:
        """All commands of the block; those of the environment, `pip` and `pytest`, are left out."""
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
                    code, out, err = self.aegis(small if "--json" in small else [*small, "--json"])
                    assert code == 0, f"{shlex.join(command.words)}\n{out}{err}"
                    self.said.append(json.loads(out))
                    if command.output is not None:
                        Path(command.output).write_text(out)
                case _:
                    pytest.fail(f"{shlex.join(command.words)}: mark the block, or teach the test this command")
            done += 1
        assert done > 0, "nothing of this block is run: mark it"

    def parse(self, block: Block) -> None:
        """Each `aegis` of the block up to the end of its options and its recipe, with something that is refused then."""
        found = [command.words[1:] for command in commands(block) if command.words[0] == "aegis"]
        assert found, "no aegis command in this block: mark it as not run"
        for words in found:
            refused, said = refused_after_reading(words)
            code, out, err = self.aegis(refused)
            assert (code, said in out + err) == (0 if refused[-1] == "--help" else 2, True), f"{shlex.join(words)}\n{out}{err}"

    def aegis(self, words: list[str]) -> tuple[int, str, str]:
        """What `python -m aegis_cli` does with these words: exit code, stdout, stderr."""
        self._monkeypatch.setattr("sys.argv", ["aegis", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = self._capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err


def refused_after_reading(words: list[str]) -> tuple[list[str], str]:
    """The command with one thing that it refuses as soon as options and recipe are read, and a word of that refusal.

    A command without a recipe shows its help instead, which it does when it knows all of its options.
    """
    command, *rest = words
    recipe = next((word for word in rest if word.startswith("recipes/")), None)
    if command not in ("train", "run", "pretrain") or recipe is None:
        return [*words, "--help"], "Usage"
    kind = kind_of(recipe)
    if command == "train" and kind == "stream":
        return [*words, "--demos", "none"], "--demos"
    if command == "train":
        place = rest.index("--demos")
        return [command, *rest[:place], *rest[place + 2 :]], "no --demos"
    if kind == "policy":
        return [*words, "--workers", "2"], "--workers"
    return [*words, "--out", "a-file/runs"], "a-file"


# --- Python: a small model, and what the blocks call their own ------------------------------------

WIDTH, WORDS, PATCHES, TEXT = 16, 23, 3, 5
IMAGE = torch.arange(PATCHES + TEXT) < PATCHES


class Layer(nn.Module):
    """One attention head and a feed-forward part."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.qkv, self.out = nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.up, self.down = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm(x)).chunk(3, -1)
        scores = (q @ k.mT / WIDTH**0.5).masked_fill(hidden[:, None], -1e4)
        x = x + self.out(scores.softmax(-1) @ v)
        return x + self.down(F.gelu(self.up(x)))


class SmallVlm(nn.Module):
    """Pixels [B, 3, 6, 2] become 3 tokens; with the words [B, 5] they pass `text.layers`."""

    def __init__(self) -> None:
        super().__init__()
        self.vision = nn.Sequential(nn.Conv2d(3, WIDTH, 2, stride=2), nn.Flatten(2))
        self.text = nn.Module()
        self.text.words = nn.Embedding(WORDS, WIDTH)
        self.text.layers = nn.ModuleList(Layer() for _ in range(2))

    def forward(self, images: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.vision(images).mT, self.text.words(ids)], 1)
        for layer in self.text.layers:
            x = layer(x, ~mask)
        return x


def small_batches(seed: int) -> list[tuple[Tensor, ...]]:
    """Images, ids, mask and target of two batches; the second row ends in padding."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.ones(4, PATCHES + TEXT, dtype=torch.bool)
    mask[1, -2:] = False
    return [
        (
            torch.randn(4, 3, 2 * PATCHES, 2, generator=generator),
            torch.randint(WORDS, (4, TEXT), generator=generator), mask,
            torch.randn(4, PATCHES + TEXT, WIDTH, generator=generator),
        )
        for _ in range(2)
    ]  # fmt: skip


def small_vlm(anchor: Path) -> SmallVlm:
    """A model with fixed weights, whose anchor is written."""
    torch.manual_seed(0)
    model = SmallVlm().eval()
    with Guard.measure(model, layers="text.layers") as measured:
        for images, ids, mask, _ in small_batches(1):
            with measured.watch(mask, IMAGE):
                model(images, ids, mask)
    measured.save(anchor)
    return model


def save_small_paligemma(folder: Path) -> None:
    """PaliGemma 2's architecture with random weights, as its owner would have it on disk."""
    from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

    common = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision = {"model_type": "siglip_vision_model", "image_size": 8, "patch_size": 4, "vision_use_head": False}
    text = {"model_type": "gemma2", "num_key_value_heads": 1, "head_dim": 8, "vocab_size": WORDS, "pad_token_id": 0}
    config = PaliGemmaConfig(
        vision_config=common | vision | {"projection_dim": 16}, text_config=common | text,
        image_token_index=WORDS - 1, projection_dim=16, vocab_size=WORDS, pad_token_id=0,
    )  # fmt: skip
    torch.manual_seed(0)
    PaliGemmaForConditionalGeneration(config).save_pretrained(folder)


def paligemma_batches(seed: int) -> list[dict[str, Tensor]]:
    """Two batches of three texts about an image of four tokens, as a processor would make them."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for _ in range(2):
        image = torch.full((3, 4), WORDS - 1)
        words = torch.randint(3, WORDS - 1, (3, TEXT), generator=generator)
        words[0, -2:] = 0
        ids = torch.cat([image, words], 1)
        made.append({
            "input_ids": ids,
            "attention_mask": (ids != 0).long(),
            "token_type_ids": torch.zeros_like(ids),
            "pixel_values": torch.randn(3, 3, 8, 8, generator=generator),
            "labels": ids.masked_fill((ids == 0) | (ids == WORDS - 1), -100),
        })
    return made


def given(namespace: Mapping[str, Any]) -> dict[str, Any]:
    """What a block calls its own and the page does not make: an optimizer of the model as it is now."""
    model = namespace["model"]
    learning = [p for p in model.parameters() if p.requires_grad]
    return {"optimizer": torch.optim.AdamW(learning, lr=1e-3)}


# --- the pages ------------------------------------------------------------------------------------


@pytest.fixture
def page_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a page's blocks run: the shipped recipes, a file that is no folder, and no cache of a user's."""
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
    tasks = {"letters": (("a", "b"), "a photo of the letter {}"), "colors": (("red", "blue"), "a photo of a {} object")}
    for task, (classes, sentence) in tasks.items():
        for part, name, number in itertools.product(("train", "test"), classes, range(4)):
            path = root / task / part / name / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(rng.integers(0, 256, (48, 48, 3), np.uint8)).save(path)
        (root / task / "templates.txt").write_text(sentence)


@pytest.mark.parametrize("page", sorted({b.page for b in ALL if b.mark != NOT_RUN}))
def test_the_blocks_of_a_page(
    page: str, page_folder: Path, tiny_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shell = Shell(tiny_folder, capsys, monkeypatch)
    namespace = own_names(page, page_folder)
    for block in tried(page):
        if block.mark == PARSED:
            shell.parse(block)
        elif block.mark is None and block.language == "sh":
            shell.run(block)
        elif block.mark is None:
            namespace |= given(namespace) if "model" in namespace else {}
            exec(compile(block.text, f"{page}:{block.line}", "exec"), namespace)
    assert undocumented([*shell.said, *documents(page_folder)]) == set()


def own_names(page: str, folder: Path) -> dict[str, Any]:
    """The names that a page's Python blocks leave to their reader."""
    names: dict[str, Any] = {"frame": np.zeros((48, 64, 3), np.uint8), "positions": [0.0] * 6}
    if not any(block.language == "python" and "Guard" in block.text for block in tried(page) if block.mark is None):
        return names
    names |= {"model": small_vlm(folder / "anchor.safetensors"), "loader": small_batches(2), "my_loss": F.mse_loss}
    if any("path/to/paligemma2" in block.text for block in tried(page)):
        save_small_paligemma(folder / "path" / "to" / "paligemma2")
        names |= {"questions": paligemma_batches(3), "robot_batches": paligemma_batches(4)}
    return names


# --- what the blocks have written -----------------------------------------------------------------

# Keys below these are names of things: methods, layers, groups, files.
NAMES_BELOW = {"families", "inputs", "outputs", "seconds", "groups", "memory_mb", "statistics"}
# What lies below these is somebody else's: a recipe's keys, and what a header says of its kind.
OPAQUE = {"recipe", "facts"}


@cache
def documented() -> frozenset[str]:
    """Every word that docs/outputs.md sets as code."""
    spans = re.findall(r"`([^`\n]+)`", PAGES["docs/outputs.md"])
    return frozenset(word for span in spans for word in re.findall(r"[\w-]+", span))


def documents(folder: Path) -> Iterator[Any]:
    """What the JSON files below a folder hold; a model's and LeRobot's own files are theirs."""
    for path in [*folder.rglob("*.json"), *folder.rglob("metrics.jsonl")]:
        if not path.is_relative_to(folder / "path") and path.parent.name != "meta":
            lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
            yield from map(json.loads, lines)


def undocumented(reports: list[Any]) -> set[str]:
    """Their keys that docs/outputs.md does not name; those with a slash or a space are names of stages."""
    found = {key for report in reports for key in keys(report)}
    return {key for key in found if "/" not in key and " " not in key} - documented()


def keys(value: Any, names: bool = False) -> set[str]:
    """The keys of nested mappings, but for those that are names, or lie below something opaque."""
    if isinstance(value, list):
        return {key for item in value for key in keys(item)}
    if not isinstance(value, dict):
        return set()
    own = set() if names else set(value)
    return own | {key for name, item in value.items() if name not in OPAQUE for key in keys(item, name in NAMES_BELOW)}


def test_keys_of_nested_mappings_are_found() -> None:
    report = {"families": {"color": {"accuracy": 1}}, "layers": [{"w2": 0.5}], "recipe": {"name": "x"}}
    assert keys(report) == {"families", "accuracy", "layers", "w2", "recipe"}


def test_the_reader_of_blocks_sees_marks_and_commands() -> None:
    page = "<!-- not run: needs weights -->\n```sh\na\n```\n\n```sh\npip install x && aegis run y > z  # why\n```\n"
    found = [(m["mark"], m["language"]) for m in _FENCE.finditer(page)]
    assert found == [("not run", "sh"), (None, "sh")]
    block = SimpleNamespace(text="pip install x && aegis run y > z  # why\n")
    assert [(c.words, c.output) for c in commands(block)] == [(["pip", "install", "x"], None), (["aegis", "run", "y"], "z")]
