"""Several processes with a copy of the model each (DistributedDataParallel): one anchor gradient
for all of them.

DistributedDataParallel averages what arrives in `.grad`. The anchor gradient does not arrive there,
so it is averaged here; without that each process would project the same task gradient against an
anchor gradient of its own, and the copies would part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch import distributed as dist

from aegis_cli.common.errors import AegisError


def check(group: dist.ProcessGroup | None) -> None:
    """Raise AegisError where several processes run and nobody said which of them share a model."""
    if (
        group is None
        and dist.is_available()
        and dist.is_initialized()
        and dist.get_world_size() > 1
    ):
        raise AegisError(
            f"a guard in one of {dist.get_world_size()} processes without process_group=",
            "the group of those that train one model together",
            (
                "process_group=torch.distributed.group.WORLD for DistributedDataParallel; sharded "
                "weights are not supported"
            ),
        )


@torch.no_grad()
def mean(tensors: Sequence[Tensor], group: dist.ProcessGroup) -> list[Tensor]:
    """Mean of each tensor over the group's processes, as new tensors: autograd may give several
    parameters one and the same.
    """
    means = [tensor / dist.get_world_size(group) for tensor in tensors]
    for work in [dist.all_reduce(tensor, group=group, async_op=True) for tensor in means]:
        work.wait()
    return means


@torch.no_grad()
def mean_gradients(
    gradients: Mapping[int, Tensor | None],
    parameters: Mapping[int, Tensor],
    group: dist.ProcessGroup,
) -> dict[int, Tensor | None]:
    """Mean of each gradient over the group's processes, by the parameters' ids; one that a process
    lacks counts as zero there.
    """
    like = next(iter(parameters.values()))
    found = torch.tensor(
        [gradients[i] is not None for i in parameters], dtype=torch.int32, device=like.device
    )
    dist.all_reduce(found, group=group)
    somewhere = [i for i, count in zip(parameters, found.tolist(), strict=True) if count]
    own = [
        gradients[i] if gradients[i] is not None else torch.zeros_like(parameters[i])
        for i in somewhere
    ]
    return dict.fromkeys(gradients) | dict(zip(somewhere, mean(own, group), strict=True))
