"""The run folder: checkpoints written aside and renamed, and what is read back from them.

recipe.yaml  ledger.safetensors  metrics.jsonl
checkpoints/000500/backbone/model.safetensors        a plain VLM; of the hub's layout with
                                                     config.json, the processor's files and a
                                                     README.md
                   expert.safetensors                the action expert and its scales
                   training_state/state.safetensors  what --resume needs
checkpoints/last -> 000500
"""

from __future__ import annotations

import contextlib
import copy
import os
import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from safetensors import SafetensorError
from torch import Tensor

from aegis_cli import recipes, sim
from aegis_cli.common import artifacts, files, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import sharded_as
from aegis_cli.common.state_dicts import check_state, outline, reading_meta, shape_from
from aegis_cli.data.batch import Normalizer
from aegis_cli.data.lerobot import layout
from aegis_cli.data.relative import of_meta as relative_of
from aegis_cli.methods.base import Method
from aegis_cli.models import backbones, download, lerobot_folder, policy_meta, structure
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape, check_fit
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.training import optimizer_state
from aegis_cli.training.average import Average

LAST = "last"
STATE = Path("training_state") / "state.safetensors"
EXPERT = "expert.safetensors"
BACKBONE = "backbone"
PARTS = (BACKBONE, EXPERT, STATE.parts[0])  # of a checkpoint's folder
_REUSED = "anchor_gradient."
_AVERAGE = "average."
_OTHER_CAMERAS = (
    "roll it out on its own robot, or train on one of them with --set demos.camera=NAME"
)
_BUFFER = "buffer."  # of a running average that training passes write, as BatchNorm's


class State(NamedTuple):
    """What a resumed run puts back: named tensors, and what has no optimizer's state."""

    tensors: dict[str, Tensor]
    stateless: list[str]


def state_of(
    policy: Policy,
    optimizers: Sequence[torch.optim.Optimizer],
    reused: Mapping[str, Tensor] | None = None,
    average: Mapping[str, Tensor] | None = None,
) -> State:
    """The state of a run.

    Args:
        reused: the anchor gradient that the next step shares with those before, by the backbone's
            parameter names.
        average: of the weights, by the policy's parameter names.
    """
    parameters = dict(policy.named_parameters())
    tensors = optimizer_state.to_tensors(parameters, optimizers)
    tensors |= {_REUSED + name: gradient for name, gradient in (reused or {}).items()}
    tensors |= {_AVERAGE + name: mean for name, mean in (average or {}).items()}
    tensors |= {_BUFFER + name: buffer for name, buffer in _running(policy).items()}
    return State(tensors, optimizer_state.stateless(parameters, optimizers))


def policy_of(state: State) -> dict[str, Tensor]:
    """What others are to use, by the policy's names: weights, or their averages, and buffers."""
    weights = _named(optimizer_state.WEIGHT, state.tensors) | _named(_AVERAGE, state.tensors)
    return weights | _named(_BUFFER, state.tensors)


def _running(policy: Policy) -> dict[str, Tensor]:
    """The buffers that training passes write, by the policy's names."""
    found = {}
    for name, module in structure.averaging(policy.backbone).items():
        for leaf, buffer in module.named_buffers(recurse=False):
            found[f"backbone.{name}.{leaf}"] = buffer
    return found


