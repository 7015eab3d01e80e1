"""Maps that read the same tensor, maps too wide for an exact sum, and sums in groups."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from samples.nullspace import with_one
from samples.tiny import make_tiny
from samples.training import images
from torch import Tensor, nn

from aegis_cli import inspection
from aegis_cli.anchors import anchor_file, curvature, inputs, passes, second_moments
from aegis_cli.anchors.curvature import CurvatureRecorder
from aegis_cli.anchors.inputs import InputRecorder
from aegis_cli.common import artifacts
from aegis_cli.core import moment_sums
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moment_sums import FullSum, size
from aegis_cli.core.nullspace import Strength, allowed, protect
from aegis_cli.core.spectrum import Spectrum, second_moment
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.questions import Question
from aegis_cli.inspection import InspectReport
from aegis_cli.models import structure

WIDTH, OUT = 12, (8, 4, 4)  # of the input, and of queries, keys and values


class Apart(nn.Module):
    """Queries, keys and values as three maps of one tensor, then a map with another input."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.norm = nn.LayerNorm(WIDTH)
        self.query, self.key, self.value = (nn.Linear(WIDTH, out) for out in OUT)
        self.out = nn.Linear(sum(OUT), 6)

    def projected(self, x: Tensor) -> Tensor:
        return torch.cat([self.query(x), self.key(x), self.value(x)], -1)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.tanh(self.projected(self.norm(x))))


class Fused(nn.Module):
    """The same function with one map instead of the three."""

    def __init__(self, apart: Apart) -> None:
        super().__init__()
        self.norm, self.out, self.qkv = apart.norm, apart.out, nn.Linear(WIDTH, sum(OUT))
        parts = (apart.query, apart.key, apart.value)
        with torch.no_grad():
            self.qkv.weight.copy_(torch.cat([part.weight for part in parts]))
            self.qkv.bias.copy_(torch.cat([part.bias for part in parts]))

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.tanh(self.qkv(self.norm(x))))


class Twice(Apart):
    """Values read a different tensor in every other pass."""

    passes = 0

    def projected(self, x: Tensor) -> Tensor:
        self.passes += 1
        other = x if self.passes % 2 else 2 * x
        return torch.cat([self.query(x), self.key(x), self.value(other)], -1)


def draw(seed: int, count: int = 30) -> Tensor:
    return torch.randn(2, count, WIDTH, generator=torch.Generator().manual_seed(seed))


def read(model: nn.Module, *batches: Tensor) -> dict[str, Spectrum]:
    recorder = InputRecorder(model, structure.find_maps(model, ()), follow_uses=False)
    for x in batches:
        with recorder.watch(None), torch.no_grad():
            model(x)
    return recorder.spectra(1.0)


def curved(model: nn.Module, *batches: Tensor) -> dict[str, Spectrum]:
    recorder = CurvatureRecorder(model, structure.find_maps(model, ()), 0, follow_uses=False)
    for x in batches:
        with recorder.watch():
            scores = model(x)
        recorder.answer(scores.flatten(0, -2), keep=False)
    return recorder.spectra(1.0)


def matrix(spectrum: Spectrum) -> Tensor:
    assert spectrum.vectors is not None
    return (spectrum.vectors * spectrum.values[: spectrum.vectors.shape[1]]) @ spectrum.vectors.T


def assert_same(found: Tensor, wanted: Tensor, tolerance: float = 1e-6) -> None:
    assert (found - wanted).abs().max() <= tolerance * wanted.abs().max()


# --- who shares -----------------------------------------------------------------------------------


def test_maps_of_one_tensor_have_one_spectrum_which_is_that_of_the_fused_map() -> None:
    model = Apart()
    found = read(model, draw(0), draw(1))
    assert found["query"] is found["key"] is found["value"] is not found["out"]
    fused = read(Fused(model), draw(0), draw(1))
    assert_same(matrix(found["query"]), matrix(fused["qkv"]))
    assert_same(matrix(found["out"]), matrix(fused["out"]))


