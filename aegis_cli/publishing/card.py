"""A policy's model card: what it still knows, how well it acts, and how it came to be.

Every figure was written into the run by `aegis probe`, `aegis rollout`, `aegis evaluate` or `aegis
run`.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from aegis_cli import inspection, methods, recipes, sim
from aegis_cli.common import artifacts
from aegis_cli.common.version import __version__
from aegis_cli.continual import files as stream_files
from aegis_cli.continual import learners, robots
from aegis_cli.continual.report import ErrorMatrix, SuccessMatrix
from aegis_cli.evaluation.results import (
    PlayedResult,
    Result,
    evaluated_on,
    question_set,
    told_apart,
)
from aegis_cli.inspection import InspectReport
from aegis_cli.models import lerobot_folder
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Recipe, RobotStreamRecipe
from aegis_cli.sim import libero_table
from aegis_cli.training import checkpoint, freezing
from aegis_cli.training.card import model, without_folders, without_places

NAME = "README.md"
LEROBOT, AEGIS = "lerobot", "aegis"

_AVERAGED = " The weights are an exponential moving average of the training's, of decay {:g}."

_CARD = """---
{front}
---

# {title}

A robot policy made of the vision-language model {model} and an action expert that reads it,
fine-tuned by Aegis {version} with the method `{method}`:
{summary}.

## What the VLM still knows

{knowledge}

## How the policy acts

{acting}

## Training

{steps} steps, of {batch} frames each, seed {seed}; learning rate {backbone_lr:g} for the backbone
and {expert_lr:g} for the expert. Options of the method: {options}.{frozen}{averaged}{merged}

{stored}

By sha256:

{inputs}

## Use

{use}
"""

_CARD_OF_TASK = """---
{front}
---

# {title}

A robot policy made of the vision-language model {model} and an action expert that reads it.
It is the policy of one task, {task}, of a stream that Aegis {version} let one model learn task
after task with the method `{method}`: {tasks}.

## What the VLM still knows

{knowledge}

## How the policy acts

{acting}

## Training

{steps} steps a task, of {batch} frames each, seed {seed}. Options of the method: {options}.{frozen}

{stored}

By sha256:

{inputs}

## Use

{use}
"""

_USE = {
    AEGIS: """```sh
{probe}
{act}
```

`recipe-of-training.yaml` is the recipe that it was trained by.

```python
from aegis_cli import load_policy

policy = load_policy("{repo}")
```""",
    LEROBOT: """LeRobot loads it with {plugins}, Aegis without LeRobot:

```sh
{lerobot}
{probe}
{act}
```""",
}


@dataclass(frozen=True)
class Stored:
    """The name of the VLM weights' dtype, and whether rounding to it lost precision."""

    dtype: str
    rounded: bool

    def __str__(self) -> str:
        said = f"The VLM's weights are stored in {self.dtype}."
        if self.rounded:
            said += " Any figures above are of the weights in float32, before they were rounded."
        return said


