"""Inspect a folder: a run, a checkpoint, a stream, a dataset or a model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from aegis_cli import recipes
from aegis_cli.common import artifacts, commands, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.headers import Header
from aegis_cli.continual import files as stream_files
from aegis_cli.continual import state
from aegis_cli.continual.state import TaskInProgress
from aegis_cli.data.lerobot import dataset
from aegis_cli.data.lerobot.summary import dataset_facts, dataset_features
from aegis_cli.data.vqa import sets
from aegis_cli.evaluation import kept_figures, results
from aegis_cli.evaluation.results import Result
from aegis_cli.inspection import figures, file
from aegis_cli.inspection.report import (
    CheckpointFigures,
    InspectReport,
    StreamInspection,
    TensorInfo,
    UnfinishedStream,
    UnknownFolder,
)
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.recipes import Demos, Recipe, RobotStreamRecipe
from aegis_cli.training import (
    checkpoint,
    folder,
    retention,
    validation_actions,
    validation_rollout,
    validation_vqa,
)
from aegis_cli.training.up_to_date import refuse_unfinished

# The entries that merged checkpoints and reports of `aegis run` have in common.
_TOLD_OF_MERGES = ("method", "strength", "damping", "base", "kept", "validation_loss")


def inspect(path: Path) -> InspectReport | StreamInspection | UnfinishedStream:
    """Determine what a folder is.

    Raises:
        UnknownFolder: an unknown kind of folder.
        AegisError: damaged, a run without a ledger yet, or an unfinished stream of images.
    """
    # The order matters: a run of a stream has a recipe too, and a checkpoint contains the folder of
    # a model.
    if recipes.is_robot_stream_run(path) and not stream_files.is_done(path):
        return _unfinished(path)
    if recipes.is_stream_run(path):
        report = stream_files.read(path)
        return StreamInspection(report.kind, str(path), report)
    if (path / "recipe.yaml").is_file():
        return _run_folder(path)
    if checkpoint.is_one(path):
        run = checkpoint.run_of(path)
        return _policy_folder(path) if run is None else _run_folder(run, path)
    if (path / "meta").is_dir():
        found = dataset.load(path)
        return InspectReport(
            "dataset", str(path), dataset_facts(found), features=dataset_features(found)
        )
    if model_folder.is_policy(path):
        return file.inspect(path / "model.safetensors")
    if (kind := model_folder.foreign_policy(path)) is not None:
        return _foreign_policy(path, kind)
    for inside in (path, path / "backbone"):
        if model_folder.is_model(inside):
            return _hub_model(inside)
        if (inside / "model.safetensors").is_file():
            return file.inspect(inside / "model.safetensors")
    model_folder.refuse_adapter(path)
    model_folder.refuse_gguf(path)
    refuse_unfinished(path, "inspect")  # a job that has no table yet
    inside = sorted(p.parent for p in path.glob("*/recipe.yaml"))
    for pattern in ("*.safetensors", "*.jsonl"):
        inside += sorted(path.glob(pattern))
    example = next(iter(inside), "runs/<recipe>/<method>")
    fix = commands.aegis("inspect", example)
    expected = "a run, a LeRobot dataset, a model or a .safetensors file"
    raise UnknownFolder(f"{path} is neither a run nor an artifact", expected, fix)


def is_questions(path: Path) -> bool:
    """Whether a folder holds questions, and is neither a run nor a dataset nor a model."""
    others = (path / "recipe.yaml", path / "meta", path / "config.json", path / "model.safetensors")
    return sets.is_folder(path) and not any(other.exists() for other in others)


def _policy_folder(path: Path) -> InspectReport:
    """A policy without its run, as written by `aegis export`: its expert's header, its backbone."""
    found, inside = file.inspect(path / checkpoint.EXPERT), path / "backbone"
    own = _hub_model(inside) if model_folder.is_model(inside) else None
    backbone: dict[str, Any] = {"kind": "embedded"}
    if own is not None:
        backbone = {"kind": own.kind} | {k: own.facts[k] for k in ("family", "parameters")}
    facts = found.facts | {"backbone": backbone}
    return dataclasses.replace(found, kind="policy", path=str(path), facts=facts)


def _foreign_policy(path: Path, kind: str) -> InspectReport:
    """A policy of LeRobot, by its weights' headers, and how to measure its VLM."""
    # policy_preprocessor_*.safetensors beside the weights hold scales of LeRobot's processor steps.
    parts = [part for part in model_folder.weights(path) if not part.name.startswith("policy_")]
    tensors = tuple(info for part in parts for info in _tensor_infos(part))
    count = sum(math.prod(tensor.shape) for tensor in tensors)
    facts = {"type": kind, "parameters": count, "vlm": model_folder.take_out(path)}
    return InspectReport("lerobot-policy", str(path), facts, tensors)


