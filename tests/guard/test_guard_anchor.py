"""The anchor of a model that is not ours, and the null-space method on it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.guard import (
    ALL_PARTS,
    IMAGE,
    LAYERS,
    PATCHES,
    TEXT,
    Vlm,
    batch,
    compiling,
    guarded_steps,
    make,
    measured,
    vector,
)
from samples.tiny import make_tiny
from samples.training import make_questions
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli import Guard, inspection
from aegis_cli.anchors import inputs, moments
from aegis_cli.anchors.anchor_file import from_artifact
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.spectrum import Spectrum


@pytest.fixture(scope="module")
def anchor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measured(make(), tmp_path_factory.mktemp("anchor") / "anchor.safetensors")


def second_moments(read: dict[str, Spectrum]) -> dict[str, Tensor]:
    found = {}
    for site, x in read.items():
        v = None if x.vectors is None else x.vectors.double()
        found[site] = x.values if v is None else v * x.values[..., None, : v.shape[-1]] @ v.mT
    return found


# --- moments and inputs ---------------------------------------------------------------------------


def test_the_embedded_vlms_anchor_is_the_one_of_the_command() -> None:
    model, asked = make_tiny(), make_questions()
    image, text = moments.measure(model, asked.batches(2), len(asked.questions))
    with Guard.measure(model, parts=ALL_PARTS, vision="stem", energy=1.0) as found:
        for images, questions in asked.batches(2):
            prepared = model.prepare(torch.from_numpy(images), [q.text for q in questions])
            mask = torch.cat([torch.ones(len(images), 64, dtype=torch.bool), prepared.mask], 1)
            with found.watch(mask, torch.arange(mask.shape[1]) < 64):
                model.encode(prepared)
    for ours, theirs in zip(
        (*found.anchor().image, *found.anchor().text), (*image, *text), strict=True
    ):
        assert (
            ours.count == theirs.count
            and torch.equal(ours.mean, theirs.mean)
            and torch.equal(ours.var, theirs.var)
        )


def test_the_embedded_vlms_inputs_are_those_of_the_command() -> None:
    """Its tied head is no module: the guard notices that the table is used for scores."""
    model, asked = make_tiny(), make_questions()
    wanted = inputs.measure(model, asked, 1.0)
    with (
        Guard.measure(model, parts=("inputs",), vision="stem", energy=1.0) as found,
        found.watch(None),
    ):
        image_of, texts = (
            torch.from_numpy(np.asarray(asked.image_of)),
            [q.text for q in asked.questions],
        )
        list(
            model.read_vqa(
                torch.from_numpy(asked.images), image_of, texts, [q.answer for q in asked.questions]
            )
        )
    assert found.anchor().inputs.keys() == wanted.keys() and "words.scores" in wanted
    for site, spectrum in found.anchor().inputs.items():
        assert torch.equal(spectrum.values, wanted[site].values)


def test_an_anchor_of_prompts_without_images_holds_all_their_tokens(
    anchor: Path, tmp_path: Path
) -> None:
    """A language model has only text tokens, so only these are compared."""
    path, model = tmp_path / "text.safetensors", make()
    with Guard.measure(model, LAYERS) as found:
        for seed in range(100, 103):
            pixels, ids, mask = batch(seed)
            with found.watch(mask, torch.zeros_like(IMAGE)):
                model(pixels, ids, mask)
    found.save(path)
    rows = inspection.run(path).moments
    assert len(rows) == len(found.anchor().text) and all("text" in row.name for row in rows)
    trained = []
    for measured_on in (anchor, path):
        model = make()
        guarded_steps(model, Guard(model, measured_on, LAYERS))
        trained.append(vector(model))
    torch.testing.assert_close(*trained, rtol=1e-6, atol=1e-9)
    for scope in ("image", "each"):
        with pytest.raises(AegisError, match="without image tokens"):
            Guard(make(), path, LAYERS, scope=scope)


def one_by_one(model: nn.Module, parts: Sequence[str] = ALL_PARTS) -> Anchor:
    """The anchor from each question alone and without its padding."""
    with Guard.measure(model, LAYERS, parts=parts, vision="vision", energy=1.0) as found:
        for seed in range(100, 103):
            pixels, ids, mask = batch(seed)
            for row in range(len(ids)):
                words = int(mask[row, PATCHES:].sum())
                alone = torch.ones(1, PATCHES + words, dtype=torch.bool)
                with found.watch(None, IMAGE[: PATCHES + words]):
                    model(pixels[row : row + 1], ids[row : row + 1, :words], alone)
    return found.anchor()


def test_padding_never_counts(anchor: Path) -> None:
    """Padded batches give the same as the questions one by one.

    Pixels are never padded.
    """
    together, alone = from_artifact(artifacts.load(anchor, "anchor")), one_by_one(make())
    for ours, theirs in zip(
        (*together.image, *together.text), (*alone.image, *alone.text), strict=True
    ):
        assert ours.count == theirs.count
        torch.testing.assert_close(ours.mean, theirs.mean, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(ours.var, theirs.var, rtol=1e-6, atol=1e-9)
    ours, theirs = second_moments(dict(together.inputs)), second_moments(dict(alone.inputs))
    assert (
        ours.keys() == theirs.keys() and len(ours) == 2 * 6 + 4
    )  # the layers' maps, stem, words, scores, norm
    words, alone_words = ours.pop("text.words"), theirs.pop("text.words")
    assert words.tolist() == [
        1.0,
        *alone_words[1:].tolist(),
    ]  # it reads 5 of the mask's 8 tokens: the padding token counts too
    for site, moment in theirs.items():
        torch.testing.assert_close(
            ours[site], moment, rtol=0, atol=2e-6 * moment.abs().max().item()
        )


def test_the_file_says_what_was_measured(anchor: Path) -> None:
    report = inspection.run(anchor)
    assert (
        report.facts["layers"] == [f"{LAYERS}.0", f"{LAYERS}.1"] and report.facts["samples"] == 12
    )
    assert len(report.moments) == 4 and {site.kind for site in report.inputs} == {
        "dense",
        "elementwise",
        "rows",
    }


def test_a_file_does_not_invent_a_number_of_samples(tmp_path: Path) -> None:
    """Without layers and a mask, the number of samples in a pass is unknown."""
    model, path = make(), tmp_path / "anchor.safetensors"
    pixels, ids, mask = batch(0)
    for masks, samples in (([mask, mask], 8), ([mask, None], None)):
        with Guard.measure(model, parts=("inputs",), vision="vision") as found:
            for given in masks:
                with found.watch(given):
                    model(pixels, ids, torch.ones_like(mask))
        found.save(path)
        assert inspection.run(path).facts.get("samples") == samples


def test_inputs_that_are_not_finite_are_refused() -> None:
    """As after a float16 overflow; the eigensolver's own error would name no map."""
    model, (pixels, ids, mask) = make(), batch(0)
    pixels[0, 0, 0, 0] = torch.inf
    with Guard.measure(model, parts=("inputs",), vision="vision") as found, found.watch(mask):
        model(pixels, ids, mask)
    with pytest.raises(AegisError, match=r"'vision.0' that is not finite[\s\S]*float32"):
        found.anchor()


