"""`aegis inspect`: every kind of artifact and run, against hand-computed figures."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from samples.artifacts import write as write_artifact
from samples.reports import probe, write_job

from aegis_cli import inspection
from aegis_cli.cli import render
from aegis_cli.cli.app import app
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.evaluation import results
from aegis_cli.recipes import Probe, Recipe, study_cells, to_yaml

GROUPS = ["stem", "layers.0"]
# step 1: stem sheds 0.25 of 4, layers.0 agrees; step 2: stem agrees, layers.0 sheds all of 2
TT = [[4.0, 1.0], [4.0, 2.0]]
TA = [[-1.0, 3.0], [1.0, -2.0]]
AA = [[1.0, 9.0], [1.0, 2.0]]


def save_ledger(path: Path, tt=TT, ta=TA, aa=AA, method: str = "aegis") -> Path:
    steps, groups = len(tt), len(GROUPS)
    columns = {
        name: torch.tensor(rows).double().reshape(steps, groups)
        for name, rows in (("tt", tt), ("ta", ta), ("aa", aa))
    }
    tensors = columns | {
        "w2": torch.ones(steps, 1, dtype=torch.float64),
        "step": torch.arange(1, steps + 1),
    }
    artifacts.save(
        path, "ledger", tensors, meta={"groups": GROUPS, "layers": ["layers.0"], "method": method}
    )
    return path


def save_run(folder: Path, **ledger) -> Path:
    (folder / "checkpoints" / "000002").mkdir(parents=True)
    (folder / "checkpoints" / "last").symlink_to("000002")
    (folder / "recipe.yaml").write_text(to_yaml(Recipe(name="small", task="point", seed=3)))
    (folder / "metrics.jsonl").write_text(
        '{"step": 1, "loss": 2.0, "validation_loss": 1.5}\n{"step": 2, "loss": 1.0}\n'
    )
    save_ledger(folder / "ledger.safetensors", **ledger)
    return folder


def save_anchor(path: Path) -> Path:
    moments = {"mean": [3.0, 4.0], "var": [1.0, 0.5]}
    tensors = {
        f"layers.{i}.{kind}.{name}": torch.tensor(v, dtype=torch.float64) * (i + 1)
        for i in range(11)
        for kind in ("image", "text")
        for name, v in moments.items()
    }
    tensors |= {
        "inputs.map.values": torch.tensor([90.0, 9.5, 0.5]).double(),
        "inputs.map.vectors": torch.eye(3)[:, :2],
    }
    tensors |= {
        "curvature.map.outputs.values": torch.tensor([99.5, 0.5]).double(),
        "curvature.map.outputs.vectors": torch.eye(2),
    }
    tensors["inputs.table.values"] = torch.tensor([0.5, 0.0, 0.5]).double()
    artifacts.save(
        path, "anchor", tensors | {"count": torch.tensor([7, 9])}, seed=5, fingerprint="f" * 64
    )
    return path


def shown(capsys, *args: object) -> str:
    with pytest.raises(SystemExit) as caught:
        app(["inspect", *map(str, args)], prog_name="aegis")
    assert caught.value.code in (0, None)
    return capsys.readouterr().out


def test_energy_and_conflict_of_a_run(tmp_path):
    report = inspection.run(save_run(tmp_path / "run"))
    stem, layer = report.layers
    assert report.kind == "run"
    assert (stem.name, stem.energy_shed, stem.energy_shed_max, stem.conflict) == (
        "stem",
        0.125,
        0.25,
        0.5,
    )
    assert (layer.name, layer.energy_shed, layer.energy_shed_max, layer.conflict) == (
        "layers.0",
        0.5,
        1.0,
        0.5,
    )
    assert report.energy_shed_mean == pytest.approx(
        (1 / 5 + 2 / 6) / 2
    )  # removed over the sum of tt, mean over steps
    assert (report.loss, report.validation_loss) == (1.0, 1.5)  # the latest of each
    assert (
        report.facts["method"],
        report.facts["task"],
        report.facts["seed"],
        report.facts["steps"],
    ) == ("aegis", "point", 3, 2)
    assert report.facts["checkpoints"] == ["000002"]


def test_energy_over_time_is_binned_without_losing_a_step(tmp_path):
    steps = 1000
    ta = [[-(i + 1) / steps, 1.0] for i in range(steps)]
    report = inspection.run(
        save_ledger(tmp_path / "l.safetensors", [[1.0, 0.0]] * steps, ta, [[1.0, 1.0]] * steps)
    )
    bins = report.over_time
    assert len(bins) == inspection.BINS
    assert (bins[0].first_step, bins[-1].last_step) == (1, steps)
    assert all(a.last_step + 1 == b.first_step for a, b in zip(bins, bins[1:]))
    first = [((i + 1) / steps) ** 2 for i in range(bins[0].last_step)]
    assert bins[0].energy_shed == pytest.approx(sum(first) / len(first)) == bins[0].layers[0]
    assert bins[0].layers[1] == 0


def test_a_row_of_the_course_is_the_mean_over_its_steps(tmp_path, capsys):
    """With 100 steps some bins have two and others one, so their means have unequal weight."""
    steps = 100
    shed = [0.9 if step % 3 == 0 else 0.001 * step for step in range(1, steps + 1)]
    ta = [[-(share**0.5), 0.0] for share in shed]
    path = save_ledger(tmp_path / "l.safetensors", [[1.0, 0.0]] * steps, ta, [[1.0, 1.0]] * steps)
    rows = [line.split() for line in shown(capsys, path).splitlines() if " to " in line]
    assert len(rows) == 8
    for first, _, last, mean in rows:
        own = shed[int(first) - 1 : int(last)]
        assert float(mean) == pytest.approx(100 * sum(own) / len(own), abs=6e-4)


def test_a_ledger_alone_gives_the_runs_figures(tmp_path):
    run, file = (
        inspection.run(save_run(tmp_path / "run")),
        inspection.run(tmp_path / "run" / "ledger.safetensors"),
    )
    assert file.kind == "ledger"
    assert (file.layers, file.over_time, file.energy_shed_mean) == (
        run.layers,
        run.over_time,
        run.energy_shed_mean,
    )


def test_a_method_without_anchor_gradient_has_no_energy(tmp_path, capsys):
    path = save_run(tmp_path / "run", tt=[], ta=[], aa=[], method="naive")
    report = json.loads(shown(capsys, path, "--json"))
    assert (report["energy_shed_mean"], report["layers"], report["over_time"]) == (None, [], [])
    assert (report["facts"]["method"], report["facts"]["steps"]) == ("naive", 2)
    assert "no step took an anchor gradient" in shown(capsys, path)


def test_a_ledger_says_how_many_steps_it_has(tmp_path, capsys):
    """This includes a ledger without a row, which is not its method's fault."""
    path = save_ledger(tmp_path / "l.safetensors")
    assert inspection.run(path).facts["steps"] == 2
    empty = save_ledger(tmp_path / "empty.safetensors", [], [], [])
    assert inspection.run(empty).facts["steps"] == 0
    assert "no step took an anchor gradient" in shown(capsys, empty)