def text(
    run: Path, at: Path, form: str, repo: str, stored: Stored, cameras: Sequence[str] = ()
) -> str:
    """The card of the checkpoint `at` of a run.

    Args:
        form: AEGIS for a checkpoint as it is, LEROBOT for one in LeRobot's layout.
        repo: where others find the policy, ORG/NAME on the hub.
        stored: how the weights beside the card are stored.
        cameras: LeRobot's names of the images, in order; empty for the task's own camera.

    Raises:
        AegisError: a run that is damaged.
    """
    # Results come from the checkpoint, settings from its run.
    recipe = recipes.load(run / "recipe.yaml")
    found = _measured(run, at)
    facts = found.facts
    # `aegis run` trains several methods by one recipe; each run's own recipe has its method.
    options = without_places(recipes.options(recipe))
    merge, decay = facts.get("merge"), recipe.train.ema_decay
    meta = cast(PolicyMeta, artifacts.read_header(at / checkpoint.EXPERT).meta)
    # Others have the model that an earlier run started from, but not that run.
    began = meta.get("began_as", recipe.backbone)
    known = dataclasses.replace(recipe, backbone=began, probe=_asked(found, recipe))
    looks_by = _looks_by(meta, facts["task"])
    return _CARD.format(
        front=_front_matter(form, facts.get("base_model"), facts.get("dataset")),
        title=f"{recipe.name}: {facts['task'] or 'a robot'} by {found.method}",
        model=model(recipe, meta.get("began_as")),
        version=__version__,
        method=recipe.train.method,
        summary=methods.get(recipe.train.method).summary,
        knowledge="\n".join(_knowledge(found, recipe)),
        acting="\n".join(_acting(found)),
        steps=inspection.steps_taken(checkpoint.step_of(at), recipe.train.steps),
        batch=recipe.train.batch_size,
        seed=recipe.seed,
        backbone_lr=recipe.train.backbone_lr,
        expert_lr=recipe.train.expert_lr,
        options=f"`{json.dumps(options, sort_keys=True)}`" if options else "none",
        frozen=freezing.sentence(recipe.train.freeze, before=" "),
        averaged="" if decay is None else _AVERAGED.format(decay),
        merged=_merged(merge),
        stored=stored,
        inputs="\n".join(f"- {name}: `{digest}`" for name, digest in _inputs(at, recipe)),
        use=_use(form, repo, known, facts["task"], cameras, looks_by, meta.get("fps")),
    )


def of_stream(
    run: Path,
    number: int,
    form: str,
    repo: str,
    stored: Stored,
    meta: PolicyMeta,
    cameras: Sequence[str] = (),
) -> str:
    """The card of one task's policy in a stream of robot tasks.

    Args:
        number: the task's number.
        form, repo, stored, cameras: as for `text`.
        meta: the policy's.

    Raises:
        AegisError: a run that is damaged.
    """
    recipe = recipes.load(run / "recipe.yaml", kind=RobotStreamRecipe)
    found, task = stream_files.read(run), recipe.tasks[number]
    assert isinstance(found, SuccessMatrix | ErrorMatrix)
    options = without_places(recipes.options(recipe))
    header = artifacts.read_header(run / robots.ACTION_EXPERT)
    digests = sorted(inputs_of_task(header.inputs, task).items())
    looks_by = _looks_by(meta, meta["task"])
    return _CARD_OF_TASK.format(
        front=_front_matter(form, meta.get("base_model"), meta.get("dataset")),
        title=f"{recipe.name}: {task} by {recipe.train.method}",
        model=model(recipe, None),
        task=task,
        version=__version__,
        method=recipe.train.method,
        tasks=", ".join(recipe.tasks),
        knowledge="\n".join(_known_after_stream(found, recipe, repo)),
        acting="\n".join(_acting_of_task(found, number)),
        steps=f"{recipe.train.steps:,}",
        batch=recipe.train.batch_size,
        seed=recipe.seed,
        options=f"`{json.dumps(options, sort_keys=True)}`" if options else "none",
        frozen=freezing.sentence(recipe.train.freeze, before=" "),
        stored=stored,
        inputs="\n".join(f"- {name}: `{digest}`" for name, digest in digests),
        use=_use(form, repo, recipe, meta["task"], cameras, looks_by, meta.get("fps")),
    )


def inputs_of_task(inputs: Mapping[str, str], task: str) -> dict[str, str]:
    """The inputs of one task of a stream's run, named like those of a single policy."""
    found = {"backbone": inputs["backbone"]} if "backbone" in inputs else {}
    demos = inputs.get(f"demos of {task}")
    return found if demos is None else {**found, "demos": demos}


def _known_after_stream(
    found: SuccessMatrix | ErrorMatrix, recipe: RobotStreamRecipe, repo: str
) -> Iterator[str]:
    """The stream's results for the VLM, if this policy has the same VLM."""
    if learners.get(recipe.train.method).trains != "model":
        yield "Not measured: the task's low-rank terms are part of its weights here, and the stream"
        yield f"asked it without them. `{_probe_command(repo, recipe)}` does it."
        return
    before, after = found.vqa[0].accuracy, found.vqa[-1].accuracy
    asked = without_folders(recipe.probe.only_set)
    yield f"Accuracy on questions of `{asked}`: {_percent(before)} before the stream,"
    yield f"{_percent(after)} after its last task."


