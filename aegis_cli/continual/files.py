"""The files of a finished stream: writing them, reading them and loading them into a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from pydantic import TypeAdapter
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.common import artifacts, commands, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.state_dicts import check_state, reading_meta
from aegis_cli.continual import state
from aegis_cli.continual.report import (
    ErrorMatrix,
    ImageStreamReport,
    RecordedStreamReport,
    RobotMatrix,
    RobotStreamReport,
    StreamReport,
    SuccessMatrix,
    report_from,
)
from aegis_cli.continual.state import AnyStreamRun
from aegis_cli.core import routing
from aegis_cli.models.structure import digest

EXPERTS, ROUTING = "experts.safetensors", "routing.safetensors"
PARAMETERS, REPORT = "parameters.json", "stream.json"
_NOT_KEPT = ("out", "minutes")  # fields of a report that differ between equal runs


def is_done(path: Path) -> bool:
    """Whether a run folder holds a stream that was learned to its end."""
    return learned(path) > 0


def learned(path: Path) -> int:
    """How many tasks a finished stream has learned; 0 if the folder holds none.

    A run to which tasks are being added is not finished, even if it was interrupted before its
    earlier report was removed.
    """
    if not (path / REPORT).is_file():
        return 0
    raw = files.load_json(path / REPORT)
    count = len(raw.get("tasks", ())) if isinstance(raw, dict) else 0
    # Otherwise the report is damaged, which `read` tells.
    if count and (path / state.STATE).is_file() and recipes.is_robot_stream_run(path):
        planned = recipes.load(path / "recipe.yaml", kind=recipes.RobotStreamRecipe).tasks
        return count if count == len(planned) else 0
    return max(1, count)


def write(run: AnyStreamRun, report: StreamReport) -> None:
    """Write all files of a finished run; stream.json comes last and marks it as finished."""
    if run.learner.trains == "experts":
        write_tensors(run, report)
    run.save_model()  # after the experts, whose digest a robot's action expert notes
    write_matrix(run.out, report)
    files.save_json(run.out / PARAMETERS, _parameters(report))
    kept = {key: value for key, value in report.to_json().items() if key not in _NOT_KEPT}
    files.save_json(run.out / REPORT, kept)


def write_matrix(path: Path, report: StreamReport) -> None:
    """Write the matrix of the tasks learned so far, and its figures."""
    files.save_json(path / report.file, report.matrix_json())


def read(path: Path) -> StreamReport:
    """The report of a finished run.

    Raises:
        AegisError: the run is not done, or the report is damaged.
    """
    if not is_done(path):
        raise AegisError(
            f"{path} has no {REPORT}: the stream is not finished",
            "a finished run of a stream",
            f"continue it: {commands.aegis('train', path)}",
        )
    raw = files.load_json(path / REPORT)
    try:
        kind: type[StreamReport] = ImageStreamReport
        if recipes.is_robot_stream_run(path):
            kind = RecordedStreamReport if "errors" in raw else RobotStreamReport
        return report_from(kind, raw, path)
    except (TypeError, ValueError, KeyError, AttributeError, ArithmeticError) as error:
        raise AegisError(
            f"'{path / REPORT}' is damaged: {error}",
            "the report as Aegis wrote it",
            "train the stream again",
        ) from error


def read_matrix(path: Path) -> RobotMatrix | None:
    """What an unfinished stream of robot tasks has measured; None if nothing yet.

    Raises:
        AegisError: the matrix is damaged.
    """
    for kind in (SuccessMatrix, ErrorMatrix):
        if (path / kind.file).is_file():
            raw = files.load_json(path / kind.file)
            try:
                return TypeAdapter(kind).validate_python(raw)
            except (TypeError, ValueError) as error:
                raise AegisError(
                    f"'{path / kind.file}' is damaged: {error}",
                    "the matrix as Aegis wrote it",
                    f"continue the stream, which writes it again: {commands.aegis('train', path)}",
                ) from error
    return None


def bring_back(model: str) -> str:
    """What to do about files of a stream that belong to other weights of its model."""
    return f"bring '{model}' back as it was when the stream was trained, or train the stream again"


def attach(run: AnyStreamRun) -> None:
    """Put a finished run's experts, routers and Gaussians back beside the bare model.

    Raises:
        AegisError: files are missing, damaged, or belong to another encoder.
    """
    recipe = run.recipe
    name = recipe.encoder if isinstance(recipe, recipes.StreamRecipe) else recipe.backbone
    owner = artifacts.Owner(run.fingerprint, name, bring_back(name))
    experts = artifacts.load(run.out / EXPERTS, "experts", owner=owner)
    routers = artifacts.load(run.out / ROUTING, "routing", owner=owner)
    if routers.header.meta.get("experts") != digest(experts.tensors):
        raise AegisError(
            f"'{run.out / EXPERTS}' and '{run.out / ROUTING}' do not belong together",
            "the files of one run",
            "train the stream again",
        )
    with reading_meta(run.out / EXPERTS):
        state.rebuild(run.sites, experts.header.meta["structure"], experts.tensors)
    parameters = routing.named_parameters(run.sites)
    # The other tensors in this file are figures. The artifact's kind has checked them.
    learned = {n: t for n, t in routers.tensors.items() if n in parameters}
    tensors = experts.tensors | learned
    check_state(f"'{run.out / EXPERTS}' and '{ROUTING}'", tensors, parameters)
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(tensors[name])
    run.gaussians = state.gaussians_from(routers.tensors)


def write_tensors(run: AnyStreamRun, report: StreamReport) -> None:
    """Write the experts, and the routers with the figures measured at them."""
    parameters = {}
    for name, parameter in routing.named_parameters(run.sites).items():
        parameters[name] = parameter.detach().cpu()
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


def _figures(run: AnyStreamRun, report: StreamReport) -> dict[str, Tensor]:
    """The experts' numbers, mean weights and loads per router.

    They were measured when the router's task was last learned.
    """
    tensors = {}
    for task, record in enumerate(report.records):
        for site in record.sites:
            if not site.experts:
                continue
            prefix = f"{site.site}.routers.{run.learner.router(task)}"
            tensors[f"{prefix}.experts"] = torch.tensor(site.experts)
            tensors[f"{prefix}.mass"] = torch.tensor(site.mass, dtype=torch.float64)
            tensors[f"{prefix}.load"] = torch.tensor(site.load, dtype=torch.float64)
    return tensors


def _parameters(report: StreamReport) -> dict[str, Any]:
    """Parameters trained in each phase and added, per task and in total."""
    names = ("task", "phase1_steps", "trained_phase1", "trained", "trained_mean", "added")
    sums = ("parameters", "inference_parameters", "trained_phase1", "trained", "trained_mean")
    plain = report.to_json()
    return {
        "method": report.method,
        "tasks": [{name: getattr(r, name) for name in names} for r in report.records],
        **{name: plain[name] for name in sums if name in plain},
    }
