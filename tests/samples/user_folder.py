"""A user's folder, and commands that must be refused and leave it as it was."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from aegis_cli import recipes
from aegis_cli.recipes import Model, PretrainRecipe
from aegis_cli.training import train
from samples.small_run import recipe, write

PRETRAIN = PretrainRecipe(
    name="vlm",
    scenes=8,
    probe_questions=7,
    steps=2,
    batch_size=4,
    model=Model(width=32, depth=2, heads=2),
)

LFS_POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345678\n"


@pytest.fixture
def place(
    tmp_path: Path,
    tiny_folder: Path,
    demos_file: Path,
    anchor_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """A working folder with everything a user has, and something that is not a folder."""
    folder = tmp_path / "place"
    folder.mkdir()
    write(folder, tiny_folder)
    (folder / "vlm.yaml").write_text(recipes.to_yaml(PRETRAIN))
    for name, source in (
        ("demos", demos_file),
        ("anchor", anchor_file),
        ("model", tiny_folder / "model.safetensors"),
    ):
        (folder / f"{name}.safetensors").write_bytes(source.read_bytes())
    (folder / "file").write_text("not a folder")
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture(scope="session")
def trained(
    tmp_path_factory: pytest.TempPathFactory, tiny_folder: Path, demos_file: Path, anchor_file: Path
) -> Path:
    """A finished run; read-only."""
    out = tmp_path_factory.mktemp("runs") / "x"
    train.run(recipe(tiny_folder), "aegis", demos_file, anchor_file, out)
    return out


def snapshot(folder: Path) -> dict[str, bytes | None]:
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in folder.rglob("*")
    }


@pytest.fixture
def bad(aegis, place: Path) -> Callable[..., str]:
    """Run a command that must be refused and leave the folder as it was; returns the error."""

    def call(*args: object, says: tuple[str, ...] = ()) -> str:
        before = snapshot(place)
        code, out, err = aegis(*args)
        assert (code, out) == (2, "") and "Traceback" not in err
        assert re.findall(r"^(found|expected|fix):", err, re.MULTILINE) == [
            "found",
            "expected",
            "fix",
        ], err
        assert snapshot(place) == before
        assert [word for word in says if word not in err] == [], err
        return err

    return call


TRAIN = (
    "train",
    "small.yaml",
    "--method",
    "aegis",
    "--demos",
    "demos.safetensors",
    "--anchor",
    "anchor.safetensors",
    "--out",
    "runs",
)


def training(**changes: str) -> tuple[str, ...]:
    """The training command with the values of some options changed."""
    args = list(TRAIN)
    for option, value in changes.items():
        args[args.index(f"--{option}") + 1] = value
    return tuple(args)


def leftovers(folder: Path) -> list[Path]:
    """Temporary files and folders that were left behind."""
    return [p for p in folder.rglob("*") if p.name.startswith(".") or p.name.endswith(".tmp")]