def _acting_of_task(found: SuccessMatrix | ErrorMatrix, number: int) -> Iterator[str]:
    """The stream's results for the task, measured after the last task."""
    figure = found.measured_rows[-1][number]
    if isinstance(found, SuccessMatrix):
        yield f"Success, or a suite task's share of the highest return: {_percent(figure)}."
        return
    ends, held = found.error_intervals[-1][number], found.hold_errors[number]
    within = "" if ends is None else f" ({ends[0]:.3f} to {ends[1]:.3f})"
    hold = "" if held is None else f"; that of holding the position is {held:.3f}"
    yield f"The open-loop error at held-out frames is {figure:.3f}{within}{hold}. Each prediction"
    yield "begins at a recorded frame, and nothing is executed. The error is squared, over the"
    yield "variance of the training's actions: their mean has 1."


def _asked(found: InspectReport, recipe: Recipe) -> recipes.Probe:
    """The probe of the card's first figures; the recipe's if there are none."""
    first = recipe.probe.of_each_set()[0]
    if not found.probes or not found.probes[0].settings:  # `aegis run` probes by the recipe
        return first
    probed = found.probes[0]
    keys = ("vqa", "ask", "questions", "seed")
    told = {name: probed.settings[name] for name in keys if name in probed.settings}
    return dataclasses.replace(first, **told, skip_bad=bool(probed.figures.get("skipped")))


def _merged(merge: Mapping[str, Any] | None) -> str:
    """A sentence about a merge after the training; empty without one."""
    if not merge:
        return ""
    return f" Merged afterwards: `{json.dumps(without_places(merge), sort_keys=True)}`."


def _looks_by(meta: PolicyMeta, task: str | None) -> Sequence[str]:
    """The cameras of its simulated task that a checkpoint's policy uses, by the task's names.

    Empty for the task's own camera, if there is no task, and if the policy has several cameras,
    except in LIBERO's tasks, where LeRobot supports several.
    """
    several = len(meta.get("cameras", ())) > 1
    if task is None or (several and sim.of_datasets(task) is None):
        return ()
    return checkpoint.cameras_of(meta, task)


def _use(
    form: str,
    repo: str,
    recipe: Recipe | RobotStreamRecipe,
    task: str | None,
    cameras: Sequence[str] = (),
    looks_by: Sequence[str] = (),
    fps: float | None = None,
) -> str:
    """How others can use the policy; without a simulated task it can only be evaluated."""
    act = f"aegis rollout {repo}" if task else f"aegis evaluate {repo} --demos DEMONSTRATIONS"
    plugins = ["lerobot_policy_aegis"]
    # A real robot needs no simulation, and LeRobot itself has LIBERO's.
    if task is not None and sim.of_datasets(task) is None:
        plugins.append("lerobot_env_aegis")
    return _USE[form].format(
        repo=repo,
        probe=_probe_command(repo, recipe),
        act=act,
        plugins=" and ".join(f"`{name}`" for name in plugins),
        lerobot=_lerobot_command(repo, task, cameras, looks_by, fps),
    )


def _probe_command(repo: str, recipe: Recipe | RobotStreamRecipe) -> str:
    """The command that repeats the run's own probe without its recipe."""
    probe = recipe.probe.of_each_set()[0]
    # Nobody else has this machine's folders, so only the last part of a path is shown.
    words = [*map(without_folders, (recipe.backbone, *probe.asking))]
    usual = recipes.Probe()  # options at their defaults are left out
    if probe.questions != usual.questions:
        words += ["--questions", str(probe.questions)]
    if probe.seed != usual.seed:
        words += ["--seed", str(probe.seed)]
    return shlex.join(["aegis", "probe", repo, "--baseline", *words])


