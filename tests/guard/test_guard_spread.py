"""A model with layers on several devices in one process is guarded as on one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from samples import processes, spread_model
from samples.guard import LAYERS, make, measured
from samples.second_device import POSSIBLE
from samples.spread_model import DONE, PLACES

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.guard import process_groups


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """How far each result is from that on one device."""
    if not POSSIBLE:
        pytest.skip("this torch takes no device of others' making")
    folder = tmp_path_factory.mktemp("spread")
    return processes.alone(spread_model.apart, folder)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", DONE)
def test_a_spread_model_ends_in_the_weights_of_one_on_one_device(
    name: str, place: str, apart: dict[str, dict[str, Any]]
) -> None:
    assert isinstance(apart[place][name], float), apart[place][name]
    assert apart[place][name] < 1e-8


def test_offloaded_weights_are_refused(tmp_path: Path) -> None:
    anchor = measured(make(), tmp_path / "anchor.safetensors")
    model = make()
    model.text.layers[1].to("meta")
    for begun in (lambda: Guard(model, anchor, LAYERS), lambda: Guard.measure(model, LAYERS)):
        with pytest.raises(AegisError, match=r"'text\.layers\.1.*offloaded"):
            begun()


def test_a_spread_model_in_one_of_several_processes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    anchor = measured(make(), tmp_path / "anchor.safetensors")
    model = make()
    monkeypatch.setattr(process_groups, "count", lambda: 2)
    monkeypatch.setattr(process_groups, "check", lambda _: None)
    model.text.layers[1].register_parameter(
        "elsewhere", torch.nn.Parameter(torch.empty(1, device="meta"))
    )
    monkeypatch.setattr("aegis_cli.models.structure.refuse_offloaded", lambda _: None)
    with pytest.raises(AegisError, match="a model on cpu and meta in one of 2 processes"):
        Guard(model, anchor, LAYERS)


def test_one_layer_that_moves_after_the_guard_was_made_is_refused(
    apart: dict[str, dict[str, Any]],
) -> None:
    said = apart["moved"]["said"]
    assert "a model that was on cpu when the guard was made, and is on stand_in:0" in said
