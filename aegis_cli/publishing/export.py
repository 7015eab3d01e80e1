"""`aegis export`: a trained policy as others use it, its weights in the type that they came in.

A checkpoint has float32, to train on. A model that came in bfloat16 goes out in bfloat16 again.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from aegis_cli import recipes, sim
from aegis_cli.common import artifacts, commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore, loading_told
from aegis_cli.common.files import check_utf8, folder_aside, make_folder, put, write_text
from aegis_cli.continual import plain, robots
from aegis_cli.data.lerobot import layout
from aegis_cli.inspection import steps_taken
from aegis_cli.models import download, lerobot_folder
from aegis_cli.models.backbones.base import FLOAT32, STORED_TYPES, Backbone
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.publishing import card
from aegis_cli.recipes import RobotStreamRecipe
from aegis_cli.recipes.strict_yaml import dump
from aegis_cli.training import checkpoint
from aegis_cli.training import folder as run_folder
from aegis_cli.training.card import without_places

RECIPE = "recipe-of-training.yaml"  # `recipe.yaml` would make the folder a run without its log
SOURCE = "source"  # the type that the backbone was stored in before it was trained


@dataclass(frozen=True)
class ExportReport:
    """What was written, and how others name what the policy takes.

    Attributes:
        pictures: LeRobot's names of them; empty in another layout.
        dtype: name of the type that the backbone's weights are in.
        rounded: whether they have lost digits by it.
        steps: after which of its run the policy was; None where it has been taken out of one, as
            `planned_steps` is then, which the run's recipe asks for.
    """

    out: str
    format: str
    dtype: str
    rounded: bool
    task: str | None
    method: str
    pictures: tuple[str, ...]
    chunk: int
    replan: int
    parameters: int
    steps: int | None
    planned_steps: int | None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    run_path: Path,
    out: Path,
    form: str = card.LEROBOT,
    camera: str | None = None,
    repo: str | None = None,
    dtype: str = SOURCE,
    on_event: OnEvent = ignore,
    task: str | None = None,
) -> ExportReport:
    """Write a run's policy, or that of a checkpoint, as a folder for others.

    Its model card is written too, and in our own layout the recipe, except for a checkpoint that
    has been taken out of its run.

    Args:
        out: a new folder; nothing is left of it where the export fails.
        form: the layout, LeRobot's or that of our checkpoints.
        camera: what LeRobot calls the picture of a policy with a single camera; None: as in
            training, `top` where it had no name.
        repo: where others will find the policy, for the card.
        dtype: of the backbone's weights, SOURCE or one of `STORED_TYPES`.
        task: whose policy, of a stream of robot tasks.

    Raises:
        AegisError: no policy, a task of a stream that is none of plain weights, a folder that is
            there already, a camera's name where none is to be given, or a type that the backbone
            cannot have.
    """
    # All that can be refused by looking is, before a model of gigabytes is loaded.
    of_stream = recipes.is_robot_stream_run(run_path)
    number = plain.check(run_path, task) if of_stream else None
    if os.path.lexists(out):  # a link that leads nowhere too
        raise AegisError(f"'{out}' is there already", "a new folder", "choose another --out")
    check_utf8(out, "choose another --out")
    if camera is not None and form != card.LEROBOT:
        raise AegisError(
            f"--camera {camera} with --format {form}",
            "a name for LeRobot",
            "leave --camera out, or give --format lerobot",
        )
    if number is None:
        run_path = download.locate(run_path)
    with loading_told("export", on_event):
        loaded = _Loaded.of(run_path, number)
    policy, meta = loaded.policy, loaded.meta
    if loaded.stream is None:
        checkpoint.check_task(meta, task)
        steps, planned = warn_of_steps_left(run_path, "export", on_event)
        warn_of_a_merge(run_path, "export", on_event)
    else:
        steps = planned = loaded.stream.train.steps
    meta, rounded = _rounded(policy.backbone, meta, dtype)
    if "merge" in meta:  # which models it was between, without where they lie here
        meta["merge"] = without_places(meta["merge"])
    cameras = _cameras(camera, meta)
    if camera is not None:
        meta = _renamed(meta, camera)
    # Written beside it under another name, so that an export that fails leaves nothing.
    make_folder(out.parent)
    with checkpoint.writing(out), folder_aside(out) as aside:
        if form == card.LEROBOT:
            lerobot_folder.write(aside, policy, meta, cameras)
        else:
            _write_checkpoint(aside, run_path, policy, meta, loaded.task)
        stored = card.Stored(meta.get("stored", FLOAT32), rounded)
        called = repo or f"ORG/{_hub_name(out.name)}"
        if number is None:
            _write_card(aside, run_path, form, called, stored, cameras)
        else:
            text = card.of_stream(run_path, number, form, called, stored, meta, cameras)
            _write_texts(aside, run_path, form, text)
        put(aside, out)
    return ExportReport(
        str(out),
        form,
        stored.dtype,
        rounded,
        meta["task"],
        meta["method"],
        _pictures(cameras) if form == card.LEROBOT else (),
        policy.expert.shape.chunk,
        meta["replan"],
        sum(p.numel() for p in policy.parameters()),
        steps,
        planned,
    )


class _Loaded(NamedTuple):
    """A policy to be written.

    Attributes:
        stream: the recipe of the stream that it is of; None of the run of one policy.
        task: whose policy it is, of a stream.
    """

    policy: Policy
    meta: PolicyMeta
    stream: RobotStreamRecipe | None = None
    task: str | None = None

    @classmethod
    def of(cls, run: Path, number: int | None) -> _Loaded:
        """The policy of a run, or of the task of that number of a stream's."""
        if number is None:
            return cls(*checkpoint.load_policy(run))
        stream = robots.load_to_act(run)
        policy, meta = plain.policy(stream, number), stream.meta(number)
        return cls(policy, meta, stream.recipe, stream.names[number])


