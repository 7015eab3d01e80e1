"""How several processes share the weights and gradients of a training run.

`ddp`: every process has all weights, and takes the same step from gradients that are summed here.
PyTorch's own wrapper would sum them during the backward pass, and could not tell apart the two
backward passes over one graph. `fsdp`: every process has some rows of each weight (PyTorch's
`fully_shard`), and gradients arrive summed.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Generator, Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.utils import _pytree as pytree

from aegis_cli import recipes
from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import Ranks, whole
from aegis_cli.common.ranks import is_sharded as is_cut
from aegis_cli.methods.backward import Groups
from aegis_cli.methods.base import Method
from aegis_cli.methods.lora import LowRankLinear
from aegis_cli.models import structure
from aegis_cli.models.backbones.base import Backbone, Encoding
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Recipe, Train

if TYPE_CHECKING:
    from torch.distributed.fsdp import MixedPrecisionPolicy

# Modules whose parameters are used only in matrix products that autocast rounds.
_PRODUCTS = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d, LowRankLinear)


def check(recipe: Recipe, method: Method, ranks: Ranks) -> None:
    """Refuse what several processes, or several passes per step, cannot do.

    Raises:
        AegisError: there are fewer frames than passes, or an option needs a single process.
    """
    settings, options = recipe.train, recipes.options(recipe)
    parts = ranks.count * settings.accumulate
    sizes = {"train.batch_size": settings.batch_size}
    if method.trains_on_questions(options):
        sizes[f"{method.name}.batch_size"] = options["batch_size"]
    for name, size in sizes.items():
        if size < parts:
            raise AegisError(
                f"{name}: {size} in {settings.accumulate} passes of {ranks.count} processes",
                f"at least {parts}, one for each",
                f"--set {name}={parts}, or a lower train.accumulate, or fewer processes",
            )
    if shards(settings, ranks):
        _check_sharding(settings, method)
    if ranks.several and options.get("fraction", 1) < 1:
        raise AegisError(
            f"aegis.fraction: {options['fraction']:g} in {ranks.count} processes",
            "the anchor gradient of the whole batch, of which each process has its share",
            "--set aegis.fraction=1, and aegis.refresh for a cheaper step; or one process",
        )


def shards(settings: Train, ranks: Ranks) -> bool:
    """Whether each process keeps only some rows of each weight."""
    return ranks.several and settings.parallel == "fsdp"


def _check_sharding(settings: Train, method: Method) -> None:
    fix = "--set train.parallel=ddp"
    if not method.shards:
        raise AegisError(
            f"train.parallel: fsdp with method '{method.name}'",
            "a method that works with weights sharded by rows",
            fix,
        )
    if settings.compile:
        raise AegisError("train.parallel: fsdp with train.compile", "one of the two", fix)


def shard(policy: Policy, precision: str, device: torch.device) -> None:
    """Let every process keep some rows of each weight; a block's weights are gathered when it runs.

    The policy may be on the CPU: its blocks are moved to the device and sharded one by one.

    Gradients arrive summed, not averaged: the losses are divided by the size of the whole batch.

    Args:
        precision: of the passes; if matrix products are in bfloat16, so are the weights that a
            block gathers. The rows that each process keeps stay as they are.
    """
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import (
        FSDPModule,
        MixedPrecisionPolicy,
        fully_shard,
        register_fsdp_forward_method,
    )

    _tell_of_encodings()
    mesh = init_device_mesh(device.type, (dist.get_world_size(),))
    as_kept = MixedPrecisionPolicy()
    policies = dict.fromkeys(_blocks(policy.backbone), as_kept)
    if devices.takes_bf16(device, precision):
        policies = _halved(policies)
    # These two are gathered as they are: their embeddings start the residual stream, which autocast
    # keeps in float32. PyTorch would otherwise keep the outermost unsharded from forward to
    # backward.
    policies |= {policy.backbone: as_kept, policy.expert: as_kept}
    for module, of_messages in policies.items():
        fully_shard(module, mesh=mesh, reshard_after_forward=True, mp_policy=of_messages)
    for part in (policy.proprio_scale, policy.action_scale, policy.origins):  # not sharded
        part.to(device)
    for name in ("encode", "answer_log_likelihood"):
        register_fsdp_forward_method(policy.backbone, name)
    for module in policy.modules():
        if isinstance(module, FSDPModule):
            module.set_gradient_divide_factor(1.0)
            module.set_force_sum_reduction_for_comms(True)  # gloo has no scaled sums
    # Keys and values are views of a layer's products. Nothing here writes into them.
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view tensor")


@cache
def _tell_of_encodings() -> None:
    """Let PyTorch find the tensors of an `Encoding`, as it does by itself since 2.13.

    The gradients of a module's output tell it when to gather the module's weights again.
    """
    pytree.register_dataclass(Encoding)


def _halved(blocks: Iterable[nn.Module]) -> dict[nn.Module, MixedPrecisionPolicy]:
    """How parts of blocks are gathered, the inner ones first, if products are in bfloat16.

    Autocast rounds the inputs of a matrix product, weights included. So these weights are gathered
    rounded, which halves the message and changes no product. Autocast leaves the inputs of other
    operations, such as a norm's weights, as they are: such modules are gathered separately, without
    rounding. Gradients are summed in float32 either way.
    """
    from torch.distributed.fsdp import MixedPrecisionPolicy

    as_kept = MixedPrecisionPolicy()
    half = MixedPrecisionPolicy(
        param_dtype=torch.bfloat16, reduce_dtype=torch.float32, cast_forward_inputs=False
    )
    found = {}
    for block in blocks:
        # A module comes before its submodules; they have to be sharded in the reverse order.
        for module in reversed(list(block.modules())):
            owns = any(True for _ in module.parameters(recurse=False))
            if owns and not isinstance(module, _PRODUCTS):
                found[module] = as_kept
        found.setdefault(block, half)
    return found


def _blocks(backbone: Backbone) -> list[nn.Module]:
    """The modules that are gathered separately, such as a transformer's layers.

    The last language layer is not among them: what the expert reads of a Hugging Face layer leaves
    it through a hook, so its gradient bypasses the output, which tells PyTorch when to gather.
    Together with what lies outside the blocks, that layer is gathered through the outputs of
    `encode`.
    """
    last = {id(p) for p in backbone.parameter_groups()[f"layers.{backbone.depth - 1}"]}
    blocks = [block for blocks in structure.outermost_lists(backbone) for block in blocks]
    return [block for block in blocks if not any(id(p) in last for p in block.parameters())]


@torch.no_grad()
def gathered(tensors: Mapping[str, Tensor], ranks: Ranks) -> dict[str, Tensor]:
    """All rows of each tensor, on the CPU of the first process; the others get none."""
    found = {}
    for name, tensor in tensors.items():
        everything = whole(tensor)
        if ranks.first:
            found[name] = everything.cpu()
    return found


@torch.no_grad()
def filled(plain: Policy, weights: Mapping[str, Tensor]) -> Policy:
    """Copy these weights and buffers, by their names in the policy, into an unsharded policy.

    Others stay: frozen weights are the same in both.
    """
    for name, tensor in [*plain.named_parameters(), *plain.named_buffers()]:
        if name in weights:
            tensor.copy_(weights[name])
    return plain


@contextlib.contextmanager
def made_whole(policy: Policy, plain: Policy | None, ranks: Ranks) -> Generator[None]:
    """Give an unsharded policy a sharded one's weights inside the block, on the same device.

    Args:
        plain: the unsharded policy, in the first process; outside the block it is on the CPU, since
            a GPU may have no room for it beside a step.
    """
    weights = gathered(dict([*policy.named_parameters(), *policy.named_buffers()]), ranks)
    if plain is not None:
        filled(plain, weights).to(policy.backbone.device)
    weights.clear()  # the copy on the CPU is as large as the policy
    try:
        yield
    finally:
        if plain is not None:
            plain.to("cpu")


def is_sharded(policy: Policy) -> bool:
    """Whether a process has only some rows of each weight."""
    # If its module was never imported, which is slow, no object can be of that class.
    fsdp = sys.modules.get("torch.distributed.fsdp")
    return fsdp is not None and isinstance(policy.backbone, fsdp.FSDPModule)


@torch.no_grad()
def share_averages(backbone: Backbone, ranks: Ranks) -> None:
    """Average the running statistics of modules such as BatchNorm over the processes.

    Each process's modules see only its own frames. Training passes do not read the statistics,
    which are linear in what was seen. So it is enough to do this before they are read, and doing it
    more often gives the same result.
    """
    averaging = structure.averaging(backbone).values()
    # Frozen modules are the same everywhere, and stay equal bit for bit.
    following = [module for module in averaging if module.training]
    buffers = [b for module in following for b in module.buffers(recurse=False)]
    averages = [b for b in buffers if b.is_floating_point()]  # not the number of batches
    ranks.add_up(averages)
    for average in averages:
        average /= ranks.count


@torch.no_grad()
def add_up_gradients(policy: Policy, ranks: Ranks) -> None:
    """Sum every `.grad` over the processes, unless FSDP has already done so."""
    if not ranks.several or is_sharded(policy):
        return
    learning = [p for p in policy.parameters() if p.requires_grad]
    found = _summed(learning, [p.grad for p in learning], ranks)
    for parameter, gradient in zip(learning, found, strict=True):
        parameter.grad = gradient


@torch.no_grad()
def added_up(
    gradients: Mapping[int, Tensor | None], groups: Groups, ranks: Ranks
) -> dict[int, Tensor | None]:
    """The sum of each gradient over the processes, by the parameters' ids."""
    parameters = [p for group in groups for p in group]
    given = [gradients[id(p)] for p in parameters]
    # FSDP has already summed the gradients of sharded parameters.
    if not ranks.several or any(map(is_cut, parameters)):
        return dict(gradients)
    # Copies: autograd may give several parameters the same tensor.
    copies = [None if g is None else g.clone() for g in given]
    ids = [id(p) for p in parameters]
    return dict(zip(ids, _summed(parameters, copies, ranks), strict=True))


def _summed(
    parameters: Iterable[nn.Parameter], gradients: list[Tensor | None], ranks: Ranks
) -> list[Tensor | None]:
    """Gradients summed in place; None only if no process has one."""
    # A sum needs the same tensors from every process. A process whose frames gave a parameter no
    # gradient adds zeros; if no process has one, it stays None, and the weight is not updated.
    somewhere = ranks.any(*(g is not None for g in gradients))
    found: list[Tensor | None] = []
    for parameter, gradient, there in zip(parameters, gradients, somewhere, strict=True):
        found.append(torch.zeros_like(parameter) if there and gradient is None else gradient)
    ranks.add_up([g for g in found if g is not None])
    return found