@pytest.mark.parametrize("parts", [("moments",), ("inputs",)])
def test_a_measurement_that_was_removed_says_so(parts: tuple[str, ...]) -> None:
    model, (pixels, ids, mask) = make(), batch(0)
    image = torch.zeros_like(mask, dtype=torch.bool)
    options = {"layers": LAYERS, "parts": parts, "vision": "vision"}
    with Guard.measure(model, **options) as found, found.watch(mask, image):
        model(pixels, ids, mask)
    removed = pytest.raises(AegisError, match="a measurement that was removed")
    with removed, found.watch(mask, image):
        model(pixels, ids, mask)
    assert found.anchor()


def test_a_mask_of_no_token_is_refused_whatever_is_measured() -> None:
    model, (pixels, ids, mask) = make(), batch(0)
    found = Guard.measure(model, parts=("inputs",), vision="vision")
    with pytest.raises(AegisError, match="a single valid token"), found.watch(mask & False):
        model(pixels, ids, mask)
    with found.watch(mask):
        model(pixels, ids, mask)
    assert found.anchor().inputs


class Loose(Vlm):
    """Uses parameters outside of module calls: a table's rows, and a map's weight by itself."""

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        scores = super().forward(pixels, ids, mask)
        return (
            scores
            + (self.text.norm.weight * 2).sum()
            + F.linear(scores[..., :16], self.text.layers[0].out.weight).sum()
        )