def test_json_keys(tmp_path, capsys):
    report = json.loads(shown(capsys, save_run(tmp_path / "run"), "--json"))
    assert report["kind"] == "run" and report["energy_shed_mean"] == pytest.approx(4 / 15)
    assert [(x["energy_shed"], x["conflict"]) for x in report["layers"]] == [
        (0.125, 0.5),
        (0.5, 0.5),
    ]


def test_the_runs_table(tmp_path, capsys):
    cells = [line.split() for line in shown(capsys, save_run(tmp_path / "run")).splitlines()]
    assert ["stem", "12.500", "25.0", "50.0"] in cells
    assert ["energy", "shed", "mean", "26.7", "%"] in cells
    assert ["2", "33.333"] in cells


def test_an_anchors_layers_in_order_of_depth(tmp_path, capsys):
    path = save_anchor(tmp_path / "anchor.safetensors")
    report = inspection.run(path)
    assert report.kind == "anchor"
    assert [m.name for m in report.moments] == [
        f"layers.{i} {kind}" for i in range(11) for kind in ("image", "text")
    ]
    assert [m.mean_norm for m in report.moments] == pytest.approx(
        [5.0 * (i + 1) for i in range(11) for _ in range(2)]
    )
    assert [m.variance_trace for m in report.moments] == pytest.approx(
        [1.5 * (i + 1) for i in range(11) for _ in range(2)]
    )
    assert (report.facts["seed"], report.facts["fingerprint"]) == (5, "f" * 64)
    assert "layers.10.text.mean" not in shown(capsys, path)
    text = shown(capsys, path, "--tensors")
    assert "layers.10.text.mean" in text
    cells = [line.split() for line in text.splitlines()]
    assert [
        "map",
        "dense",
        "3",
        "1",
        "2",
        "3",
        "2",
    ] in cells  # 90, 99 and 99.9 % of the energy, and what is stored
    assert ["map.outputs", "dense", "2", "1", "1", "2", "2"] in cells and "Curvature" in text
    assert ["table", "rows", "3", "2", "2", "2", "-"] in cells


