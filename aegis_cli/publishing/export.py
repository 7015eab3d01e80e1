"""`aegis export`: write a trained policy for others, with weights in their original dtype.

A checkpoint has float32, for further training. A model that came in bfloat16 is exported in
bfloat16.
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
from aegis_cli.continual import places, plain, robots
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
SOURCE = "source"  # the dtype in which the backbone was stored before training


@dataclass(frozen=True)
class ExportReport:
    """What was written, and the names of the policy's inputs.

    Attributes:
        pictures: LeRobot's names of the images; empty in another layout.
        dtype: name of the dtype of the backbone's weights.
        rounded: whether rounding to it lost precision.
        steps: the policy's training steps, and planned_steps: those of the run's recipe; both None
            for a checkpoint outside a run.
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
    backbone: str | None = None,
) -> ExportReport:
    """Write the policy of a run or a checkpoint as a folder for others.

    Its model card is written too, and in our own layout the recipe, except for a checkpoint outside
    a run.

    Args:
        out: a new folder; if the export fails, nothing of it is left.
        form: the layout, LeRobot's or that of our checkpoints.
        camera: LeRobot's name of the image, for a policy with a single camera; None: as in
            training, or `top` if it had no name.
        repo: where others will find the policy, for the card.
        dtype: dtype of the backbone's weights, SOURCE or one of `STORED_TYPES`.
        task: the task of a stream of robot tasks whose policy is written.
        backbone: the new place of such a stream's backbone, if it has moved.

    Raises:
        AegisError: no policy, a stream's task whose policy is not plain weights, a folder that
            already exists, a camera's name where none can be given, or a dtype that the backbone
            cannot have.
    """
    # Everything that can be refused without loading gigabytes is refused first.
    of_stream = recipes.is_robot_stream_run(run_path)
    if backbone is not None and not of_stream:
        raise places.refuse(run_path)
    number = plain.check(run_path, task) if of_stream else None
    if os.path.lexists(out):  # also a broken link
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
        loaded = _Loaded.of(run_path, number, backbone)
    policy, meta = loaded.policy, loaded.meta
    if loaded.stream is None:
        checkpoint.check_task(meta, task)
        steps, planned = warn_of_steps_left(run_path, "export", on_event)
        warn_of_a_merge(run_path, "export", on_event)
    else:
        steps = planned = loaded.stream.train.steps
    meta, rounded = _rounded(policy.backbone, meta, dtype)
    if "merge" in meta:  # names of the merged models, without local paths
        meta["merge"] = without_places(meta["merge"])
    cameras = _cameras(camera, meta)
    if camera is not None:
        meta = _renamed(meta, camera)
    # Written under a temporary name beside it, so that a failed export leaves nothing.
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
        stream: the recipe of its stream; None for the run of one policy.
        task: the policy's task in a stream.
    """

    policy: Policy
    meta: PolicyMeta
    stream: RobotStreamRecipe | None = None
    task: str | None = None

    @classmethod
    def of(cls, run: Path, number: int | None, backbone: str | None) -> _Loaded:
        """The policy of a run, or of the numbered task of a stream's run."""
        if number is None:
            return cls(*checkpoint.load_policy(run))
        stream = robots.load_to_act(run, backbone)
        policy, meta = plain.policy(stream, number), stream.meta(number)
        return cls(policy, meta, stream.recipe, stream.names[number])


def warn_of_steps_left(
    run: Path, stage: str, on_event: OnEvent
) -> tuple[int, int] | tuple[None, None]:
    """Warn if the last policy of an unfinished run is given to others.

    For an earlier checkpoint there is no warning, since the user has named it.

    Returns:
        The policy's training steps, and those that its run's recipe asks for; None for both if the
        policy is outside a run.
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
        if (at / checkpoint.STATE).is_file():  # a merged one has no state
            text += f"; {commands.aegis('train', home)} goes on"
        on_event(Warned(stage, text))
    return steps, planned


def warn_of_a_merge(run: Path, stage: str, on_event: OnEvent) -> None:
    """Warn if `aegis run` has merged a run, but the weights before the merge are given to others.

    The measured weights are the merged ones.
    """
    if lerobot_folder.is_policy(run):
        return
    home = checkpoint.run_of(checkpoint.chosen(run))
    merged = None if home is None else run_folder.merged_in(home)
    if merged is not None:
        text = f"'{home}' has the weights before their merge; what was merged and measured"
        on_event(Warned(stage, f"{text} is in '{merged}'"))


def _cameras(camera: str | None, meta: PolicyMeta) -> list[str]:
    """LeRobot's names of the images: the policy's own names, or `camera` for a single camera.

    Raises:
        AegisError: a name for a policy with several cameras, or one that no feature can have.
    """
    # Without a name of its own, the only image gets the default of LeRobot's layout.
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
    """The metadata of a policy with one camera after that camera is renamed.

    A simulated task and the demonstrations keep their own name for it.
    """
    task = meta["task"]
    named = meta.get("cameras") or ([] if task is None else sim.cameras(task))
    if not named:  # it has no name yet
        return meta
    now = layout.short(named[0])
    known = meta.get("rename", {})
    # A renaming maps the demonstrations' name to the policy's; this camera's is replaced.
    others = {own: new for own, new in known.items() if layout.short(new) != now}
    # If the camera was renamed before, its original name.
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
    """Round the backbone's weights to a dtype.

    Returns:
        The metadata, which names the dtype, and whether precision was lost.

    Raises:
        AegisError: the backbone has to be float32.
    """
    # A checkpoint of `train.weights: bf16` is in bfloat16, whatever it was made from.
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
    # References to the old weights are enough, since rounding allocates new ones.
    before = [p.detach() for p in backbone.parameters()]
    backbone.round_weights(STORED_TYPES[chosen])
    after = backbone.parameters()
    lost = any(not torch.equal(a, b.float()) for a, b in zip(before, after, strict=True))
    now["stored"] = chosen
    return now, lost


def _write_checkpoint(
    folder: Path, run: Path, policy: Policy, meta: PolicyMeta, task: str | None = None
) -> None:
    """Write a policy in the layout of our checkpoints, without the training state.

    Args:
        task: the policy's task in the run of a stream.
    """
    # A folder in LeRobot's layout does not record what its policy was made from.
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
    """LeRobot's names of the images; a dataset's own, such as `observation.image`, are kept."""
    return tuple(lerobot_folder.picture_key(name) for name in cameras)


def _hub_name(name: str) -> str:
    """A folder's name as a valid repository name on the hub, for commands on the card."""
    return re.sub(r"[^A-Za-z0-9_.]+|\.{2,}", "-", name).strip("-.") or "NAME"


def _write_card(
    folder: Path, run: Path, form: str, repo: str, stored: card.Stored, cameras: Sequence[str]
) -> None:
    """Write the model card of a run's policy; a policy without a run gets none."""
    if lerobot_folder.is_policy(run):
        return
    at = checkpoint.chosen(run)
    home = checkpoint.run_of(at)
    if home is None:
        return
    _write_texts(folder, home, form, card.text(home, at, form, repo, stored, cameras))


def _write_texts(folder: Path, home: Path, form: str, text: str) -> None:
    """Write a card, and in our own layout the recipe of the run, to which the card refers."""
    write_text(folder / card.NAME, text)
    if form == card.AEGIS:
        write_text(folder / RECIPE, _recipe(home))


def _recipe(home: Path) -> str:
    """The recipe of the training, without local paths of models and data."""
    kept = yaml.safe_load((home / "recipe.yaml").read_text(encoding="utf-8"))
    return dump(without_places(kept))
