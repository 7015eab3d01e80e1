"""The inputs of a training run, loaded and checked against each other before anything is built."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from aegis_cli import recipes, sim
from aegis_cli.anchors import anchor_file
from aegis_cli.common import artifacts, devices, launch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.common.ranks import Ranks
from aegis_cli.common.watched_files import WatchedFiles
from aegis_cli.core.anchor import Anchor
from aegis_cli.data import demonstrations, joints, mixture
from aegis_cli.data.outliers import outliers
from aegis_cli.data.relative import Places
from aegis_cli.data.selection import Paths
from aegis_cli.data.vqa import sets
from aegis_cli.methods import kfac
from aegis_cli.methods.base import Method
from aegis_cli.models import backbones
from aegis_cli.models.backbones import shapes
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Demos, Recipe, RobotStreamRecipe, RobotTrain, Train
from aegis_cli.training import checkpoint, parallel

Questions = sets.Scenes | sets.Listed


@dataclass(frozen=True)
class Loaded:
    """The inputs of a training run, checked against each other.

    Attributes:
        backbone: with its weights as they were stored, on the device that it is trained on; on the
            CPU if it is to be sharded.
        began_as: the name of the model that the backbone was before another run trained it; None if
            no run did, or if that is not known.
        fingerprint: of its weights.
        watched: the anchor's file, if there is one; `anchor` is its digest.
        measured: the contents of the anchor; None if there is none.
    """

    backbone: Backbone
    began_as: str | None
    fingerprint: str
    demos: demonstrations.Demonstrations
    watched: WatchedFiles
    anchor: str | None
    measured: Anchor | None


def load(
    recipe: Recipe,
    method: Method,
    demos: Paths,
    anchor: Path | None,
    on_event: OnEvent,
    ranks: Ranks,
) -> Loaded:
    """Load backbone, demonstrations and anchor.

    Raises:
        AegisError: inputs that do not fit together.
    """
    device = devices.pick()
    # Weights to be sharded stay on the CPU: a GPU may only have room for its own shard.
    shards = parallel.shards(recipe.train, ranks)
    backbone = backbones.load(recipe.backbone).to("cpu" if shards else device)
    fingerprint = backbone.fingerprint()
    watched = WatchedFiles([] if anchor is None else [anchor])
    measured = None if anchor is None else _measured(anchor, backbone, fingerprint, recipe, method)
    _check_parts(method, measured, recipe)
    # Last, since this may decode hours of video.
    recorded = _demonstrations(recipe, backbone, demos, on_event, ranks)
    _warn_of_no_instruction(demos, recorded, on_event)
    warn_of_outliers(demos, recorded, recipe.train, on_event)
    if method.name == "kfac":
        _warn_of_strong_pull(recipe, on_event)
    if method.name == "nullspace" and anchor is not None:
        _warn_of_soft_beyond_the_anchor(anchor, recipe, on_event)
    if anchor is not None and method.needs:
        _warn_of_another_prompt(anchor, recipe, on_event)
        _warn_of_other_cameras(anchor, demos, recorded.cameras, recipe.demos.rename, on_event)
    digest = None if anchor is None else watched.sha256[anchor]
    before = began_as(recipe.backbone)
    return Loaded(backbone, before, fingerprint, recorded, watched, digest, measured)


def began_as(name: str) -> str | None:
    """The name of the model that a run began with, if `name` is the backbone of its checkpoint.

    Folders are left out. None if `name` is no backbone of a checkpoint, or its run is gone.
    """
    if shapes.of_backbone(name) is not None:
        return None
    path = backbones.locate(name)
    at = path.parent if path.is_dir() else path.parent.parent
    if not (at / checkpoint.EXPERT).is_file():
        return None
    known = artifacts.read_header(at / checkpoint.EXPERT).meta
    if (told := known.get("began_as") or known.get("base_model")) is not None:
        return told
    run = checkpoint.run_of(at)
    if run is None:
        return None
    own = recipes.load(run / "recipe.yaml", kind=Recipe).backbone
    return own if own in backbones.SHIPPED else Path(own).name


def _demonstrations(
    recipe: Recipe, backbone: Backbone, demos: Paths, on_event: OnEvent, ranks: Ranks
) -> demonstrations.Demonstrations:
    """The demonstrations; one process per machine decodes their frames, the others reuse them."""
    # All processes call `wait` once, the decoding ones after their work, so the others find a
    # complete cache.
    decodes = launch.local_rank() == 0
    found = load_demonstrations(recipe, backbone, demos, on_event) if decodes else None
    ranks.wait()
    if found is not None:
        return found
    return load_demonstrations(recipe, backbone, demos, on_event, decides=False)


def load_demonstrations(
    recipe: Recipe, backbone: Backbone, paths: Paths, on_event: OnEvent, decides: bool = True
) -> demonstrations.Demonstrations:
    """Load the demonstrations that the backbone learns from.

    Args:
        decides: whether this process checks if the disk has room for decoded frames, when the
            recipe does not say; otherwise another process has decided, and cached frames are used
            if there are any.

    Raises:
        AegisError: the demonstrations are of another task, have words that the backbone does not
            know, or do not match the recipe's weights.
    """
    check_cameras(backbone, recipe)
    mixture.check_weights(recipe.demos.weights, len(mixture.each(paths)))
    found = mixture.load(
        paths,
        recipe.train.validation_share,
        recipe.seed,
        recipe.demos.selection,
        backbone.image_size,
        on_event=on_event,
        cache=recipe.demos.cache if decides else bool(recipe.demos.cache),
        check_text=backbone.check_prompt,
    )
    if found.task is None:
        found = of_named_task(found, recipe.task, recipes.selected(recipe).get("rename", {}))
    elif found.task != recipe.task:
        recorded = sim.of_datasets(recipe.task) is None
        raise AegisError(
            f"demonstrations of '{found.task}' for a recipe of '{recipe.task}'",
            "the same task",
            f"--set task={found.task}"
            + (f", or record with: aegis demos {recipe.task}" if recorded else ""),
        )
    mixture.drawn(found, recipe.demos.weights)
    # A word that the backbone does not know is found here, and not in the middle of training.
    backbone.check_prompts(found.images(found.read[:1]), found.texts)
    return found


def of_named_task(
    found: demonstrations.Demonstrations,
    named: str,
    rename: Mapping[str, str] = MappingProxyType({}),
) -> demonstrations.Demonstrations:
    """LIBERO demonstrations with the recipe's task, which they do not name themselves.

    Args:
        named: the recipe's task.
        rename: new names of cameras, by their names in the data set.

    Raises:
        AegisError: the demonstrations are of another robot than the task's, or of other cameras.
    """
    spec = sim.of_datasets(named)
    if spec is None:
        return found
    own = (found.tensors["proprio"].shape[1], found.tensors["actions"].shape[1])
    expected = (len(spec.proprio_names), len(spec.action_names))
    if own != expected:
        raise AegisError(
            f"demonstrations with {own[0]} positions and {own[1]} actions for task: {named}",
            f"{expected[0]} positions ({', '.join(spec.proprio_names)}) and {expected[1]} actions "
            f"({', '.join(spec.action_names)})",
            "delete task from the recipe if they are another robot's, or choose their columns by "
            "demos.state and demos.action",
        )
    meta = {"cameras": found.cameras, "rename": rename}
    checkpoint.cameras_of(cast(PolicyMeta, meta), named)
    return dataclasses.replace(found, task=named)


def check_named(recipe: Recipe, on_event: OnEvent) -> None:
    """Raise AegisError for what `load` would reject in a recipe's demonstrations and expert."""
    if recipe.expert.start is not None:
        checkpoint.load_expert(recipe.expert.start)
    if recipe.demos.path is None:
        _refuse_keys_of_a_path(recipe.demos)
        return
    backbone, paths = backbones.load(recipe.backbone), mixture.at(recipe.demos.path)
    if recipe.anchor.source == "demos" and len(mixture.each(paths)) > 1:
        raise AegisError(
            f"anchor.source: demos with demonstrations in {mixture.said(paths)}",
            "one set, to measure the anchor on",
            "measure it on one of them with aegis anchor --demos, and train with aegis train "
            "--anchor; or set anchor.source to questions",
        )
    load_demonstrations(recipe, backbone, paths, on_event)


