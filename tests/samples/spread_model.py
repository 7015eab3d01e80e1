"""A model with layers on two devices, as `device_map="auto"` places them; one is a stand-in."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.guard.wide_step import WideStep
from samples import second_device
from samples.guard import LAYERS, Vlm, anchors_by_method, guarded_steps, make, measured

PLACES = ("vision", "text.layers.0", "text.layers.1")  # what is on the other device
# The guard's methods and options.
GUARDS: dict[str, dict[str, object]] = {
    "aegis": {"method": "aegis", "layers": LAYERS},
    "aegis of the update": {"method": "aegis", "layers": LAYERS, "projects": "update"},
    "nullspace": {"method": "nullspace", "energy": 0.9},
    "nullspace, soft": {"method": "nullspace", "soft": 0.1},
    "kfac": {"method": "kfac"},
    "kfac, unbalanced": {"method": "kfac", "balance": 0.0},
}
DONE = (*GUARDS, "measure", "masters")


def spread(place: str | None) -> Vlm:
    """The model with one part on the other device; None: all of it is on the CPU."""
    model = make()
    if place is not None:
        model.get_submodule(place).to(second_device.NAME)
    model.vision.register_forward_pre_hook(_at_its_place)
    model.vision.register_forward_hook(lambda _, given, found: found.to("cpu"))
    for layer in model.text.layers:
        layer.register_forward_pre_hook(_at_its_place)
    # A layer's output stays on the layer's device until something else needs it.
    model.around = lambda layer, *given: layer(*given).to("cpu")
    return model


def _at_its_place(part: nn.Module, given: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """The inputs of a part of the model, on the part's own device."""
    place = next(part.parameters()).device
    return tuple(x.to(place) for x in given)


def guarded(anchors: dict[str, Path], name: str, place: str | None) -> Tensor:
    """The weights after a few steps with the guard."""
    options = dict(GUARDS[name])
    model, method = spread(place), str(options["method"])
    if method == "kfac":
        _only_maps_learn(model)
    guard = Guard(model, anchors[method], vision="vision", **options)
    guarded_steps(model, guard, steps=2)
    guard.remove()
    return torch.cat([p.detach().to("cpu").flatten() for p in model.parameters()])


def _only_maps_learn(model: Vlm) -> None:
    for module in model.modules():
        if not isinstance(module, nn.Linear | nn.Conv2d) or module is model.head:
            for parameter in module.parameters(recurse=False):
                parameter.requires_grad_(False)


def anchor(folder: Path, place: str | None) -> Tensor:
    """The measured anchor of the model."""
    path = measured(spread(place), folder / f"{place}.safetensors")
    tensors = load_file(path)
    return torch.cat([tensors[name].double().flatten() for name in sorted(tensors)])


def masters(place: str | None) -> Tensor:
    """Which half-precision parameters are their rounded float32 masters: every other one."""
    parameters = [p.detach().to(torch.bfloat16) for p in spread(place).parameters()]
    step = WideStep(torch.optim.AdamW(parameters), parameters)
    known = [p.float() + place % 2 for place, p in enumerate(parameters)]
    return torch.tensor(step._rounded_alike(known)).float()


def moved(anchors: dict[str, Path]) -> str:
    """The error about a layer that moves to the other device after the guard was made."""
    model = spread(None)
    guard = Guard(model, anchors["nullspace"], vision="vision", method="nullspace", energy=0.9)
    model.text.layers[1].to(second_device.NAME)
    try:
        with guard.watch(None):
            return "nothing"
    except AegisError as error:
        return str(error)


def _apart(made: Callable[[str | None], Tensor], whole: Tensor, place: str) -> float | str:
    try:
        return float((whole - made(place)).abs().max())
    except Exception:
        return traceback.format_exc()[-2000:]


def apart(folder: Path) -> dict[str, dict[str, float | str]]:
    """How far the weights, or the anchor, are from those of the same model on the CPU alone.

    The keys are the layer on the other device, which this process then keeps, and what was done.
    A text in place of a number says what went wrong.
    """
    torch.set_num_threads(1)
    found: dict[str, dict[str, float | str]] = {}
    with second_device.in_reach():
        anchors = anchors_by_method(folder)
        made: dict[str, Callable[[str | None], Tensor]] = {
            name: lambda place, name=name: guarded(anchors, name, place) for name in GUARDS
        }
        made["measure"] = lambda place: anchor(folder, place)
        made["masters"] = masters
        on_one = {name: do(None) for name, do in made.items()}
        for place in PLACES:
            found[place] = {name: _apart(do, on_one[name], place) for name, do in made.items()}
        found["moved"] = {"said": moved(anchors)}
    return found
