"""The processes that train one guarded model together, and their averages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch import distributed as dist

from aegis_cli.common.errors import AegisError

WORLD = "world"  # all processes, even if they are connected only after the guard was created
ProcessGroup = dist.ProcessGroup | str | None


def count() -> int:
    """How many processes torch.distributed has connected so far; 1 if it has none."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def resolved(group: ProcessGroup) -> dist.ProcessGroup | None:
    """The group that is meant; None if the processes are not connected yet.

    Raises:
        AegisError: it is a string other than "world".
    """
    if not isinstance(group, str):
        return group
    if group != WORLD:
        raise AegisError(
            f"process_group={group!r}",
            f"a group of torch.distributed, or {WORLD!r}",
            f"process_group={WORLD!r}",
        )
    return dist.group.WORLD if count() > 1 else None


def check(group: ProcessGroup) -> None:
    """Raise AegisError if several processes run and no group names those that share a model."""
    if resolved(group) is None and count() > 1:
        raise AegisError(
            f"a guard in one of {count()} processes without process_group=",
            "those that train one model together",
            f"process_group={WORLD!r}, under DistributedDataParallel or FSDP2",
        )


@torch.no_grad()
def mean_over(tensors: Sequence[Tensor], group: dist.ProcessGroup) -> list[Tensor]:
    """Mean of each tensor over the group's processes.

    The means are new tensors, because autograd may return the same one for several parameters.
    """
    means = [tensor / dist.get_world_size(group) for tensor in tensors]
    # All are started before waiting for the first, so that they overlap.
    begun = [dist.all_reduce(tensor, group=group, async_op=True) for tensor in means]
    for work in begun:
        work.wait()
    return means


@torch.no_grad()
def mean_gradients(
    gradients: Mapping[int, Tensor | None],
    parameters: Mapping[int, Tensor],
    group: dist.ProcessGroup,
) -> dict[int, Tensor | None]:
    """Mean of each gradient over the group's processes, by the parameters' ids.

    A gradient that a process lacks counts as zero there; one that all lack stays None.
    """
    like = next(iter(parameters.values()))
    # In the order of `parameters`, which is the same in every process, unlike the ids.
    here = [gradients[i] is not None for i in parameters]
    # Every process has to join each reduction below, so first they agree on the list of them.
    counts = torch.tensor(here, dtype=torch.int32, device=like.device)
    dist.all_reduce(counts, group=group)
    somewhere = [i for i, count in zip(parameters, counts.tolist(), strict=True) if count]
    own = []
    for i in somewhere:
        gradient = gradients[i]
        own.append(torch.zeros_like(parameters[i]) if gradient is None else gradient)
    means = dict(zip(somewhere, mean_over(own, group), strict=True))
    return dict.fromkeys(gradients) | means
