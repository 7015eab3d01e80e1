"""`aegis train` on a stream of robot tasks: one after the other, and after each the success in
closed loop on all so far.

    recipe.yaml  metrics.jsonl
    expert.safetensors                        the action expert and each task's scales
    experts.safetensors  routing.safetensors  of a learner with experts
    backbone/                                 of one that trains the backbone itself
    success_matrix.json                       after each task
    parameters.json  stream.json
    state.safetensors                         what --resume needs; gone when the stream is done
    ../demos/                                 what was recorded, for all runs beside this one

All but the metrics, which hold times, are the same bytes in every repetition, interrupted or not.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

import torch

from aegis_cli import sim
from aegis_cli.common import device as devices
from aegis_cli.common import files, gl
from aegis_cli.common.errors import AegisError, check_finite
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.palette import COLORS
from aegis_cli.continual import files as stream_files
from aegis_cli.continual import learners, loop, robot_files, robot_report, robots, state
from aegis_cli.continual import report as stream_report
from aegis_cli.continual import train as stream
from aegis_cli.continual.robot_evaluate import Evaluator, questions
from aegis_cli.continual.robot_report import RobotStreamReport
from aegis_cli.continual.robots import RobotRun
from aegis_cli.data import demonstrations
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Demos, RobotStreamRecipe
from aegis_cli.training import assemble, folder, train
from aegis_cli.training.up_to_date import StageRecords


def run(
    recipe: RobotStreamRecipe, out: Path, resume: bool = False, on_event: OnEvent = ignore
) -> RobotStreamReport:
    """Learn `recipe.train.method`'s way through the tasks, into the run folder `out`.

    Raises:
        AegisError: inputs that do not fit, an existing run without `resume`, or a disk that cannot
            be written. Diverged: a loss or gradient that is not finite.
    """
    out = Path(out)
    folder.check(out, recipe, resume)
    if stream_files.is_done(out):
        return robot_files.report(out)
    source = questions(recipe, on_event)  # a bad set shows before anything is recorded
    built = build(recipe, out, on_event)
    built.question_files = source.sha256
    evaluator = Evaluator(built, source, on_event)
    optimizer = None
    if (out / state.STATE).exists():
        optimizer = state.restore(built)
        stream.truncate_metrics(built)
    else:
        folder.begin(out, recipe)
        built.place.vqa.append(evaluator.vqa())
    _learn(built, evaluator, optimizer, on_event)
    return _conclude(built)


def build(recipe: RobotStreamRecipe, out: Path, on_event: OnEvent = ignore) -> RobotRun:
    """Backbone, demonstrations and learner; demonstrations that are not given are recorded, unless
    they are there.

    Raises:
        AegisError: inputs that do not fit together; nothing has been recorded then.
    """
    gl.check()
    for task in recipe.tasks:
        sim.check(task)
    learner = learners.get(recipe.train.method)
    backbone = backbones.load(recipe.backbone).to(devices.pick()).eval()
    for task in recipe.tasks:
        _check_words(backbone, task)
    demos = tuple(_demos(recipe, i, backbone, out, on_event) for i in range(len(recipe.tasks)))
    fingerprint = backbone.fingerprint()
    scales = [d.scales(recipe.train.normalization) for d in demos]
    widest = (max(len(both[k].mean) for both in scales) for k in (0, 1))
    policies = robots.share(
        backbone, assemble.expert_shape(backbone, recipe, *widest), scales, recipe.seed
    )
    sites = robots.route(policies[0]) if learner.trains == "experts" else {}
    return RobotRun(
        recipe=recipe,
        learner=learner,
        sites=sites,
        fingerprint=fingerprint,
        out=out,
        policies=policies,
        demos=demos,
    )


def _check_words(backbone: Backbone, task: str) -> None:
    """Raise AegisError unless the backbone knows the words of a simulated task's instructions."""
    size = backbone.image_size or 64
    picture = torch.zeros(1, size, size, 3, dtype=torch.uint8)
    for template in sim.make(task).spec.templates:
        backbone.prepare(picture, [template.format(color=COLORS[0])])


def _demos(
    recipe: RobotStreamRecipe, number: int, backbone: Backbone, out: Path, on_event: OnEvent
) -> demonstrations.Demonstrations:
    """Of one task, whose instructions the backbone can read."""
    settings, task = recipe.demos, recipe.tasks[number]
    if settings.paths is not None:
        path = Path(settings.paths[number])
    else:
        asked = Demos(episodes=settings.episodes, noise=settings.noise, seed=settings.seed)
        home = out.parent / "demos"
        files.make_folder(home)
        path = StageRecords(home, on_event).demonstrations(task, asked).path
    found = demonstrations.load(
        path,
        recipe.train.validation_share,
        recipe.seed,
        None,
        backbone.image_size,
        on_event=on_event,
    )
    if found.task != task:
        of = f"'{found.task}'" if found.task else "no simulated task"
        said = f"demonstrations of {of} in '{path}' for the task '{task}'"
        raise AegisError(said, "one and the same task", f"record with: aegis demos {task}")
    for (
        text
    ) in found.instructions:  # a word that the backbone does not know ends no training half-way
        backbone.prepare(found.images(torch.zeros(1, dtype=torch.int64)), [text])
    return found


def _learn(
    run: RobotRun, evaluator: Evaluator, optimizer: torch.optim.Optimizer | None, on_event: OnEvent
) -> None:
    """The rest of the stream."""
    while run.place.task < len(run.names):
        place = run.place
        record = loop.learn(run, [], optimizer, on_event)
        started = time.perf_counter()
        place.records.append(json.loads(files.canonical(dataclasses.asdict(record))))
        place.oracle.append(evaluator.row(place.task))
        place.vqa.append(evaluator.vqa())
        line = {
            "task": place.task,
            "step": run.recipe.train.steps,
            "validation_loss": _validation_loss(run),
        }
        found = {"validation loss": line["validation_loss"], "VQA cross-entropy": place.vqa[-1][1]}
        check_finite(
            found,
            f"after task '{run.names[place.task]}'",
            run.slower(run.parameters()),
            line["step"],
        )
        folder.append_metrics(run.out, line | {"seconds": time.perf_counter() - started})
        run.place, optimizer = place.next_task(), None
        if run.place.task < len(run.names):
            state.save(run, [])
            robot_files.write_matrix(run.out, _report(run))
        shown = {"success": place.oracle[-1][place.task]}
        on_event(Progress("stream", run.place.task, len(run.names), "tasks", shown))


def _validation_loss(run: RobotRun) -> float:
    """Of the task just learned, on held-out episodes."""
    number = run.place.task
    run.activate(number)
    noise = robots.generator(run.recipe.seed, number * run.recipe.train.steps, robots.VALIDATION)
    return train.validation_loss(
        run.policies[number].eval(), run.demos[number], run.recipe.train, noise
    )


def _report(run: RobotRun) -> RobotStreamReport:
    """Of the tasks learned so far."""
    place, recipe = run.place, run.recipe
    return robot_report.assemble(
        recipe.name,
        recipe.train.method,
        str(run.out),
        stream_files.minutes(run.out),
        [stream_report.record_from(raw) for raw in place.records],
        place.oracle,
        place.vqa,
        run.inputs,
    )


def _conclude(run: RobotRun) -> RobotStreamReport:
    """Write what came out."""
    report = _report(run)
    robot_files.write(run, report)
    (run.out / state.STATE).unlink(missing_ok=True)
    return report
