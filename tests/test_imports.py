"""Who may import whom: DESIGN's layers, held by walking every import statement of the package."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import aegis_cli

ROOT = Path(aegis_cli.__file__).parent
MODULES = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in sorted(ROOT.rglob("*.py"))}

# Leaf modules anybody may import.
LEAVES = {"errors", "events", "palette", "gl", "files", "fitting", "interrupts", "processes"}
# First part of a module's name -> the parts it may import besides itself and the leaves.
ALLOWED: dict[str, set[str]] = {
    **{leaf: set() for leaf in LEAVES},
    "core": set(),
    "kinds": set(),
    "artifacts": {"kinds"},
    "methods": {"core"},
    "backbones": {"core", "artifacts"},
    "lerobot": set(),
    "tasks": set(),
    "vqa": set(),
    "streams": {"vqa", "tasks", "artifacts"},
    "continual": {"core"},
    "flow": {"core"},
    "expert": {"core"},
    "policy": {"backbones", "expert", "flow", "core"},
    "strict_yaml": set(),
    "sections": {"strict_yaml"},
    "stream_sections": {"sections", "strict_yaml"},
    "study_recipes": {"sections", "strict_yaml", "stream_sections"},
    # of streams the names alone, which the tests of --help hold
    "stream_recipes": {"sections", "strict_yaml", "stream_sections", "streams"},
    "recipe": {"sections", "strict_yaml", "stream_recipes", "stream_sections", "study_recipes"},
    "variants": {"recipe", "strict_yaml"},
    "stream_studies": {"recipe", "strict_yaml", "variants"},
    "studies": {"recipe", "strict_yaml", "stream_studies", "variants"},
    "stages": {
        "methods",
        "backbones",
        "expert",
        "flow",
        "policy",
        "tasks",
        "lerobot",
        "vqa",
        "streams",
        "continual",
        "artifacts",
        "core",
        "recipe",
        "stream_studies",
        "studies",
    },
    "render": set(),
    "deploy": {"stages", "policy", "recipe"},
    "guard": {"stages", "methods", "backbones", "artifacts", "core", "sections", "strict_yaml"},
    "arguments": {"sections"},
    "exits": {"render"},
    "stream_commands": {"render", "stages", "recipe"},
    "job_commands": {"arguments", "render", "stages", "guard", "recipe", "studies", "stream_commands"},
    "inspect_commands": {"job_commands", "recipe", "render", "stages", "stream_commands", "strict_yaml", "studies"},
    "cli": {"arguments", "exits", "render", "stages", "recipe", "inspect_commands", "stream_commands", "job_commands"},
    "__main__": {"cli"},
}
UI = {"typer", "rich", "click"}


def imports(source: str, module: str) -> Iterator[str]:
    """Dotted names a module imports anywhere, also inside functions: `aegis_cli.core.moments`, `torch`."""
    package = ["aegis_cli", *module.split(".")[: None if module.endswith("__init__") else -1]]
    package = [part for part in package if part != "__init__"]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            if base == "aegis_cli":  # `from aegis_cli import artifacts` imports a module, `__version__` does not
                yield from (f"aegis_cli.{alias.name}" for alias in node.names if not alias.name.startswith("__"))
            else:
                yield base


def violations(source: str, module: str) -> list[str]:
    """The imports of a module that its layer may not have."""
    layer = module.split(".")[0]
    bad = []
    for name in imports(source, module):
        root, _, rest = name.partition(".")
        if root == "aegis_cli":
            fine = rest.split(".")[0] in ALLOWED[layer] | LEAVES | {layer}
        elif root in UI:
            fine = layer in ("arguments", "cli", "exits", "job_commands", "render")
        else:
            fine = layer != "core" or root == "torch" or root in sys.stdlib_module_names
        if not fine:
            bad.append(f"{module} imports {name}")
    return bad


def test_the_walk_sees_the_package() -> None:
    assert {"cli", "core.moments", "core.__init__", "artifacts", "errors"} <= MODULES.keys()
    layers = {module.split(".")[0] for module in MODULES} - {"__init__"}
    assert layers <= ALLOWED.keys(), f"no layer for {layers - ALLOWED.keys()}"


@pytest.mark.parametrize("module", [m for m in MODULES if m != "__init__"])
def test_imports_go_down_only(module: str) -> None:
    assert violations(MODULES[module].read_text(encoding="utf-8"), module) == []


def test_the_package_itself_imports_nothing_before_it_is_asked_for() -> None:
    found = list(imports(MODULES["__init__"].read_text(encoding="utf-8"), "__init__"))
    assert found == ["aegis_cli.guard", "aegis_cli.deploy"]
    program = (
        "import sys, aegis_cli; assert not {'torch', 'aegis_cli.guard', 'aegis_cli.deploy'} & sys.modules.keys()\n"
        "assert not hasattr(aegis_cli, 'Gaurd') and 'torch' not in sys.modules\n"
        "from aegis_cli import Guard; assert Guard.__module__ == 'aegis_cli.guard.guard'\n"
        "heavy = {'mujoco', 'OpenGL', 'typer', 'rich'} & sys.modules.keys(); assert not heavy, heavy\n"
        "from aegis_cli import load_policy; assert load_policy.__module__ == 'aegis_cli.deploy'\n"
        "screens = {'typer', 'rich'} & sys.modules.keys(); assert not screens, screens"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("core.moments", "import numpy"),
        ("core.moments", "from aegis_cli.backbones.base import Backbone"),
        ("core.moments", "def f():\n    from aegis_cli import artifacts"),
        ("core.__init__", "from ..backbones import base"),
        ("tasks.reach", "from aegis_cli import vqa"),
        ("lerobot.write", "from aegis_cli.artifacts import save"),
        ("backbones.embedded", "from ..stages.train import run"),
        ("methods.aegis", "import aegis_cli.backbones.base"),
        ("stages.train", "from rich.console import Console"),
        ("stages.train", "from aegis_cli.render import show"),
        ("errors", "from aegis_cli.core import moments"),
        ("cli", "from aegis_cli.core import moments"),
        ("guard.guard", "from aegis_cli import recipe"),
        ("stages.train", "from aegis_cli import guard"),
    ],
)
def test_a_violation_is_seen(module: str, line: str) -> None:
    assert len(violations(line, module)) == 1


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("core.moments", "import torch.nn\nimport math\nfrom aegis_cli.errors import AegisError"),
        ("core.__init__", "from . import moments\nfrom .transport import w2_diag"),
        ("stages.train", "from aegis_cli import __version__, artifacts\nfrom ..core import ledger"),
        ("cli", "import typer\nfrom aegis_cli.stages import train"),
    ],
)
def test_what_is_allowed_passes(module: str, line: str) -> None:
    assert violations(line, module) == []


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["--version"]])
def test_help_does_not_load_torch(arguments: list[str]) -> None:
    program = (
        "import sys; from aegis_cli.cli import main; sys.argv = ['aegis', *sys.argv[1:]]\n"
        "try: main()\n"
        "except SystemExit as done: assert not done.code, done.code\n"
        "heavy = {'torch', 'mujoco', 'safetensors', 'matplotlib', 'pyarrow'} & sys.modules.keys()\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout, done.stdout + done.stderr