def _hub_model(path: Path) -> InspectReport:
    """A folder in the Hugging Face hub's layout, by its configuration and its weights' headers."""
    config = files.load_json(path / "config.json")
    if not isinstance(config, dict) or not isinstance(config.get("model_type"), str):
        found = f"'{path / 'config.json'}' without a model_type"
        raise AegisError(
            found, "the configuration of a Hugging Face model", "download the model again"
        )
    # A vision-language model has the language model's sizes in a separate section.
    inner = config.get("text_config")
    text = inner if isinstance(inner, dict) else config
    named = {
        "layers": "num_hidden_layers",
        "width": "hidden_size",
        "heads": "num_attention_heads",
        "key_heads": "num_key_value_heads",
        "vocabulary": "vocab_size",
    }
    tensors = tuple(info for part in model_folder.weights(path) for info in _tensor_infos(part))
    family = config["model_type"]
    facts: dict[str, Any] = {"family": family, "known": family in FAMILIES}
    facts["parameters"] = sum(math.prod(tensor.shape) for tensor in tensors)
    facts |= {name: text.get(key) for name, key in named.items()}
    said = {name: value for name, value in facts.items() if value is not None}
    return InspectReport("hugging-face-model", str(path), said, tensors)


def _tensor_infos(weights: Path) -> Iterator[TensorInfo]:
    try:
        with safe_open(weights, framework="np") as opened:
            for name in sorted(opened.keys()):
                part = opened.get_slice(name)
                yield TensorInfo(name, tuple(part.get_shape()), part.get_dtype(), "1")
    except (SafetensorError, OSError) as error:
        files.refuse_pointer(weights)
        found = f"'{weights}' is truncated or not a safetensors file ({error})"
        raise AegisError(found, "a complete file", "download it again") from error


def _run_folder(path: Path, at: Path | None = None) -> InspectReport:
    """A run, or its state at one of its checkpoints."""
    settings = recipes.load(path / "recipe.yaml")
    rows = path / "ledger.safetensors"
    if not rows.is_file():
        fix = f"continue it: {commands.aegis('train', path)}"
        raise AegisError(
            f"{path} has no ledger.safetensors", "a run with at least one checkpoint", fix
        )
    until = None if at is None else checkpoint.step_of(at)
    header, metrics = artifacts.read_header(rows), _last_metrics(path, until)
    which = path / "checkpoints" / checkpoint.LAST if at is None else at
    merged = _merged(path, which)
    if merged:
        # The log is from the training, before the merge.
        metrics["validation_loss"] = merged.get("validation_loss")
    facts = _run_facts(path, until, header, settings, metrics)
    if merged:
        facts["merge"] = merged
    elif (into := folder.merged_in(path)) is not None:
        facts["merged_into"] = str(into)
    if not merged and (asked := validation_vqa.of_line(settings, metrics)):
        facts["validation_vqa"] = asked
    if not merged and (acted := validation_rollout.of_line(metrics)):
        facts["validation_rollout"] = acted
    if not merged and (predicted := validation_actions.of_line(metrics)):
        facts["validation_actions"] = predicted
    facts |= _data_facts(header, settings.demos)
    if base_model := header.meta.get("base_model"):
        facts["base_model"] = base_model
    report = InspectReport(
        "run" if at is None else "checkpoint",
        str(path if at is None else at),
        facts,
        loss=metrics.get("loss"),
        validation_loss=metrics.get("validation_loss"),
        **figures.of_ledger(rows, until),
    )
    if at is not None:
        return report
    # A merged run has a single checkpoint, and the log of the training before the merge.
    by_checkpoint = () if merged else _by_checkpoint(path, settings)
    report = dataclasses.replace(report, by_checkpoint=by_checkpoint)
    return _with_results(report, path, settings)


def _unfinished(path: Path) -> UnfinishedStream:
    """How far a stream of robot tasks is, and what was measured so far."""
    recipe = recipes.load(path / "recipe.yaml", kind=RobotStreamRecipe)
    saved = path / state.STATE
    place = state.place_in(saved) if saved.is_file() else TaskInProgress()
    return UnfinishedStream(
        kind="unfinished-stream",
        path=str(path),
        method=recipe.train.method,
        tasks=recipe.tasks,
        learned=place.task,
        step=place.step,
        steps=recipe.train.steps,
        matrix=stream_files.read_matrix(path) if place.task else None,
    )


