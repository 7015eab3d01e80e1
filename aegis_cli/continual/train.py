"""`aegis train` on a stream: its tasks one after the other, and after each the accuracy on all of
them.

    recipe.yaml  metrics.jsonl
    experts.safetensors  routing.safetensors   of a learner with experts
    encoder/                                   of one that trains the encoder itself
    accuracy_matrix.json  parameters.json  stream.json
    state.safetensors                          what --resume needs; gone when the stream is done

All but the metrics, which hold times, are the same bytes in every repetition, interrupted or not.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

from torch import Tensor

from aegis_cli.common import device as devices
from aegis_cli.common import files
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.continual import files as stream_files
from aegis_cli.continual import images, learners, loop, state
from aegis_cli.continual import report as stream_report
from aegis_cli.continual.report import StreamReport
from aegis_cli.continual.state import Base, Run
from aegis_cli.continual.stream_evaluate import Evaluator
from aegis_cli.core import gaussians, routing
from aegis_cli.models.backbones.dual import class_weights
from aegis_cli.recipes import VALIDATION, StreamRecipe
from aegis_cli.training import folder


def run(
    recipe: StreamRecipe, out: Path, resume: bool = False, on_event: OnEvent = ignore
) -> StreamReport:
    """Learn `recipe.train.method`'s way through the stream, into the run folder `out`.

    Raises:
        AegisError: inputs that do not fit, an existing run without `resume`, or a disk that cannot
            be written. Diverged: a loss or gradient that is not finite.
    """
    out = Path(out)
    folder.check(out, recipe, resume)
    if stream_files.is_done(out):
        return stream_files.report(out)
    built = build(recipe, out, on_event)
    optimizer = None
    if (out / state.STATE).exists():
        optimizer = state.restore(built)
        truncate_metrics(built)
    else:
        folder.begin(out, recipe)
    _learn(built, optimizer, on_event)
    return _conclude(built)


def build(recipe: StreamRecipe, out: Path, on_event: OnEvent = ignore) -> Run:
    """Encoder, tasks and learner; experts can be put beside the encoder's maps, and
    none are yet.
    """
    learner = learners.get(recipe.train.method)
    encoder = images.encoder(recipe.encoder).to(devices.pick()).eval()
    tasks = images.tasks(recipe, encoder.image_size, on_event)
    if recipe.split == VALIDATION:  # for choices, which must not see the test parts
        tasks = images.on_validation(tasks)
    fingerprint = encoder.fingerprint()
    encoder.requires_grad_(False)
    for (
        task
    ) in tasks:  # a name that the text tower cannot read is refused before anything is written
        class_weights(encoder, task.classes, task.templates)
    sites = routing.route(encoder, encoder.sites()) if learner.trains == "experts" else {}
    return Run(
        recipe=recipe,
        learner=learner,
        encoder=encoder,
        sites=sites,
        tasks=tasks,
        fingerprint=fingerprint,
        out=out,
        image_set=images.image_set(recipe),
    )


def _learn(run: Run, optimizer: object, on_event: OnEvent) -> None:
    """The rest of the stream."""
    evaluator = Evaluator(run.encoder, run.sites, run.tasks, run.learner)
    prototypes: list[Tensor] = []
    while run.place.task < len(run.tasks):
        place = run.place
        prototypes += _prototypes(run, evaluator, len(prototypes), place.task)
        _describe(run, evaluator)
        record = loop.learn(run, prototypes, optimizer, on_event)
        started = time.perf_counter()
        told, inferred = evaluator.row(place.task, run.gaussians)
        place.records.append(json.loads(files.canonical(dataclasses.asdict(record))))
        place.oracle.append(told)
        place.inferred.append(inferred)
        line = {
            "task": place.task,
            "step": run.recipe.train.steps,
            "seconds": time.perf_counter() - started,
        }
        folder.append_metrics(run.out, line)
        run.place, optimizer = place.next_task(), None
        if run.learner.trains != "nothing" and run.place.task < len(run.tasks):
            state.save(run, [])
        on_event(
            Progress(
                "stream", run.place.task, len(run.tasks), "tasks", {"accuracy": told[place.task]}
            )
        )


def _prototypes(run: Run, evaluator: Evaluator, known: int, task: int) -> list[Tensor]:
    """Mean features of the tasks from `known` to `task`, for a learner that asks for them."""
    new = range(known, task + 1) if run.learner.compares else ()
    return [evaluator.bare(run.tasks[i].train).double().mean(0).float().cpu() for i in new]


def _describe(run: Run, evaluator: Evaluator) -> None:
    """What tells the task that is about to be learned from the others; a learner with one state for
    all need not know.
    """
    if not run.learner.shared and len(run.gaussians) == run.place.task:
        settings = run.recipe.inference
        looks = evaluator.looks(run.tasks[run.place.task].train)
        run.gaussians.append(
            gaussians.fit(looks, settings.rank, settings.shrinkage, settings.quantile)
        )


def truncate_metrics(run: Base) -> None:
    """Forget what was logged after the state was written: a resumed run repeats those steps."""
    at = (run.place.task, run.place.step)
    kept = [
        line
        for line in folder.read_metrics(run.out, "task", "step")
        if (line["task"], line["step"]) <= at
    ]
    files.write_text(run.out / folder.METRICS, "".join(json.dumps(line) + "\n" for line in kept))


def _conclude(run: Run) -> StreamReport:
    """Write what came out; stream.json comes last and says that the run is done."""
    place, recipe = run.place, run.recipe
    report = stream_report.assemble(
        recipe.name,
        recipe.stream,
        recipe.split,
        recipe.train.method,
        str(run.out),
        stream_files.minutes(run.out),
        [stream_report.record_from(raw) for raw in place.records],
        place.oracle,
        place.inferred,
        sum(g.count() for g in run.gaussians),
        stream_files.measured_with(run),
    )
    stream_files.write(run, report)
    (run.out / state.STATE).unlink(missing_ok=True)
    return report
