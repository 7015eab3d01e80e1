"""The files of a finished stream of robot tasks: written, read back, and put to work again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.common import artifacts, files
from aegis_cli.common import device as devices
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import files as stream_files
from aegis_cli.continual import learners, robot_report, robots
from aegis_cli.continual.robot_report import RobotStreamReport
from aegis_cli.continual.robots import RobotRun
from aegis_cli.data.batch import Normalizer
from aegis_cli.evaluation.rollout import Acting
from aegis_cli.models import backbones
from aegis_cli.models.expert import ExpertShape
from aegis_cli.models.structure import digest
from aegis_cli.recipes import RobotStreamRecipe

ACTION_EXPERT, BACKBONE, MATRIX = "expert.safetensors", "backbone", "success_matrix.json"


def write(run: RobotRun, report: RobotStreamReport) -> None:
    """Every file of a finished run; stream.json comes last and says that it is finished."""
    fingerprint = run.fingerprint
    if run.learner.trains == "model":
        run.model.backbone.save(run.out / BACKBONE)
        fingerprint = run.model.backbone.fingerprint()
    else:
        stream_files.write_tensors(run, report)
    _write_expert(run, report, fingerprint)
    write_matrix(run.out, report)
    stream_files.write_report(run.out, report)


def write_matrix(path: Path, report: RobotStreamReport) -> None:
    """S of the tasks learned so far with its figures, and what the backbone knew."""
    plain = report.to_json()
    files.save_json(
        path / MATRIX,
        {name: plain[name] for name in ("tasks", "method", "success", "scores", "vqa")},
    )


def report(path: Path) -> RobotStreamReport:
    """The report of a finished run.

    Raises:
        AegisError: the run is not done, or the report is damaged.
    """
    raw = stream_files.raw_report(path)
    try:
        return robot_report.from_json(raw, str(path), stream_files.minutes(path))
    except (KeyError, TypeError) as error:
        raise stream_files.damaged(path, error) from error


def load(path: Path) -> RobotRun:
    """A finished run that can act and be asked, but not learn.

    Raises:
        AegisError: the run is not done, or files are missing, damaged or of another backbone.
    """
    report(path)
    recipe = recipes.load(path / "recipe.yaml", kind=RobotStreamRecipe)
    learner = learners.get(recipe.train.method)
    backbone = backbones.load(
        str(path / BACKBONE) if learner.trains == "model" else recipe.backbone
    ).to(devices.pick())
    fingerprint = backbone.fingerprint()
    saved = artifacts.load(path / ACTION_EXPERT, "expert", fingerprint=fingerprint)
    if saved.header.meta.get("tasks") != list(recipe.tasks):
        found = f"'{path / ACTION_EXPERT}' is no action expert of {', '.join(recipe.tasks)}"
        raise AegisError(found, "the file of this run", "train the stream again")
    scales = [
        (_scale(saved.tensors, i, "proprio"), _scale(saved.tensors, i, "action"))
        for i in range(len(recipe.tasks))
    ]
    policies = robots.share(
        backbone, ExpertShape(**saved.header.meta["shape"]), scales, recipe.seed
    )
    own = robots.own_parameters(policies[0].expert)
    with torch.no_grad():
        for name, parameter in own.items():
            parameter.copy_(saved.tensors[f"expert.{name}"])
    sites = robots.route(policies[0]) if learner.trains == "experts" else {}
    run = RobotRun(
        recipe=recipe,
        learner=learner,
        sites=sites,
        fingerprint=fingerprint,
        out=path,
        policies=policies,
    )
    if sites:
        stream_files.attach(run)
        if saved.header.meta.get("experts") != digest(
            artifacts.load(path / stream_files.EXPERTS).tensors
        ):
            found = (
                f"'{path / ACTION_EXPERT}' and '{path / stream_files.EXPERTS}' do not "
                "belong together"
            )
            raise AegisError(found, "the files of one run", "train the stream again")
    return run


def load_policy(path: Path, task: str | None) -> Acting:
    """The policy of one of a run's tasks, ready to act.

    Raises:
        AegisError: a task that the run has not learned, or none named, or what `load` finds wrong.
    """
    known = report(path).tasks
    if task not in known:
        found = (
            f"no --task for the stream in '{path}'"
            if task is None
            else f"task '{task}' for the stream in '{path}'"
        )
        raise AegisError(found, f"one of its tasks: {', '.join(known)}", f"--task {known[0]}")
    run = load(path)
    number = known.index(task)
    run.activate(number)
    return Acting(run.policies[number], task, run.recipe.rollout.replan)


def _scale(tensors: Mapping[str, Tensor], task: int, kind: str) -> Normalizer:
    return Normalizer(tensors[f"tasks.{task}.{kind}.mean"], tensors[f"tasks.{task}.{kind}.std"])


def _write_expert(run: RobotRun, report: RobotStreamReport, fingerprint: str) -> None:
    """The action expert's own weights and each task's scales."""
    tensors = {f"expert.{name}": p for name, p in robots.own_parameters(run.model.expert).items()}
    for i, policy in enumerate(run.policies):
        for kind, scale in (("proprio", policy.proprio_scale), ("action", policy.action_scale)):
            tensors |= {f"tasks.{i}.{kind}.{name}": t for name, t in scale.state_dict().items()}
    meta = {
        "method": report.method,
        "tasks": list(report.tasks),
        "shape": run.model.expert.shape.to_json(),
    }
    if run.sites:
        meta["experts"] = digest(artifacts.load(run.out / stream_files.EXPERTS).tensors)
    artifacts.save(
        run.out / ACTION_EXPERT,
        "expert",
        tensors,
        seed=run.recipe.seed,
        inputs=run.inputs,
        fingerprint=fingerprint,
        meta=meta,
    )
