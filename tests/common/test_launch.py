"""What a launcher has to set so that several processes can connect."""

from __future__ import annotations

import pytest

from aegis_cli.common import launch, ranks
from aegis_cli.common.errors import AegisError

WHOLE = {"WORLD_SIZE": "2", "RANK": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


@pytest.fixture(autouse=True)
def no_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in WHOLE:
        monkeypatch.delenv(name, raising=False)


def test_a_whole_environment_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in WHOLE.items():
        monkeypatch.setenv(name, value)
    launch.check_meeting()
    assert (launch.rank(), launch.world_size()) == (1, 2)


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"RANK": None}, "without RANK"),
        ({"RANK": None, "MASTER_ADDR": None, "MASTER_PORT": None}, "RANK and MASTER_ADDR and"),
        ({"MASTER_PORT": ""}, "without MASTER_PORT"),
        ({"RANK": "2"}, "RANK=2 in the environment, of WORLD_SIZE=2"),
        ({"RANK": "first"}, "RANK=first"),
    ],
)
def test_what_is_missing_or_impossible_is_one_error_before_anybody_waits(
    changed: dict[str, str | None], found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (WHOLE | changed).items():
        if value is not None:
            monkeypatch.setenv(name, value)
    with pytest.raises(AegisError, match=found) as caught, ranks.joined():
        pass
    assert "torchrun" in caught.value.fix and "unset WORLD_SIZE" in caught.value.fix
