"""A copy of the package to which a test may add."""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import aegis_cli
from samples import processes

_SOURCE = Path(aegis_cli.__file__).parent


def copied(folder: Path) -> Path:
    """The package in `folder`, without the checkpoints that ship.

    Its compiled files are valid for the copy too, since the source's times are copied. A compiled
    file that another process is just writing may be gone before it is copied.
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


def run(package: Path, program: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The result of a program (Python text or a module's name) with the copy as `aegis_cli`."""
    given = (str(package.parent), program, list(map(str, arguments)))
    return processes.alone(_ran, *given)


def _ran(folder: str, program: str, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    for name in [name for name in sys.modules if name.partition(".")[0] == _SOURCE.name]:
        del sys.modules[name]
    sys.path.insert(0, folder)
    os.chdir(folder)
    sys.argv = [program, *arguments]
    code = 0
    # The command needs real file descriptors for its streams.
    stream = partial(tempfile.TemporaryFile, "w+", encoding="utf-8")
    with stream() as out, stream() as err:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                if program.isidentifier():
                    runpy.run_module(program, run_name="__main__", alter_sys=True)
                else:
                    exec(program, {})
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 1
        said = [each.read() for each in (out, err) if not each.seek(0)]
    return subprocess.CompletedProcess(arguments, code, *said)
