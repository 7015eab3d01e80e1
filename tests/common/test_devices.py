"""Which device is used: the chosen one, in this process and in those it starts."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from samples.command import refused

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned

Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture(autouse=True)
def none_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """No device, unlike in other tests, which all use the CPU."""
    monkeypatch.delenv(devices.VARIABLE, raising=False)


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What torch reports on a machine with two; the list receives each device made current."""
    current: list[int] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    return current


def test_a_gpu_is_taken_if_there_is_one_and_none_was_chosen(two_gpus: list[int]) -> None:
    assert devices.pick() == torch.device("cuda")
    with devices.chosen("auto"):
        assert devices.pick() == torch.device("cuda") and devices.on_gpu()


def test_choosing_one_warns_of_nothing() -> None:
    torch.set_warn_always(True)  # otherwise PyTorch warns once per process
    try:
        devices.pick()
    finally:
        torch.set_warn_always(False)
    assert not torch.backends.cudnn.allow_tf32


@pytest.mark.parametrize("multiplies", [True, False])
def test_auto_is_bf16_where_a_gpu_multiplies_in_it_and_does_not_emulate_it(
    multiplies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def supported(including_emulation: bool = True) -> bool:
        return including_emulation or multiplies

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert devices.takes_bf16(torch.device("cuda"), "auto") == multiplies
    assert devices.takes_bf16(torch.device("cuda"), "bf16")


def test_the_chosen_one_is_taken_until_the_block_ends(two_gpus: list[int]) -> None:
    with devices.chosen("cpu"):
        assert devices.pick() == torch.device("cpu") and not devices.on_gpu()
        assert os.environ[devices.VARIABLE] == "cpu"  # which workers inherit
        with devices.chosen(None):
            assert devices.pick() == torch.device("cpu")
        with devices.chosen("cuda:1"):
            assert devices.pick() == torch.device("cuda:1") and current_is(two_gpus, 1)
        assert devices.pick() == torch.device("cpu")
    assert devices.VARIABLE not in os.environ


def current_is(current: list[int], number: int) -> bool:
    return current[-1] == number


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "cpu:0", "mps", "cuda:-1"])
def test_another_name_is_refused(name: str) -> None:
    with pytest.raises(AegisError, match=r"cuda:N"), devices.chosen(name):
        pass
    assert devices.VARIABLE not in os.environ


def test_a_gpu_that_is_not_there_is_refused(
    two_gpus: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(AegisError, match="2 GPUs"), devices.chosen("cuda:2"):
        pass
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(AegisError, match="no GPU"), devices.chosen("cuda"):
        pass


@pytest.mark.parametrize(
    ("listed", "slow"),
    [
        ({"amx_bf16": False, "avx512_bf16": False}, True),
        ({"amx_bf16": True, "avx512_bf16": True}, False),
        ({"amx_bf16": False, "avx512_bf16": True}, False),
        ({"sve": True}, False),
        (None, False),
    ],
)
def test_bf16_is_warned_of_where_a_processor_is_known_to_have_nothing_for_it(
    listed: dict[str, bool] | None, slow: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if listed is None:  # an older torch
        monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    else:
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: listed, raising=False)
    said: list[Event] = []
    for device, precision in (("cpu", "float32"), ("cpu", "auto"), ("cuda", "bf16")):
        devices.warn_of_slow_bf16(torch.device(device), precision, said.append)
    assert not said
    devices.warn_of_slow_bf16(torch.device("cpu"), "bf16", said.append)
    assert len(said) == slow
    assert all(isinstance(event, Warned) and "float32" in event.text for event in said)


def test_several_processes_take_no_numbered_gpu(
    two_gpus: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices.launch, "world_size", lambda: 2)
    with pytest.raises(AegisError, match="2 processes"), devices.chosen("cuda:1"):
        pass


def test_commands_compute_where_they_are_told(
    aegis: Aegis, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str | None] = []
    pick = devices.pick

    def noting() -> torch.device:
        seen.append(os.environ.get(devices.VARIABLE))
        return pick()

    monkeypatch.setattr(devices, "pick", noting)
    given = ("probe", tiny_folder, "--questions", "7", "--json")
    assert aegis(*given, "--device", "cpu")[0] == 0
    assert set(seen) == {"cpu"} and devices.VARIABLE not in os.environ
    if not torch.cuda.is_available():
        assert "no GPU" in refused(aegis(*given, "--device", "cuda"))
    monkeypatch.setenv(devices.VARIABLE, "abacus")
    said = refused(aegis(*given))
    assert devices.VARIABLE in said and "render" not in said, "it is refused before any work"