def test_other_kinds_need_no_more_than_their_header(tmp_path):
    path = tmp_path / "expert.safetensors"
    artifacts.save(
        path, "expert", {"w": torch.zeros(3, 2)}, units={"w": "rad"}, meta={"width": 128}
    )
    path.write_bytes(path.read_bytes()[:-24] + b"\xff" * 24)  # NaN where the zeros were
    report = inspection.run(path)
    assert (report.kind, report.facts["width"]) == ("expert", 128)
    assert report.tensors == (inspection.TensorInfo("w", (3, 2), "float32", "rad"),)


def test_a_checkpoint_without_its_run_is_a_policy_with_its_backbone(tmp_path, capsys):
    """In the form that `aegis export --format aegis` writes."""
    (tmp_path / "backbone").mkdir()
    joints = {"action_names": ["pan", "lift"]}
    artifacts.save(tmp_path / "expert.safetensors", "expert", {"w": torch.zeros(2)}, meta=joints)
    artifacts.save(tmp_path / "backbone" / "model.safetensors", "backbone", {"w": torch.zeros(2)})
    assert inspection.run(tmp_path / "backbone").kind == "backbone"
    found = inspection.run(tmp_path)
    assert (found.kind, found.path) == ("policy", str(tmp_path))
    assert found.facts["action_names"] == ["pan", "lift"]
    assert found.facts["backbone"] == {"kind": "embedded"}


def test_a_checkpoint_of_a_run_is_the_run_up_to_it(tmp_path, capsys):
    run = save_run(tmp_path / "run")
    for step in (1, 2):
        folder = run / "checkpoints" / f"{step:06d}"
        (folder / "backbone").mkdir(parents=True)
        artifacts.save(folder / "expert.safetensors", "expert", {"w": torch.zeros(1)})
    whole, first = inspection.run(run), inspection.run(run / "checkpoints" / "000001")
    last = inspection.run(run / "checkpoints" / "last")
    assert (first.kind, first.facts["checkpoint"], first.facts["run"]) == (
        "checkpoint",
        "000001",
        str(run),
    )
    assert (first.loss, first.facts["steps"], [b.last_step for b in first.over_time]) == (
        2.0,
        1,
        [1],
    )
    assert last.facts["checkpoint"] == "000002"
    assert (last.loss, last.layers) == (whole.loss, whole.layers)
    assert first.layers != whole.layers
    assert "000001" in shown(capsys, run / "checkpoints" / "000001")


def test_checkpoints_are_listed_by_their_steps(tmp_path):
    run, steps = save_run(tmp_path / "run"), ["000002", "999500", "1000000", "10000000"]
    for name in (*steps, "000002.old"):
        (run / "checkpoints" / name).mkdir(exist_ok=True)
    assert inspection.run(run).facts["checkpoints"] == steps


VQA = {"vqa_accuracy": 0.9, "vqa_cross_entropy": 0.3, "vqa_drop_low": -1, "vqa_drop_high": 9}


def test_what_was_measured_of_each_checkpoint_is_a_table_that_marks_the_best(tmp_path, capsys):
    run = save_run(tmp_path / "run")
    probe = Probe(while_training=9, max_drop=2.0)
    (run / "recipe.yaml").write_text(to_yaml(Recipe(name="small", task="point", probe=probe)))
    lines = [{"step": 1, "loss": 3}, {"step": 2, "validation_loss": 0.25} | VQA]
    lines += [{"step": 3, "validation_loss": 0.5} | VQA]
    for line, drop in zip(lines, (0, 2.5, 1.25), strict=True):
        line |= {"vqa_drop_points": drop} if "vqa_accuracy" in line else {}
    lines[2] |= {"rollout_success": 0.75, "rollout_low": 0.7, "rollout_high": 0.8}
    lines[2] |= {"action_error": 0.125}
    log = run / "metrics.jsonl"
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    for step in (1, 2, 3):
        folder = run / "checkpoints" / f"{step:06d}"
        folder.mkdir(exist_ok=True)
        artifacts.save(folder / "expert.safetensors", "expert", {"w": torch.zeros(1)})
    first, second, third = inspection.run(run).by_checkpoint
    assert (first.name, first.validation_loss, first.drop_points, first.best) == (
        "000001",
        None,
        {},
        False,
    )
    assert (second.validation_loss, second.drop_points, second.success) == (
        0.25,
        {"scenes": 2.5},
        None,
    )
    # The second has the lowest loss, and has lost more than the recipe allows.
    assert (second.best, third.best) == (False, True)
    text = shown(capsys, run)
    assert "Lost of scenes (points)" in text and "Success %" in text
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if " 0000" in line}
    assert rows["000001"] == ["-"] * 4
    assert rows["000002"] == ["0.25", "2.50", "-", "-"]
    assert rows["000003"] == ["(best)", "0.5", "1.25", "75.0", "0.125"]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines[:2]))
    assert inspection.run(run).by_checkpoint == ()  # one measured checkpoint is no choice


