"""What maps of Hugging Face models read for questions, tested by the effect of changes."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import pytest
import torch
from samples.backbones import TEXTS, images
from samples.hf import WITH_TORCHVISION
from torch import Tensor, nn

from aegis_cli.anchors import curvature, inputs
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.spectrum import DENSE, second_moment
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.questions import Question
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Update
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.recipes import SITE_KINDS, Kfac

Loaded = Callable[[str], HFBackbone]  # by a family's name
SAID = ["red", "two", "x3 y5", ""]
TOWER = "vision_tower"
DEEPER = f"{TOWER}.vision_model"  # where transformers 5.5 has what later releases have in the tower
# What a family keeps outside any torch map, norm or table: frozen as a whole.
LONE = {
    "llava_onevision": ["image_newline"],
    "llava": [f"{TOWER}.embeddings.class_embedding"],
    "llava_next": ["image_newline", f"{TOWER}.embeddings.class_embedding"],
    "internvl": [
        f"{TOWER}.embeddings.cls_token",
        f"{TOWER}.embeddings.position_embeddings",
        *(f"{TOWER}.encoder.layer.{i}.lambda_{j}" for i in (0, 1) for j in (1, 2)),
    ],
    "gemma3": ["multi_modal_projector.mm_input_projection_weight"],
}


@pytest.mark.parametrize("name", FAMILIES)
def test_the_measured_inputs_say_what_any_change_of_a_map_does(
    name: str, hf_backbone: Loaded
) -> None:
    """At every site sum |(W + D)(x) - W(x)|^2 over all calls is tr(D C D^T), C the second moment.

    Norms and tables are sites too.
    """
    backbone = hf_backbone(name).double()
    sites = backbone.sites()
    assert {"maps", "norms", "embeddings", "stem"} == set(sites.values())
    modules = backbone.site_modules()
    lone = [site for site in sites if site not in modules]
    here = sorted(site.replace(DEEPER, TOWER) for site in lone)
    assert here == [f"vlm.model.{row}" for row in LONE.get(name, [])]
    owned = {id(p) for module in modules.values() for p in module.parameters(recurse=False)}
    idle = {id(p) for part in backbone.idle for p in backbone.get_submodule(part).parameters()}
    assert (len(idle) > 0) == (name in ("llava", "llava_next")) and not owned & idle
    assert owned | idle | {id(backbone.get_parameter(site)) for site in lone} == {
        id(p) for p in backbone.parameters()
    }
    changes = _watch_changes(backbone, modules)
    with torch.no_grad():
        for _ in backbone.read_vqa(images(2), torch.tensor([0, 0, 1, 1]), TEXTS, SAID):
            pass
    for site, (found, wanted) in changes.items():
        assert found > 0, site
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=0.0, msg=site)


def _watch_changes(backbone: HFBackbone, modules: dict[str, nn.Module]) -> dict[str, list[Tensor]]:
    """The energy of the change of each site's outputs, and the same from the measured moments.

    It is filled while the model runs.
    """
    generator = torch.Generator().manual_seed(0)
    changes: dict[str, list[Tensor]] = {}

    def watch(site: str) -> Callable[..., None]:
        module = backbone.get_submodule(site)
        other = copy.deepcopy(module)
        drawn = {
            n: torch.randn(p.shape, generator=generator, dtype=p.dtype)
            for n, p in module.named_parameters(recurse=False)
        }
        for n, p in other.named_parameters(recurse=False):
            p.data += drawn[n]
        scale = getattr(module, "scalar_embed_scale", 1.0)

        def hook(_: nn.Module, arguments: tuple[Tensor, ...], output: Tensor) -> None:
            if isinstance(module, DENSE):
                moment = second_moment(inputs.dense_rows(module, arguments[0]))
            else:
                moment, _ = inputs.moment(module, arguments[0])
            # the shadow has no hooks: it was copied before they were set
            energy = (other(arguments[0]) - output).double().square().sum() / scale**2
            was = changes.get(site, [torch.zeros((), dtype=torch.float64)] * 2)
            changes[site] = [was[0] + energy, was[1] + _quadratic(moment, drawn)]

        return hook

    hooks = {site: watch(site) for site in modules}
    for site, hook in hooks.items():
        backbone.get_submodule(site).register_forward_hook(hook)
    return changes


def _quadratic(moment: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    weight, bias = drawn["weight"], drawn.get("bias")
    if moment.ndim == 1:  # rows of a table
        return (moment * weight.square().sum(1)).sum()
    if moment.ndim == 3:  # a scale (and shift) per channel
        both = torch.stack([weight, bias], -1) if bias is not None else weight[:, None]
        return torch.einsum("di,dij,dj->", both, moment, both)
    flat = weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)
    return torch.einsum("oi,ij,oj->", flat, moment, flat)


@pytest.mark.parametrize("name", ["llava", "llava_next"])
def test_no_gradient_comes_to_what_takes_no_part(name: str, hf_backbone: Loaded) -> None:
    """CLIP's layers after the one that is read are called nevertheless."""
    backbone = hf_backbone(name)
    for scored in backbone.read_vqa(images(2), torch.tensor([0, 0, 1, 1]), TEXTS, SAID):
        scored.scores.square().sum().backward()
    without = {n for n, p in backbone.named_parameters() if p.grad is None}
    idle = set()
    for part in backbone.idle:
        inside = backbone.get_submodule(part).named_parameters()
        idle |= {f"{part}.{leaf}" for leaf, _ in inside}
    assert without == idle and idle


