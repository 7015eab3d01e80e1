"""A training run, built before the first step from what `loading` has loaded and checked."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn

from aegis_cli import recipes
from aegis_cli.common import devices, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.common.watched_files import WatchedFiles
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.ledger import Ledger
from aegis_cli.data import demonstrations, mixture
from aegis_cli.data.batch import Normalizer, Share
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.selection import Paths
from aegis_cli.data.vqa.images import tensors
from aegis_cli.methods import ledger_file
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models import structure
from aegis_cli.models.backbones.base import FLOAT32, Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Recipe, RobotStreamRecipe, Train
from aegis_cli.training import (
    card,
    checkpoint,
    eight_bit,
    freezing,
    loading,
    optimizers,
    parallel,
    retention,
)
from aegis_cli.training.average import Average
from aegis_cli.training.masters import BF16_MASTER, NONE, Masters, check_masters
from aegis_cli.training.schedule import BatchOrder
from aegis_cli.training.step_figures import UnreadFigures
from aegis_cli.training.validation_actions import ValidationActions
from aegis_cli.training.validation_rollout import ValidationEpisodes
from aegis_cli.training.validation_vqa import ValidationQuestions

T = TypeVar("T")


@dataclass
class TrainingRun:
    """A run at some step.

    Attributes:
        ranks: the processes that take its steps together.
        plain: in the first process, an unsharded policy of the same shape, through which a sharded
            policy is written and asked questions; None if the policy is not sharded.
        watched: the anchor's file, which stays memory-mapped.
        temporary: the checkpoint of an interruption, if the run was resumed from one; the next
            checkpoint replaces it.
        unread: figures of past steps that have not been read yet.
        reused: the anchor gradient that the next steps share, by the backbone's parameter names;
            None if each step computes its own.
        masters: the float32 weights that passes see rounded.
        began_as: as in `loading.Loaded`.
        questions: what the backbone is asked at every validation; None for no questions.
        episodes: episodes that the policy acts in at every validation; None for none.
        actions: held-out frames for which it predicts actions at every validation; None for none.
        told_of_drop: whether the user was told that accuracy dropped further than the recipe
            allows.
        told_of_few: whether the user was told that, or that too few questions tell.
    """

    recipe: Recipe
    method: Method
    out: Path
    inputs: dict[str, str]
    demos: demonstrations.Demonstrations
    policy: Policy
    parts: Parts
    stepper: Stepper
    optimizers: list[torch.optim.Optimizer]
    ledger: Ledger
    ranks: Ranks = ALONE
    plain: Policy | None = None
    watched: WatchedFiles = field(default_factory=WatchedFiles)
    temporary: Path | None = None
    reused: Mapping[str, Tensor] | None = None
    unread: UnreadFigures = field(default_factory=UnreadFigures)
    masters: Masters = NONE
    average: Average = field(default_factory=Average)
    began_as: str | None = None
    questions: ValidationQuestions | None = None
    episodes: ValidationEpisodes | None = None
    actions: ValidationActions | None = None
    told_of_drop: bool = False
    told_of_few: bool = False

    @property
    def learns_vlm(self) -> bool:
        """Whether anything of the backbone learns."""
        return any(p.requires_grad for p in self.policy.backbone.parameters())

    @property
    def shown(self) -> Policy:
        """The policy, with whole weights, that answers, acts and predicts during training.

        If weights are sharded, only the first process has it, and its weights are current only
        inside `by_whole`.
        """
        return self.policy if self.plain is None else self.plain

    def by_whole(self, find: Callable[[Ranks], T]) -> T:
        """The result of `find`, called by all processes whose `shown` has whole weights.

        If weights are sharded, they are gathered to the first process, which calls `find` alone and
        sends the result to the others, which wait.

        Args:
            find: the function to call with the processes that run it together.
        """
        if not parallel.is_sharded(self.policy):
            return find(self.ranks)
        with parallel.made_whole(self.policy, self.plain, self.ranks):
            return self.ranks.by_first(partial(find, ALONE))

    @property
    def rates(self) -> list[dict[str, Any]]:
        """The optimizers' groups of parameters with a learning rate, the backbone's first."""
        return [group for optimizer in self.optimizers for group in optimizer.param_groups]

    @property
    def learning(self) -> list[nn.Parameter]:
        """Every trainable parameter."""
        return [p for group in self.rates for p in group["params"]]

    @property
    def meta(self) -> PolicyMeta:
        """The metadata that a user of the policy needs."""
        found: dict[str, Any] = {
            "method": self.method.name,
            "task": self.demos.task,
            "replan": self.recipe.rollout.replan,
            "normalization": self.recipe.train.normalization,
        }
        if self.recipe.rollout.ensemble is not None:
            found["ensemble"] = self.recipe.rollout.ensemble
        found |= recipes.selected(self.recipe)
        found |= self.demos.recorded
        if self.policy.origins.places:
            found["relative"] = list(self.policy.origins.places)
        scale, normalization = self.policy.action_scale, found["normalization"]
        if "relative" in found or not is_spread(scale, normalization, self.demos):
            found["action_std"] = self.demos.action_std
        reach = self.demos.proprio_reach(self.policy.proprio_scale, normalization)
        found |= {} if reach is None else {"proprio_reach": reach}
        if self.demos.datasets:
            one, *others = self.demos.datasets
            found["dataset"] = [one, *others] if others else one
        if self.policy.backbone.hub_id is not None:
            found["base_model"] = self.policy.backbone.hub_id
        if self.began_as is not None:
            found["began_as"] = self.began_as
        found |= view(self.demos, self.policy.backbone)
        if self.policy.backbone.stored != FLOAT32:
            found["stored"] = self.policy.backbone.stored
        return cast(PolicyMeta, found)

    @property
    def order(self) -> BatchOrder:
        """Which training frames each step uses, as indices into them."""
        count, batch = len(self.demos.train), self.recipe.train.batch_size
        return BatchOrder(count, batch, self.recipe.seed, self.shares)

    @property
    def shares(self) -> list[tuple[int, int]]:
        """Each set's frame count, and how many an epoch draws; empty if each frame comes once."""
        weights = self.recipe.demos.weights
        if weights is None:
            return []
        sizes = (member.train for member in self.demos.members)
        return list(zip(sizes, mixture.drawn(self.demos, weights), strict=True))

    def save_checkpoint(self, steps: int, going_on: Mapping[str, Any] | None = None) -> None:
        """Write a checkpoint and the ledger so far; with several processes, the first one writes.

        Args:
            going_on: what else a resumed run needs to know, written to the training state's header.

        Raises:
            AegisError: it cannot be written, or the files trained on have changed meanwhile.
        """
        self.demos.check_files()
        self.watched.check()
        # The first step of an interval computes its own gradient.
        reused = (self.reused or {}) if self.parts.reuses(steps) else {}
        self.average.follow(steps)
        state = checkpoint.state_of(self.policy, self.optimizers, reused, self.average.weights)
        if parallel.is_sharded(self.policy):
            state = state._replace(tensors=parallel.gathered(state.tensors, self.ranks))
        if self.ranks.first:
            self._write(steps, state, going_on)
        # GPU collectives would time out if the first process writes for ten minutes.
        self.ranks.wait()

    def _write(
        self,
        steps: int,
        state: checkpoint.State,
        going_on: Mapping[str, Any] | None,
    ) -> None:
        """Write a checkpoint, as the first of the processes."""
        policy, averaged = self.policy, self.average.in_place
        if self.plain is not None:
            policy = parallel.filled(self.plain, checkpoint.policy_of(state))
            averaged = nullcontext
        # The ledger first. If the process ends between the two, the ledger is ahead of the last
        # checkpoint, and a resumed run truncates it; a ledger that lacks rows would have to be
        # refused.
        with checkpoint.writing(self.out):
            ledger_file.save(
                self.out / "ledger.safetensors",
                self.ledger,
                self.meta,
                self.inputs,
                self.recipe.seed,
            )
        shown = card.Data(
            self.demos.task, self.demos.cameras, len(self.demos.train), len(self.demos.validation)
        )
        readme = card.text(
            self.recipe, self.method, steps, shown, self.inputs, self.ledger, self.began_as
        )
        saved = checkpoint.save(
            self.out,
            steps,
            policy,
            self.method,
            state,
            meta=self.meta,
            inputs=self.inputs,
            seed=self.recipe.seed,
            card=readme,
            going_on=going_on,
            wide=self.recipe.train.weights == BF16_MASTER,
            averaged=averaged,
        )
        # `temporary` is a resolved path; `out` may be relative, or lead through a link.
        is_same = self.temporary == saved.resolve()
        if self.temporary is not None and not (going_on and is_same):
            if not is_same:
                shutil.rmtree(self.temporary, ignore_errors=True)
            self.temporary = None
        kept = self.recipe.train.keep_checkpoints
        # The checkpoint of an interruption goes when the next one is written, and replaces none
        # until then.
        if kept is not None and not going_on:
            retention.prune(self.out, steps, kept, self.recipe)