def test_parameters_used_outside_their_modules_are_not_taken_as_measured(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Loose().double().eval()
    path = measured(model, tmp_path / "anchor.safetensors")
    read = from_artifact(artifacts.load(path, "anchor")).inputs
    assert (
        not {"text.norm", "text.layers.0.out"} & read.keys()
        and {"text.words.scores", "text.layers.1.out"} <= read.keys()
    )
    with pytest.raises(AegisError, match="outside its forward"):
        Guard(model, path, method="nullspace", vision="vision")
    model.text.norm.requires_grad_(False)
    model.text.layers[0].out.requires_grad_(False)
    Guard(model, path, method="nullspace", vision="vision").remove()


class Shared(Vlm):
    """One layer used twice: all its maps read two sets of inputs."""

    def __init__(self) -> None:
        super().__init__()
        first, second = (layer.qkv for layer in self.text.layers)
        second.weight, second.bias = first.weight, first.bias

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.vision(pixels).mT, self.text.words(ids)], 1)
        for layer in (*self.text.layers, self.text.layers[0]):
            x = layer(x, ~mask)
        return self.head(self.text.norm(x))


def test_shared_maps_and_repeated_layers_are_measured_with_all_they_read(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Shared().double().eval()
    path = measured(model, tmp_path / "anchor.safetensors", parts=("inputs",))
    read = from_artifact(artifacts.load(path, "anchor")).inputs
    rows: dict[str, list[Tensor]] = {"text.layers.0.qkv": [], "text.layers.0.up": []}
    for layer in model.text.layers:
        layer.qkv.register_forward_pre_hook(
            lambda m, x: rows["text.layers.0.qkv"].append(x[0][mask])
        )
    model.text.layers[0].up.register_forward_pre_hook(
        lambda m, x: rows["text.layers.0.up"].append(x[0][mask])
    )
    with torch.no_grad():
        for seed in range(100, 103):
            pixels, ids, mask = batch(seed)
            model(pixels, ids, mask)
    assert "text.layers.1.qkv" not in read
    for site, found in rows.items():
        x = F.pad(torch.cat(found), (0, 1), value=1.0)
        wanted = x.mT @ x / len(x)
        torch.testing.assert_close(
            second_moments({site: read[site]})[site],
            wanted,
            rtol=0,
            atol=1e-5 * wanted.max().item(),
        )


class Ids(nn.Module):
    """A model whose only tokens are words."""

    def __init__(self) -> None:
        super().__init__()
        self.words, self.map = nn.Embedding(9, 4), nn.Linear(4, 4)

    def forward(self, ids: Tensor, flat: bool = False) -> Tensor:
        x = self.words(ids)
        return self.map(x.flatten(0, 1)) if flat else self.map(x)


@pytest.mark.parametrize("flat", [False, True])
def test_a_table_of_all_tokens_leaves_the_padding_out(flat: bool) -> None:
    ids = torch.tensor([[3, 4, 5], [3, 0, 0]])
    with Guard.measure(Ids().eval(), parts=("inputs",), energy=1.0) as found, found.watch(ids != 0):
        assert not found._model(ids, flat).requires_grad  # no graph is kept for questions
    read = found.anchor().inputs
    assert read["words"].values.nonzero().flatten().tolist() == [3, 4, 5]
    rows = F.pad(found._model.words.weight[[3, 4, 5, 3]], (0, 1), value=1.0).double()
    torch.testing.assert_close(
        second_moments(dict(read))["map"], rows.mT @ rows / 4, rtol=0, atol=1e-5
    )


WIDTH, HEADS = 8, 2


class Heads(nn.Module):
    """A map that reads a row for each head of each token, as query norms do."""

    def __init__(self) -> None:
        super().__init__()
        self.words, self.map = nn.Embedding(6, WIDTH), nn.Linear(WIDTH // HEADS, 3)

    def forward(self, ids: Tensor) -> Tensor:
        return self.map(self.words(ids).unflatten(-1, (HEADS, WIDTH // HEADS)))


def test_padding_never_counts_where_a_token_has_several_rows() -> None:
    ids = torch.tensor([[3, 4, 5], [3, 0, 0]])
    with (
        Guard.measure(Heads().eval(), parts=("inputs",), energy=1.0) as found,
        found.watch(ids != 0),
    ):
        found._model(ids)
    rows = (
        found._model.words.weight[[3, 4, 5, 3]].unflatten(-1, (HEADS, WIDTH // HEADS)).flatten(0, 1)
    )
    rows = F.pad(rows, (0, 1), value=1.0).double()
    torch.testing.assert_close(
        second_moments(dict(found.anchor().inputs))["map"],
        rows.mT @ rows / (4 * HEADS),
        rtol=0,
        atol=1e-5,
    )


# --- the null-space method ------------------------------------------------------------------------


@torch.no_grad()
def answers(model: nn.Module) -> Tensor:
    return torch.cat([model(*batch(seed))[batch(seed)[2]] for seed in range(100, 103)])


# Free steps change these answers by 10. What remains is below the float32 rounding of a map's
# strongest input, and such directions are not protected (core/spectrum.py).
STAYS = 1e-3


def few_questions(model: nn.Module, path: Path, **options: Any) -> Path:
    """An anchor that leaves room: a single question, asked once."""
    with Guard.measure(
        model, **({"parts": ("inputs",), "vision": "vision", "energy": 1.0} | options)
    ) as found:
        pixels, ids, mask = batch(100, size=2, dtype=next(model.parameters()).dtype)
        with found.watch(mask):
            model(pixels, ids, mask)
    found.save(path)
    return path


@torch.no_grad()
def answer(model: nn.Module) -> Tensor:
    pixels, ids, mask = batch(100, size=2)
    return model(pixels, ids, mask)[mask]


@compiling
@pytest.mark.parametrize("build", ["plain", "compiled", "shared"])
def test_answers_stay_while_the_model_learns(build: str, tmp_path: Path) -> None:
    """AdamW with weight decay through `guard.step`: all measured questions keep their answers."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = (Shared() if build == "shared" else Vlm()).double().eval()
    path, said, origin = (
        few_questions(model, tmp_path / "anchor.safetensors"),
        answer(model),
        vector(model),
    )
    if build == "compiled":
        torch._dynamo.reset()
        model.text.layers[0] = torch.compile(model.text.layers[0], backend="eager")
    guard = Guard(model, path, method="nullspace", vision="vision", energy=1.0)
    losses = guarded_steps(model, guard, steps=5, weight_decay=0.3)
    assert (answer(model) - said).abs().max() < STAYS
    assert (vector(model) - origin).norm() > 1e-2 and losses[-1] < losses[0]
    assert guard.unprotected == () and len(guard.ledger) == 0
    torch._dynamo.reset()


@pytest.mark.parametrize("left", ["maps", "norms", "embeddings", "stem"])
def test_protect_chooses_and_says_what_it_leaves(left: str, tmp_path: Path) -> None:
    model = make()
    path, said = few_questions(model, tmp_path / "anchor.safetensors"), answer(model)
    kinds = tuple(kind for kind in ("maps", "norms", "embeddings", "stem") if kind != left)
    guard = Guard(model, path, method="nullspace", vision="vision", energy=1.0, protect=kinds)
    guarded_steps(model, guard)
    assert (answer(model) - said).abs().max() > 10 * STAYS
    one = {
        "maps": "text.layers.0.up",
        "norms": "text.norm",
        "embeddings": "text.words",
        "stem": "vision.0",
    }
    assert [kind for kind, site in one.items() if site in guard.unprotected] == [left]


@pytest.mark.parametrize("every", [1, 3])
def test_accumulated_steps_are_projected_as_applied(every: int, tmp_path: Path) -> None:
    model = make()
    path, said = few_questions(model, tmp_path / "anchor.safetensors"), answer(model)
    guard = Guard(model, path, method="nullspace", vision="vision", energy=1.0)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.05)
    scaler = torch.amp.GradScaler("cpu", init_scale=8.0)
    before = vector(model)
    for index in range(6):
        guard.backward((model(*batch(index)) - 1).square().mean(), scaler)
        if index % every == every - 1:
            guard.step(optimizer, scaler)
            scaler.update()
            optimizer.zero_grad()
    assert (answer(model) - said).abs().max() < STAYS < (vector(model) - before).norm()


def test_a_step_inside_of_autocast_is_projected_as_finely(tmp_path: Path) -> None:
    ends = []
    for narrow in (True, False):
        model = make(dtype=torch.float32)
        path = few_questions(model, tmp_path / f"{narrow}.safetensors")
        guard = Guard(model, path, method="nullspace", vision="vision", energy=1.0)
        guard.backward((model(*batch(0, dtype=torch.float32)) - 1).square().mean())
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=narrow):
            guard.step(torch.optim.SGD(model.parameters(), lr=0.05))
        ends.append(vector(model))
    assert torch.equal(*ends)


@pytest.mark.parametrize("end", ["settle", "remove", "in its turn"])
def test_several_steps_are_projected_together(end: str, tmp_path: Path) -> None:
    """Until then the weights also have the movement of the last steps along the questions."""
    model = make()
    path, said = few_questions(model, tmp_path / "anchor.safetensors"), answer(model)
    guard = Guard(model, path, method="nullspace", vision="vision", energy=1.0, every=3)
    optimizer, moved = torch.optim.AdamW(model.parameters(), lr=1e-2, weight_decay=0.3), []
    for seed in range(5 if end != "in its turn" else 6):
        guard.backward((model(*batch(seed)) - 1).square().mean())
        guard.step(optimizer)
        optimizer.zero_grad()
        moved.append((answer(model) - said).abs().max().item() > 10 * STAYS)
    assert moved == [True, True, False, True, True, False][: len(moved)]
    if end != "in its turn":
        getattr(guard, end)()
    after = vector(model)
    assert (answer(model) - said).abs().max() < STAYS
    guard.remove()  # and nothing that has been settled changes any more
    assert torch.equal(vector(model), after)


def test_a_guard_that_goes_on_from_settled_weights_constrains_in_the_same_turn(
    tmp_path: Path,
) -> None:
    model = make()
    path = few_questions(model, tmp_path / "anchor.safetensors")

    def steps(model: nn.Module, guard: Guard, seeds: Sequence[int]) -> None:
        optimizer = torch.optim.SGD(model.parameters(), lr=1e-2)
        for seed in seeds:
            guard.backward((model(*batch(seed)) - 1).square().mean())
            guard.step(optimizer)
            optimizer.zero_grad()
        guard.settle()

    def guarded(model: nn.Module) -> Guard:
        return Guard(model, path, method="nullspace", vision="vision", energy=0.9, every=3)

    again, guard = make(), guarded(model)
    resumed = guarded(again)
    steps(model, guard, range(4))
    again.load_state_dict(model.state_dict())
    steps(model, guard, range(4, 8))
    steps(again, resumed, range(4, 8))
    assert torch.equal(vector(again), vector(model))


def test_frozen_maps_need_no_anchor_and_do_not_move(tmp_path: Path) -> None:
    model = make()
    model.vision.requires_grad_(False)
    model.text.words.requires_grad_(False)
    model.extra = nn.Linear(3, 3).double().requires_grad_(False)  # no question uses it
    path, frozen = few_questions(model, tmp_path / "anchor.safetensors"), vector(model.vision)
    guarded_steps(model, Guard(model, path, method="nullspace", energy=1.0), weight_decay=0.3)
    assert torch.equal(vector(model.vision), frozen)


def test_a_table_read_at_positions_is_protected_whole(tmp_path: Path) -> None:
    class Positions(Vlm):
        def __init__(self) -> None:
            super().__init__()
            self.position = nn.Embedding(20, 16)

        def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
            x = torch.cat([self.vision(pixels).mT, self.text.words(ids)], 1) + self.position(
                torch.arange(mask.shape[1])
            )
            return self.head(self.text.layers[1](self.text.layers[0](x, ~mask), ~mask))

    model = Positions().double().eval()
    model.text.norm.requires_grad_(False)
    path = few_questions(model, tmp_path / "anchor.safetensors")
    rows = from_artifact(artifacts.load(path, "anchor")).inputs["position"].values
    assert rows.tolist() == [1.0] * (PATCHES + TEXT) + [0.0] * (20 - PATCHES - TEXT)


class Parted(Vlm):
    """A lone row between image and words, and one that only the loss reads."""

    def __init__(self) -> None:
        super().__init__()
        self.between, self.spare = nn.Parameter(torch.randn(16)), nn.Parameter(torch.randn(1, 1, 3))

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat(
            [
                self.vision(pixels).mT,
                self.between.expand(len(ids), 1, -1),
                self.text.words(ids[:, 1:]),
            ],
            1,
        )
        for layer in self.text.layers:
            x = layer(x, ~mask)
        return self.head(self.text.norm(x)) + 0 * self.spare.sum()


def test_a_lone_row_is_held_still_unless_it_is_left_by_name(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Parted().double().eval()
    path, said = few_questions(model, tmp_path / "anchor.safetensors"), answer(model)
    rows = from_artifact(artifacts.load(path, "anchor")).inputs
    assert rows["between"].values.tolist() == rows["spare"].values.tolist() == [1.0]
    free, row = copy.deepcopy(model), model.between.detach().clone()
    with Guard(model, path, method="nullspace", vision="vision", energy=1.0) as guard:
        guarded_steps(model, guard, steps=5, weight_decay=0.3)
        assert guard.unprotected == ()
    assert torch.equal(model.between, row) and (answer(model) - said).abs().max() < STAYS
    with Guard(
        free,
        path,
        method="nullspace",
        vision="vision",
        energy=1.0,
        protect=("maps", "norms", "stem"),
    ) as guard:
        guarded_steps(free, guard, steps=5)
        assert {"between", "spare", "text.words"} == set(guard.unprotected)
    assert not torch.equal(free.between, row)


def test_a_matrix_beside_other_modules_is_not_taken_for_a_row(tmp_path: Path) -> None:
    model = make()
    model.text.mix = nn.Parameter(torch.eye(16).double())
    path = few_questions(model, tmp_path / "anchor.safetensors")
    with pytest.raises(AegisError, match=r"a Text \(text\)"):
        Guard(model, path, method="nullspace", vision="vision")


# --- a table with more rows -----------------------------------------------------------------------

ADDED = 4


def resized(model: Vlm) -> Vlm:
    """The model after resize_token_embeddings: its tied table has extra rows after the old ones."""
    old = model.text.words
    words, width = old.weight.shape
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model.text.words = nn.Embedding(words + ADDED, width).to(old.weight.dtype)
        model.head = nn.Linear(width, words + ADDED, bias=False)
    with torch.no_grad():
        model.text.words.weight[:words] = old.weight
    model.head.weight = model.text.words.weight
    return model


def test_a_table_that_was_resized_later_is_refused(anchor: Path) -> None:
    for options in ({"layers": LAYERS}, {"method": "nullspace", "vision": "vision"}):
        with pytest.raises(AegisError, match="the weights are not those that anchor"):
            Guard(resized(make()), anchor, **options)
        model = make()
        guard = Guard(model, anchor, **options)
        resized(model)
        with pytest.raises(AegisError, match="text.words.weight.*added to the model later"):
            guard.backward(model(*batch(0)).square().mean())


def test_of_a_resized_table_what_questions_read_stays_and_new_rows_learn(tmp_path: Path) -> None:
    model = resized(make())
    path = measured(model, tmp_path / "anchor.safetensors")
    guard = Guard(model, path, method="nullspace", vision="vision")
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    table = model.text.words.weight
    before, asked = (
        table.detach().clone(),
        {int(w) for s in range(100, 103) for w in batch(s)[1].unique()},
    )
    pixels, ids, mask = batch(0)
    ids[0, 0] = len(table) - ADDED
    guard.backward((model(pixels, ids, mask) - 1).square().mean())
    guard.step(optimizer)
    moved = (table.detach() - before).norm(dim=1)
    assert float(moved[sorted(asked - {0})].max()) < 1e-12
    # How far depends on their initial values, since the head scores with them too.
    assert float(moved[len(table) - ADDED]) > 1e-6
