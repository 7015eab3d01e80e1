"""The command line: exit codes, the two streams, help, progress.

Stages are replaced by recorders here.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import itertools
import json
import re
import signal
import subprocess
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
import typer
from samples.command import ROOT, finding, python, refused

from aegis_cli.cli import exits, other_trainers, render, stages
from aegis_cli.cli.app import app
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress
from aegis_cli.common.version import __version__
from aegis_cli.data.selection import Selection
from aegis_cli.deploy import load_acting
from aegis_cli.recipes import Anchor, Recipe
from aegis_cli.recipes.decoding import below

STAGES = {
    "demos": "aegis_cli.data.record",
    "anchor": "aegis_cli.anchors.measure",
    "dry-run": "aegis_cli.training.dry_run",
    "train": "aegis_cli.training.train",
    "probe": "aegis_cli.evaluation.probe",
    "rollout": "aegis_cli.evaluation.rollout",
    "evaluate": "aegis_cli.evaluation.open_loop",
    "pretrain": "aegis_cli.pretraining.vlm",
    "pipeline": "aegis_cli.studies.pipeline",
}
COMMANDS = (
    "demos",
    "anchor",
    "train",
    "probe",
    "inspect",
    "rollout",
    "evaluate",
    "pretrain",
    "run",
)


@dataclass(frozen=True)
class Report:
    """Stands for any stage's report."""

    accuracy: float = 0.5
    interval: tuple[float, float] = (0.4, 0.6)
    drop_points: float | None = 2.0
    drop_interval: tuple[float, float] | None = (1.0, 3.0)
    passed: bool | None = None
    unknown: float = float("nan")
    entropy: float | None = None
    out: Path = Path("x")
    families: dict[str, Any] = field(default_factory=dict)
    validation_vqa: dict[str, Any] = field(default_factory=dict)
    validation_rollout: dict[str, Any] = field(default_factory=dict)
    validation_actions: dict[str, Any] = field(default_factory=dict)
    layers: tuple[Any, ...] = ()
    gate_failed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evaluated(Report):
    """Stands for an open-loop report."""

    trained_on: tuple[int, ...] = (3, 4)


@pytest.fixture
def stage(monkeypatch):
    """Replace a stage's `run`; its arguments are appended to the returned list."""

    def replace(
        name: str, report: Any = Report(), error: BaseException | None = None
    ) -> list[tuple[tuple, dict]]:
        calls: list[tuple[tuple, dict]] = []

        def run(*args: Any, on_event: Any, **kwargs: Any) -> Any:
            calls.append((args, kwargs))
            on_event(Progress(name, 1, 2, "steps", {"loss": 0.25}))
            if error is not None:
                raise error
            return report

        room, _, stage = STAGES[name].rpartition(".")
        module = types.ModuleType(stage)
        module.run = run
        monkeypatch.setitem(sys.modules, STAGES[name], module)
        monkeypatch.setattr(importlib.import_module(room), stage, module, raising=False)
        return calls

    return replace


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text("name: small\ntrain: {steps: 5}\n")
    return path


# --- help and version -----------------------------------------------------------------------------