def build(
    recipe: Recipe,
    method: Method,
    demos: Paths,
    anchor: Path | None,
    out: Path,
    on_event: OnEvent,
    ranks: Ranks = ALONE,
) -> TrainingRun:
    """Load and check the inputs, adapt the backbone, start the method.

    Args:
        demos: one set, or several to learn from together.
        ranks: the processes that take its steps together, each of which builds the same run.

    Raises:
        AegisError: inputs that do not fit together.
    """
    parallel.check(recipe, method, ranks)
    check_masters(recipe.train, ranks)
    eight_bit.check(recipe.train, ranks)
    device, shards = devices.pick(), parallel.shards(recipe.train, ranks)
    devices.warn_of_slow_bf16(device, recipe.train.precision, on_event)
    loaded = loading.load(recipe, method, demos, anchor, on_event, ranks)
    backbone, measured = loaded.backbone, loaded.measured
    policy = _begun_policy(recipe, loaded, on_event)
    source = loading.questions(method, recipes.options(recipe), on_event)
    # Before the method adapts the backbone: an anchor's sites are named as in the plain backbone.
    sites = backbone.sites() if measured and (measured.inputs or measured.curvature) else {}
    masters = _adapted(recipe, method, backbone, on_event)
    # The first process writes checkpoints from an unsharded copy, which includes what the method
    # added.
    plain = copy.deepcopy(policy) if shards and ranks.first else None
    owners = ranks if shards else ALONE
    # Sharding replaces the parameters, so whatever holds references to them is made afterwards: the
    # method's groups, the optimizers and the average.
    if shards:
        parallel.shard(policy, recipe.train.precision, device)
    parts = _start(recipe, method, policy, loaded.demos, measured, sites, source, owners, on_event)
    _check_weights(recipe, parts)
    if recipe.train.compile:
        backbone.compile_passes()
        policy.expert.compile_layers()
    made = optimizers.make(policy, recipe.train, rate_per_parameter=parts.shares is not None)
    return TrainingRun(
        recipe=recipe,
        method=method,
        out=out,
        inputs=loading.digests(recipe, loaded, source),
        demos=loaded.demos,
        policy=policy,
        parts=parts,
        stepper=Stepper(backbone, parts, may_shard=owners.several),
        optimizers=made,
        ledger=_ledger(parts, backbone),
        ranks=ranks,
        plain=plain,
        watched=loaded.watched,
        unread=UnreadFigures.of(backbone.device, made, parts, sharded=owners.several),
        masters=masters,
        average=_average(recipe.train, policy),
        began_as=loaded.began_as,
    )


