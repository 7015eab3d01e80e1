"""Several processes that share one training run: how they connect and what they compute together.

A sum over a batch is a sum over the processes' shares of it. So nothing is weighted: each process
computes the contribution of its own frames to the mean of the whole batch, and these are summed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

from aegis_cli.common import devices, interrupts, launch
from aegis_cli.common.errors import PeerLost

if TYPE_CHECKING:
    from torch.distributed.tensor import DTensor

T = TypeVar("T")
_BUCKET = 1 << 23  # entries that are summed in one message, 32 MB of float32
# How long a process may wait for what another does alone. A process that has ended is noticed at
# once, because its connections close.
_PATIENCE = timedelta(days=365)


@dataclass(frozen=True)
class Ranks:
    """This process among those that share its work.

    Attributes:
        rank: number of this process, from 0; only number 0 writes and reports.
        count: number of processes.
        group: their group, if they are not all processes.
        patient: a group of all processes whose connections wait for a reply as long as any work
            takes; None if they are not all processes.
    """

    rank: int = 0
    count: int = 1
    group: dist.ProcessGroup | None = None
    patient: dist.ProcessGroup | None = None

    @property
    def first(self) -> bool:
        """Whether this is the one that writes."""
        return self.rank == 0

    @property
    def several(self) -> bool:
        """Whether there are others."""
        return self.count > 1

    def total(self, x: Tensor) -> Tensor:
        """The sum of x over all processes, whose gradient is that of this process's share."""
        return _Total.apply(x, self.group) if self.several else x

    @torch.no_grad()
    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the processes, in place."""
        if not self.several:
            return
        for bucket in _buckets(tensors):
            flat = torch.cat([t.flatten() for t in bucket])
            dist.all_reduce(flat, group=self.group)
            sums = flat.split([t.numel() for t in bucket])
            for tensor, found in zip(bucket, sums, strict=True):
                tensor.copy_(found.view_as(tensor))

    def rows(self, size: int) -> slice:
        """The slice of `size` rows of a sharded tensor that is here; the last ranks have fewer.

        `fully_shard` splits like `torch.chunk`.
        """
        most = -(-size // self.count)  # rounded up
        return slice(min(self.rank * most, size), min((self.rank + 1) * most, size))

    def any(self, *flags: bool) -> list[bool]:
        """Which of these flags are set in any process."""
        if not self.several:
            return list(flags)
        counts = torch.tensor(flags, dtype=torch.int32, device=_device())
        dist.all_reduce(counts, group=self.group)
        return [count > 0 for count in counts.tolist()]

    def gathered(self, value: T) -> list[T]:
        """The value of every process; it must be picklable."""
        if not self.several:
            return [value]
        found: list[Any] = [None] * self.count
        dist.all_gather_object(found, value, group=self.group)
        return found

    def wait(self) -> None:
        """Wait until every process has arrived here, however long one of them takes."""
        if self.several:
            dist.barrier(group=self.group if self.patient is None else self.patient)

    def agree(self, value: T) -> T:
        """The value of the first process; it must be picklable.

        The others wait for it, however long it takes.
        """
        return self._told([value]) if self.several else value

    def by_first(self, find: Callable[[], T]) -> T:
        """The result of `find` in the first process, as in `agree`; only that process calls it."""
        return self.agree(find()) if self.first else self._told([None])

    def _told(self, box: list[Any]) -> Any:
        """The content of the first process's box."""
        # `patient` uses gloo, which sends from a CPU; NCCL sends from a GPU.
        device = _device() if self.patient is None else torch.device("cpu")
        dist.broadcast_object_list(box, src=0, group=self.patient, device=device)
        return box[0]


ALONE = Ranks()
_met: Ranks | None = None  # the processes that `joined` has connected, or those given to `among`


@contextlib.contextmanager
def joined() -> Generator[Ranks]:
    """Connect to the other processes that the launcher has started, until the block ends.

    A nested block yields the same processes.

    Raises:
        AegisError: the environment does not allow it.
        PeerLost: one of them has ended.
    """
    if _met is not None or launch.world_size() == 1:
        yield _met or ALONE
        return
    launch.check_meeting()
    on_gpu = devices.on_gpu()
    if on_gpu:
        torch.cuda.set_device(launch.local_rank())  # before NCCL takes the current one
    with interrupts.ending_at_once():
        dist.init_process_group("nccl" if on_gpu else "gloo")
    try:
        patient = dist.new_group(backend="gloo", timeout=_PATIENCE)
        assert isinstance(patient, dist.ProcessGroup)  # an int if this process is not in it
        ranks = Ranks(dist.get_rank(), dist.get_world_size(), patient=patient)
        with among(ranks):
            yield ranks
        dist.barrier(group=patient)  # the first may still write when the others are done
    except RuntimeError as error:
        if not _is_lost(error):
            raise
        raise PeerLost(
            "another process of this training has ended",
            "all processes running",
            "read the error of that process; then start all of them again, with --resume",
        ) from error
    finally:
        dist.destroy_process_group()


@contextlib.contextmanager
def among(ranks: Ranks) -> Generator[None]:
    """Let `joined` yield these processes inside the block, or only this one with `ALONE`."""
    global _met
    before, _met = _met, ranks
    try:
        yield
    finally:
        _met = before


def is_sharded(x: Tensor) -> TypeGuard[DTensor]:
    """Whether each process has only some rows of a tensor."""
    return hasattr(x, "to_local")  # only a DTensor has it; importing its class is slow


def rows_here(x: Tensor) -> Tensor:
    """The rows of a tensor that this process has; all if it is not sharded.

    Without gradients they share the tensor's memory.
    """
    return x.to_local() if is_sharded(x) else x


def whole(x: Tensor) -> Tensor:
    """All rows of a tensor; every process has to call this."""
    return x.full_tensor() if is_sharded(x) else x


def sharded_as(x: Tensor, like: Tensor) -> Tensor:
    """A tensor that every process has in full, sharded like another one."""
    if not is_sharded(like):
        return x
    from torch.distributed.tensor import distribute_tensor

    # Every process takes its own rows, so nothing is sent.
    return distribute_tensor(x, like.device_mesh, like.placements, src_data_rank=None)


def _is_lost(error: RuntimeError) -> bool:
    """Whether a collective operation failed because a process is gone; gloo says so in text."""
    said = str(error)
    return isinstance(error, dist.DistError) or "gloo" in said or "Connection" in said


def _device() -> torch.device:
    return torch.device("cuda" if dist.get_backend() == "nccl" else "cpu")


def _buckets(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """Tensors of one dtype, together not much larger than a message should be."""
    for dtype in dict.fromkeys(t.dtype for t in tensors):
        bucket: list[Tensor] = []
        for tensor in tensors:
            if tensor.dtype != dtype:
                continue
            bucket.append(tensor)
            if sum(t.numel() for t in bucket) >= _BUCKET:
                yield bucket
                bucket = []
        if bucket:
            yield bucket


class _Total(torch.autograd.Function):
    """Sum over the processes.

    Each process backpropagates from the same sum into its own share. Summing their parameter
    gradients later gives the gradient of the whole, so nothing is summed in the backward pass.
    """

    @staticmethod
    def forward(_: Any, x: Tensor, group: dist.ProcessGroup | None) -> Tensor:
        found = x.detach().clone()
        dist.all_reduce(found, group=group)
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