def test_help_and_recipes_need_neither_torch_nor_mujoco():
    result = python(
        "import sys; from aegis_cli.cli.app import app; from aegis_cli import recipes\n"
        "recipes.load('recipes/quickstart.yaml')\n"
        "try: app(['--help'])\n"
        "except SystemExit as e: assert e.code == 0\n"
        "heavy = {'torch', 'numpy', 'mujoco', 'dm_control', 'matplotlib'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    assert result.returncode == 0, result.stderr
    assert all(f"\n  {name} " in result.stdout for name in COMMANDS)


def test_the_module_is_the_command():
    module = [sys.executable, "-W", "error", "-m", "aegis_cli"]
    said = subprocess.run([*module, "--version"], cwd=ROOT, capture_output=True, text=True)
    assert (said.returncode, said.stdout, said.stderr) == (0, f"aegis {__version__}\n", "")
    refused = subprocess.run([*module, "run", "no.yaml"], cwd=ROOT, capture_output=True, text=True)
    assert (
        refused.returncode == 2
        and "no.yaml" in refused.stderr
        and "Traceback" not in refused.stderr
    )


def test_every_commands_summary_is_whole_in_eighty_columns(aegis, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    commands = typer.main.get_command(app).commands
    out = aegis("--help")[1]
    assert set(COMMANDS) < set(commands)
    for name, command in commands.items():
        assert 0 < len(command.short_help) <= 60 and f"\n  {name:<10}{command.short_help}\n" in out


def test_an_option_that_replaces_a_file_says_so(aegis):
    assert "replac" in aegis("demos", "--help")[1] and "new folder" in aegis("demos", "--help")[1]
    assert "replaced" in aegis("anchor", "--help")[1]


def test_no_arguments_show_the_help(aegis):
    code, out, err = aegis()
    assert (code, err) == (0, "")
    assert "Usage: aegis" in out and "aegis run recipes/quickstart.yaml" in out


def test_version(aegis):
    assert aegis("--version") == (0, f"aegis {__version__}\n", "")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_and_every_option_a_help(name, aegis):
    code, out, _ = aegis(name, "--help")
    assert code == 0
    assert f"Example: aegis {name} " in out
    command = typer.main.get_command(app).commands[name]
    assert [p.name for p in command.params if not getattr(p, "help", "")] == []


# --- arguments reach the stages -------------------------------------------------------------------


def test_demos_arguments(aegis, stage):
    calls = stage("demos")
    assert (
        aegis(
            "demos", "reach", "--episodes", 7, "--out", "d.safetensors", "--seed", 3, "--noise", 0.1
        )[0]
        == 0
    )
    options = {
        "noise": 0.1,
        "preview": None,
        "form": "safetensors",
        "as_video": False,
        "drop_below": None,
        "cameras": (),
    }
    assert calls == [(("reach", 7, 3, Path("d.safetensors")), options)]
    aegis("demos", "suite/cartpole-swingup", "--out", "d.safetensors", "--drop-below", 0.5)
    assert calls[1][1]["drop_below"] == 0.5


def test_anchor_arguments(aegis, stage):
    calls = stage("anchor")
    assert (
        aegis(
            "anchor",
            "--backbone",
            "b",
            "--vqa",
            "scenes",
            "--samples",
            9,
            "--out",
            "a",
            "--batch-size",
            2,
        )[0]
        == 0
    )
    no_frames = {"demos": None, "selection": Selection()}
    assert calls == [(("b", Anchor(samples=9, batch_size=2), Path("a")), no_frames)]
    assert (
        aegis(
            "anchor",
            "--out",
            "a",
            "--parts",
            "fisher,inputs",
            "--energy",
            0.5,
            "--fisher-samples",
            3,
            "--seed",
            4,
        )[0]
        == 0
    )
    settings = Anchor(parts=("fisher", "inputs"), energy=0.5, fisher_samples=3, seed=4)
    assert calls[1] == (("embedded", settings, Path("a")), no_frames)
    frames = ("--demos", "d", "--camera", "top", "--camera", "wrist", "--only", "0-3")
    assert aegis("anchor", "--out", "a", *frames)[0] == 0
    chosen = {"demos": Path("d"), "selection": Selection(("top", "wrist"), "0-3")}
    assert calls[2][1] == chosen


def test_train_takes_method_and_overrides_into_the_recipe(aegis, stage, recipe):
    calls = stage("train")
    given = (
        "--method",
        "aegis",
        "--demos",
        "d",
        "--anchor",
        "a",
        "--out",
        "r",
        "--resume",
        "--set",
        "train.backbone_lr=1e-5",
        "--set",
        "seed=4",
    )
    assert aegis("train", recipe, *given)[0] == 0
    ((resolved, *rest), kwargs) = calls[0]
    assert (
        resolved.train.steps,
        resolved.train.backbone_lr,
        resolved.seed,
        resolved.train.method,
    ) == (5, 1e-5, 4, "aegis")
    assert rest == ["aegis", Path("d"), Path("a"), Path("r")]
    assert kwargs == {"resume": True, "overwrite": False}


def test_train_without_method_uses_the_recipes(aegis, stage, recipe):
    calls = stage("train")
    aegis("train", recipe, "--demos", "d", "--out", "r", "--set", "train.method=lora")
    assert calls[0][0][1] == "lora"


def test_probe_rollout_pretrain_run_arguments(aegis, stage, recipe, tmp_path, monkeypatch):
    calls = stage("probe")
    aegis(
        "probe",
        "runs/x",
        "--baseline",
        "embedded",
        "--anchor",
        "a",
        "--questions",
        8,
        "--max-drop",
        0.5,
        "--seed",
        3,
        "--json",
    )
    assert calls == [
        (
            ("runs/x", "scenes", 8, "embedded", Path("a"), 0.5),
            {
                "batch_size": 64,
                "gate": "mean",
                "predictions": None,
                "skip_bad": False,
                "ask": "{}",
                "seed": 3,
                "keep": True,
                "only_if_own": False,
            },
        )
    ]
    calls = stage("rollout")
    aegis(
        "rollout",
        "runs/x",
        "--task",
        "point",
        "--episodes",
        3,
        "--colors",
        "held-out",
        "--video",
        "v.gif",
        "--seed",
        4,
        "--json",
    )
    load = calls[0][1].pop("load")
    assert (load.func, load.keywords) == (load_acting, {"backbone": None})
    assert calls == [
        (
            (Path("runs/x"), "point", 3, "held-out", Path("v.gif")),
            {
                "seed": 4,
                "keep": True,
                "ensemble": None,
                "delay": None,
                "guided": False,
            },
        )
    ]
    calls.clear()
    aegis("rollout", "runs/x", "--delay", 2, "--guided", "--json")
    assert (calls[0][1]["delay"], calls[0][1]["guided"]) == (2, True)
    code, _, err = aegis("rollout", "runs/x", "--guided")
    assert code == 2 and "add --delay STEPS" in err and len(calls) == 1
    calls, drawn = stage("evaluate", Evaluated()), []
    monkeypatch.setattr(render, "open_loop_plot", lambda report, path: drawn.append(path))
    plot = tmp_path / "a.png"
    command = ("evaluate", "runs/x", "--demos", "d", "--episodes", "0,3-5", "--plot", plot)
    _, _, err = aegis(*command, "--json")
    asked = (Path("runs/x"), Path("d"), [0, 3, 4, 5], 1000, 0, 64, True)
    assert calls == [(asked, {"keep": True, "task": None, "rename": ()})]
    assert drawn == [plot] and "trained on: 3, 4; " in err
    calls, saved = stage("pipeline"), []
    monkeypatch.setattr(render, "save_table", lambda report, view: saved.append((report.out, view)))
    aegis("run", recipe, "--out", tmp_path, "--set", "task=point", "--json")
    assert (calls[0][0][0].task, calls[0][0][1]) == ("point", tmp_path) and saved == [
        (Path("x"), render.pipeline)
    ]
    calls = stage("pretrain")
    aegis("pretrain", recipe.with_name("p.yaml"), "--json")
    assert not calls  # the file is missing
    recipe.with_name("p.yaml").write_text("name: vlm")
    aegis("pretrain", recipe.with_name("p.yaml"), "--resume", "--set", "model.depth=2", "--json")
    assert (calls[0][0][0].model.depth, *calls[0][0][1:]) == (2, Path("runs/vlm"), True)


# --- streams and exit codes -----------------------------------------------------------------------


def test_json_is_all_there_is_on_stdout_and_progress_is_on_stderr(aegis, stage):
    stage("anchor")
    code, out, err = aegis("anchor", "--out", "a", "--json")
    report = json.loads(out)
    assert (code, report["accuracy"], report["interval"], report["unknown"], report["out"]) == (
        0,
        0.5,
        [0.4, 0.6],
        None,
        "x",
    )
    assert "anchor: 1/2 steps (50 %)" in err and "loss 0.25" in err


def test_a_table_says_percent_and_units(aegis, stage):
    stage("probe")
    _, out, _ = aegis("probe", "runs/x")
    assert "50.0 %" in out and "40.0 to 60.0 %" in out and "2 points" in out


@pytest.mark.parametrize(("passed", "code"), [(None, 0), (True, 0), (False, 1)])
def test_the_probes_gate_is_the_exit_code(passed, code, aegis, stage):
    stage("probe", Report(passed=passed))
    got, out, err = aegis(
        "probe", "runs/x", "--baseline", "embedded", "--max-drop", "0.5", "--json"
    )
    assert got == code and json.loads(out)["passed"] is passed
    assert ("gate failed: a drop of 2.00 points, more" in err) == (code == 1)


def test_a_drop_that_fails_by_little_is_shown_to(aegis, stage):
    """2.00 points are not more than a limit of 2."""
    stage("probe", Report(passed=False, drop_points=2.004, drop_interval=(1.0, 3.0004)))
    _, _, err = aegis("probe", "runs/x", "--baseline", "embedded", "--max-drop", "2")
    assert "a drop of 2.004 points, more than --max-drop 2" in err
    limits = ("--max-drop", "3", "--gate", "upper")
    _, _, err = aegis("probe", "runs/x", "--baseline", "embedded", *limits)
    assert "a drop of 2.00 points, which may be as large as 3.0004, more than" in err


def test_a_gate_on_the_upper_end_says_it(aegis, stage):
    calls = stage("probe", Report(passed=False))
    limits = ("--max-drop", "2.5", "--gate", "upper")
    code, _, err = aegis("probe", "runs/x", "--baseline", "embedded", *limits)
    assert code == 1 and calls[0][1]["gate"] == "upper"
    assert "a drop of 2.00 points, which may be as large as 3.00, more than --max-drop 2.5" in err
    assert aegis("probe", "runs/x", "--baseline", "embedded", "--gate", "worst")[0] == 2


def test_a_gate_without_a_limit_is_refused_for_it_would_pass_everything(aegis, stage):
    calls = stage("probe", Report(passed=None))
    for gate in ("upper", "mean"):
        command = ("probe", "runs/x", "--baseline", "embedded", "--gate", gate)
        assert f"--gate {gate} without --max-drop" in refused(aegis(*command))
    assert not calls and aegis("probe", "runs/x", "--baseline", "embedded")[0] == 0


def test_an_error_of_a_stage_is_one_block(aegis, stage):
    stage("demos", error=AegisError("a [red] 'box'", "a ball", "aegis ball"))
    err = refused(aegis("demos", "reach", "--out", "x", "--json"))
    assert "found: a [red] 'box'\nexpected: a ball\nfix: aegis ball\n" in err


@pytest.mark.parametrize(
    "args",
    [
        ("run", "x" * 300),
        ("train", "x" * 300, "--out", "r"),
        ("probe", "x" * 300),
        ("inspect", "x" * 300),
        ("rollout", "x" * 300, "--episodes", "1"),
        ("anchor", "--backbone", "x" * 300, "--out", "a"),
        ("demos", "reach", "--episodes", "1", "--out", "x" * 300),
    ],
)
def test_a_path_that_the_system_refuses_is_one_block(args, aegis, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "File name too long" in refused(aegis(*args))


def test_a_reader_that_has_gone_is_no_error(aegis, stage):
    stage("demos", error=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    code, _, err = aegis("demos", "reach", "--out", "x")
    assert code == 141 and "found" not in err and "Traceback" not in err  # 1 is a failed gate


@pytest.mark.parametrize("closed", ["1>&-", "2>&-", "1>&- 2>&-", "| true", "2>&1 | true"])
def test_closed_streams_change_no_exit_code(closed: str, tmp_path: Path):
    """A refused command exits with 2 even if its output is not read: 1 would be a failed gate."""
    command = f"'{sys.executable}' -m aegis_cli recipes show nothing {closed}"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=tmp_path, env=finding(ROOT))
    assert done.returncode == 2


def test_a_gone_reader_ends_a_report_with_a_code_of_its_own(tmp_path: Path):
    """`true` reads nothing, and ends before there is a report."""
    command = f"'{sys.executable}' -m aegis_cli inspect embedded | true"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=tmp_path, env=finding(ROOT), capture_output=True)
    assert (done.returncode, done.stderr) == (141, b"")


def buffered() -> dict[str, str]:
    """An environment in which Python buffers its output, as it does for users."""
    kept = finding(ROOT)
    kept.pop("PYTHONUNBUFFERED", None)
    return kept


# Reports shorter than Python's output buffer, and longer ones.
@pytest.mark.parametrize(
    "words",
    [
        "inspect embedded --json",
        "recipes ls --json",
        "inspect embedded",
        "--help",
        "train --help",
        "--version",
    ],
)
@pytest.mark.parametrize("more", [{}, {"PYTHONUNBUFFERED": "1"}], ids=["gathered", "at_once"])
def test_a_full_disk_loses_no_report_without_a_word(
    words: str, more: dict[str, str], tmp_path: Path
):
    command = f"'{sys.executable}' -m aegis_cli {words} > /dev/full"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, env=buffered() | more, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "standard output cannot be written: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


@pytest.mark.parametrize(
    "asked",
    [
        {"_AEGIS_COMPLETE": "source_bash"},
        {"_AEGIS_COMPLETE": "complete_bash", "COMP_WORDS": "aegis tr", "COMP_CWORD": "1"},
    ],
)
@pytest.mark.parametrize(("output", "code"), [("> /dev/full", 2), ("| true", 141)])
def test_a_completion_that_cannot_be_written_ends_without_a_traceback(
    asked: dict[str, str], output: str, code: int, tmp_path: Path
):
    program = "from aegis_cli.cli.app import main; main()"
    command = f"'{sys.executable}' -c '{program}' {output}"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(
        shell, cwd=tmp_path, env=buffered() | asked, capture_output=True, text=True
    )
    assert done.returncode == code and "Traceback" not in done.stderr
    assert ("No space left on device" in done.stderr) is (code == 2)


def test_ctrl_c_while_the_commands_are_loaded_ends_without_a_traceback(tmp_path: Path) -> None:
    program = """
import os, signal, sys
class Pressed:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Pressed())
from aegis_cli.__main__ import main
main()
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_a_process_of_many_commands_wraps_its_output_once() -> None:
    def full(*_: str) -> None:
        raise OSError(errno.ENOSPC, "full")

    stream: Any = types.SimpleNamespace(write=full, flush=full)
    render.name_errors(stream, "standard output")
    wrapped = stream.write, stream.flush
    render.name_errors(stream, "standard output")
    assert (stream.write, stream.flush) == wrapped
    for call in wrapped:
        with pytest.raises(OSError) as caught:
            call("x")
        assert caught.value.filename == "standard output"


@pytest.mark.parametrize("words", ["inspect embedded --json", "--help", "train --help"])
def test_a_gone_reader_ends_gathered_output_alike(words: str, tmp_path: Path):
    command = f"'{sys.executable}' -m aegis_cli {words} | true"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=tmp_path, env=buffered(), capture_output=True)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("words", ["bogus", "--bogus", "train --bogus", "inspect nothing"])
@pytest.mark.parametrize("nowhere", ["2> /dev/full", "2>&1 | true"])
def test_a_problem_that_nobody_can_be_told_has_its_code_all_the_same(
    words: str, nowhere: str, tmp_path: Path
):
    command = f"'{sys.executable}' -m aegis_cli {words} {nowhere}"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=tmp_path, env=buffered(), capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")


@pytest.mark.parametrize("moment", ["main", "parse_args"])
def test_ctrl_c_before_a_command_begins_ends_without_a_traceback(tmp_path: Path, moment: str):
    code = f"""
import os, signal
from aegis_cli.cli import app

def interrupted(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGINT)

app.Commands.{moment} = interrupted
app.main()
"""
    command = [sys.executable, "-c", code, "doctor"]
    done = subprocess.run(command, cwd=tmp_path, env=finding(ROOT), capture_output=True)
    assert (done.returncode, done.stderr) == (130, b"")


def test_a_mapped_file_that_is_cut_ends_with_a_message(tmp_path: Path):
    """The system kills the process; Python says where it was, and leaves other threads alone."""
    (tmp_path / "frames").write_bytes(bytes(8192))
    code = f"""
import mmap, os, threading
from aegis_cli.cli import app

def elsewhere():
    threading.Event().wait()

def train(prog_name):
    with open({str(tmp_path / "frames")!r}, "r+b") as file:
        frames = mmap.mmap(file.fileno(), 0)
    os.truncate({str(tmp_path / "frames")!r}, 0)
    return frames[0]

threading.Thread(target=elsewhere, daemon=True).start()
app.app = train
app.main()
"""
    done = python(code)
    assert done.returncode == -signal.SIGBUS
    assert "Fatal Python error: Bus error" in done.stderr and "in train" in done.stderr
    assert "elsewhere" not in done.stderr


@pytest.mark.parametrize("triton", [False, True])
def test_a_process_ends_without_looking_through_all_that_it_has_made(triton: bool):
    """Except for triton's objects, whose bindings print warnings about those that are left."""
    code = f"""
import gc
import sys
from aegis_cli.cli import app

if {triton}:
    sys.modules["triton"] = sys

frozen = gc.get_freeze_count()  # Python 3.12 has frozen hundreds of its own

def command(prog_name):
    assert gc.get_freeze_count() == frozen

app.app = command
app.main()
print(gc.get_freeze_count() - frozen)
"""
    done = python(code)
    frozen = int(done.stdout)
    assert frozen <= 0 if triton else frozen > 10_000, done.stderr


def test_control_characters_of_metadata_are_shown_and_not_sent(aegis, tmp_path: Path):
    """They could move the cursor, or set the terminal's title."""
    artifacts.save(
        path := tmp_path / "x.safetensors",
        "expert",
        {"w": torch.ones(1)},
        meta={"method": "\x1b]0;title\x07\x9b2J", "note": "a line\nand another"},
    )
    code, out, _ = aegis("inspect", path)
    assert code == 0 and "\\x1b]0;title\\x07\\x9b2J" in out
    assert "\x1b" not in out and "\x9b" not in out
    code, _, err = aegis("inspect", "no\x1b[2Jfile")
    assert code == 2 and "no\\x1b[2Jfile" in err and "\x1b[2J" not in err


def test_bad_recipes_are_refused_before_any_stage(aegis, stage, recipe):
    calls = stage("train")
    given = ("--demos", "d", "--out", "r")
    assert "did you mean 'train.steps'?" in refused(
        aegis("train", recipe, *given, "--set", "train.stesp=4")
    )
    assert "'many'" in refused(aegis("train", recipe, *given, "--set", "train.steps=many"))
    assert "did you mean 'aegis'?" in refused(aegis("train", recipe, *given, "--method", "aegsi"))
    assert "no file" in refused(aegis("train", recipe.with_name("nothing.yaml"), *given))
    assert "did you mean 'reach'?" in refused(aegis("run", recipe, "--set", "task=raech"))
    assert "aegis pretrain" in refused(aegis("run", ROOT / "recipes" / "pretrain-embedded.yaml"))
    assert calls == []


@pytest.mark.parametrize(
    "args",
    [
        ("demos", "reach", "--out", "x", "--episodes", "0"),
        ("demos", "reach", "--out", "x", "--seed", "-1"),
        ("demos", "reach", "--out", "x", "--seed", "4294967296"),
        ("anchor", "--out", "x", "--seed", "1" + "0" * 400),
        ("demos", "reach", "--out", "x", "--noise", "nan"),
        ("anchor", "--out", "x", "--samples", "0"),
        ("probe", "runs/x", "--questions", "-5"),
        ("probe", "runs/x", "--baseline", "embedded", "--max-drop", "nan"),
        ("rollout", "runs/x", "--episodes", "0"),
        ("evaluate", "runs/x", "--demos", "d", "--episodes", "5-2"),
        ("evaluate", "runs/x", "--demos", "d", "--episodes", "1,,2"),
        ("evaluate", "runs/x", "--demos", "d", "--frames", "0"),
    ],
)
def test_numbers_out_of_range_are_refused_before_any_stage(args, aegis):
    assert args[-2] in refused(aegis(*args))


def test_a_gate_needs_a_baseline(aegis):
    assert "--baseline" in refused(aegis("probe", "runs/x", "--max-drop", "1"))


@pytest.mark.parametrize(
    "args",
    [
        ("demos",),
        ("demos", "reach"),
        ("rollout", "runs/x", "--colors", "blue"),
        ("probe", "x", "--questions", "many"),
        ("nothing",),
    ],
)
def test_misuse_of_the_command_line_exits_2_on_stderr(args, aegis):
    code, out, err = aegis(*args)
    assert (code, out) == (2, "")
    assert "Usage: aegis" in err and "Traceback" not in err


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("demos", "reach", "--format", "zip"), "'zip' is not one of 'safetensors', 'lerobot'."),
        (("demos", "reach", "--episodes", "many"), "'many' is no whole number."),
        (("demos", "reach", "--episodes", "2.5"), "'2.5' is no whole number."),
        (("probe", "embedded", "--max-drop", "little"), "'little' is no number."),
    ],
)
def test_an_options_value_that_is_refused_is_told(args, said: str, aegis) -> None:
    code, out, err = aegis(*args)
    assert (code, out) == (2, "")
    assert f"Invalid value for '{args[2]}': {said}" in " ".join(err.split())