def _refuse_keys_of_a_path(settings: Demos) -> None:
    """Refuse keys that choose from existing demonstrations if they are still to be recorded."""
    belonging = {
        "camera": ("a LeRobot folder, to choose from", "set demos.path to it"),
        "rename": ("demonstrations with names of their own", "set demos.path to them"),
        "only": ("demonstrations, to choose from", "set demos.path to it"),
        "weights": ("several sets of demonstrations", "set demos.path to a list of them"),
    }
    for name, (expected, fix) in belonging.items():
        if getattr(settings, name) is not None:
            raise AegisError(f"demos.{name} without demos.path", expected, fix)


def check_cameras(backbone: Backbone, recipe: Recipe | RobotStreamRecipe) -> None:
    """Refuse several cameras, before their frames are decoded, if the backbone reads one image."""
    named = recipe.demos.camera
    if isinstance(named, tuple) and len(named) > 1 and not backbone.reads_several:
        raise AegisError(
            f"demos.camera: {', '.join(named)} with a backbone that reads one image",
            "one camera, or a Hugging Face backbone",
            f"--set demos.camera={named[0]}",
        )


def _measured(
    path: Path, backbone: Backbone, fingerprint: str, recipe: Recipe, method: Method
) -> Anchor:
    """The parts of the anchor that the method reads."""
    measuring = _measuring(recipe, sorted(method.needs)) if method.needs else None
    wanted = anchor_file.Wanted(
        fingerprint, recipe.backbone, "--set backbone=", measuring, backbone.preparation()
    )
    found = anchor_file.only(anchor_file.load(path, wanted), method.needs)
    return anchor_file.to_device(found, devices.pick())