def save(
    folder: Path,
    step: int,
    policy: Policy,
    method: Method,
    state: State,
    meta: PolicyMeta,
    inputs: Mapping[str, str],
    seed: int,
    card: str = "",
    going_on: Mapping[str, Any] | None = None,
    wide: bool = False,
    averaged: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
) -> Path:
    """Write checkpoint `step` of the run in `folder` and point `checkpoints/last` at it.

    If `last` already points at a complete checkpoint of this step, that stays: there has to be one
    at every moment. From the header of its training state goes what an interruption has left there.

    Args:
        policy: its weights are those of `state`, or of its average.
        card: written beside a model of the Hugging Face Hub.
        going_on: written into the header of the training state.
        wide: as of `plain_backbone`.
        averaged: inside its block the policy has the weights that others are to use.
    """
    described = {**meta, "step": step, optimizer_state.STATELESS: state.stateless}
    target = folder / "checkpoints" / f"{step:06d}"
    link = target.with_name(LAST)

    def write_state(path: Path) -> None:
        artifacts.save(
            path,
            "training-state",
            state.tensors,
            seed=seed,
            inputs=inputs,
            meta={**described, **(going_on or {})},
        )

    if (link / EXPERT).is_file() and link.resolve() == target.resolve():
        there = artifacts.read_header(target / STATE, "training-state").meta
        if not going_on and not there.keys() <= described.keys():
            with writing(folder):
                write_state(target / STATE)
        return target
    aside = target.with_name(f".{target.name}.tmp")
    try:
        with writing(folder):
            # Another step's is of a process that was killed, for this one has the folder alone.
            for left in (aside, *aside.parent.glob(".*.tmp")):
                shutil.rmtree(left, ignore_errors=True)
            (aside / STATE.parent).mkdir(parents=True)
            with averaged():
                plain = plain_backbone(policy.backbone, method, wide)
                write_policy(aside, plain, policy, meta, inputs, seed, card)
            files.begin_to_write(aside)
            write_state(aside / STATE)
            files.reach_disk(aside)
            # `last` moves only when the new checkpoint is complete under its own name. What may lie
            # under that name, as in a run that was taken back to an earlier step, is not `last`.
            shutil.rmtree(target, ignore_errors=True)
            os.rename(aside, target)
            point_last_at(target)
    finally:
        shutil.rmtree(aside, ignore_errors=True)  # after the rename there is nothing to remove
    return target


def write_policy(
    folder: Path,
    plain: Backbone,
    policy: Policy,
    meta: PolicyMeta,
    inputs: Mapping[str, str],
    seed: int | None,
    card: str = "",
) -> None:
    """Write into an existing folder what a policy's user needs: its plain backbone, its expert."""
    plain.save(folder / BACKBONE)
    if card and model_folder.is_model(folder / BACKBONE):
        files.write_text(folder / BACKBONE / "README.md", card)
    _save_expert(folder / EXPERT, policy, plain.fingerprint(), meta, inputs, seed)


def plain_backbone(backbone: Backbone, method: Method, wide: bool = False) -> Backbone:
    """A copy of the backbone without what the method has added; itself where that is nothing.

    Args:
        wide: whether weights become float32 before what was added is merged into them.
    """
    if method.export is None:
        return backbone
    copied = copy.deepcopy(backbone)
    if wide:
        copied.round_weights(torch.float32)
    method.export(copied)
    return copied


def _save_expert(
    path: Path,
    policy: Policy,
    fingerprint: str,
    meta: PolicyMeta,
    inputs: Mapping[str, str],
    seed: int | None,
) -> None:
    scales = {"proprio": policy.proprio_scale, "action": policy.action_scale}
    tensors = {f"expert.{name}": t for name, t in policy.expert.state_dict().items()}
    for kind, scale in scales.items():
        tensors |= {f"{kind}.{name}": t for name, t in scale.state_dict().items()}
    artifacts.save(
        path,
        "expert",
        tensors,
        seed=seed,
        inputs=inputs,
        fingerprint=fingerprint,
        meta={**meta, "shape": policy.expert.shape.to_json()},
    )


def point_last_at(target: Path) -> None:
    """Let `checkpoints/last` lead to this checkpoint."""
    link = target.with_name(LAST)
    # A link cannot be changed in one step, but another one can be renamed over it. It is relative,
    # so that a run folder may be moved.
    fresh = target.with_name(f".{LAST}.tmp")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target.name)
    if link.is_dir() and not link.is_symlink():
        # A copy that followed links has a folder there, which no rename replaces.
        shutil.rmtree(link)
    os.replace(fresh, link)