@pytest.mark.parametrize(
    ("option", "key"),
    [
        ("--backbone", "backbone"),
        ("--batch_size=8", "train.batch_size"),
        ("--batch-size", "train.batch_size"),
        ("--train.steps=100", "train.steps"),
        ("--camera", "demos.camera"),
        ("--optimizer.betas", "train.betas"),
        ("--scheduler.type=cosine", "train.schedule"),
        ("--lr_scheduler_type", "train.schedule"),
        ("--lr-scheduler-type", "train.schedule"),
    ],
)
def test_a_recipes_key_that_is_given_as_an_option_is_told(option: str, key: str, aegis) -> None:
    code, out, err = aegis("train", "reach", "--out", "x", option, "8")
    assert (code, out) == (2, "") and f"but a key of recipes: --set {key}=..." in err


def test_an_option_of_several_keys_is_told_all_of_them(aegis) -> None:
    code, out, err = aegis("train", "reach", "--out", "x", "--learning_rate=1e-4")
    told = "keys of recipes: --set train.backbone_lr=... --set train.expert_lr=..."
    assert (code, out) == (2, "") and told in " ".join(err.split())


def test_options_of_other_trainers_are_told_as_the_documentation_has_them() -> None:
    page = (ROOT / "docs" / "lerobot.md").read_text()
    (section,) = re.findall(r"^## What its options are called here$(.+?)^## ", page, re.M | re.S)
    rows = re.findall(r"^\| (.+?) \| (.+?) \|$", section, re.M)
    documented = {
        option.partition("=")[0].lstrip("-"): re.findall(r"`(?:--)?([\w.]+)[^`]*`", here)
        for there, here in rows
        for option in re.findall("`([^`]+)`", there)
    }
    assert other_trainers.KEYS.keys() - documented.keys() == {"lr"}
    for name in other_trainers.KEYS.keys() & documented.keys():
        # A method is an option here too.
        keys = {"method" if k == "train.method" else k for k in other_trainers.KEYS[name]}
        assert keys <= set(documented[name]), name


