"""The commands one after another on real files, and what the README and the help texts tell people
to type.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import typer
from samples.command import ROOT
from samples.small_run import write

from aegis_cli import recipes
from aegis_cli.cli.app import app
from aegis_cli.common import artifacts
from aegis_cli.recipes import study_cells

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = typer.main.get_command(app).commands


def picture(path: str) -> np.ndarray:
    image = pytest.importorskip("PIL.Image")
    with image.open(path) as opened:
        return np.asarray(opened.convert("RGB"))


def test_the_job_by_hand(
    aegis, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = write(tmp_path, tiny_folder)

    def done(*args: object) -> dict:
        code, out, err = aegis(*args, "--json")
        assert code == 0, err
        return json.loads(out)

    demos = done(
        "demos", "reach", "--episodes", 5, "--out", "reach.safetensors", "--preview", "reach.png"
    )
    assert demos["episodes"] == 5 and picture("reach.png").shape[1] > 600
    anchor = done(
        "anchor", "--backbone", tiny_folder, "--samples", 21, "--out", "anchor.safetensors"
    )
    files = ("--demos", "reach.safetensors", "--anchor", "anchor.safetensors", "--out", "runs/x")
    trained = done("train", settings, "--method", "aegis", *files)
    assert (
        trained["method"] == "aegis"
        and trained["steps"] == 4
        and 0 <= trained["energy_shed_mean"] <= 1
    )
    probed = done(
        "probe",
        "runs/x",
        "--baseline",
        tiny_folder,
        "--anchor",
        "anchor.safetensors",
        "--questions",
        14,
    )
    assert (
        probed["questions"] == 14
        and len(probed["layers"]) == anchor["layers"] == 2
        and probed["layers"][1]["w2"] > 0
    )
    inspected = done("inspect", "runs/x", "--plot", "energy.png")
    assert inspected["kind"] == "run" and inspected["energy_shed_mean"] == pytest.approx(
        trained["energy_shed_mean"]
    )
    assert [x["name"] for x in inspected["layers"][:2]] == ["layers.0", "layers.1"]
    assert all({"energy_shed", "conflict"} <= set(x) for x in inspected["layers"])
    assert picture("energy.png").std() > 5
    rolled = done(
        "rollout",
        "runs/x",
        "--task",
        "reach",
        "--episodes",
        2,
        "--colors",
        "all",
        "--video",
        "out.gif",
    )
    assert rolled["episodes"] == 2 and picture("out.gif").std() > 5
    assert not list(tmp_path.rglob("*.tmp")) and not list(tmp_path.rglob(".*"))


def test_every_artifact_knows_what_it_was_made_from(
    aegis, tiny_folder: Path, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    settings, out = write(tmp_path, tiny_folder), tmp_path / "run"
    assert (
        aegis(
            "train",
            settings,
            "--method",
            "aegis",
            "--demos",
            demos_file,
            "--anchor",
            anchor_file,
            "--out",
            out,
        )[0]
        == 0
    )
    begun_with = {
        name: artifacts.sha256_file(path)
        for name, path in (("demos", demos_file), ("anchor", anchor_file))
    }
    last = out / "checkpoints" / "last"
    for path in (
        out / "ledger.safetensors",
        last / "expert.safetensors",
        last / "training_state" / "state.safetensors",
    ):
        inputs = artifacts.read_header(path).inputs
        assert begun_with.items() <= inputs.items() and len(inputs["backbone"]) == 64
    fingerprint = artifacts.read_header(last / "backbone" / "model.safetensors").fingerprint
    assert artifacts.read_header(last / "expert.safetensors").fingerprint == fingerprint
    assert fingerprint != artifacts.read_header(anchor_file).fingerprint  # the backbone has moved
    for path in [*out.rglob("*.safetensors"), demos_file, anchor_file, out, last / "backbone"]:
        code, shown, _ = aegis("inspect", path, "--json")
        assert code == 0 and json.loads(shown)["kind"] in {*artifacts.KINDS, "run"}


def test_the_same_commands_give_the_same_bytes(
    aegis, tiny_folder: Path, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    settings = write(tmp_path, tiny_folder)
    for name in ("a", "b"):
        given = (
            "--method",
            "aegis",
            "--demos",
            demos_file,
            "--anchor",
            anchor_file,
            "--out",
            tmp_path / name,
        )
        assert aegis("train", settings, *given)[0] == 0
    files = {p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.safetensors")}
    assert len(files) > 4
    assert [
        f for f in files if (tmp_path / "a" / f).read_bytes() != (tmp_path / "b" / f).read_bytes()
    ] == []


# --- the README ----------------------------------------------------------------------------------


def blocks(text: str) -> list[str]:
    """The shell blocks of a Markdown text."""
    return re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def pipeline_block() -> str:
    found = [
        block for block in blocks(README) if block.startswith("set -e\n") and "aegis demos" in block
    ]
    assert len(found) == 1
    return found[0]


def made_small(block: str) -> str:
    """The same commands on less: few episodes, samples and questions, three steps of a slow
    warm-up.
    """
    for option, number in (("episodes", 4), ("samples", 21), ("questions", 35)):
        block = re.sub(rf"--{option} \d+", f"--{option} {number}", block)
    small = (
        "train.steps=3 train.batch_size=4 train.flow_samples=1 train.warmup=1000 expert.width=32"
    )
    settings = "".join(f" --set {setting}" for setting in small.split())
    block, trainings = re.subn(r"^(aegis train .*)$", rf"\1{settings}", block, flags=re.MULTILINE)
    assert trainings == 1
    return block


def test_the_readmes_pipeline_for_ci_runs(tmp_path: Path) -> None:
    """That very block, in a shell. Three tiny steps cost the VLM nothing, so the gate
    lets it pass.
    """
    (tmp_path / "recipes").symlink_to(ROOT / "recipes")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    block = made_small(pipeline_block())
    for command in ("demos", "anchor", "train", "probe", "inspect"):
        assert f"\naegis {command} " in block
    assert re.search(r"^aegis probe .*--max-drop 1\b", block, re.MULTILINE)
    result = subprocess.run(
        ["bash", "-c", block], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    run = tmp_path / re.search(r"--out (runs/\S+)", block)[1]
    assert (run / "checkpoints" / "last").resolve().name == "000003"
    written = {
        name: json.loads((tmp_path / name).read_text())
        for name in re.findall(r"> (\S+\.json)", block)
    }
    for name, report in written.items():
        assert (
            report["questions"] == 35 and report["passed"] is True
            if "probe" in name
            else report["kind"] == "run"
        )


def test_the_pipelines_gate_stops_the_shell(tmp_path: Path) -> None:
    """`set -e` with a stand-in `aegis` whose probe fails: what comes after it does not run."""
    fake = tmp_path / "aegis"
    fake.write_text('#!/bin/sh\necho "$1" >> calls.txt\ntest "$1" != probe\n')
    fake.chmod(0o755)
    result = subprocess.run(
        ["bash", "-c", pipeline_block()],
        cwd=tmp_path,
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )
    assert result.returncode == 1
    assert (tmp_path / "calls.txt").read_text().split() == ["demos", "anchor", "train", "probe"]


def commands(text: str) -> Iterator[list[str]]:
    """Every `aegis ...` in lines of shell: comments, redirections and what another command says are
    left out.
    """
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        words: list[str] = []
        tokens = shlex.shlex(line, posix=True, punctuation_chars=True)
        for token in [*tokens, ";"]:
            if set(token) <= set("&|;()<>"):
                if words[:1] == ["aegis"]:
                    yield words[1:]
                words = []  # what follows '>' is a file name, not a command
            else:
                words.append(token)


def accept(args: list[str]) -> None:
    """Parse a command line as `aegis` would, without running it."""
    assert args and args[0] in COMMANDS, f"no command 'aegis {' '.join(args)}'"
    COMMANDS[args[0]].make_context(args[0], args[1:])
    for path in (word for word in args if word.startswith("recipes/")):
        settings = [b for a, b in zip(args, args[1:]) if a == "--set"]
        if args[0] == "run":
            study_cells.load(ROOT / path, settings)
        else:
            (recipes.load_pretrain if args[0] == "pretrain" else recipes.load_training)(
                ROOT / path, settings
            )


def test_every_command_line_in_the_readme_is_accepted() -> None:
    found = [args for block in blocks(README) for args in commands(block)]
    assert len(found) >= 10 and {
        "demos",
        "anchor",
        "train",
        "probe",
        "inspect",
        "rollout",
        "run",
    } <= {args[0] for args in found}
    for args in found:
        accept(args)


def test_every_command_in_the_readmes_prose_exists() -> None:
    found = [shlex.split(text) for text in re.findall(r"`aegis ([^`\n]+)`", README)]
    assert len(found) >= 8
    for command, *rest in found:
        options = {name for p in COMMANDS[command].params for name in p.opts}
        assert {word for word in rest if word.startswith("--")} <= options


def test_every_setting_in_the_readme_is_a_recipe_key() -> None:
    settings = re.findall(r"--set ([\w.]+=\S+?)[\s`]", README)
    of_streams = [
        setting
        for setting in settings
        if setting.startswith(("igsp.", "sequential.", "split=", "train.lr="))
    ]
    assert of_streams and len(settings) > len(of_streams)
    recipes.load(ROOT / "recipes" / "quickstart.yaml", [s for s in settings if s not in of_streams])
    recipes.load_training(ROOT / "recipes" / "igsp-stream.yaml", of_streams)


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_helps_example_is_accepted(name: str) -> None:
    help_text = re.sub(r" \\\n\s+", " ", COMMANDS[name].help or "")  # a line that goes on
    examples = re.findall(r"Example: (aegis .+)", help_text)
    assert examples
    for example in examples:
        (args,) = commands(example)
        assert args[0] == name
        accept(args)


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_recipe_begins_with_the_command_that_runs_it(path: Path) -> None:
    (args,) = commands(path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# "))
    assert args[1] == f"recipes/{path.name}"
    accept(args)
