"""The run folder: checkpoints written aside and renamed, and what is read back from them.

recipe.yaml  ledger.safetensors  metrics.jsonl
checkpoints/000500/backbone/model.safetensors        a plain VLM; in the hub's layout with
                                                     config.json, the processor's files and a
                                                     README.md
                   expert.safetensors                the action expert and its scales
                   training_state/state.safetensors  what --resume needs beside the model that the
                                                     run began with
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
from torch import Tensor, nn

from aegis_cli import recipes, sim
from aegis_cli.common import artifacts, commands, files, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import sharded_as
from aegis_cli.common.state_dicts import check_state, outline, reading_meta, shape_from
from aegis_cli.data.batch import Normalizer
from aegis_cli.data.lerobot import layout
from aegis_cli.data.relative import of_meta as relative_of
from aegis_cli.methods.base import Method
from aegis_cli.models import backbones, download, lerobot_folder, policy_meta, structure
from aegis_cli.models.backbones import model_folder, preparation
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape, check_fit
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.training import inputs as places
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
_BUFFER = "buffer."  # of a running average that training passes update, such as BatchNorm's


class State(NamedTuple):
    """What a resumed run restores: named tensors, and the parameters without optimizer state."""

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
        reused: the anchor gradient that the next step shares with earlier steps, by the backbone's
            parameter names.
        average: of the weights, by the policy's parameter names.
    """
    parameters = learning(policy)
    tensors = optimizer_state.to_tensors(parameters, optimizers)
    tensors |= {_REUSED + name: gradient for name, gradient in (reused or {}).items()}
    tensors |= {_AVERAGE + name: mean for name, mean in (average or {}).items()}
    tensors |= {_BUFFER + name: buffer for name, buffer in _running(policy).items()}
    return State(tensors, optimizer_state.stateless(parameters, optimizers))


def learning(policy: Policy) -> dict[str, nn.Parameter]:
    """The parameters that a training state holds, by the policy's names: those that learn.

    A resumed run has the frozen ones already: it loads the model that the run began with, and
    refuses any other by its digest.
    """
    return {name: p for name, p in policy.named_parameters() if p.requires_grad}


def policy_of(state: State) -> dict[str, Tensor]:
    """What users of a policy load, by its names: learned weights or their averages, and buffers."""
    weights = _named(optimizer_state.WEIGHT, state.tensors) | _named(_AVERAGE, state.tensors)
    return weights | _named(_BUFFER, state.tensors)


def _running(policy: Policy) -> dict[str, Tensor]:
    """The buffers that training passes update, by the policy's names."""
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

    If `last` already points at a complete checkpoint of this step, that one stays, since there has
    to be one at every moment; only what an interruption left in the header of its training state is
    removed.

    Args:
        policy: its weights are those of `state`, or of its average.
        card: written beside the model if it has the Hugging Face layout.
        going_on: written into the header of the training state.
        wide: as in `plain_backbone`.
        averaged: a context in which the policy has the weights that its users load.
    """
    described = {**meta, "step": step, optimizer_state.STATELESS: state.stateless}
    if settings := policy.backbone.preparation():
        described[preparation.META] = dict(settings)
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
            # One of another step was left by a killed process: this process has the folder to
            # itself.
            for left in (aside, *aside.parent.glob(".*.tmp")):
                shutil.rmtree(left, ignore_errors=True)
            (aside / STATE.parent).mkdir(parents=True)
            with averaged():
                plain = plain_backbone(policy.backbone, method, wide)
                write_policy(aside, plain, policy, meta, inputs, seed, card)
            files.begin_to_write(aside)
            write_state(aside / STATE)
            files.reach_disk(aside)
            # `last` moves only once the new checkpoint is complete under its own name. An old
            # checkpoint of that name, as in a run that was set back to an earlier step, is not
            # `last`.
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
    """Write a policy's plain backbone and its expert into an existing folder."""
    plain.save(folder / BACKBONE)
    if card and model_folder.is_model(folder / BACKBONE):
        files.write_text(folder / BACKBONE / "README.md", card)
    _save_expert(folder / EXPERT, policy, plain.fingerprint(), meta, inputs, seed)