def _begun_policy(recipe: Recipe, loaded: loading.Loaded, on_event: OnEvent) -> Policy:
    """The policy before the first step, with its backbone in the dtype that the recipe asks for."""
    # After the fingerprint: the anchor was measured on the weights before rounding.
    _fit(loaded.backbone, recipe)
    torch.manual_seed(recipe.seed)  # the expert has the same initial weights under every method
    return _policy(recipe, loaded.backbone, loaded.demos, on_event)


def _adapted(recipe: Recipe, method: Method, backbone: Backbone, on_event: OnEvent) -> Masters:
    """Make trainable what the method trains, unless `train.freeze` names it; return the masters."""
    own = list(backbone.parameters())
    freezing.adapt(method, backbone, recipes.options(recipe), recipe.train.freeze, on_event)
    # Afterwards, since adapters are float32 anyway, and frozen weights need no master.
    return Masters.of(own) if recipe.train.weights == BF16_MASTER else NONE


def _average(settings: Train, policy: Policy) -> Average:
    """The average of the trainable weights as they are now; an empty one if none is asked for."""
    if settings.ema_decay is None:
        return Average()
    learning = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    return Average(learning, settings.ema_decay)


def _ledger(parts: Parts, backbone: Backbone) -> Ledger:
    """A ledger of the trainable groups and all layers; without columns for one backward pass."""
    if not parts.dual:
        return Ledger([], [])
    return Ledger(list(backbone.learning_groups()), [f"layers.{i}" for i in range(backbone.depth)])