def _by_checkpoint(path: Path, settings: Recipe) -> tuple[CheckpointFigures, ...]:
    """What was measured of each checkpoint of a run while it trained."""
    names = {int(at.name): at.name for at in checkpoint.whole(path)}
    best = retention.best(path, names, settings).step
    lines: dict[int, dict[str, Any]] = {}
    for line in folder.read_metrics(path, "step"):
        lines.setdefault(line["step"], {}).update(line)
    found = []
    for step, name in names.items():
        line = lines.get(step, {})
        asked = validation_vqa.of_line(settings, line)
        acted = validation_rollout.of_line(line)
        figures_of_step = CheckpointFigures(
            name=name,
            validation_loss=line.get("validation_loss"),
            drop_points={name: told["drop_points"] for name, told in asked.items()},
            success=acted.get("success"),
            mean_return=acted.get("mean_return"),
            relative_error=validation_actions.of_line(line).get("relative_error"),
            best=step == best,
        )
        found.append(figures_of_step)
    measured = [figures_of_step.validation_loss is not None for figures_of_step in found]
    return tuple(found) if sum(measured) > 1 else ()


def _with_results(report: InspectReport, path: Path, settings: Recipe) -> InspectReport:
    """Add a run's results to its report."""
    facts = dict(report.facts)
    if before := results.steps_measured_before(path):
        facts["measured_before"] = before
    probed = tuple(_without_pictures(found) for found in results.probes(path))
    return dataclasses.replace(
        report,
        facts=facts,
        probes=probed,
        rollouts=tuple(results.rollouts(path)),
        open_loops=tuple(results.open_loops(path)),
        question_sets=tuple(results.question_set(each, settings) for each in probed),
        gate=results.gate(probed, settings.probe),
    )


def _run_facts(
    path: Path,
    until: int | None,
    header: Header,
    settings: Recipe,
    metrics: Mapping[str, Any],
) -> dict[str, Any]:
    """The facts of a run, now or after `until` steps."""
    which: dict[str, Any] = {"checkpoints": [at.name for at in checkpoint.numbered(path)]}
    if until is not None:
        which = {"run": str(path), "checkpoint": f"{until:06d}"}
    return {
        "method": header.meta.get("method"),
        "task": header.meta.get("task", settings.task),
        "recipe": settings.name,
        "backbone": settings.backbone,
        "seed": settings.seed,
        "steps": _steps(path, metrics) if until is None else until,
        "planned_steps": settings.train.steps,
        "fingerprint": header.fingerprint,
        **which,
        "loss": metrics.get("loss"),
        "validation_loss": metrics.get("validation_loss"),
    }


def _data_facts(header: Header, demos: Demos) -> dict[str, Any]:
    """The data that a run was trained on, unless it is the task's own demonstrations."""
    facts: dict[str, Any] = {}
    if cameras := header.meta.get("cameras", demos.camera):
        facts["cameras"] = cameras
    if dataset_id := header.meta.get("dataset"):
        facts["dataset"] = dataset_id
    if demos.path is not None:
        facts["demos"] = demos.path if isinstance(demos.path, str) else list(demos.path)
    if demos.rename is not None:
        facts["rename"] = dict(demos.rename)
    if demos.weights is not None:
        facts["weights"] = list(demos.weights)
    return facts


def _steps(path: Path, metrics: Mapping[str, Any]) -> int | None:
    """The steps of a run's policy, or of its log if a study has removed the checkpoints."""
    last = path / "checkpoints" / checkpoint.LAST
    there = (last / checkpoint.EXPERT).is_file()
    return checkpoint.step_of(last) if there else metrics.get("step")


def _without_pictures(found: Result) -> Result:
    """A probe without the images of its wrong answers, which a report shows."""
    figures = {name: value for name, value in found.figures.items() if name != "wrong"}
    return dataclasses.replace(found, figures=figures)


def _merged(run: Path, at: Path) -> dict[str, Any] | None:
    """How `aegis merge` made a checkpoint of a run; None if it did not.

    The report of `aegis run` is used too: a study removes checkpoints, and those of an earlier
    Aegis lack the loss after the merge.
    """
    expert, home = at / checkpoint.EXPERT, folder.measured_in(run)
    found = artifacts.read_header(expert).meta.get("merge") if expert.is_file() else None
    if home is None or not (home / folder.MERGE_REPORT).is_file():
        return found
    told = kept_figures.read(home / folder.MERGE_REPORT, kept_figures.MergeFigures)
    merge = {name: told.get(name) for name in _TOLD_OF_MERGES}
    # The checkpoint's own facts take precedence.
    return merge | {name: value for name, value in (found or {}).items() if value is not None}


def _last_metrics(path: Path, until: int | None) -> dict[str, Any]:
    """The latest value of each figure of a run, up to step `until` if given."""
    latest: dict[str, Any] = {}
    for row in folder.read_metrics(path, "step"):
        if until is None or row["step"] <= until:
            # Not every line has every figure: the validation loss is less frequent.
            latest |= {name: value for name, value in row.items() if value is not None}
    return latest