@pytest.mark.parametrize("name", FAMILIES)
def test_answers_keep_their_scores_under_any_protected_update(
    name: str, hf_backbone: Loaded
) -> None:
    """With the anchor's own inputs nothing changes, although every parameter is moved at random.

    Sites that are left unprotected change the outputs.
    """
    backbone = hf_backbone(name).double()
    sites, said = backbone.sites(), scores(backbone)
    measured = Anchor(inputs=inputs.measure(backbone, asked(), 1.0))
    rest = [{site: kind for site, kind in sites.items() if kind != "stem"}]
    if name in LONE:
        alone = {f"vlm.model.{row}" for row in LONE[name]}
        others = (site for site in sites if site.replace(DEEPER, TOWER) not in alone)
        rest.append({site: sites[site] for site in others})
    held, *changed = [
        (scores(pushed(backbone, chosen, measured)) - said).abs().max() for chosen in (sites, *rest)
    ]
    assert held < 1e-3 and min(changed) > 1e-2


@pytest.mark.parametrize("name", FAMILIES)
def test_kfac_draws_back_what_answers_mind(name: str, hf_backbone: Loaded) -> None:
    """A strong step undoes most of the effect on the answers, and leaves much of the movement."""
    backbone = hf_backbone(name).double()
    said, one = scores(backbone), asked()
    asking = VQASet(
        one.images, np.zeros(64, int), one.questions * 64
    )  # as many draws of the possible words
    measured = Anchor(curvature=curvature.measure(backbone, asking, 1.0, seed=0))
    dense = {site for site, module in backbone.site_modules().items() if isinstance(module, DENSE)}
    assert measured.curvature.keys() == {
        f"{site}.{side}" for site in dense for side in curvature.SIDES
    }
    assert all(found.values.isfinite().all() for found in measured.curvature.values())
    free, held = (moved(backbone, weight, measured) for weight in (1e-9, 1e6))
    assert divergence(said, scores(held)) < 0.2 * divergence(said, scores(free))
    left = {
        site: (held.get_submodule(site).weight - backbone.get_submodule(site).weight).norm().item()
        for site in dense
    }
    assert sum(size > 0.003 for size in left.values()) > len(left) / 3


def divergence(before: Tensor, after: Tensor) -> float:
    """Mean KL divergence between the word distributions, in nats."""
    p, q = before.log_softmax(-1), after.log_softmax(-1)
    return (p.exp() * (p - q)).sum(-1).mean().item()


@torch.no_grad()
def moved(backbone: HFBackbone, weight: float, measured: Anchor) -> HFBackbone:
    """A copy with every map moved, as far as kfac allows it."""
    other, generator = copy.deepcopy(backbone), torch.Generator().manual_seed(1)
    METHODS["kfac"].adapt(other, {}, {})
    options = asdict(Kfac(weight=weight, damping=0.0, balance=0.0, every=1))
    constrain = (
        METHODS["kfac"].start(MethodContext(other, {}, other.sites(), options, measured)).constrain
    )
    before = {name: p.detach().clone() for name, p in other.named_parameters()}
    for parameter in (p for p in other.parameters() if p.requires_grad):
        parameter += 0.003 * torch.randn(
            parameter.shape, generator=generator, dtype=parameter.dtype
        )
    assert constrain is not None
    constrain(Update(before, {}))
    return other


