"""How several processes share a training's weights and gradients.

`ddp`: every process has all weights, and takes the same step from gradients that are summed here.
PyTorch's own wrapper would sum them while they are made, and could not tell the two backward passes
over one graph apart. `fsdp`: every process has some rows of each weight (PyTorch's `fully_shard`),
and gradients arrive summed.
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

# Modules whose parameters enter matrix products alone, and those of autocast.
_PRODUCTS = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d, LowRankLinear)


def check(recipe: Recipe, method: Method, ranks: Ranks) -> None:
    """Refuse what several processes, or several passes a step, cannot do.

    Raises:
        AegisError: too few frames for each to have one, or an option that needs one process.
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
    """Whether each process is to keep some rows of each weight alone."""
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
    """Let every process keep some rows of each weight; a block's are gathered where it is at work.

    The policy may be on the CPU: its blocks go to the device one by one, and there each is cut
    before the next one comes.

    Gradients come summed, not averaged: the losses have the whole batch's divisor.

    Args:
        precision: of the passes; where matrix products are in bfloat16, so are the weights that a
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
    # These two are gathered as they are: their embeddings begin the residual stream, which autocast
    # keeps in float32. PyTorch would else leave the outermost whole between forward and backward.
    policies |= {policy.backbone: as_kept, policy.expert: as_kept}
    for module, of_messages in policies.items():
        fully_shard(module, mesh=mesh, reshard_after_forward=True, mp_policy=of_messages)
    for part in (policy.proprio_scale, policy.action_scale, policy.origins):  # nothing cuts them
        part.to(device)
    for name in ("encode", "answer_log_likelihood"):
        register_fsdp_forward_method(policy.backbone, name)
    for module in policy.modules():
        if isinstance(module, FSDPModule):
            module.set_gradient_divide_factor(1.0)
            module.set_force_sum_reduction_for_comms(True)  # gloo knows no scaled sums
    # Keys and values are views of a layer's products. Nothing here writes into them.
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view tensor")


@cache
def _tell_of_encodings() -> None:
    """Let PyTorch find the tensors of an `Encoding`, as it does by itself since 2.13.

    By the gradients of a module's output it knows when to gather the module's weights again.
    """
    pytree.register_dataclass(Encoding)


def _halved(blocks: Iterable[nn.Module]) -> dict[nn.Module, MixedPrecisionPolicy]:
    """How the parts of blocks are gathered, the inner ones first, where products are in bfloat16.

    Autocast rounds what enters a matrix product, its weights too. So these are gathered rounded,
    which halves the message and changes no product. What enters another operation, such as a norm's
    weights, autocast leaves as it is: such modules are gathered by themselves, whole.
    Gradients are summed in float32 either way.
    """
    from torch.distributed.fsdp import MixedPrecisionPolicy

    as_kept = MixedPrecisionPolicy()
    half = MixedPrecisionPolicy(
        param_dtype=torch.bfloat16, reduce_dtype=torch.float32, cast_forward_inputs=False
    )
    found = {}
    for block in blocks:
        # A module comes before what it holds; the reverse is the order in which to shard.
        for module in reversed(list(block.modules())):
            owns = any(True for _ in module.parameters(recurse=False))
            if owns and not isinstance(module, _PRODUCTS):
                found[module] = as_kept
        found.setdefault(block, half)
    return found


def _blocks(backbone: Backbone) -> list[nn.Module]:
    """The modules that are gathered by themselves, such as a transformer's layers.

    The last language layer is not: what the expert reads of a Hugging Face one leaves it by a hook,
    so that a gradient comes back past the output, by which PyTorch knows that it is time to gather.
    With what lies outside the blocks it is gathered by what `encode` returns.
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
    """A whole policy with these weights, which have its names, and with the buffers among them."""
    for name, parameter in plain.named_parameters():
        parameter.copy_(weights[name])
    for name, buffer in plain.named_buffers():
        if name in weights:
            buffer.copy_(weights[name])
    return plain


@contextlib.contextmanager
def made_whole(policy: Policy, plain: Policy | None, ranks: Ranks) -> Generator[None]:
    """Let a whole policy have a sharded one's weights inside the block, on the same device.

    Args:
        plain: the whole one, in the first process; it is on the CPU otherwise, since a GPU may have
            no room for it beside a step.
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
    # The class cannot occur where nobody has imported its module, which takes long.
    fsdp = sys.modules.get("torch.distributed.fsdp")
    return fsdp is not None and isinstance(policy.backbone, fsdp.FSDPModule)


@torch.no_grad()
def share_averages(backbone: Backbone, ranks: Ranks) -> None:
    """Make what modules such as BatchNorm average of frames the mean over the processes.

    Each process's modules read its own frames alone. Training passes do not read the averages, and
    they are linear in what was read. So it is enough to do this before somebody does read them, and
    to do it more often leads to the same.
    """
    averaging = structure.averaging(backbone).values()
    # What is frozen is the same everywhere, and stays so to the last bit.
    following = [module for module in averaging if module.training]
    buffers = [b for module in following for b in module.buffers(recurse=False)]
    averages = [b for b in buffers if b.is_floating_point()]  # not the number of batches
    ranks.add_up(averages)
    for average in averages:
        average /= ranks.count


@torch.no_grad()
def add_up_gradients(policy: Policy, ranks: Ranks) -> None:
    """Make every `.grad` its sum over the processes, where it is not yet."""
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
    # FSDP has summed those of sharded parameters on their way into `.grad`.
    if not ranks.several or any(map(is_cut, parameters)):
        return dict(gradients)
    # Copies: autograd may give several parameters one and the same tensor.
    copies = [None if g is None else g.clone() for g in given]
    ids = [id(p) for p in parameters]
    return dict(zip(ids, _summed(parameters, copies, ranks), strict=True))


def _summed(
    parameters: Iterable[nn.Parameter], gradients: list[Tensor | None], ranks: Ranks
) -> list[Tensor | None]:
    """Gradients summed in place; None only where no process has one."""
    # A sum needs the same tensors from every process. One whose share of the frames has given a
    # parameter no gradient adds zeros; where nobody has one, it stays None, and the weight is left.
    somewhere = ranks.any(*(g is not None for g in gradients))
    found: list[Tensor | None] = []
    for parameter, gradient, there in zip(parameters, gradients, somewhere, strict=True):
        found.append(torch.zeros_like(parameter) if there and gradient is None else gradient)
    ranks.add_up([g for g in found if g is not None])
    return found