@contextlib.contextmanager
def writing(folder: Path) -> Generator[None]:
    """Turn a failing disk, also as safetensors reports it, into the one error that a user sees."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        known = isinstance(error, OSError)
        fix = files.cure(folder, error) if known else "free some space or choose another --out"
        raise AegisError(
            f"cannot write to '{folder}': {getattr(error, 'strerror', None) or error}",
            "a writable folder with free space",
            f"{fix}; what was complete before is still there",
        ) from error


def whole(folder: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return [path for path in numbered(folder) if (path / EXPERT).is_file()]


def numbered(folder: Path) -> list[Path]:
    """What lies in a run's checkpoints under the number of a step, in the steps' order.

    The names of a millionth step and of those after it have more digits than those before.
    """
    named = (Path(folder) / "checkpoints").glob("[0-9]*")
    return sorted((path for path in named if path.name.isdecimal()), key=lambda p: int(p.name))


def begun(folder: Path) -> bool:
    """Whether a run has a checkpoint to go on from.

    Raises:
        AegisError: it has some, and `checkpoints/last`, a link that some copying leaves out, leads
            to none of them.
    """
    link = Path(folder) / "checkpoints" / LAST
    if (link / EXPERT).is_file():
        return True
    if found := whole(folder):
        raise AegisError(
            f"{len(found)} checkpoints in '{link.parent}', but '{LAST}' points to none of them",
            f"a link '{LAST}' to the newest",
            f"ln -sfn {found[-1].name} '{link}', or start anew in another --out",
        )
    return False


def kept_state(run: Path) -> Path:
    """The file of the training state in a run's last checkpoint.

    Raises:
        AegisError: none, as in a merged run.
    """
    state = last(run) / STATE
    if not state.is_file():
        raise AegisError(
            f"no training state in '{run}', as in a run that aegis merge wrote",
            "a run that aegis train wrote",
            "continue the run that was merged, or begin another with what this one has learned: "
            f"--set 'backbone={run}' --set 'expert.start={run}'",
        )
    return state


def last(folder: Path) -> Path:
    """The newest complete checkpoint of a run.

    Raises:
        AegisError: no run, or a run without a checkpoint.
    """
    path = Path(folder) / "checkpoints" / LAST
    if not (path / EXPERT).is_file():
        raise AegisError(
            f"no checkpoint in '{folder}'",
            "a run folder with checkpoints/last, the folder of one of its checkpoints, or a "
            "policy's id on the hub",
            f"train one with aegis train … --out RUN{_not_asked(folder)}",
        )
    return path


def _not_asked(folder: Path) -> str:
    """What to add to the advice for a folder that may have been meant as an id on the hub."""
    return "" if Path(folder).exists() else hub.not_asked(str(folder))


def chosen(folder: Path) -> Path:
    """A checkpoint's own folder as it is, and of a run the newest one, as `last` finds it."""
    return Path(folder) if is_one(folder) else last(folder)


def is_one(folder: Path) -> bool:
    """Whether a folder is a checkpoint.

    The run of a stream of robot tasks has files of the same names, and a recipe.
    """
    folder = Path(folder)
    return (
        (folder / EXPERT).is_file()
        and (folder / BACKBONE).is_dir()
        and not (folder / "recipe.yaml").exists()
    )


def run_of(path: Path) -> Path | None:
    """The run that a checkpoint's folder lies in; None where it has been taken out of one."""
    # `RUN/checkpoints/last` says by its own name where it lies; of another link only its target
    # does.
    inside = path if path.parent.name == "checkpoints" else path.resolve()
    run = inside.parent.parent
    return run if (run / "recipe.yaml").is_file() else None


def step_of(path: Path) -> int:
    """After how many steps a checkpoint was written.

    Where `last` was copied as a folder, its files say so: its state does, and where it has none, as
    after a merge, the checkpoint beside it that has the same expert.
    """
    name = path.resolve().name
    if name.isdecimal():
        return int(name)
    if not (path / STATE).is_file():
        own = files.sha256_file(path / EXPERT)
        for other in reversed(whole(path.parent.parent)):
            if files.sha256_file(other / EXPERT) == own:
                return int(other.name)
    return int(artifacts.read_header(path / STATE).meta["step"])