def refusal(path: Path) -> AegisError:
    with pytest.raises(AegisError) as caught:
        inspection.run(path)
    return caught.value


def test_what_is_no_artifact_is_refused(tmp_path):
    (tmp_path / "words.safetensors").write_text("hello")
    for path in (tmp_path / "nothing", tmp_path / "words.safetensors"):
        assert path.name in refusal(path).found
    (tmp_path / "empty").mkdir()
    assert "neither a run nor an artifact" in refusal(tmp_path / "empty").found


@pytest.mark.parametrize(
    ("name", "found"),
    [("adapter_config.json", "an adapter of PEFT"), ("model.gguf", "llama.cpp's form, GGUF")],
)
def test_a_model_in_a_form_that_no_command_takes_is_named(tmp_path, name, found):
    (tmp_path / name).write_text("{}")
    assert found in refusal(tmp_path).found


@pytest.mark.parametrize(
    "name", ["v2_OpenEnded_mscoco_val2014_questions.json", "part.parquet", "dataset_info.json"]
)
def test_a_damaged_folder_of_questions_is_told_as_one(name, tmp_path, capfd):
    """A file of each form of question set: VQAv2's, and Hugging Face's two."""
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / name).write_text("{}")
    if name == "dataset_info.json":
        (folder / "state.json").write_text("{}")
    error = refusal(folder)
    assert str(folder) in error.found and "question" in error.expected
    assert capfd.readouterr().err == ""  # the error says what `datasets` would log


@pytest.mark.parametrize("name", ["plot.png", "notes.txt", "stream.json", "words"])
def test_another_file_is_named_as_what_it_is(name, tmp_path):
    (tmp_path / name).write_text("hello")
    error = refusal(tmp_path / name)
    assert str(tmp_path / name) in error.found and "truncated" not in error.found
    assert Path(name).suffix in error.found
    assert error.expected.startswith("a .safetensors file, or the folder of")


@pytest.mark.parametrize(
    ("name", "kind"), [("embedded", "backbone"), ("embedded-dual", "dual-encoder")]
)
def test_the_embedded_models_have_names(name, kind, capsys):
    assert json.loads(shown(capsys, name, "--json"))["kind"] == kind


RECIPES = sorted((Path(__file__).parent.parent / "recipes").glob("*.yaml"))


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_a_recipe_is_shown_with_every_key_and_read_back(path, capsys, tmp_path):
    out = shown(capsys, path)
    (tmp_path / "whole.yaml").write_text(out)
    meant, again = study_cells.load_any(path), study_cells.load_any(tmp_path / "whole.yaml")
    assert type(again) is type(meant)
    assert study_cells.written_out(again) == study_cells.written_out(meant)
    assert "leak" not in json.dumps(study_cells.written_out(meant))  # retired keys have no effect
    if not hasattr(meant, "shared"):
        assert again == meant
    keys = study_cells.written_out(meant).get("shared", study_cells.written_out(meant))
    assert any(isinstance(value, dict) for value in keys.values())
    assert json.loads(shown(capsys, path, "--json"))["recipe"] == study_cells.written_out(meant)
    assert shown(capsys, tmp_path / "whole.yaml") == out


def test_a_recipe_with_a_mistake_and_a_plot_of_one_are_refused(tmp_path, capsys):
    (tmp_path / "small.yaml").write_text("name: small\ntrain: {stesp: 5}\n")
    for words in ([], ["--plot", "x.png"]):
        with pytest.raises(SystemExit) as caught:
            app(["inspect", str(tmp_path / "small.yaml"), *words], prog_name="aegis")
        assert caught.value.code == 2 and "found: " in capsys.readouterr().err