def plain_backbone(backbone: Backbone, method: Method, wide: bool = False) -> Backbone:
    """A copy of the backbone without the method's additions; the backbone itself if there are none.

    Args:
        wide: whether weights are cast to float32 before the additions are merged into them.
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
    """Point `checkpoints/last` at this checkpoint."""
    link = target.with_name(LAST)
    # A link cannot be changed atomically, but a new one can be renamed over it. It is relative, so
    # that a run folder can be moved.
    fresh = target.with_name(f".{LAST}.tmp")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target.name)
    if link.is_dir() and not link.is_symlink():
        # A copy that followed links has a folder there, which no rename replaces.
        shutil.rmtree(link)
    os.replace(fresh, link)


@contextlib.contextmanager
def writing(folder: Path) -> Generator[None]:
    """Turn a disk failure, including one reported by safetensors, into an AegisError."""
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
    """The entries of a run's checkpoints folder that are named by a step, in order of the steps.

    They are sorted as numbers: from step 1,000,000 on the names have more digits.
    """
    named = (Path(folder) / "checkpoints").glob("[0-9]*")
    return sorted((path for path in named if path.name.isdecimal()), key=lambda p: int(p.name))


def begun(folder: Path) -> bool:
    """Whether a run has a checkpoint to resume from.

    Raises:
        AegisError: it has checkpoints, but `checkpoints/last` leads to none of them; some ways of
            copying leave out links.
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
        AegisError: there is none, as in a merged run.
    """
    state = last(run) / STATE
    if not state.is_file():
        raise _without_state(run)
    return state


def _without_state(run: Path) -> AegisError:
    """The error for a run that cannot be resumed, with the commands that go on from it."""
    origin, kept = places.merged_from(run), places.of(run)
    merged = "as in a run that aegis merge wrote"
    on = "continue the run that was merged"
    if origin is not None:
        merged = f"which aegis merge made from '{origin}'"
        on += f": {commands.aegis('train', origin)}"
    demos = [] if kept is None else [word for each in kept.demos for word in ("--demos", each)]
    learned = ["--set", f"backbone={run}", "--set", f"expert.start={run}"]
    again = commands.aegis("train", run / "recipe.yaml", *demos, *learned, "--out", "RUN")
    return AegisError(
        f"no training state in '{run}', {merged}",
        "a run that aegis train wrote",
        f"{on}; or begin another with what this one has learned: {again}",
    )


def last(folder: Path) -> Path:
    """The newest complete checkpoint of a run.

    Raises:
        AegisError: this is no run, or a run without a checkpoint.
    """
    path = Path(folder) / "checkpoints" / LAST
    if not (path / EXPERT).is_file():
        model_folder.refuse_foreign_policy(Path(folder))
        if model_folder.is_model(Path(folder)):
            raise _without_expert(folder)
        raise AegisError(
            f"no checkpoint in '{folder}'",
            "a run folder with checkpoints/last, the folder of one of its checkpoints, or a "
            "policy's id on the hub",
            f"train one with aegis train … --out RUN{_not_asked(folder)}",
        )
    return path


def _without_expert(folder: Path) -> AegisError:
    """The error for a model by itself, such as one that `aegis extract` or `aegis merge` wrote."""
    train = commands.aegis(
        "train", "RECIPE", "--set", f"backbone={folder}", "--demos", "PATH", "--out", "RUN"
    )
    back = commands.aegis("insert", folder, "--into", "POLICY", "--out", "FOLDER")
    return AegisError(
        f"no checkpoint in '{folder}', a model by itself, without an action expert",
        "a trained policy: a run's folder, or that of one of its checkpoints",
        f"train one from it: {train}; a VLM that aegis extract took out of another program's "
        f"policy goes back into that by {back}",
    )


def _not_asked(folder: Path) -> str:
    """What to add to the advice if the folder may have been meant as an id on the hub."""
    return "" if Path(folder).exists() else hub.not_asked(str(folder))


def chosen(folder: Path) -> Path:
    """The folder itself if it is a checkpoint, else the run's newest one, as `last` finds it."""
    return Path(folder) if is_one(folder) else last(folder)


def is_one(folder: Path) -> bool:
    """Whether a folder is a checkpoint.

    The run of a stream of robot tasks has files of the same names, but also a recipe.
    """
    folder = Path(folder)
    return (
        (folder / EXPERT).is_file()
        and (folder / BACKBONE).is_dir()
        and not (folder / "recipe.yaml").exists()
    )


def run_of(path: Path) -> Path | None:
    """The run that a checkpoint's folder lies in; None if it does not lie in one."""
    # `RUN/checkpoints/last` shows by its own path which run it lies in; for another link only the
    # target does.
    inside = path if path.parent.name == "checkpoints" else path.resolve()
    run = inside.parent.parent
    return run if (run / "recipe.yaml").is_file() else None


def step_of(path: Path) -> int:
    """The number of steps after which a checkpoint was written.

    If `last` was copied as a folder, the step is read from its training state or, if it has none,
    as after a merge, from the name of the checkpoint beside it that has the same expert.
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
    """Load the policy of a checkpoint, of a run's last one, or of a folder in LeRobot's layout.

    How its chunks are executed is read from the recipe of its run, if it lies in one: a job's
    `rollout` may have changed since training.

    Args:
        folder: such a folder, or the id on the hub of a policy that was pushed.

    Raises:
        AegisError: files are missing, broken, or from different checkpoints.
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
    """Raise AegisError if the requested task is not the policy's own."""
    if task not in (None, meta["task"]):
        said = f"task '{task}' for a policy of '{meta['task'] or 'no simulated task'}'"
        raise AegisError(said, "the policy's own task", "leave out the task")


