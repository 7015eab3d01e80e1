"""Commands run once in this process, so that forked children find what they need imported.

The slowest imports are done here: torch does them itself when the first optimizer is made.
"""

from __future__ import annotations

import contextlib
import gc
import io
import shutil
from pathlib import Path

import datasets  # noqa: F401
import pyarrow.parquet  # noqa: F401
import torch._dynamo  # noqa: F401
import typer.main
from campaign import world

from aegis_cli.cli.app import app


def up(root: Path) -> None:
    """Run commands that render nothing: a graphics context would not survive a fork.

    Args:
        root: a world after `world.begin`.
    """
    command = typer.main.get_command(app)
    typer.main.get_command = lambda _: command  # it takes longer to make than most cases
    asked = ("--vqa", world.ASKED, "--questions", "14")
    commands = (
        ("train", world.RECIPE, *world.TRAIN, "--out", "warm"),
        ("inspect", "warm"),
        ("evaluate", "warm", "--demos", world.DEMOS, "--frames", "4"),
        ("probe", "model", *asked),
        ("inspect", "dataset"),
        ("inspect", world.RECIPE),
    )
    with contextlib.chdir(root):
        for args in commands:
            _run(command, args)
        shutil.rmtree("warm")
    # Garbage collections in children then skip these objects, and do not copy their memory.
    gc.collect()
    gc.freeze()


def _run(command: object, args: tuple[str, ...]) -> None:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            command(list(args), prog_name="aegis")  # type: ignore[operator]
        except SystemExit as end:
            if end.code:
                raise RuntimeError(f"aegis {' '.join(args)}: {said.getvalue()}") from end