def _check_parts(method: Method, anchor: Anchor | None, recipe: Recipe) -> None:
    """Raise AegisError if the anchor lacks what the method needs."""
    # For users, `moments` is one part; here it is `image` and `text`, which are measured together.
    held = {} if anchor is None else {"moments": anchor.image, **vars(anchor)}
    missing = [part for part in sorted(method.needs) if not held.get(part)]
    if not missing:
        return
    found = "no anchor" if anchor is None else f"an anchor without {' and '.join(missing)}"
    raise AegisError(
        f"{found} for method '{method.name}'",
        f"an anchor of the backbone with its {' and '.join(missing)}",
        f"add --anchor FILE, measured by: {_measuring(recipe, missing)}",
    )


_MEASURED_AS = (
    "vqa",
    "ask",
    "samples",
    "batch_size",
    "seed",
    "energy",
    "fisher_samples",
    "exact_width",
    "tokens",
    "temperature",
    "memory",
)


def _measuring(recipe: Recipe, parts: Sequence[str]) -> str:
    """The command that measures these parts with the settings of the recipe's section `anchor`."""
    asked, usual = recipe.anchor, type(recipe.anchor)()
    words = ["aegis", "anchor"]
    if recipe.backbone != backbones.EMBEDDED:
        words += ["--backbone", recipe.backbone]
    if asked.source == "demos" and list(parts) == ["moments"]:  # frames serve nothing else
        words += ["--demos", "DEMOS"]
    for name in _MEASURED_AS:
        value = getattr(asked, name)
        if value != getattr(usual, name):
            words += ["--" + name.replace("_", "-"), f"{value}"]
    if asked.skip_bad:
        words.append("--skip-bad")
    return shlex.join([*words, "--parts", ",".join(parts), "--out", "FILE"])


def _warn_of_no_instruction(
    paths: Paths, found: demonstrations.Demonstrations, on_event: OnEvent
) -> None:
    """Warn of training episodes whose instruction is empty or blank."""
    learned = found.episode_of[found.read].unique()
    if bare := len(found.without_instruction):
        text = (
            f"{bare} of the {len(learned)} episodes to learn from in {mixture.said(paths)} have an "
            "empty instruction: a policy learns from them to act without being told what to do. "
            "Write what they do as the dataset's tasks, or choose others with demos.only"
        )
        on_event(Warned("train", text))