@torch.no_grad()
def pushed(backbone: HFBackbone, sites: dict[str, str], measured: Anchor) -> HFBackbone:
    """A copy with every parameter moved, as far as the null-space method allows for these sites."""
    other, generator = copy.deepcopy(backbone), torch.Generator().manual_seed(1)
    options = {"energy": 1.0, "soft": 0.0, "every": 1, "protect": SITE_KINDS, "keeps": "weights"}
    constrain = (
        METHODS["nullspace"].start(MethodContext(other, {}, sites, options, measured)).constrain
    )
    before = {name: p.detach().clone() for name, p in other.named_parameters()}
    for parameter in other.parameters():
        parameter += 0.05 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
    assert constrain is not None
    constrain(Update(before, {}))
    assert sum(not torch.equal(p, before[name]) for name, p in other.named_parameters()) > 10
    return other


def asked() -> VQASet:
    """A single question, so some directions are read by none."""
    return VQASet(images(1).numpy(), np.zeros(1, int), (Question("count", TEXTS[0], "two"),))


@torch.no_grad()
def scores(backbone: HFBackbone) -> Tensor:
    question = asked().questions[0]
    frames = torch.from_numpy(asked().images)
    (part,) = backbone.read_vqa(frames, torch.tensor([0]), [question.text], [question.answer])
    return part.scores


def test_a_tied_head_is_watched_at_the_words_of_answers_alone(hf_backbone: Loaded) -> None:
    backbone = hf_backbone("paligemma")
    ((table, head),) = backbone.tied_heads.items()
    assert table in backbone.sites() and head not in backbone.sites()
    seen: list[int] = []
    backbone.get_submodule(head).register_forward_hook(
        lambda _, a, __: seen.append(a[0].flatten(0, -2).shape[0])
    )
    parts = list(backbone.read_vqa(images(2), torch.tensor([0, 0, 1, 1]), TEXTS, SAID))
    assert sum(seen) == sum(len(part.scores) for part in parts)


@torch.no_grad()
@pytest.mark.parametrize("together", [1, 3])
def test_a_pass_takes_no_more_questions_than_asked_for(
    together: int, hf_backbone: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    backbone, sizes = hf_backbone("paligemma"), []
    texts, said, image_of = TEXTS[:1] * 7, SAID[:1] * 7, torch.tensor([0, 0, 0, 1, 1, 1, 1])

    def read(*together: int) -> Tensor:
        parts = backbone.read_vqa(images(2), image_of, texts, said, *together)
        return torch.cat([part.scores for part in parts])

    wanted = read()
    inner = backbone._scores
    monkeypatch.setattr(
        backbone, "_scores", lambda batch, last: sizes.append(len(batch.ids)) or inner(batch, last)
    )
    found = read(together)
    assert sizes == ([1] * 7 if together == 1 else [3, 3, 1])
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


# Families that make several shapes of the sizes below: of tiles, or of tiles without their borders.
PASSES = {"llava_onevision": 3, "llava_next": 3, "internvl": 2}
SIZES = [(48, 64), (64, 48), (43, 64), (64, 43), (50, 64), (40, 48)]  # height and width


def of_sizes() -> tuple[list[Tensor], Tensor, list[str], list[str]]:
    """Noise of six sizes with one question each, and all that `read_vqa` is given for them."""
    generator = torch.Generator().manual_seed(0)
    shown = [
        torch.randint(256, (*size, 3), generator=generator, dtype=torch.uint8) for size in SIZES
    ]
    return shown, torch.arange(len(SIZES)), TEXTS[:1] * len(SIZES), SAID[:1] * len(SIZES)


@torch.no_grad()
@pytest.mark.parametrize("name", FAMILIES)
def test_images_of_many_sizes_share_a_pass_if_the_processor_makes_the_same_shape(
    name: str, hf_backbone: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scores are those of a pass for each image, and no token of a pass is padding."""
    backbone, given, passed = hf_backbone(name), of_sizes(), []
    alone = list(backbone.read_vqa(*given, together=1))
    inner = backbone._scores
    monkeypatch.setattr(
        backbone, "_scores", lambda batch, last: passed.append(batch) or inner(batch, last)
    )
    parts = list(backbone.read_vqa(*given))
    assert all(batch.mask.all() for batch in passed)
    assert len(passed) == PASSES.get(name, 1) or name in WITH_TORCHVISION
    numbers, found, wanted = (
        torch.cat([part.question for part in parts]),
        torch.cat([part.scores for part in parts]),
        torch.cat([part.scores for part in alone]),
    )
    assert torch.equal(numbers, torch.cat([part.question for part in alone]))
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    again = torch.cat([part.scores for part in backbone.read_vqa(*given)])
    assert torch.equal(found, again)  # an interrupted measurement goes on with the same passes
