"""The OpenGL backend: the user's choice, else what is installed, else what to install."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
from samples.command import ROOT, finding

from aegis_cli.common import gl
from aegis_cli.common.errors import AegisError


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A Linux machine with some libraries, whose user has set MUJOCO_GL or not."""

    def pretend(*libraries: str, setting: str | None = None, platform: str = "linux") -> None:
        monkeypatch.setattr(
            gl.ctypes.util,
            "find_library",
            lambda name: f"lib{name}.so.1" if name in libraries else None,
        )
        monkeypatch.setattr(gl.sys, "platform", platform)
        monkeypatch.setenv("MUJOCO_GL", setting or "")
        if setting is None:
            monkeypatch.delenv("MUJOCO_GL")

    return pretend


@pytest.mark.parametrize(
    ("libraries", "backend"),
    [
        (("EGL",), "egl"),
        (("EGL", "OSMesa"), "egl"),
        (("OSMesa",), "osmesa"),
        (("OSMesa", "glfw"), "osmesa"),
    ],
)
def test_unset_becomes_egl_then_osmesa(
    libraries: tuple[str, ...], backend: str, machine: Callable[..., None]
) -> None:
    machine(*libraries)
    assert gl.choose_backend() == backend == os.environ["MUJOCO_GL"]


@pytest.mark.parametrize(
    ("setting", "library"),
    [("egl", "EGL"), ("osmesa", "OSMesa"), ("glfw", "glfw"), (" OSMesa ", "OSMesa")],
)
def test_the_users_choice_stands(setting: str, library: str, machine: Callable[..., None]) -> None:
    machine("EGL", library, setting=setting)
    assert gl.choose_backend() == setting.strip().lower()
    assert os.environ["MUJOCO_GL"] == setting


def test_an_empty_setting_is_none(machine: Callable[..., None]) -> None:
    machine("OSMesa", setting="  ")
    assert gl.choose_backend() == "osmesa" == os.environ["MUJOCO_GL"]


@pytest.mark.parametrize(
    ("setting", "package"), [("egl", "libegl1"), ("osmesa", "libosmesa6"), ("glfw", "libglfw3")]
)
def test_a_chosen_library_that_is_missing_is_named_with_its_package(
    setting: str, package: str, machine: Callable[..., None]
) -> None:
    machine(
        *{"EGL", "OSMesa", "glfw"} - {gl._LIBRARY[setting][0]}, setting=setting
    )  # what else is installed does not matter
    with pytest.raises(AegisError, match=f"MUJOCO_GL={setting}") as caught:
        gl.choose_backend()
    assert f"apt-get install {package}" in caught.value.fix


@pytest.mark.parametrize("setting", ["elg", "disable"])
def test_a_setting_that_cannot_render_is_refused(
    setting: str, machine: Callable[..., None]
) -> None:
    """MuJoCo would raise at its import, or render nothing at all."""
    machine("EGL", setting=setting)
    with pytest.raises(AegisError, match=f"MUJOCO_GL={setting}") as caught:
        gl.choose_backend()
    assert "egl, osmesa, glfw" in caught.value.expected and "unset MUJOCO_GL" in caught.value.fix


def test_a_machine_without_any_is_told_what_to_install(machine: Callable[..., None]) -> None:
    machine("glfw")  # needs a screen
    with pytest.raises(AegisError, match="neither libEGL nor libOSMesa") as caught:
        gl.choose_backend()
    assert "apt-get install libegl1" in caught.value.fix and "libosmesa6" in caught.value.fix
    assert "MUJOCO_GL" not in os.environ


def test_other_systems_bring_their_own(machine: Callable[..., None]) -> None:
    machine(platform="darwin")
    assert gl.choose_backend() == "default" and "MUJOCO_GL" not in os.environ


def test_check_opens_a_context_here() -> None:
    gl.check()


def test_a_library_without_a_driver_is_found_by_trying(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr(mujoco, "GLContext", fail)
    with pytest.raises(
        AegisError, match="cannot open an OpenGL context .*eglQueryString"
    ) as caught:
        gl.check()
    assert "libegl-mesa0" in caught.value.fix and "ulimit -v" in caught.value.fix


@pytest.mark.parametrize(
    ("args", "setting", "words"),
    [
        (("demos", "reach", "--out", "d"), "", "sudo apt-get install libegl1"),
        (("run", str(ROOT / "recipes" / "quickstart.yaml")), "", "sudo apt-get install libegl1"),
        (("anchor", "--out", "a"), "elg", "MUJOCO_GL=elg"),
    ],
)
def test_the_command_says_so_before_any_work(
    args: tuple[str, ...],
    setting: str,
    words: str,
    aegis: Callable[..., tuple[int, str, str]],
    machine: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine(setting=setting)
    monkeypatch.chdir(tmp_path)
    code, out, err = aegis(*args)
    assert (code, out) == (2, ""), err
    assert words in err and "Traceback" not in err
    # No progress, and no file.
    assert not re.search(r"^\w+: \d", err, re.MULTILINE) and not list(tmp_path.iterdir())


def test_triton_comes_before_the_renderer(tmp_path: Path) -> None:
    """If Mesa's LLVM is already in use, importing triton's ends the process."""
    (tmp_path / "triton.py").write_text("import sys; print('mujoco' in sys.modules)")
    done = subprocess.run(
        [sys.executable, "-c", "import aegis_cli.sim.scene"],
        cwd=ROOT,
        env=finding(tmp_path),
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "False\n"), done.stderr
