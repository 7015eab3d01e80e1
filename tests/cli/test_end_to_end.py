"""The commands one after another on real files, and what help texts tell people to type."""

from __future__ import annotations

import json
import re
import shlex
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

COMMANDS = typer.main.get_command(app).commands


def picture(path: str) -> np.ndarray:
    from PIL import Image as image

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
    kept = json.loads((tmp_path / "runs/x/results/probe-scenes.json").read_text())
    asked = probed.pop("asked")  # the kept report has settings instead
    assert (asked["questions"], asked["anchor"]) == (14, "anchor.safetensors")
    assert kept.items() >= probed.items() and kept["settings"]["questions"] == 14
    assert kept["wrong"] and {one["family"] for one in kept["wrong"]} <= kept["families"].keys()
    inspected = done("inspect", "runs/x", "--plot", "energy.png")
    assert inspected["probes"][0]["figures"]["accuracy"] == probed["accuracy"]
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
    assert (tmp_path / "runs/x/results/rollout-reach-all.json").is_file()
    assert done("compare", "runs/x")["rows"][0]["accuracy"] == probed["accuracy"]
    done("train", settings, "--method", "naive", "--demos", "reach.safetensors", "--out", "runs/y")
    asked = done("probe", "runs/y", "--questions", 14)  # without a baseline
    done("rollout", "runs/y", "--task", "reach", "--episodes", 2, "--colors", "seen")
    done("rollout", "runs/x", "--task", "reach", "--episodes", 2, "--colors", "seen")
    (other,) = done("compare", "runs/x", "runs/y")["paired"]
    gained = 100 * (asked["accuracy"] - probed["accuracy"])
    assert other["vqa_points"]["mean"] == pytest.approx(gained)
    assert other["success_seen_points"]["interval"] and other["success_held_out_points"] is None
    both = done("report", "runs/x", "runs/y", "--out", "both.html")
    assert [run["path"] for run in both["runs"]] == ["runs/x", "runs/y"]
    assert both["comparison"]["paired"] == [other]
    assert done("report", "runs/x")["rollouts"][0]["figures"]["episodes"] == 2
    assert "data:image/png;base64," in (tmp_path / "runs/x/report.html").read_text()
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


# --- what help texts and recipes tell people to type ----------------------------------------------


def commands(text: str) -> Iterator[list[str]]:
    """Every `aegis ...` in lines of shell.

    Comments, redirections and the output of other commands are left out.
    """
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        words: list[str] = []
        tokens = shlex.shlex(line, posix=True, punctuation_chars=True)
        tokens.whitespace_split = True  # a comma is part of a word
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


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_helps_example_is_accepted(name: str) -> None:
    help_text = re.sub(r" \\\n\s+", " ", COMMANDS[name].help or "")  # a continued line
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