def warn_of_steps_left(
    run: Path, stage: str, on_event: OnEvent
) -> tuple[int, int] | tuple[None, None]:
    """Say so where the last policy of a run that is not finished is given to others.

    An earlier checkpoint that a user names is what the user wants.

    Returns:
        The steps that the policy has behind it, and those that its run's recipe asks for; None for
        each of a policy outside of its run.
    """
    if lerobot_folder.is_policy(run):
        return None, None
    at = checkpoint.chosen(run)
    home = checkpoint.run_of(at)
    if home is None:
        return None, None
    steps, planned = checkpoint.step_of(at), recipes.load(home / "recipe.yaml").train.steps
    if steps < planned and at.resolve() == checkpoint.last(home).resolve():
        taken = steps_taken(steps, planned)
        text = f"'{home}' is not finished: {taken} steps"
        if (at / checkpoint.STATE).is_file():  # one that was merged has none
            text += f"; {commands.aegis('train', home)} goes on"
        on_event(Warned(stage, text))
    return steps, planned


def warn_of_a_merge(run: Path, stage: str, on_event: OnEvent) -> None:
    """Say so where `aegis run` has merged a run, of which the weights before are given to others.

    What was measured is what it was merged into.
    """
    if lerobot_folder.is_policy(run):
        return
    home = checkpoint.run_of(checkpoint.chosen(run))
    merged = None if home is None else run_folder.merged_in(home)
    if merged is not None:
        text = f"'{home}' has the weights before their merge; what was merged and measured"
        on_event(Warned(stage, f"{text} is in '{merged}'"))


def _cameras(camera: str | None, meta: PolicyMeta) -> list[str]:
    """What LeRobot calls the pictures: the policy's own names, or for a single camera `camera`.

    Raises:
        AegisError: a name where the policy has several cameras, or one that no feature can have.
    """
    # Without a name of its own the only picture has the one that LeRobot's folder gives it.
    named = list(meta.get("cameras", ())) or [lerobot_folder.CAMERA]
    if camera is None:
        return named
    if len(named) > 1:
        raise AegisError(
            f"--camera {camera} for a policy of {', '.join(named)}",
            "a policy of one camera",
            "leave --camera out",
        )
    if not camera.strip() or not camera.isprintable() or "/" in camera:
        raise AegisError(
            f"--camera {camera!r}",
            "a camera's name, without '/', which no feature of LeRobot has",
            "e.g. --camera front",
        )
    return [camera]


def _renamed(meta: PolicyMeta, camera: str) -> PolicyMeta:
    """What a user has to know of a policy of one camera that is called otherwise from now on.

    A simulated task, and the demonstrations, call it as they did.
    """
    task = meta["task"]
    named = meta.get("cameras") or ([] if task is None else sim.cameras(task))
    if not named:  # nobody has called it anything
        return meta
    now = layout.short(named[0])
    known = meta.get("rename", {})
    # A renaming is from the demonstrations' name to the policy's: this camera's is replaced.
    others = {own: new for own, new in known.items() if layout.short(new) != now}
    # Of a camera that was renamed already, the name that it had at first.
    first = next((layout.short(own) for own in known if own not in others), now)
    found = meta.copy()
    found["rename"] = {**others, first: layout.short(camera)}
    return found