def test_every_key_that_is_told_is_one() -> None:
    for key in set(itertools.chain(*other_trainers.KEYS.values())):
        section, _, name = key.partition(".")
        assert key in below(name, Recipe) and section


@pytest.mark.parametrize("args", [("train", "reach", "--anchor.steps=1"), ("anchor", "--steps")])
def test_no_key_is_told_where_none_can_be_set(args: tuple[str, ...], aegis) -> None:
    code, _, err = aegis(*args)
    assert code == 2 and "No such option" in err and "--set train" not in err


class OutOfMemoryError(RuntimeError):
    """Like torch's error for a GPU, by name."""


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB\nmore"),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:124] err == 0. DefaultCPUAllocator: can't allocate "
            "memory: you tried to allocate 4000000000000 bytes. Error code 12"
        ),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("ft2font.so: failed to map segment from shared object"),
        ImportError("libx.so: cannot map segment: Cannot allocate memory"),
    ],
)
def test_want_of_memory_is_a_problem_to_act_on(error, aegis, stage):
    stage("anchor", error=error)
    code, out, err = aegis("anchor", "--out", "a.safetensors")
    assert (
        code == 2
        and out == ""
        and "out of memory" in err
        and "--batch-size" in err
        and "Traceback" not in err
    )
    assert ("2.00 GiB" in err) == isinstance(error, OutOfMemoryError) and "more" not in err