def warn_of_outliers(
    paths: Paths,
    found: demonstrations.Demonstrations,
    settings: Train | RobotTrain,
    on_event: OnEvent,
) -> None:
    """Warn of joints whose scale is set by a few outliers, such as a sensor's glitches.

    On such a scale all other values of the joint nearly coincide, and errors look small. Quantiles
    are hardly affected by outliers, and relative actions have their own scale.
    """
    if settings.normalization != "mean_std":
        return
    told = list[str]()
    for what, tensor, names in (
        ("action", "actions", found.action_names),
        ("position", "proprio", found.proprio_names),
    ):
        if settings.relative_actions and what == "action":
            continue
        for one in outliers(found.tensors[tensor][found.train]):
            name = names[one.dimension] if names else str(one.dimension)
            # With several sets the episodes are renumbered.
            episode = f" in episode {int(found.episode_of[found.train[one.row]])}"
            where = episode if len(mixture.each(paths)) == 1 else ""
            told.append(
                f"{what} {name} ({one.value:.6g}{where}; deviation {one.std:.4g}, of the others "
                f"{one.others:.4g})"
            )
    if told:
        text = (
            f"a few values far from all others make most of the spread in {mixture.said(paths)}: "
            f"{', '.join(told)}. Next to them, all other values look nearly the same to the "
            "policy, and its errors look small. If they are recording faults and not rare motions, "
            "leave these episodes out (demos.only), or scale by quantiles (train.normalization)"
        )
        on_event(Warned("train", text))


def _warn_of_strong_pull(recipe: Recipe, on_event: OnEvent) -> None:
    """Warn of a `kfac.weight` beside which the learning rate is so small that little is learned."""
    if recipe.kfac.step != "proximal":
        return
    rate = recipe.train.backbone_lr
    if text := kfac.why_strong(recipe.kfac.weight, rate, "--set kfac.weight"):
        on_event(Warned("train", text))


def _warn_of_soft_beyond_the_anchor(path: Path, recipe: Recipe, on_event: OnEvent) -> None:
    """Warn of a `nullspace.soft` that reaches further than the directions that an anchor stores."""
    left_out = 1 - artifacts.read_header(path).meta.get("energy", 1)
    soft = recipe.nullspace.soft
    # Not for the default of both, whose difference is rounding.
    if recipe.nullspace.energy is None and soft < 0.99 * left_out:
        text = (
            f"nullspace.soft: {soft:g} is less than the share {left_out:.2g} of a map's energy "
            f"that '{path}' does not store: directions of so little energy stay unprotected. "
            f"Measure the anchor with --energy {1 - soft / 10:.10g}, or raise nullspace.soft"
        )
        on_event(Warned("train", text))


def _warn_of_another_prompt(path: Path, recipe: Recipe, on_event: OnEvent) -> None:
    """Warn of an anchor whose questions were asked with another prompt than the recipe's.

    A chat model answers `{}` in sentences, and `{} Give a very brief answer.` in a word: preserving
    the one need not preserve the other.
    """
    meta = artifacts.read_header(path).meta
    asked = meta.get("ask", sets.PLAIN)
    if "vqa" in meta and asked != recipe.anchor.ask:
        wanted, own = shlex.quote(recipe.anchor.ask), shlex.quote(f"anchor.ask={asked}")
        text = (
            f"the questions of '{path}' were asked as '{asked}', and the recipe asks them as "
            f"'{recipe.anchor.ask}' (anchor.ask): measure the anchor with --ask {wanted}, or --set "
            f"{own}; and probe with the same --ask"
        )
        on_event(Warned("train", text))


def _warn_of_other_cameras(
    path: Path,
    demos: Paths,
    shown: Sequence[str],
    rename: Mapping[str, str] | None,
    on_event: OnEvent,
) -> None:
    """Warn of an anchor measured on robot frames of other cameras than the training uses.

    Each camera's frame is an image in the prompt. There is no warning for frames of a single
    unnamed camera, nor for questions, which have one image each.
    """
    meta = artifacts.read_header(path).meta
    own = meta.get("cameras", [])
    # One side names no camera and the other at most one: it may well be the same.
    unnamed = not (own and shown) and max(len(own), len(shown)) < 2
    if "demos" not in meta or own == list(shown) or unnamed:
        return
    words = [word for camera in shown for word in ("--camera", camera)]
    for old, new in (rename or {}).items():
        words += ["--rename", f"{old}={new}"]
    names = shlex.join(words)
    text = (
        f"the anchor '{path}' was measured on frames of {', '.join(own) or 'no camera by name'}, "
        f"but the training sees {', '.join(shown) or 'no camera by name'}: measure it with aegis "
        f"anchor --demos {shlex.quote(str(mixture.each(demos)[0]))} {names}".rstrip()
    )
    on_event(Warned("train", text))


