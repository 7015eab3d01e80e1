"""The files of a finished stream: written, read back, and put to work again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import report as stream_report
from aegis_cli.continual import state
from aegis_cli.continual.report import StreamReport
from aegis_cli.continual.robot_report import RobotStreamReport
from aegis_cli.continual.state import Base, Run
from aegis_cli.core import routing
from aegis_cli.core.accuracy_matrix import StreamScores
from aegis_cli.models.structure import digest
from aegis_cli.recipes import StreamRecipe
from aegis_cli.training import folder

EXPERTS, ROUTING, ENCODER = "experts.safetensors", "routing.safetensors", "encoder"
MATRIX, PARAMETERS, REPORT = "accuracy_matrix.json", "parameters.json", "stream.json"
OWN_ENCODER = "trained encoder"
_NOT_KEPT = (
    "out",
    "minutes",
    "published",
)  # of a report: the first two differ from repetition to repetition


def is_done(path: Path) -> bool:
    return (path / REPORT).is_file()


def write(run: Run, report: StreamReport) -> None:
    """Every file of a finished run."""
    if run.learner.trains == "model":
        run.encoder.save(run.out / ENCODER)
    if run.learner.trains == "experts":
        write_tensors(run, report)
    write_matrix(run.out, report)
    write_report(run.out, report)


def write_matrix(path: Path, report: StreamReport) -> None:
    """R with the task told and inferred, and the figures of both."""
    names = ("tasks", "split", "method", "oracle", "inferred", "scores", "inferred_scores")
    plain = report.to_json()
    files.save_json(path / MATRIX, {name: plain[name] for name in names})


def write_report(path: Path, report: StreamReport | RobotStreamReport) -> None:
    """The parameters, and at last the report, which says that the run is done."""
    files.save_json(path / PARAMETERS, _parameters(report))
    files.save_json(
        path / REPORT, {k: v for k, v in report.to_json().items() if k not in _NOT_KEPT}
    )


def encoder_of(recipe: StreamRecipe, path: Path) -> StreamRecipe:
    """The recipe with the encoder that a run ends with in the place of the one it began with, if
    they differ.
    """
    own = path / ENCODER
    return dataclasses.replace(recipe, encoder=str(own)) if own.is_dir() else recipe


def report(path: Path) -> StreamReport:
    """The report of a finished run.

    Raises:
        AegisError: the run is not done, or the report is damaged.
    """
    raw = raw_report(path)
    try:
        made = {
            **raw,
            "records": tuple(stream_report.record_from(r) for r in raw["records"]),
            "tasks": tuple(raw["tasks"]),
            "scores": StreamScores(**raw["scores"]),
            "inferred_scores": StreamScores(**raw["inferred_scores"]),
            **{name: tuple(tuple(row) for row in raw[name]) for name in ("oracle", "inferred")},
        }
        return StreamReport(**made, out=str(path), minutes=minutes(path))
    except (KeyError, TypeError) as error:
        raise damaged(path, error) from error


def raw_report(path: Path) -> Any:
    """What stream.json holds.

    Raises:
        AegisError: the run is not done, or the file is not JSON.
    """
    if not is_done(path):
        fix = f"continue it: aegis train {path / 'recipe.yaml'} --out {path} --resume"
        raise AegisError(
            f"{path} has no {REPORT}: the stream is not learned to its end",
            "a finished run of a stream",
            fix,
        )
    return files.load_json(path / REPORT)


def damaged(path: Path, error: Exception) -> AegisError:
    found = f"'{path / REPORT}' is damaged: {error}"
    return AegisError(found, "the report as Aegis wrote it", "train the stream again")


def minutes(path: Path) -> float:
    """Of training and evaluation, as logged."""
    return sum(line["seconds"] for line in folder.read_metrics(path, "seconds")) / 60


def attach(run: Base) -> None:
    """Put a finished run's experts, routers and Gaussians back beside the bare model.

    Raises:
        AegisError: files that are missing, damaged, or of another encoder.
    """
    experts = artifacts.load(run.out / EXPERTS, "experts", fingerprint=run.fingerprint)
    routers = artifacts.load(run.out / ROUTING, "routing", fingerprint=run.fingerprint)
    structure = experts.header.meta["structure"]
    if structure.keys() != run.sites.keys() or routers.header.meta.get("experts") != digest(
        experts.tensors
    ):
        found = f"'{run.out / EXPERTS}' and '{run.out / ROUTING}' do not belong together"
        raise AegisError(found, "the files of one run", "train the stream again")
    state.rebuild(run.sites, structure)
    tensors = {**experts.tensors, **routers.tensors}
    with torch.no_grad():
        for name, parameter in routing.named_parameters(run.sites).items():
            parameter.copy_(tensors[name])
    run.gaussians = state.gaussians_from(routers.tensors)


def measured_with(run: Run) -> dict[str, str]:
    """Digests of what a finished run was measured with: its inputs, and an encoder that it trained,
    as it is at the end.
    """
    own = {OWN_ENCODER: run.encoder.fingerprint()} if run.learner.trains == "model" else {}
    return {**run.inputs, **own}


def check_inputs(run: Run, before: StreamReport) -> None:
    """Raise AegisError unless images, words and encoder are those that the run was measured with.

    Of a learner that trains the encoder that is the run's own, which `run` has been built with;
    else the bare one.
    """
    now = measured_with(run)
    read = [OWN_ENCODER if OWN_ENCODER in now else "encoder", "image set"]
    if changed := [name for name in read if before.inputs.get(name) != now[name]]:
        raise AegisError(
            f"another {', '.join(changed)} than the run in '{run.out}' was measured with",
            "the same images, words and encoder",
            "bring them back, or train the stream again in another --out",
        )


def write_tensors(run: Base, report: StreamReport | RobotStreamReport) -> None:
    """Experts, and routers with what they were measured to do."""
    parameters = {name: p.detach().cpu() for name, p in routing.named_parameters(run.sites).items()}
    experts = {name: t for name, t in parameters.items() if ".experts." in name}
    routers = {name: t for name, t in parameters.items() if ".routers." in name}
    common: dict[str, Any] = {
        "seed": run.recipe.seed,
        "inputs": run.inputs,
        "fingerprint": run.fingerprint,
    }
    meta = {"method": report.method, "stream": report.stream, "tasks": list(report.tasks)}
    structure = {name: site.structure() for name, site in run.sites.items()}
    artifacts.save(
        run.out / EXPERTS, "experts", experts, **common, meta=meta | {"structure": structure}
    )
    artifacts.save(
        run.out / ROUTING,
        "routing",
        routers | _figures(run, report) | state.gaussian_tensors(run.gaussians),
        **common,
        units={"tasks.threshold": "nats"},
        meta=meta | {"experts": digest(experts)},
    )


def _figures(run: Base, report: StreamReport | RobotStreamReport) -> dict[str, Tensor]:
    """Of each router its experts' numbers, mean weights and loads, as measured when its task was
    last learned.
    """
    tensors = {}
    for task, record in enumerate(report.records):
        for site in (s for s in record.sites if s.experts):
            prefix = f"{site.site}.routers.{run.learner.router(task)}"
            tensors[f"{prefix}.experts"] = torch.tensor(site.experts)
            tensors[f"{prefix}.mass"] = torch.tensor(site.mass, dtype=torch.float64)
            tensors[f"{prefix}.load"] = torch.tensor(site.load, dtype=torch.float64)
    return tensors


def _parameters(report: StreamReport | RobotStreamReport) -> dict[str, Any]:
    """Of each task what learned in each phase and what was added, and the sums."""
    names = ("task", "phase1_steps", "trained_phase1", "trained", "trained_mean", "added")
    plain = report.to_json()
    sums = ("parameters", "inference_parameters", "trained_phase1", "trained", "trained_mean")
    tasks = [{name: getattr(r, name) for name in names} for r in report.records]
    return {
        "method": report.method,
        "tasks": tasks,
        **{name: plain[name] for name in sums if name in plain},
    }