def _fit(backbone: Backbone, recipe: Recipe) -> None:
    """Apply the recipe's weight dtype and gradient checkpointing to the backbone.

    Raises:
        AegisError: the backbone cannot do so, or two settings exclude each other.
    """
    if recipe.train.compile and recipe.train.gradient_checkpointing:
        raise AegisError(
            "train.compile with train.gradient_checkpointing",
            "one of the two",
            "--set train.compile=false",
        )
    round_weights(backbone, recipe.train.weights)
    if recipe.train.gradient_checkpointing:
        backbone.checkpoint_gradients()


def round_weights(backbone: Backbone, weights: str) -> None:
    """Round the backbone's weights if `train.weights` is bf16.

    Raises:
        AegisError: the backbone has to be float32.
    """
    if weights != "float32" and not backbone.rounds:
        raise AegisError(
            f"train.weights: {weights} with the embedded backbone",
            "a Hugging Face backbone",
            "--set train.weights=float32",
        )
    if weights == "bf16":
        backbone.round_weights(torch.bfloat16)


def _check_weights(recipe: Recipe, parts: Parts) -> None:
    """Refuse half-precision weights for a method that constrains the applied update.

    The rounding would be as large as the update.
    """
    if recipe.train.weights == "bf16" and parts.constrain is not None:
        raise AegisError(
            f"train.weights: bf16 with method '{recipe.train.method}', which constrains the "
            "applied update",
            "weights that keep small steps",
            f"--set train.weights={BF16_MASTER}; or float32, and --set train.precision=bf16 "
            "for fast products",
        )


def _start(
    recipe: Recipe,
    method: Method,
    policy: Policy,
    demos: demonstrations.Demonstrations,
    anchor: Anchor | None,
    sites: Mapping[str, str],
    source: loading.Questions | None,
    owners: Ranks,
    on_event: OnEvent,
) -> Parts:
    options, backbone = recipes.options(recipe), policy.backbone
    vqa_loss = None if source is None else _vqa_loss(backbone, recipe, source, on_event)
    context = MethodContext(
        backbone=backbone,
        groups=backbone.learning_groups(),
        sites=_learning_sites(backbone, sites, options),
        options=options,
        anchor=anchor,
        vqa_loss=vqa_loss,
        instructions=demos.texts,
        targets=policy.targets_on_cpu(),
        actions=len(policy.action_scale.mean),
        owners=owners,
    )
    return method.start(context)


def _learning_sites(
    backbone: Backbone, sites: Mapping[str, str], options: Mapping[str, Any]
) -> dict[str, str]:
    """The trainable sites.

    Raises:
        AegisError: a site of which only a part is trainable, or no trainable site of the protected
            kinds.
    """
    found = {site: kind for site, kind in sites.items() if not structure.frozen(backbone, site)}
    kinds = options.get("protect", ())  # only nullspace has such an option
    if any(kind in kinds for kind in sites.values()) and not set(found.values()) & set(kinds):
        raise AegisError(
            f"nothing that learns is of the kinds {', '.join(kinds)}",
            "a map to protect",
            "name kinds that learn in nullspace.protect, or freeze less",
        )
    return found