def questions(method: Method, options: Mapping[str, Any], on_event: OnEvent) -> Questions | None:
    """The questions that a method trains on; None for most methods."""
    if not method.trains_on_questions(options):
        return None
    return sets.read(options["vqa"], options["skip_bad"], on_event, options["ask"])


def digests(recipe: Recipe, loaded: Loaded, source: Questions | None) -> dict[str, str]:
    """Digests of a training run's inputs, by name."""
    found = {**mixture.inputs(loaded.demos), "backbone": loaded.fingerprint}
    if loaded.anchor is not None:
        found["anchor"] = loaded.anchor
    if recipe.expert.start is not None:
        found["expert"] = checkpoint.expert_sha256(recipe.expert.start)
    return found if source is None else found | source.sha256


def begun_expert(
    recipe: Recipe,
    shape: ExpertShape,
    relative: Places,
    recorded: Mapping[str, Any],
    on_event: OnEvent,
) -> ActionExpert:
    """The expert of another run, which has to have the shape that this run needs.

    Args:
        recorded: what the demonstrations say about the robot, as in `Demonstrations.recorded`.

    Raises:
        AegisError: it has another shape, joints in another order, or actions relative to other
            positions.
    """
    start = recipe.expert.start
    assert start is not None
    found, meta = checkpoint.load_expert(start)
    for other in joints.differences(meta, recorded):
        if other.moved is not None:
            raise AegisError(
                f"'{other.moved}' in another place than the expert of '{start}' has it, with "
                f"{other.what} {', '.join(other.found)}",
                f"{', '.join(other.known)}, in this order, as that expert was trained on",
                "give demonstrations in that order, or delete expert.start",
            )
    if tuple(meta.get("relative", ())) != tuple(relative):
        raise AegisError(
            f"the expert of '{start}' predicts {_told(meta.get('relative', ()))}, this training "
            f"{_told(relative)}",
            "an expert that predicts the same",
            "set train.relative_actions and train.relative_exclude to those of that run, or delete "
            "expert.start",
        )
    here, there = shape.to_json(), found.shape.to_json()
    other = [
        f"{name} {there[name]} instead of {here[name]}"
        for name in here
        if here[name] != there[name]
    ]
    if other:
        raise AegisError(
            f"the expert of '{start}' has {', '.join(other)}",
            "an expert of the same robot and the same kind of backbone",
            "set train.chunk, expert.width and expert.mlp_ratio to those of that run, give it as "
            "--set backbone=… too, or delete expert.start",
        )
    _warn_of_other_units(start, meta, recipe.train.normalization, recorded, on_event)
    return found


def _warn_of_other_units(
    start: str,
    meta: PolicyMeta,
    normalization: str,
    recorded: Mapping[str, Any],
    on_event: OnEvent,
) -> None:
    """Warn of an expert whose units differ here: another normalization, or steps of another length.

    It learns the new units, but its weights are then a poor starting point.
    """
    known = meta.get("normalization", normalization)
    if known != normalization:
        text = (
            f"the expert of '{start}' was trained with train.normalization: {known}, and this "
            f"training has {normalization}: its predictions are on a different scale here; --set "
            f"train.normalization={known}"
        )
        on_event(Warned("train", text))
    before, now = meta.get("fps"), recorded.get("fps")
    if before is not None and now is not None and before != now:
        text = (
            f"the expert of '{start}' was trained on {before:g} frames a second, and these "
            f"demonstrations have {now:g}: its actions are meant for steps of a different length"
        )
        on_event(Warned("train", text))


def _told(relative: Places) -> str:
    if not relative:
        return "absolute actions"
    own = ", ".join("absolute" if place is None else f"to {place}" for place in relative)
    return f"actions relative to positions ({own})"