def test_maps_that_do_not_always_read_the_same_have_spectra_of_their_own() -> None:
    model = Twice()
    found = read(model, draw(0), draw(1))
    assert found["query"] is found["key"] is not found["value"]
    with torch.no_grad():
        first, second = (model.norm(draw(i)).flatten(0, 1) for i in range(2))
    for name, rows in (("query", (first, second)), ("value", (first, 2 * second))):
        assert_same(matrix(found[name]), second_moment(with_one(torch.cat(rows))) / 120)


def test_the_curvature_of_such_maps_is_that_of_the_fused_map() -> None:
    model = Apart()
    found, fused = curved(model, draw(0), draw(1)), curved(Fused(model), draw(0), draw(1))
    assert found["query.inputs"] is found["key.inputs"] is found["value.inputs"]
    assert_same(matrix(found["query.inputs"]), matrix(fused["qkv.inputs"]), 1e-5)
    whole, start = matrix(fused["qkv.outputs"]), 0
    for name, out in zip(("query", "key", "value"), OUT, strict=True):
        own = slice(start, start + out)
        # The other factor's trace weights a map's own inputs alike, fused or not.
        assert_same(matrix(found[f"{name}.outputs"]), whole[own, own], 1e-5)
        start += out


def test_no_gradient_of_a_parameter_is_made() -> None:
    model, seen = Apart(), []
    for parameter in model.parameters():
        parameter.register_hook(lambda gradient: seen.append(gradient))
    assert len(curved(model, draw(0))) == 8 and not seen


# --- the file -------------------------------------------------------------------------------------


def saved(path: Path, anchor: Anchor) -> Anchor:
    anchor_file.save(path, anchor, fingerprint="0" * 64, meta={})
    return anchor_file.load(path, anchor_file.Wanted("0" * 64, "model", "--backbone "))


def test_a_shared_spectrum_is_in_the_file_once(tmp_path: Path) -> None:
    model = Apart()
    anchor = Anchor(inputs=read(model, draw(0)), curvature=curved(model, draw(0)))
    again = saved(tmp_path / "a.safetensors", anchor)
    header = artifacts.read_header(tmp_path / "a.safetensors")
    assert header.meta["shared"]["inputs.key"] == "inputs.query"
    assert "inputs.key.vectors" not in header.tensors
    assert again.inputs["query"] is again.inputs["key"] is again.inputs["value"]
    assert again.inputs.keys() == anchor.inputs.keys()
    assert again.curvature.keys() == anchor.curvature.keys()
    moved = anchor_file.to_device(again, torch.device("cpu"))
    assert moved.inputs["query"] is moved.inputs["key"]
    assert second_moments.shared(moved.inputs) == second_moments.shared(anchor.inputs)


def test_inspect_names_the_map_with_which_a_spectrum_is_stored(tmp_path: Path) -> None:
    model = Apart()
    anchor = Anchor(inputs=read(model, draw(0)), curvature=curved(model, draw(0)))
    saved(tmp_path / "a.safetensors", anchor)
    report = inspection.run(tmp_path / "a.safetensors")
    assert isinstance(report, InspectReport)
    told = [(site.name, site.same_as) for site in report.inputs]
    first = told.index(("query", None))
    assert told[first + 1 : first + 3] == [("key", "query"), ("value", "query")]
    assert {site.same_as for site in report.inputs if site.name in ("norm", "out")} == {None}
    assert len({name for name, _ in told}) == len(told) == len(anchor.inputs)
    ends = tuple(f"{name}.inputs" for name in ("query", "key", "value"))
    own = [site.same_as or site.name for site in report.curvature if site.name in ends]
    assert len(own) == 3 and len(set(own)) == 1


def test_beside_a_sketch_vectors_are_in_half_precision_and_come_back_orthonormal(
    tmp_path: Path,
) -> None:
    width = moment_sums.WHOLE + 1
    total = moment_sums.make(width, torch.device("cpu"))
    total.add(torch.randn(40, width, generator=torch.Generator().manual_seed(0)))
    wide = total.spectrum(40, 0.9)
    head = moment_sums.TraceOnly(width, torch.device("cpu")).spectrum(1, 0.9)
    narrow = read(Apart(), draw(0))["out"]
    anchor = Anchor(
        curvature={"map.inputs": wide, "map.outputs": head, "other.inputs": narrow},
        inputs={"other": narrow},
    )
    again = saved(tmp_path / "a.safetensors", anchor).curvature
    for name, before in anchor.curvature.items():
        after = again[name]
        assert after.whole == before.whole and torch.equal(after.values, before.values)
        wanted = before.vectors.float()
        torch.testing.assert_close(after.vectors, wanted, rtol=0, atol=5e-4)
        gram = after.vectors.T @ after.vectors
        assert torch.allclose(gram, torch.eye(len(gram)), atol=2e-6)
    layout = artifacts.read_header(tmp_path / "a.safetensors").tensors
    halves = {name for name, spec in layout.items() if spec.dtype == "float16"}
    assert halves == {f"curvature.{name}.vectors" for name in anchor.curvature}