def _lerobot_command(
    repo: str,
    task: str | None,
    cameras: Sequence[str],
    looks_by: Sequence[str],
    fps: float | None,
) -> str:
    """LeRobot's command that runs the policy, in our simulation or on a robot."""
    if task is None:
        rate = "" if fps is None else f" --fps={fps:g}"  # LeRobot's default is 30
        return (
            f"lerobot-rollout --strategy.type=base --policy.path={repo} --robot.type=ROBOT "
            f"--task=INSTRUCTION{rate}"
        )
    if sim.of_datasets(task) is not None:
        return _libero_command(repo, task, cameras, looks_by)
    if len(cameras) > 1:
        return f"# lerobot-eval cannot: our tasks have one camera there, the policy {len(cameras)}"
    command = f"lerobot-eval --policy.path={repo} --env.type=aegis --env.task={task}"
    own = sim.cameras(task)[0]  # the default of LeRobot's environment
    named = [name.removeprefix(lerobot_folder.IMAGES) for name in cameras] or [own]
    if looks_by and named != [*looks_by]:  # another name would rename the task's own camera
        names = {lerobot_folder.picture_key(looks_by[0]): lerobot_folder.picture_key(named[0])}
        return f"{command} --env.camera={looks_by[0]} --rename_map={shlex.quote(json.dumps(names))}"
    return command if named == [own] else f"{command} --env.camera={shlex.quote(named[0])}"


def _libero_command(repo: str, task: str, cameras: Sequence[str], looks_by: Sequence[str]) -> str:
    """LeRobot's command for its own LIBERO environment, whose cameras are image and image2."""
    places = [libero_table.place(member) for member in sim.members(task)]
    suites = ",".join(dict.fromkeys(f"libero_{suite}" for suite, _ in places))
    command = f"lerobot-eval --policy.path={repo} --env.type=libero --env.task={suites}"
    if len(places) == 1:
        command += f" --env.task_ids='[{places[0][1]}]'"
    shown = {"agentview": "image", "robot0_eye_in_hand": "image2"}
    asked = [shown[libero_table.CAMERAS[name]] for name in looks_by or sim.cameras(task)[:1]]
    named = zip(map(lerobot_folder.picture_key, asked), cameras, strict=False)
    renamed = {own: called for own, called in named if own != called}
    return f"{command} --rename_map={shlex.quote(json.dumps(renamed))}" if renamed else command


def _measured(run: Path, at: Path) -> InspectReport:
    """What is known about a checkpoint; results of the last one are those of its run."""
    is_last = at.resolve() == checkpoint.last(run).resolve()
    found = inspection.run(run if is_last else at)
    assert isinstance(found, InspectReport)  # a stream's run was refused earlier
    return found


def _front_matter(form: str, base_model: str | None, dataset: str | list[str] | None) -> str:
    """The lines that the hub reads, with its ids of the backbone and the demonstrations."""
    lines = [
        f"library_name: {'lerobot' if form == LEROBOT else 'aegis-vla'}",
        "pipeline_tag: robotics",
        "tags: [robotics, vision-language-action, aegis]",
    ]
    if base_model is not None:
        lines.append(f"base_model: {base_model}")
    if dataset is not None:
        named = [dataset] if isinstance(dataset, str) else dataset
        lines.append(f"datasets: [{', '.join(named)}]")
    return "\n".join(lines)


def _knowledge(found: InspectReport, recipe: Recipe) -> Iterator[str]:
    """Accuracy on questions before and after, and the gate's verdict."""
    if not found.probes:
        yield "Not measured. `aegis probe RUN --baseline BACKBONE` does it."
        return
    yield "| questions | number | before | after | drop, with its 95 % interval |"
    yield "|---|---|---|---|---|"
    for result in found.probes:
        yield _probe_row(result, recipe)
    yield ""
    yield _verdict(found.gate, found.probes, recipe)


def _probe_row(result: Result, recipe: Recipe) -> str:
    """The table's row of one set of questions."""
    figures = result.figures
    asked = question_set(result, recipe)
    drop = "not measured"
    if figures.get("drop_points") is not None:  # a probe without --baseline has none
        low, high = figures["drop_interval"]
        drop = f"{figures['drop_points']:.2f} points ({low:.2f} to {high:.2f})"
    before = figures.get("baseline_accuracy")
    cells = [
        f"`{without_folders(asked)}`",
        f"{figures['questions']:,}",
        "not measured" if before is None else _percent(before),
        _share(figures["accuracy"], figures["interval"]),
        drop,
    ]
    return f"| {' | '.join(cells)} |"