def load_policy(folder: str | Path) -> tuple[Policy, PolicyMeta]:
    """The policy of a checkpoint, of a run's last one, or of a folder in LeRobot's layout.

    How its chunks are executed is read from the recipe of its run, where it lies in one: a job's
    `rollout` may be another than when it was trained.

    Args:
        folder: such a folder, or the id on the hub of a policy that was pushed.

    Raises:
        AegisError: files that are missing, broken, or not of one checkpoint.
    """
    folder = download.locate(folder)
    if lerobot_folder.is_policy(folder):
        policy, meta = lerobot_folder.load(folder)
        sizes = len(policy.action_scale.mean), len(policy.proprio_scale.mean)
        with reading_meta(folder / lerobot_folder.MODEL):
            policy_meta.check(meta, *sizes)
        return policy, meta
    path = chosen(folder)
    backbone = backbones.load(str(path / BACKBONE))
    expert, meta, proprio, action = _load_expert(path / EXPERT, backbone)
    relative = relative_of(meta, expert.shape.actions, expert.shape.proprio)
    return Policy(backbone, expert, proprio, action, relative).eval(), _executed_now(path, meta)


def check_task(meta: PolicyMeta, task: str | None) -> None:
    """Raise AegisError for a task that is asked of a policy and is not the one that it has."""
    if task not in (None, meta["task"]):
        said = f"task '{task}' for a policy of '{meta['task'] or 'no simulated task'}'"
        raise AegisError(said, "the policy's own task", "leave out the task")


def _executed_now(path: Path, meta: PolicyMeta) -> PolicyMeta:
    """A checkpoint's meta with `replan` and `ensemble` as its run's recipe says them by now."""
    run = run_of(path)
    now = meta.copy()
    if run is None:
        return now
    settings = recipes.load(run / "recipe.yaml", kind=recipes.Recipe).rollout
    now["replan"] = settings.replan
    now.pop("ensemble", None)
    if settings.ensemble is not None:
        now["ensemble"] = settings.ensemble
    return now


def load_expert(folder: str | Path) -> tuple[ActionExpert, PolicyMeta]:
    """The expert alone of what `load_policy` takes, and the meta."""
    folder = download.locate(folder)
    if lerobot_folder.is_policy(folder):
        policy, meta = lerobot_folder.load(folder)
        return policy.expert, meta
    return _load_expert(_expert_file(folder))[:2]


def expert_sha256(folder: str | Path) -> str:
    """sha256 of the file with the expert of what `load_policy` takes."""
    return files.sha256_file(_expert_file(folder))


def _expert_file(folder: str | Path) -> Path:
    path = download.locate(folder)
    return path / lerobot_folder.MODEL if lerobot_folder.is_policy(path) else chosen(path) / EXPERT