# --- the embedded VLM -----------------------------------------------------------------------------


def asked() -> VQASet:
    texts = ("what color is the cube", "count the objects", "is there a ball")
    answers = ("red", "two", "yes")
    questions = tuple(Question("color", *pair) for pair in zip(texts, answers, strict=True))
    return VQASet(images(2, seed=5).numpy(), torch.tensor([0, 0, 1]).numpy(), questions)


def test_groups_measure_what_one_pass_does(monkeypatch: pytest.MonkeyPatch) -> None:
    model, events = make_tiny(), []
    memory = max(size(module.weight[0].numel() + 1) for module in model.stem.mix) * 2
    whole = (inputs.measure(model, asked(), 1.0), curvature.measure(model, asked(), 1.0, 0))
    parts = (
        inputs.measure(model, asked(), 1.0, on_event=events.append, memory=memory),
        curvature.measure(model, asked(), 1.0, 0, on_event=events.append, memory=memory),
    )
    assert len({event.stage for event in events}) > 4
    for one, grouped in zip(whole, parts, strict=True):
        assert one.keys() == grouped.keys()
        assert all(torch.equal(one[name].values, grouped[name].values) for name in one)


def test_the_groups_are_as_large_as_the_budget_lets_them_be() -> None:
    model = make_tiny()
    sizes = {name: 10 for name, m in model.site_modules().items() if not name.startswith("stem")}

    def one(module: nn.Module) -> int:
        return next((10 for name in sizes if model.get_submodule(name) is module), 0)

    def groups(memory: int | None) -> list[list[str]]:
        return [list(maps.kinds) for maps, _ in passes.groups(model, "x", memory, one)]

    assert len(groups(None)) == 1 and sorted(groups(None)[0]) == sorted(model.sites())
    found = groups(60)
    assert sorted(sum(found, [])) == sorted(model.sites()) and len(found) > 1
    parents = [{site.rpartition(".")[0] for site in group} for group in found]
    assert not set.intersection(*parents)
    assert all(sum(site in sizes for site in group) <= 6 for group in found)


def test_a_sketched_map_protects_as_its_exact_spectrum_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The effect that updates still have on VQA outputs after projection by either."""
    model, questions = make_tiny(), asked()
    exact = inputs.measure(model, questions, 1.0)
    monkeypatch.setattr(moment_sums, "_FEWEST_COLUMNS", 40)
    sketched = inputs.measure(model, questions, 1.0, whole=100)
    wide = [name for name, s in sketched.items() if not s.whole]
    assert len(wide) > 1
    for name in wide:
        moment, update = matrix(exact[name]), torch.randn(5, len(exact[name].values) - 1)
        harm = []
        for found in (exact, sketched):
            strength = Strength(soft=1e-4)
            left, _ = allowed(protect(found[name], strength, update), (update, torch.zeros(5)))
            left = torch.cat([left, torch.zeros(5, 1)], 1).double()
            harm.append(((left @ moment) * left).sum())
        unprotected = torch.cat([update, torch.zeros(5, 1)], 1).double()
        before = ((unprotected @ moment) * unprotected).sum()
        assert harm[1] < max(1.5 * harm[0], 1e-3 * before)


def test_whole_sums_of_the_embedded_vlm_stay_whole() -> None:
    for name, module in make_tiny().site_modules().items():
        width = inputs.dense_width(module)
        if width is not None:
            convolution = not isinstance(module, nn.Linear)
            assert isinstance(moment_sums.make(width, torch.device("cpu"), convolution), FullSum), (
                name
            )
