"""Who may import whom: an ordered list of rooms, checked on every import statement."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import aegis_cli

ROOT = Path(aegis_cli.__file__).parent
MODULES = {
    ".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in sorted(ROOT.rglob("*.py"))
}

# A module imports only from lower rows, or from its own room.
ROWS: tuple[frozenset[str], ...] = (
    frozenset({"common"}),
    frozenset({"core", "sim"}),
    frozenset({"data"}),
    frozenset({"recipes", "models"}),
    frozenset({"methods"}),
    frozenset({"anchors"}),
    frozenset({"training", "guard"}),
    frozenset({"evaluation"}),
    frozenset({"continual", "merging", "pretraining"}),
    frozenset({"studies"}),
    frozenset({"deploy", "inspection"}),
    frozenset({"publishing", "serving", "reporting"}),
    frozenset({"cli"}),
    frozenset({"__main__"}),
)
ROW = {room: number for number, row in enumerate(ROWS) for room in row}
SCREEN = {"typer", "rich", "click"}  # only the command line knows them
CORE_MAY = {"torch", "aegis_cli.core", "aegis_cli.common.errors"}


def imports(source: str, module: str) -> Iterator[str]:
    """Dotted names a module imports anywhere, also inside functions: `aegis_cli.core.moments`."""
    package = ["aegis_cli", *module.split(".")[: None if module.endswith("__init__") else -1]]
    package = [part for part in package if part != "__init__"]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def violations(source: str, module: str) -> list[str]:
    """The imports of a module that its room must not have."""
    room = module.split(".")[0]
    return [f"{module} imports {name}" for name in imports(source, module) if not fine(room, name)]


def fine(room: str, name: str) -> bool:
    """Whether a module of this room may import that name."""
    root, _, rest = name.partition(".")
    if room == "core":
        allowed = any(name == may or name.startswith(f"{may}.") for may in CORE_MAY)
        return allowed or root in sys.stdlib_module_names
    if root == "aegis_cli":
        other = rest.split(".")[0]
        return other == room or (other in ROW and ROW[other] < ROW[room])
    return root not in SCREEN or room == "cli"


def test_every_room_has_its_row() -> None:
    rooms = {module.split(".")[0] for module in MODULES} - {"__init__"}
    assert rooms == ROW.keys()


@pytest.mark.parametrize("room", sorted(ROW))
def test_imports_go_down_only(room: str) -> None:
    own = [module for module in MODULES if module.split(".")[0] == room]
    found = [violations(MODULES[module].read_text(encoding="utf-8"), module) for module in own]
    assert own and [violation for each in found for violation in each] == []


def test_the_package_itself_imports_nothing_before_it_is_asked_for() -> None:
    found = set(imports(MODULES["__init__"].read_text(encoding="utf-8"), "__init__"))
    lazy = {"aegis_cli.guard.Guard", "aegis_cli.deploy.load_policy"}
    lazy.add("aegis_cli.serving.real_time.RealTime")
    assert found == lazy | {"aegis_cli.common.version.__version__", "typing.TYPE_CHECKING"}
    assert (ROOT / "py.typed").is_file()  # so that type checkers use its types
    program = """
import sys, aegis_cli
assert not {'torch', 'aegis_cli.guard', 'aegis_cli.deploy'} & sys.modules.keys()
assert {'Guard', 'RealTime', 'load_policy'} <= set(dir(aegis_cli))  # a notebook offers them
assert not hasattr(aegis_cli, 'Gaurd') and 'torch' not in sys.modules
from aegis_cli import Guard
assert Guard.__module__ == 'aegis_cli.guard.guard'
heavy = {'mujoco', 'OpenGL', 'typer', 'rich'} & sys.modules.keys()
assert not heavy, heavy
from aegis_cli import load_policy
assert load_policy.__module__ == 'aegis_cli.deploy'
from aegis_cli import RealTime
assert RealTime.__module__ == 'aegis_cli.serving.real_time'
heavy = {'mujoco', 'dm_control', 'OpenGL', 'typer', 'rich'} & sys.modules.keys()
assert not heavy, heavy
"""
    done = run(program)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("core.moments", "import numpy"),
        ("core.moments", "from aegis_cli.models.backbones.base import Backbone"),
        ("core.moments", "def f():\n    from aegis_cli.common import artifacts"),
        ("core.__init__", "from ..models import backbones"),
        ("sim.reach", "from aegis_cli.data import vqa"),
        ("recipes.reader", "from aegis_cli.models.policy import Policy"),
        ("data.lerobot.write", "from aegis_cli.recipes import Demos"),
        ("models.backbones.embedded", "from ...training.train import run"),
        ("methods.aegis", "import aegis_cli.anchors.measure"),
        ("training.train", "from rich.console import Console"),
        ("training.train", "from aegis_cli.cli.render import show"),
        ("common.errors", "from aegis_cli.core import moments"),
        ("guard.guard", "from aegis_cli.training import step"),
        ("studies.__init__", "from aegis_cli import deploy"),
        ("training.train", "from aegis_cli import nowhere"),
    ],
)
def test_a_violation_is_seen(module: str, line: str) -> None:
    assert len(violations(line, module)) == 1


@pytest.mark.parametrize(
    ("module", "line"),
    [
        (
            "core.moments",
            "import torch.nn\nimport math\nfrom aegis_cli.common.errors import AegisError",
        ),
        ("core.__init__", "from . import moments\nfrom .transport import w2_diag"),
        ("training.train", "from aegis_cli.common import artifacts\nfrom ..core import ledger"),
        ("cli.app", "import typer\nfrom aegis_cli.training import train"),
    ],
)
def test_what_is_allowed_passes(module: str, line: str) -> None:
    assert violations(line, module) == []


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["--version"]])
def test_help_does_not_load_torch(arguments: list[str]) -> None:
    program = """
import sys
from aegis_cli.cli.app import main
sys.argv = ['aegis', *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
heavy = {'torch', 'mujoco', 'safetensors', 'matplotlib', 'pyarrow'} & sys.modules.keys()
assert not heavy, heavy
"""
    done = run(program, *arguments)
    assert done.returncode == 0 and done.stdout, done.stdout + done.stderr


def test_a_model_is_read_without_torchs_compiler() -> None:
    """Its import takes as long as that of all the rest of torch."""
    program = """
import sys
from aegis_cli.models import backbones
backbones.load('embedded')
assert 'torch._dynamo' not in sys.modules
"""
    done = run(program)
    assert done.returncode == 0, done.stderr


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A Python program in a process of its own."""
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)