def _verdict(gate: bool | None, probed: tuple[Result, ...], recipe: Recipe) -> str:
    """Whether the gate was passed, and what it allowed."""
    if gate is None:
        return "No gate was set."
    # A probe may have had its own limit instead of the recipe's.
    limits = [found.settings.get("max_drop", recipe.probe.max_drop) for found in probed]
    limit = next((limit for limit in limits if limit is not None), None)
    allowed = "" if limit is None else f" (a drop of at most {limit:g} points)"
    return f"Gate{allowed}: **{'passed' if gate else 'failed'}**."


def _acting(found: InspectReport) -> Iterator[str]:
    """Success, or the mean return, in simulated episodes, and open-loop errors."""
    if not found.rollouts and not found.open_loops:
        yield "Not measured. `aegis rollout RUN` does it for simulated tasks, in open loop"
        yield "`aegis evaluate RUN --demos DEMONSTRATIONS` for any."
    if found.rollouts:
        yield from _played(found.rollouts)
    if found.rollouts and found.open_loops:
        yield ""
    if found.open_loops:
        yield from _evaluated(found.open_loops)


def _evaluated(open_loops: Sequence[Result]) -> Iterator[str]:
    """Errors on recorded episodes, and what they mean."""
    yield "| recorded | frames | open-loop error, with its 95 % interval |"
    yield "|---|---|---|"
    for result in open_loops:
        figures = result.figures
        error, interval = figures["relative_error"], figures["relative_interval"]
        cell = "actions did not vary" if error is None else f"{error:.3f}"
        if interval is not None:
            cell += f" ({interval[0]:.3f} to {interval[1]:.3f})"
        if figures.get("hold_error") is not None:
            cell += f"; hold's {figures['hold_error']:.3f}"
        yield f"| {evaluated_on(figures)} | {figures['frames']:,} | {cell} |"
    yield ""
    yield "Open loop: each prediction begins at a recorded frame, and nothing is executed. The"
    yield "error is squared, over the variance of the training's actions: their mean has 1."
    if any(result.figures.get("hold_error") is not None for result in open_loops):
        yield "Hold is the current position, repeated."


def _played(rollouts: Sequence[PlayedResult]) -> Iterator[str]:
    """A table of rollouts."""
    yield "| task | colours | episodes | success, with its 95 % interval |"
    yield "|---|---|---|---|"
    # The settings in which they differ, if two have the same task and colours.
    apart = told_apart([result.played for result in rollouts])
    for result, otherwise in zip(rollouts, apart, strict=True):
        figures = result.figures
        cells = [figures["task"], figures.get("colors") or "", f"{figures['episodes']:,}"]
        cells[-1] += f" ({otherwise})" if otherwise else ""
        yield f"| {' | '.join([*cells, _success(figures)])} |"
        for suite, part in (figures.get("suites") or {}).items():
            share = _share(part["success"], part["interval"])
            yield f"| {suite}, of these |  | {part['episodes']:,} | {share} |"


def _success(figures: Mapping[str, Any]) -> str:
    """A rollout's success rate, or its mean return if the task is measured by returns."""
    if figures.get("success") is not None:
        return _share(figures["success"], figures["interval"])
    said, interval = f"mean return {figures['mean_return']:.4g}", figures.get("return_interval")
    if interval is not None:  # a single episode has none
        said += f" ({interval[0]:.4g} to {interval[1]:.4g})"
    share = figures.get("return_share")
    return said if share is None else f"{said}, {_percent(share)} of the highest there is"


def _share(share: float, interval: tuple[float, float]) -> str:
    """A share in [0, 1] with its interval, in percent."""
    return f"{_percent(share)} ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _inputs(at: Path, recipe: Recipe) -> list[tuple[str, str]]:
    """Name and sha256 of each input that the policy was made from.

    An anchor is left out if the method does not read one.
    """
    named = artifacts.read_header(at / checkpoint.EXPERT).inputs.items()
    reads = recipe.reads_anchor(recipe.train.method)
    return sorted((name, digest) for name, digest in named if name != "anchor" or reads)