def test_a_folder_of_runs_names_one_of_them(tmp_path):
    save_run(tmp_path / "naive")
    (tmp_path / "naive" / "expert.safetensors").touch()
    assert refusal(tmp_path).fix == f"aegis inspect {tmp_path / 'naive'}"


def test_an_unfinished_run_is_named_as_such(tmp_path):
    (save_run(tmp_path / "run") / "ledger.safetensors").unlink()
    assert "no ledger.safetensors" in refusal(tmp_path / "run").found
    assert refusal(tmp_path / "run").fix == f"continue it: aegis train {tmp_path / 'run'}"


def test_a_metrics_line_still_being_written_is_left_out_and_a_damaged_one_refused(tmp_path):
    metrics = save_run(tmp_path / "run") / "metrics.jsonl"
    whole = metrics.read_text()
    metrics.write_text(whole + '{"step": 3, "lo')
    assert inspection.run(tmp_path / "run").loss == 1.0
    metrics.write_text('{"step": 0, "lo\n' + whole)
    assert "metrics.jsonl is damaged" in refusal(tmp_path / "run").found


# --- the plot -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_plot_is_written_whole(suffix, tmp_path, capsys):
    out = tmp_path / f"energy{suffix}"
    shown(capsys, save_run(tmp_path / "run"), "--plot", out)
    assert out.read_bytes().startswith((b"\x89PNG", b"<?xml"))
    assert sorted(p.name for p in tmp_path.iterdir()) == [out.name, "run"]


def test_the_course_of_a_run_without_energies_is_drawn(tmp_path, capsys):
    run = save_run(tmp_path / "run", tt=[], ta=[], aa=[], method="naive")
    shown(capsys, run, "--plot", tmp_path / "course.svg")
    drawn = (tmp_path / "course.svg").read_text()
    assert all(title in drawn for title in ("Training loss", "Validation loss", "naive in"))
    assert "Energy shed" not in drawn


def test_a_plot_of_a_run_that_never_conflicts(tmp_path):
    report = inspection.run(save_ledger(tmp_path / "l.safetensors", ta=[[1.0, 1.0]] * 2))
    render.energy_plot(report, tmp_path / "energy.png")
    assert report.energy_shed_mean == 0 and (tmp_path / "energy.png").stat().st_size > 1000


def test_plots_that_cannot_be_are_refused(tmp_path):
    report = inspection.run(save_run(tmp_path / "run"))
    with pytest.raises(AegisError, match="no projection energy"):
        render.energy_plot(
            inspection.run(save_anchor(tmp_path / "a.safetensors")), tmp_path / "x.png"
        )
    with pytest.raises(AegisError, match=r"ending in \.png"):
        render.energy_plot(report, tmp_path / "x.jpeg")
    for path in (tmp_path / "no" / "x.png", tmp_path / "a.safetensors" / "x.png"):
        with pytest.raises(AegisError, match="cannot write"):
            render.energy_plot(report, path)


# --- digests --------------------------------------------------------------------------------------

OLD_RUN = Path(__file__).parent / "samples" / "old_runs" / "policy-2e38d13" / "run"