def refuse_stream(run: Path) -> None:
    """Raise AegisError for the run of a stream of robot tasks, which has a policy for each."""
    if recipes.is_robot_stream_run(run):
        export = commands.aegis("export", run, "--task", "NAME", "--out", "FOLDER")
        raise AegisError(
            f"the run of a stream in '{run}', with a policy for each task",
            "one policy",
            f"write that of a task, and send its folder: {export}",
        )


def _rounded(backbone: Backbone, meta: PolicyMeta, dtype: str) -> tuple[PolicyMeta, bool]:
    """Round the backbone's weights to a type.

    Returns:
        What a user has to know, which names the type, and whether digits were lost.

    Raises:
        AegisError: the backbone has to be float32.
    """
    # A checkpoint of `train.weights: bf16` has bfloat16 itself, whatever it was made from.
    chosen = meta.get("stored", backbone.stored) if dtype == SOURCE else dtype
    now = meta.copy()
    now.pop("stored", None)
    if chosen == FLOAT32:
        return now, False
    if not backbone.rounds:
        raise AegisError(
            f"--dtype {dtype} for a policy with the embedded backbone",
            "a policy with a Hugging Face backbone",
            f"leave --dtype out, or give --dtype {FLOAT32}",
        )
    # References do for the weights of before: rounding gives each parameter new ones.
    before = [p.detach() for p in backbone.parameters()]
    backbone.round_weights(STORED_TYPES[chosen])
    after = backbone.parameters()
    lost = any(not torch.equal(a, b.float()) for a, b in zip(before, after, strict=True))
    now["stored"] = chosen
    return now, lost


def _write_checkpoint(
    folder: Path, run: Path, policy: Policy, meta: PolicyMeta, task: str | None = None
) -> None:
    """Write a policy as our checkpoints are, without what a training needs to go on.

    Args:
        task: whose policy it is, in the run of a stream.
    """
    # A folder in LeRobot's layout keeps no record of what its policy was made from.
    inputs: Mapping[str, str] = {}
    seed, about = None, ""
    if task is not None:
        header = artifacts.read_header(run / robots.ACTION_EXPERT)
        inputs, seed = card.inputs_of_task(header.inputs, task), header.seed
    elif not lerobot_folder.is_policy(run):
        at = checkpoint.chosen(run)
        header = artifacts.read_header(at / checkpoint.EXPERT)
        inputs, seed = header.inputs, header.seed
        readme = at / checkpoint.BACKBONE / card.NAME
        if readme.is_file():
            about = readme.read_text(encoding="utf-8")
    checkpoint.write_policy(folder, policy.backbone, policy, meta, inputs, seed, about)


def _pictures(cameras: Sequence[str]) -> tuple[str, ...]:
    """LeRobot's names of the pictures; a dataset's own, such as `observation.image`, stay."""
    return tuple(lerobot_folder.picture_key(name) for name in cameras)


def _hub_name(name: str) -> str:
    """A folder's name as a repository of the hub may be called, for commands on the card."""
    return re.sub(r"[^A-Za-z0-9_.]+|\.{2,}", "-", name).strip("-.") or "NAME"


def _write_card(
    folder: Path, run: Path, form: str, repo: str, stored: card.Stored, cameras: Sequence[str]
) -> None:
    """Write the model card of a run's policy; a policy without a run has nothing to say."""
    if lerobot_folder.is_policy(run):
        return
    at = checkpoint.chosen(run)
    home = checkpoint.run_of(at)
    if home is None:
        return
    _write_texts(folder, home, form, card.text(home, at, form, repo, stored, cameras))


def _write_texts(folder: Path, home: Path, form: str, text: str) -> None:
    """Write a card, and in our own layout beside it the recipe of the run, which it names."""
    write_text(folder / card.NAME, text)
    if form == card.AEGIS:
        write_text(folder / RECIPE, _recipe(home))


def _recipe(home: Path) -> str:
    """The recipe of the training, without the folders in which models and data lie here."""
    kept = yaml.safe_load((home / "recipe.yaml").read_text(encoding="utf-8"))
    return dump(without_places(kept))
