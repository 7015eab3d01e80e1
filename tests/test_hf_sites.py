"""What the maps of Hugging Face models read on questions, by what any change of a map does to its outputs."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from backbone_samples import TEXTS, images
from torch import Tensor, nn

from aegis_cli.backbones.families import FAMILIES
from aegis_cli.backbones.hf import HFBackbone
from aegis_cli.stages import inputs

Loaded = Callable[[str], HFBackbone]  # by a family's name
SAID = ["red", "two", "x3 y5", ""]



@pytest.mark.parametrize("name", [name for name in FAMILIES if name != "llava_onevision"])
def test_the_measured_inputs_say_what_any_change_of_a_map_does(name: str, hf_backbone: Loaded) -> None:
    """sum |(W + D)(x) - W(x)|^2 over all its calls is tr(D C D^T), C the second moment: of every site, norms and tables too."""
    backbone = hf_backbone(name).double()
    sites = backbone.sites()
    assert {"maps", "norms", "embeddings", "stem"} == set(sites.values())
    owned = {id(p) for site in sites for p in backbone.get_submodule(site).parameters(recurse=False)}
    assert owned == {id(p) for p in backbone.parameters()}
    changes = _watch_changes(backbone, sites)
    with torch.no_grad():
        for _ in backbone.read_vqa(images(2), torch.tensor([0, 0, 1, 1]), TEXTS, SAID):
            pass
    for site, (found, wanted) in changes.items():
        assert found > 0, site
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=0.0, msg=site)


def _watch_changes(backbone: HFBackbone, sites: dict[str, str]) -> dict[str, list[Tensor]]:
    """Site -> [energy of the change of its outputs, the same by the measured moments], filled as the model runs."""
    generator = torch.Generator().manual_seed(0)
    changes: dict[str, list[Tensor]] = {}

    def watch(site: str) -> Callable[..., None]:
        module = backbone.get_submodule(site)
        other = copy.deepcopy(module)
        drawn = {n: torch.randn(p.shape, generator=generator, dtype=p.dtype) for n, p in module.named_parameters(recurse=False)}
        for n, p in other.named_parameters(recurse=False):
            p.data += drawn[n]
        scale = getattr(module, "scalar_embed_scale", 1.0)

        def hook(_: nn.Module, arguments: tuple[Tensor, ...], output: Tensor) -> None:
            moment, _ = inputs.moment(module, arguments[0])
            # the shadow has no hooks of its own: it was copied before they were set
            energy = (other(arguments[0]) - output).double().square().sum() / scale**2
            was = changes.get(site, [torch.zeros((), dtype=torch.float64)] * 2)
            changes[site] = [was[0] + energy, was[1] + _quadratic(moment, drawn)]

        return hook

    hooks = {site: watch(site) for site in sites}
    for site, hook in hooks.items():
        backbone.get_submodule(site).register_forward_hook(hook)
    return changes


def _quadratic(moment: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    weight, bias = drawn["weight"], drawn.get("bias")
    if moment.ndim == 1:  # rows of a table
        return (moment * weight.square().sum(1)).sum()
    if moment.ndim == 3:  # a scale (and shift) a channel
        both = torch.stack([weight, bias], -1) if bias is not None else weight[:, None]
        return torch.einsum("di,dij,dj->", both, moment, both)
    flat = weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)
    return torch.einsum("oi,ij,oj->", flat, moment, flat)


def test_a_tied_head_is_watched_at_the_words_of_answers_alone(hf_backbone: Loaded) -> None:
    backbone = hf_backbone("paligemma")
    ((table, head),) = backbone.tied_heads.items()
    assert table in backbone.sites() and head not in backbone.sites()
    seen: list[int] = []
    backbone.get_submodule(head).register_forward_hook(lambda _, a, __: seen.append(a[0].flatten(0, -2).shape[0]))
    scores = torch.cat(list(backbone.read_vqa(images(2), torch.tensor([0, 0, 1, 1]), TEXTS, SAID)))
    assert sum(seen) == len(scores)