def test_verifying_reads_every_artifact_of_a_run(aegis, tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    save_ledger(run / "checkpoints" / "000002" / "expert.safetensors")
    code, out, err = aegis("inspect", run, "--verify", "--json")
    assert code == 0 and "2 files agree with their digests" in err
    assert json.loads(out)["kind"] == "run"
    code, _, err = aegis("inspect", run / "ledger.safetensors", "--verify")
    assert code == 0 and "1 file agrees with its digest" in err
    data = bytearray((run / "ledger.safetensors").read_bytes())
    data[-1] ^= 0x40
    (run / "ledger.safetensors").write_bytes(data)
    code, out, err = aegis("inspect", run, "--verify")
    assert (code, out) == (2, "")
    assert "ledger.safetensors' is damaged: its content does not match its digest" in err


def test_verifying_says_what_has_no_digest(aegis) -> None:
    code, _, err = aegis("inspect", OLD_RUN, "--verify")
    assert code == 0
    assert "0 files agree" in err and "4 without a digest, written by an earlier Aegis" in err
    code, _, err = aegis("inspect", "embedded", "--verify")
    assert code == 0 and "1 without a digest" in err


def test_verifying_where_nothing_is(aegis, tmp_path: Path) -> None:
    code, _, err = aegis("inspect", tmp_path, "--verify")
    assert code == 2 and "no artifact of Aegis" in err
    code, _, err = aegis("inspect", tmp_path / "none.safetensors", "--verify")
    assert code == 2 and "no file" in err


def test_verifying_a_folder_that_only_holds_runs_is_all_there_is_to_say(
    aegis, tmp_path: Path
) -> None:
    """Runs reached through a link are included, and a link back up ends somewhere."""
    save_run(tmp_path / "elsewhere")
    folder = tmp_path / "folder"
    save_run(folder / "runs" / "one")
    (folder / "two").symlink_to(tmp_path / "elsewhere")
    (folder / "runs" / "up").symlink_to(folder)
    code, out, err = aegis("inspect", folder, "--verify", "--json")
    assert code == 0 and "2 files agree with their digests" in err
    expected = {"kind": "folder", "path": str(folder), "verified": 2, "without_digest": 0}
    assert json.loads(out) == expected
    assert aegis("inspect", folder)[0] == 2  # an error that asks for a run
    data = bytearray((tmp_path / "elsewhere" / "ledger.safetensors").read_bytes())
    data[-1] ^= 0x40
    (tmp_path / "elsewhere" / "ledger.safetensors").write_bytes(data)
    code, _, err = aegis("inspect", folder, "--verify")
    assert code == 2 and "two/ledger.safetensors' is damaged" in err


def test_verifying_follows_no_link_in_a_circle(aegis, tmp_path: Path) -> None:
    run = save_run(tmp_path / "run")
    (run / "ledger.safetensors").unlink()
    (run / "ledger.safetensors").symlink_to("ledger.safetensors")
    code, _, err = aegis("inspect", run, "--verify")
    assert code == 2 and "no file" in err and "Traceback" not in err


# --- how much is loaded ---------------------------------------------------------------------------

INSPECTED = """
import sys
from aegis_cli.cli.app import main
sys.argv = ['aegis', 'inspect', sys.argv[1]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
print('loaded:', *sorted(sys.modules))
"""


def loaded(path: Path) -> set[str]:
    """The modules that are loaded at the end of `aegis inspect` on a path."""
    command = [sys.executable, "-c", INSPECTED, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.partition("loaded:")[2].split())


def test_a_header_is_shown_without_torch(tmp_path: Path) -> None:
    path = write_artifact(tmp_path, "demos")
    assert not {"torch", "mujoco", "pyarrow", "matplotlib", "PIL"} & loaded(path)


def test_figures_of_an_artifact_need_torch_and_no_model(tmp_path: Path) -> None:
    found = loaded(write_artifact(tmp_path, "ledger"))
    assert "torch" in found
    others = {"training.train", "continual.files", "models.policy", "evaluation.probe"}
    assert not {f"aegis_cli.{name}" for name in others} & found


def test_a_run_is_one_page_of_what_how_well_and_what_was_lost(tmp_path, capsys):
    job = write_job(tmp_path, probe=Probe(max_drop=15.0))
    text = shown(capsys, job / "naive")
    for said in ("naive", "75.0", "50.0 to 87.5", "80.0", "10.00", "5.00 to 15.00", "gate: passed"):
        assert said in text
    assert "gate: failed" in shown(capsys, job / "aegis")
    found = json.loads(shown(capsys, job / "aegis", "--json"))
    assert (found["gate"], found["probes"][0]["figures"]["accuracy"]) == (False, 0.7000000000000001)
    assert "wrong" not in found["probes"][0]["figures"] and len(found["rollouts"]) == 2


def test_each_probe_of_a_run_says_how_many_questions_of_which_set_it_asked(tmp_path, capsys):
    job = write_job(tmp_path)
    again = {**probe("shape"), "questions": 5000}
    results.keep(job / "naive", "probe-easy", again, {"vqa": "easy-vqa"})
    lines = [line.split() for line in shown(capsys, job / "naive").splitlines()]
    asked = [line[:2] for line in lines if line and line[0] in ("scenes", "easy-vqa", "probe")]
    assert asked == [["scenes", "40"], ["easy-vqa", "5,000"]]
    found = json.loads(shown(capsys, job / "naive", "--json"))
    assert found["question_sets"] == ["scenes", "easy-vqa"]


def test_a_run_that_nobody_measured_says_who_does(tmp_path, capsys):
    said = shown(capsys, save_run(tmp_path / "run"))
    assert "aegis probe, aegis rollout and aegis evaluate" in said
