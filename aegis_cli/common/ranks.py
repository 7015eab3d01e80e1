"""Several processes that share one training: how they meet, and what they compute together.

Whatever is a sum over a batch is one over the processes' shares of it. So nothing is weighted: each
process adds what its own frames contribute to the whole batch's mean, and contributions are summed.
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
# How long a process may wait for what another does alone. Who has ended is noticed at once, because
# its connections close.
_PATIENCE = timedelta(days=365)


@dataclass(frozen=True)
class Ranks:
    """This process among those that share its work.

    Attributes:
        rank: its number, from 0; number 0 alone writes and speaks.
        count: how many there are.
        group: where they are not all processes.
        patient: all of them, by connections on which an answer may take as long as any work; None
            where they are not all processes.
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
        """The sum of every process's x, whose gradient is that of this one's share."""
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
        """Which of `size` rows of a sharded tensor are here: the first have more, the last fewer.

        `fully_shard` cuts as `torch.chunk` does.
        """
        most = -(-size // self.count)  # rounded up
        return slice(min(self.rank * most, size), min((self.rank + 1) * most, size))

    def any(self, *flags: bool) -> list[bool]:
        """Which of these flags a process has set."""
        if not self.several:
            return list(flags)
        counts = torch.tensor(flags, dtype=torch.int32, device=_device())
        dist.all_reduce(counts, group=self.group)
        return [count > 0 for count in counts.tolist()]

    def gathered(self, value: T) -> list[T]:
        """Every process's value, which has to be one that can be pickled."""
        if not self.several:
            return [value]
        found: list[Any] = [None] * self.count
        dist.all_gather_object(found, value, group=self.group)
        return found

    def wait(self) -> None:
        """Wait until every process is here, however long one of them takes."""
        if self.several:
            dist.barrier(group=self.group if self.patient is None else self.patient)

    def agree(self, value: T) -> T:
        """The first process's value, which has to be one that can be pickled.

        The others wait for it, however long it takes to find.
        """
        return self._told([value]) if self.several else value

    def by_first(self, find: Callable[[], T]) -> T:
        """What the first process finds, as `agree` does with a value; only it is asked."""
        return self.agree(find()) if self.first else self._told([None])

    def _told(self, box: list[Any]) -> Any:
        """What is in the first process's box."""
        # `patient` is gloo's, which sends from a CPU; NCCL's own sends from a GPU.
        device = _device() if self.patient is None else torch.device("cpu")
        dist.broadcast_object_list(box, src=0, group=self.patient, device=device)
        return box[0]


ALONE = Ranks()
_met: Ranks | None = None  # whom `joined` has met, or who a block works among


@contextlib.contextmanager
def joined() -> Generator[Ranks]:
    """Meet the other processes that the launcher has started, until the block ends.

    Who is inside such a block already finds the same processes there.

    Raises:
        AegisError: an environment by which they cannot be met.
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
        assert isinstance(patient, dist.ProcessGroup)  # an int where this process is outside it
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
    """Let `joined` find these processes inside the block, or none but this with `ALONE`."""
    global _met
    before, _met = _met, ranks
    try:
        yield
    finally:
        _met = before


def is_sharded(x: Tensor) -> TypeGuard[DTensor]:
    """Whether each process has only some rows of a tensor."""
    return hasattr(x, "to_local")  # as only a DTensor has, whose class takes long to import


def rows_here(x: Tensor) -> Tensor:
    """The rows that this process has of a tensor; all where it is not sharded.

    Without gradients they are the tensor's own memory.
    """
    return x.to_local() if is_sharded(x) else x


def whole(x: Tensor) -> Tensor:
    """All rows of a tensor, which all processes have to ask for."""
    return x.full_tensor() if is_sharded(x) else x


def sharded_as(x: Tensor, like: Tensor) -> Tensor:
    """A tensor that every process has whole, sharded as another one is."""
    if not is_sharded(like):
        return x
    from torch.distributed.tensor import distribute_tensor

    # Every process takes its own rows, so that nothing is sent.
    return distribute_tensor(x, like.device_mesh, like.placements, src_data_rank=None)


def _is_lost(error: RuntimeError) -> bool:
    """Whether a collective operation failed because somebody is gone; gloo says so in words."""
    said = str(error)
    return isinstance(error, dist.DistError) or "gloo" in said or "Connection" in said


def _device() -> torch.device:
    return torch.device("cuda" if dist.get_backend() == "nccl" else "cpu")


def _buckets(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """Tensors of one type, together not much larger than a message is to be."""
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

    Each process goes back from the same sum into its own share. Together they have the gradient of
    the whole, once their gradients are summed too, so that nothing is summed on the way back.
    """

    @staticmethod
    def forward(_: Any, x: Tensor, group: dist.ProcessGroup | None) -> Tensor:
        found = x.detach().clone()
        dist.all_reduce(found, group=group)
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