def test_a_library_that_may_not_be_run_from_its_disk_is_no_want_of_memory(aegis, stage):
    said = "failed to map segment from shared object: Operation not permitted"
    stage("anchor", error=ImportError(said))
    code, _, err = aegis("anchor", "--out", "a.safetensors")
    assert code == 3 and said in err and "out of memory" not in err


def test_a_defect_is_no_failed_gate(aegis, stage):
    stage("probe", error=ZeroDivisionError("a defect"))
    code, out, err = aegis("probe", "runs/x", "--max-drop", "1", "--baseline", "embedded")
    assert code == 3 and out == "" and "Traceback" in err and "ZeroDivisionError: a defect" in err


def test_of_several_processes_the_launcher_is_named_too(
    aegis, stage, recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage("train", error=KeyboardInterrupt())
    monkeypatch.setattr(stages, "joined", lambda _: contextlib.nullcontext())  # without others
    command = ("train", recipe, "--demos", "d", "--out", "r")
    for world, local, said in (("2", None, ""), ("4", "2", " --nnodes 2")):
        monkeypatch.setenv("WORLD_SIZE", world)
        monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
        if local is not None:
            monkeypatch.setenv("LOCAL_WORLD_SIZE", local)
        launcher = f"resume with: torchrun{said} --nproc-per-node 2 -m aegis_cli train {recipe}"
        assert launcher in aegis(*command)[2]


def test_ctrl_c_exits_130_and_says_how_to_resume(aegis, stage, recipe):
    for name in ("train", "dry-run", "pipeline", "demos", "probe", "rollout", "anchor"):
        stage(name, error=KeyboardInterrupt())
    code, out, err = aegis("train", recipe, "--demos", "a b", "--out", "r")
    assert (code, out) == (130, "") and "Traceback" not in err
    assert f"interrupted; resume with: aegis train {recipe} --demos 'a b' --out r --resume\n" in err
    assert (
        aegis("train", recipe, "--demos", "d", "--out", "r", "--resume")[2].count("--resume") == 1
    )
    assert aegis("run", recipe)[2].endswith(f"interrupted; resume with: aegis run {recipe}\n")
    again = aegis("run", recipe, "--overwrite")[2]
    assert again.endswith(f"interrupted; resume with: aegis run {recipe}\n")
    for command, kept in (("probe", "answers so far"), ("rollout", "episodes so far")):
        said = aegis(command, "r")[2]
        assert f"interrupted; {kept}" in said and said.endswith(f"go on with: aegis {command} r\n")
    said = aegis("anchor", "--out", "x")[2]
    kept = "all but the last of what is measured so far is kept, unless a warning says otherwise"
    assert said.endswith(f"interrupted; {kept}; go on with: aegis anchor --out x\n")
    whole = "interrupted; no half-written file is left; begin again with: aegis"
    assert aegis("demos", "reach", "--out", "x")[2].endswith(f"{whole} demos reach --out x\n")
    dry = ("--demos", "d", "--out", "r", "--dry-run")
    assert aegis("train", recipe, *dry)[2].endswith(f"{whole} train {recipe} {' '.join(dry)}\n")


@pytest.mark.parametrize(
    ("command", "begins"),
    [
        ("evaluate r --demos d", "predictions so far are kept; go on with: "),
        ("merge r --sweep 1,10", "the strengths so far are kept; go on with: "),
        ("merge r --strength=1 --out x", "no half-written file is left; begin again with: "),
    ],
)
def test_what_is_kept_of_a_command_that_was_ended(command: str, begins: str) -> None:
    assert exits._what_now({"aegis.args": command.split()}) == f"{begins}aegis {command}"