def _executed_now(path: Path, meta: PolicyMeta) -> PolicyMeta:
    """A checkpoint's meta with `replan` and `ensemble` as they are now in its run's recipe."""
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
    """Load only the expert and the meta of what `load_policy` accepts."""
    folder = download.locate(folder)
    if lerobot_folder.is_policy(folder):
        policy, meta = lerobot_folder.load(folder)
        return policy.expert, meta
    return _load_expert(_expert_file(folder))[:2]


def expert_sha256(folder: str | Path) -> str:
    """sha256 of the file that holds the expert, for what `load_policy` accepts."""
    return files.sha256_file(_expert_file(folder))


def _expert_file(folder: str | Path) -> Path:
    path = download.locate(folder)
    return path / lerobot_folder.MODEL if lerobot_folder.is_policy(path) else chosen(path) / EXPERT


def _load_expert(
    file: Path, backbone: Backbone | None = None
) -> tuple[ActionExpert, PolicyMeta, Normalizer, Normalizer]:
    """The expert in a checkpoint's file, the meta, and the scales of proprioception and actions.

    Args:
        backbone: the backbone that it has to belong to; None: any.
    """
    owner = None
    if backbone is not None:
        own = file.parent / BACKBONE
        fix = (
            f"bring '{own}' back as it was written beside the expert, from a copy of the run; or "
            "give another checkpoint of the run"
        )
        owner = artifacts.Owner(backbone.fingerprint(), str(own), fix)
    artifact = artifacts.load(file, "expert", owner=owner)
    meta, tensors = cast(PolicyMeta, artifact.header.meta), artifact.tensors
    with reading_meta(file):
        shape = shape_from(ExpertShape, artifact.header.meta["shape"], file, len(tensors))
        if backbone is not None:
            check_fit(shape, backbone.depth, backbone.heads, backbone.head_dim)
        policy_meta.check(meta, shape.actions, shape.proprio)
        relative_of(meta, shape.actions, shape.proprio)
    # The expert that the header describes, without allocating memory: the file's tensors are
    # compared with it before an expert of that size is made.
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
    """(height, width) of the pictures that each camera showed in training; () if unknown.

    Only a backbone that accepts pictures of any size needs them.
    """
    return tuple((height, width) for height, width in meta.get("pictures", ()))


def cameras_of(meta: PolicyMeta, task: str | None) -> tuple[str, ...]:
    """The cameras of a simulated task that a policy sees through; empty for the task's default.

    Raises:
        AegisError: it was trained on other cameras.
    """
    named = meta.get("cameras", ())
    found = seen_by(meta, task)
    known = () if task is None else sim.cameras(task)  # the first is the task's default
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
    """The short names of a policy's cameras, as the simulated task names them if it has them.

    A camera that was renamed for the policy is looked up by its old name, or by the new one if the
    task has no camera of the old name.
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
    """Restore the last checkpoint's training state, and the average if the run keeps one.

    Returns:
        The number of steps taken, the meta of the state's header, and the anchor gradient that the
        next step reuses, by the backbone's parameter names: empty if it computes its own.

    Raises:
        AegisError: the state is damaged, or not of this policy; nothing was restored.
    """
    path = last(folder) / STATE
    saved = artifacts.load(path, "training-state")
    with reading_meta(path):
        step = int(saved.header.meta["step"])
        if step_of(path.parent.parent) != step or step < 0:
            raise ValueError(f"a state after {step} steps")
        bare = optimizer_state.said_stateless(saved.header.meta)
    # Every kind of tensor is checked before the first value is changed. `from_tensors` comes last
    # among the checks, since it restores its own tensors at once.
    reused = _reused(path, saved.tensors, policy.backbone)
    average.check(_named(_AVERAGE, saved.tensors), f"the average in '{path}'")
    running, buffers = _running(policy), _named(_BUFFER, saved.tensors)
    check_state(f"the running averages in '{path}'", buffers, running)
    parameters = dict(policy.named_parameters())
    frozen = parameters.keys() - learning(policy).keys()
    if frozen.isdisjoint(_named(optimizer_state.WEIGHT, saved.tensors)):
        parameters = learning(policy)  # an earlier version wrote the frozen ones too
    others = (_REUSED, _AVERAGE, _BUFFER)
    own = {n: t for n, t in saved.tensors.items() if not n.startswith(others)}
    optimizer_state.from_tensors(own, parameters, optimizers, f"'{path}'", bare)
    for name, buffer in running.items():
        buffer.copy_(buffers[name])
    average.put_back(step, _named(_AVERAGE, saved.tensors))
    return step, saved.header.meta, reused


def _named(kind: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of one kind, without the prefix that marks it."""
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
