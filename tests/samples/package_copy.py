"""A copy of the package that a test may add to."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import aegis_cli
from samples.command import finding

_SOURCE = Path(aegis_cli.__file__).parent


def copied(folder: Path) -> Path:
    """The package in `folder`, without the checkpoints that ship.

    What is compiled of it holds for the copy, too, whose files are as old; one that another process
    is only now writing may be gone before it is copied.
    """
    ignored = shutil.ignore_patterns("*.safetensors", "*.pyc.*")
    return shutil.copytree(_SOURCE, folder / "aegis_cli", ignore=ignored)


def declare(package: Path, tuple_name: str, name: str) -> None:
    """Add a name to a tuple of names in the copy's recipes."""
    for path in sorted((package / "recipes").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        added = re.sub(rf"^({tuple_name} = \()", rf'\1"{name}", ', text, flags=re.MULTILINE)
        if added != text:
            path.write_text(added, encoding="utf-8")
            return
    raise AssertionError(f"no tuple {tuple_name} in {package / 'recipes'}")


def declare_options(package: Path, source: str, kind: str, name: str) -> None:
    """Add a section of options to the copy's recipes of one policy, as a class and as its key."""
    path = package / "recipes" / "policy.py"
    text = path.read_text(encoding="utf-8")
    recipe, last = "\n@section\nclass Recipe:", "\n    merge: Merge = Merge()"
    assert recipe in text and last in text
    text = text.replace(recipe, f"{source}\n{recipe}")
    path.write_text(text.replace(last, f"\n    {name}: {kind} = {kind}(){last}"), encoding="utf-8")


def run(package: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Python with these arguments, where `aegis_cli` is the copy."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=package.parent,
        env=finding(package.parent),
        capture_output=True,
        text=True,
        check=False,
    )