def _load_expert(
    file: Path, backbone: Backbone | None = None
) -> tuple[ActionExpert, PolicyMeta, Normalizer, Normalizer]:
    """The expert in a checkpoint's file, the meta, and the scales of proprioception and actions.

    Args:
        backbone: the one that it has to be of; None: any.
    """
    artifact = artifacts.load(
        file, "expert", fingerprint=None if backbone is None else backbone.fingerprint()
    )
    meta, tensors = cast(PolicyMeta, artifact.header.meta), artifact.tensors
    with reading_meta(file):
        shape = shape_from(ExpertShape, artifact.header.meta["shape"], file, len(tensors))
        if backbone is not None:
            check_fit(shape, backbone.depth, backbone.heads, backbone.head_dim)
        policy_meta.check(meta, shape.actions, shape.proprio)
        relative_of(meta, shape.actions, shape.proprio)
    # The expert that the header describes, without memory: the file's tensors are compared with it
    # before one of that size is made.
    with outline(file):
        wanted = {f"expert.{name}": t for name, t in ActionExpert(shape).state_dict().items()}
        for kind, size in (("proprio", shape.proprio), ("action", shape.actions)):
            for name in ("mean", "std"):
                wanted[f"{kind}.{name}"] = torch.empty(size, dtype=torch.float32)
    check_state(f"'{file}'", tensors, wanted)
    expert = ActionExpert(shape)
    parts: dict[str, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        kind, rest = name.split(".", 1)
        parts.setdefault(kind, {})[rest] = tensor
    expert.load_state_dict(parts["expert"])
    return expert, meta, Normalizer(**parts["proprio"]), Normalizer(**parts["action"])


def sizes_of(meta: PolicyMeta) -> tuple[tuple[int, int], ...]:
    """(height, width) of the pictures that each camera showed in training; () where none is known.

    Only a backbone that reads pictures of any size has to know.
    """
    return tuple((height, width) for height, width in meta.get("pictures", ()))


def cameras_of(meta: PolicyMeta, task: str | None) -> tuple[str, ...]:
    """The cameras of a simulated task that a policy looks by; empty for the task's own.

    Raises:
        AegisError: it was trained on others.
    """
    named = meta.get("cameras", ())
    found = seen_by(meta, task)
    known = () if task is None else sim.cameras(task)  # the first is the task's own
    if len(found) == 1 and found[0] not in known[1:]:
        return ()  # whatever the only camera is called
    if not set(found) <= {*known}:
        expected, fix = "cameras of a simulated task", _OTHER_CAMERAS
        if task is not None:
            expected = f"cameras of '{task}': {', '.join(known)}"
            if sim.of_datasets(task) is not None:
                unused = (name for name in ("image", "image2") if name not in found)
                unknown = [name for name in found if name not in known]
                pairs = zip(unknown, unused, strict=False)
                renamed = ", ".join(f"{old}: {new}" for old, new in pairs)
                fix = (
                    f"give them its names in training: --set 'demos.rename={{{renamed}}}', or "
                    "choose those that have them by demos.camera"
                )
        raise AegisError(
            f"a policy trained on {len(named)} cameras: {', '.join(named)}", expected, fix
        )
    return found


def seen_by(meta: PolicyMeta, task: str | None) -> tuple[str, ...]:
    """The names of a policy's cameras, in short, as a simulated task has them where it does.

    One that was renamed for the policy is known by the name that it had before, or by the new one
    where the task has none of the old.
    """
    before = {layout.short(new): layout.short(old) for old, new in meta.get("rename", {}).items()}
    now = [layout.short(name) for name in meta.get("cameras", ())]
    return tuple(sim.camera(task, before.get(name, name), name) for name in now)


def restore(
    folder: Path,
    policy: Policy,
    optimizers: Sequence[torch.optim.Optimizer],
    average: Average,
) -> tuple[int, Mapping[str, Any], dict[str, Tensor]]:
    """Put the last checkpoint's training state back, and the average that a run may keep.

    Returns:
        How many steps it has behind it, the meta of its header, and the anchor gradient that the
        next step reuses, by the backbone's parameter names: empty where that takes its own.

    Raises:
        AegisError: a state that is damaged, or not of this policy; nothing was put back.
    """
    path = last(folder) / STATE
    saved = artifacts.load(path, "training-state")
    with reading_meta(path):
        step = int(saved.header.meta["step"])
        if step_of(path.parent.parent) != step or step < 0:
            raise ValueError(f"a state after {step} steps")
        bare = optimizer_state.said_stateless(saved.header.meta)
    # Every kind of tensor is checked before the first value is changed. `from_tensors` comes last
    # among the checks, since it puts its own back at once.
    reused = _reused(path, saved.tensors, policy.backbone)
    average.check(_named(_AVERAGE, saved.tensors), f"the average in '{path}'")
    running, buffers = _running(policy), _named(_BUFFER, saved.tensors)
    check_state(f"the running averages in '{path}'", buffers, running)
    parameters = dict(policy.named_parameters())
    others = (_REUSED, _AVERAGE, _BUFFER)
    own = {n: t for n, t in saved.tensors.items() if not n.startswith(others)}
    optimizer_state.from_tensors(own, parameters, optimizers, f"'{path}'", bare)
    for name, buffer in running.items():
        buffer.copy_(buffers[name])
    average.put_back(step, _named(_AVERAGE, saved.tensors))
    return step, saved.header.meta, reused


def _named(kind: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of a kind, without the prefix that says so."""
    return {name.removeprefix(kind): t for name, t in tensors.items() if name.startswith(kind)}


def _reused(path: Path, tensors: Mapping[str, Tensor], backbone: Backbone) -> dict[str, Tensor]:
    """The anchor gradient in a training state, on the backbone's device.

    Raises:
        AegisError: it is not of this backbone.
    """
    found = _named(_REUSED, tensors)
    wanted = {name: p for name, p in backbone.named_parameters() if name in found}
    check_state(f"the anchor gradient in '{path}'", found, wanted)
    return {
        name: sharded_as(t.to(backbone.device, copy=True), wanted[name])
        for name, t in found.items()
    }