def _vqa_loss(
    backbone: Backbone, recipe: Recipe, source: loading.Questions, on_event: OnEvent
) -> Callable[[Pass], Tensor]:
    """Mean cross-entropy, in nats, of an answer over a step's batch of training questions."""
    options, checks = recipes.options(recipe), [backbone.check_text]
    chosen = source.choose("train", options["questions"], recipe.seed, checks, on_event)
    asked = chosen.sized(backbone.image_size)
    order = BatchOrder(len(asked.questions), options["batch_size"], recipe.seed)
    waits = devices.reading_stalls(backbone.device)

    def make(place: tuple[int, Share]) -> tuple[Any, list[str], list[str], Any]:
        """The images, questions and answers of one share of a step, prepared for the backbone."""
        number, share = place
        # Questions about the same image are put side by side, so that it is encoded once.
        rows = sorted(order.rows(number)[share.rows(options["batch_size"])].tolist())
        questions = [asked.questions[i] for i in rows]
        images = tensors(asked.images[asked.image_of[rows]])
        texts, answers = [q.text for q in questions], [q.answer for q in questions]
        prepared = backbone.prepare_answers(images, texts, answers) if waits else None
        return images, texts, answers, prepared

    def same_of_next_step(place: tuple[int, Share]) -> tuple[int, Share]:
        number, share = place
        return number + 1, share

    # Otherwise a step would wait for images to be decoded and scaled.
    fetch = prefetch.one_ahead(make, same_of_next_step) if waits else make

    def loss(seen: Pass) -> Tensor:
        images, texts, answers, prepared = fetch((seen.step, seen.share))
        said = -backbone.answer_log_likelihood(images, texts, answers, prepared)  # [N]
        if seen.total is None:
            return said.mean()
        # Divided by the questions of all processes: gradients are summed over processes, not
        # averaged.
        return said.sum() / seen.total(said.new_tensor(len(texts)))

    return loss


def _policy(
    recipe: Recipe,
    backbone: Backbone,
    demos: demonstrations.Demonstrations,
    on_event: OnEvent,
) -> Policy:
    train = recipe.train
    relative = demos.relative_places(train.relative_exclude or ()) if train.relative_actions else ()
    proprio, action = demos.scales(train.normalization, train.chunk, relative)
    shape = expert_shape(backbone, recipe, len(proprio.mean), len(action.mean))
    expert = ActionExpert(shape)
    expert.recomputes = train.gradient_checkpointing
    if recipe.expert.start is not None:
        begun = loading.begun_expert(recipe, shape, relative, demos.recorded, on_event)
        expert.load_state_dict(begun.state_dict())
    return Policy(backbone, expert, proprio, action, relative).to(backbone.device)


def is_spread(scale: Normalizer, normalization: str, demos: Demonstrations) -> bool:
    """Whether a scale of absolute actions is their standard deviation over the training frames."""
    # An action that hardly varies compared with its mean has a scale of 1, or 0.
    found, spread = scale.std.cpu().double(), torch.tensor(demos.action_std).double()
    return normalization == "mean_std" and torch.allclose(found, spread, rtol=1e-4)


def view(demos: Demonstrations, backbone: Backbone) -> PolicyMeta:
    """How the policy saw its demonstrations: the entries `cameras` and `pictures` of its meta."""
    found: dict[str, Any] = {}
    if demos.cameras:
        found["cameras"] = list(demos.cameras)
    if backbone.image_size is None:
        found["pictures"] = [list(frames.shape[1:3]) for frames in demos.frames]
    return cast(PolicyMeta, found)


def expert_shape(
    backbone: Backbone, recipe: Recipe | RobotStreamRecipe, proprio: int, actions: int
) -> ExpertShape:
    """The shape of an expert that reads this backbone.

    Args:
        proprio: joint positions and other readings per frame.
        actions: dimensions of an action.
    """
    return ExpertShape(
        depth=backbone.depth,
        heads=backbone.heads,
        head_dim=backbone.head_dim,
        proprio=proprio,
        actions=actions,
        chunk=recipe.train.chunk,
        width=recipe.expert.width,
        mlp_ratio=recipe.expert.mlp_ratio,
        # None if they are equal: a shape without grouped-query attention is written so.
        kv_heads=backbone.kv_heads if backbone.kv_heads != backbone.heads else None,
    )
