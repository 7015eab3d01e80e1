"""A stand-in for a device besides the CPU, in the CPU's own memory, and commands that run on it.

PyTorch has one device name for third-party backends. Here, tensors of that device are wrappers, and
the CPU computes on what they hold. As with a GPU, no operation takes tensors of both devices, and
reading a number waits. A process that has made such a device keeps it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import threading
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration as registration
from torch.utils._device import _device_constructors
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from aegis_cli.common import devices
from samples.command import command

NAME = "stand_in"
POSSIBLE = hasattr(registration, "_setup_privateuseone_for_python_backend")
aten = torch.ops.aten
# Operations that take tensors of both devices: copies, and indexing rows with a CPU tensor.
INDEXING = {
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
}
MIXES = {aten._to_copy.default, aten.copy_.default, aten._pin_memory.default, *INDEXING}
# Operations that take no CPU scalars beside tensors of the device.
STRICT = {aten.cat.default, aten.stack.default}
# Operations whose result, or its shape, depends on numbers that have to be read.
READS = {
    aten._local_scalar_dense.default,
    aten.nonzero.default,
    aten.masked_select.default,
    aten.equal.default,
    aten._unique2.default,
    aten.bincount.default,
}
waits: Counter[str] = Counter()
# transformers loads models on the CPU in its own threads.
_loading = threading.Event()
_sending = threading.local()  # `on`: the copy to the device in progress does not wait


class Mixed(RuntimeError):
    """An operation has been given tensors of both devices."""


class StandIn(Tensor):
    """A tensor of the device; `held` is what it holds."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: Tensor) -> StandIn:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(NAME, 0),
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"StandIn({self.held})"

    def tolist(self) -> Any:
        note_wait()
        return self.held.tolist()

    def __getitem__(self, index: Any) -> Tensor:
        return Tensor.__getitem__(self, _as_tensors(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        Tensor.__setitem__(self, _as_tensors(index), value)


def _as_tensors(index: Any) -> Any:
    """Lists in an index as tensors of the device; torch would make them where no mode sees it."""
    if isinstance(index, tuple):
        return tuple(_as_tensors(one) for one in index)
    if isinstance(index, list | range):
        return torch.tensor(list(index)).to(NAME)
    return index


def is_there(device: Any) -> bool:
    """Whether a device, or its name, is the stand-in."""
    return device is not None and torch.device(device).type == NAME


def compute(func: Any, args: Any, kwargs: Any) -> Any:
    """One operation, computed by the CPU on what the device's tensors hold.

    Raises:
        Mixed: it was given tensors of both devices.
    """
    tensors = _tensors(args, kwargs)
    of_device = [x for x in tensors if isinstance(x, StandIn)]
    if 0 < len(of_device) < len(tensors) and "_foreach_" in str(func):
        return _one_by_one(func, args, kwargs)
    if of_device:
        _check(func, args, tensors)
        if _reads(func, args, kwargs):
            note_wait()
    wanted = kwargs.get("device")
    there = bool(of_device) if wanted is None else is_there(wanted)
    if func is aten._to_copy.default and there and not of_device:
        note_copy()
    if is_there(wanted):
        kwargs = {**kwargs, "device": torch.device("cpu")}
    known: dict[int, StandIn] = {}

    def unwrap(x: Any) -> Any:
        if not isinstance(x, StandIn):
            return x
        known[id(x.held)] = x
        return x.held

    def wrap(x: Any) -> Any:
        if not isinstance(x, Tensor):
            return x
        # What an operation changes in place stays the same tensor.
        same = known.get(id(x))
        if same is not None:
            return same
        return StandIn(x) if there else x

    own_args = [_of_each(unwrap, x) for x in args]
    own_kwargs = {name: _of_each(unwrap, x) for name, x in kwargs.items()}
    return _of_each(wrap, func(*own_args, **own_kwargs))


def _tensors(args: Any, kwargs: Any) -> list[Tensor]:
    """The tensors that an operation takes, including those in lists.

    Operations have no deeper nesting. PyTorch's own tree functions, which look for it, would take
    most of the time of what runs on the device.
    """
    found = []
    for x in (*args, *kwargs.values()):
        if isinstance(x, Tensor):
            found.append(x)
        elif isinstance(x, list | tuple):
            found += [one for one in x if isinstance(one, Tensor)]
    return found


def _of_each(function: Callable[[Any], Any], x: Any) -> Any:
    """Apply a function to an operation's argument or result, or to each item of a list."""
    if isinstance(x, list | tuple):
        return type(x)([function(one) for one in x])
    return function(x)


def _one_by_one(func: Any, args: Any, kwargs: Any) -> Any:
    """An operation on lists of tensors, item by item, since items may be on different devices."""
    lists = [x for x in args if isinstance(x, list | tuple)]
    found = []
    for place in range(len(lists[0])):
        own = [[x[place]] if isinstance(x, list | tuple) else x for x in args]
        found.append(compute(func, own, kwargs))
    return None if found[0] is None else [one for (one,) in found]


def _check(func: Any, args: Any, tensors: Sequence[Tensor]) -> None:
    if func in INDEXING:
        tensors = [args[0], *args[2:3]]  # the indices may be on the CPU
    elif func in MIXES:
        return
    for x in tensors:
        # A scalar may be on the CPU.
        if not isinstance(x, StandIn) and (x.dim() > 0 or func in STRICT):
            shapes = [(tuple(one.shape), str(one.device)) for one in tensors]
            raise Mixed(f"{func} of {shapes}")


def _reads(func: Any, args: Any, kwargs: Any) -> bool:
    """Whether an operation waits for the device."""
    if func in INDEXING:
        return any(x is not None and x.dtype == torch.bool for x in args[1])
    if func is aten._to_copy.default:
        return kwargs.get("device") is not None and not is_there(kwargs["device"])
    if func is aten.copy_.default:
        return not isinstance(args[0], StandIn)
    return func in READS


def note_wait() -> None:
    """Count a wait within a step, by its place in Aegis, unless a model's own code waits."""
    # Only the frames, from the innermost on, since `extract_stack` would also read their lines. The
    # start is explicit, because what `walk_stack(None)` skips depends on Python's version.
    callers = [frame.f_code for frame, _ in traceback.walk_stack(sys._getframe())]
    if not any(code.co_filename.endswith("training/step.py") for code in callers):
        return
    of_interest = ("/aegis_cli/", "/transformers/")
    waiting = next(c for c in callers if any(name in c.co_filename for name in of_interest))
    if "/transformers/" not in waiting.co_filename:
        file = waiting.co_filename.rpartition("/aegis_cli/")[2]
        waits[f"{file}:{waiting.co_name}"] += 1


def note_copy() -> None:
    """Count a copy to the device that waits, as all do except those by `devices.send`."""
    if not getattr(_sending, "on", False):
        note_wait()


def _sent_by_itself(send: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def sent(x: Tensor, device: torch.device) -> Tensor:
        _sending.on = True
        try:
            return send(x, device)
        finally:
            _sending.on = False

    return sent


class InReach(TorchDispatchMode):
    """Lets tensors be made on the device within it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if StandIn in types or is_there(kwargs.get("device")):
            return compute(func, args, kwargs)
        return func(*args, **kwargs)


class _Module(registration._DummyBackendModule if POSSIBLE else object):  # type: ignore[misc]
    """What PyTorch asks of a device module."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]

    def set_device(self, device: Any) -> None: ...

    def get_rng_state(self, device: Any = None) -> Tensor:
        return torch.get_rng_state()

    def set_rng_state(self, state: Tensor, device: Any = None) -> None: ...

    def synchronize(self, device: Any = None) -> None: ...


@contextlib.contextmanager
def in_reach(hugging_face: bool = False) -> Iterator[None]:
    """Make the device for the rest of the process, and let Aegis choose it within the block.

    Args:
        hugging_face: whether to patch transformers' loading too, whose import takes long.
    """
    registration._setup_privateuseone_for_python_backend(NAME, _Module())
    torch.__future__.set_swap_module_params_on_conversion(True)  # so that a parameter stays itself
    # Without a view of its own, a tensor of inference mode cannot be of a class of one's own.
    torch._C._InferenceMode = _without_gradients  # type: ignore[misc,assignment]
    # PyTorch lists the tensor constructors once, for blocks of `torch.device`. If the replacements
    # were in that list, transformers would not see that it creates a model on the device `meta`.
    _device_constructors()
    makers = torch.tensor, torch.as_tensor
    torch.tensor, torch.as_tensor = map(_moved_after, makers)
    _let_threads_reach()
    if hugging_face:
        _load_outside(makers)
    devices.pick = lambda: torch.device(NAME, 0)
    plain, sent = devices.send, _sent_by_itself(devices.send)
    for module in list(sys.modules.values()):
        if getattr(module, "send", None) is plain:
            module.send = sent  # type: ignore[attr-defined]
    with InReach():
        yield


def _without_gradients(mode: bool) -> contextlib.AbstractContextManager[None]:
    """Replaces inference mode; a `mode` of False turns it off within it."""
    return torch.set_grad_enabled(not mode)


def _moved_after(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A constructor of tensors from numbers; torch would make them where no mode sees it."""

    def made(data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Tensor:
        if isinstance(data, StandIn):
            return data if device is None else data.to(device)
        if isinstance(data, list | tuple):
            data = [x.item() if isinstance(x, StandIn) else x for x in data]
        if not is_there(device):
            return make(data, *args, **({"device": device} if device else {}), **kwargs)
        return make(data, *args, **kwargs).to(device)

    return made


def _let_threads_reach() -> None:
    plain = threading.Thread.run

    def run(self: threading.Thread) -> None:
        with contextlib.nullcontext() if _loading.is_set() else InReach():
            plain(self)

    threading.Thread.run = run  # type: ignore[method-assign]


def _load_outside(makers: Sequence[Callable[..., Tensor]]) -> None:
    """Let transformers load and save on the CPU, since its code does not work with wrappers."""
    from transformers import PreTrainedModel

    load, save = PreTrainedModel.from_pretrained.__func__, PreTrainedModel.save_pretrained

    def loaded(cls: type, *args: Any, **kwargs: Any) -> Any:
        ours = torch.tensor, torch.as_tensor
        torch.tensor, torch.as_tensor = makers
        _loading.set()
        try:
            with _disable_current_modes():
                return load(cls, *args, **kwargs)
        finally:
            _loading.clear()
            torch.tensor, torch.as_tensor = ours

    def saved(self: Any, folder: Any, **kwargs: Any) -> Any:
        weights = {}
        for name, x in self.state_dict().items():
            if name not in (self.all_tied_weights_keys or {}):
                weights[name] = getattr(x, "held", x).detach().clone()
        return save(self, folder, state_dict=weights, **kwargs)

    PreTrainedModel.from_pretrained = classmethod(loaded)
    PreTrainedModel.save_pretrained = saved


def said(commands: Sequence[Sequence[str]]) -> list[dict[str, Any]]:
    """The output of each command, run one after the other, and where its steps waited.

    Args:
        commands: each a list of `aegis`'s arguments.
    """
    found = []
    for arguments in commands:
        waits.clear()
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            code = command()(list(arguments), standalone_mode=False)
        assert not code, arguments
        found.append({"said": json.loads(printed.getvalue()), "waits": dict(waits)})
    return found


def said_there(
    folder: Path, commands: Sequence[Sequence[str]], device: str, kind: str
) -> list[dict[str, Any]]:
    """The result of `said` on a device, for commands in a folder.

    Args:
        device: the stand-in, which this process then keeps, or `cuda`.
        kind: `hugging_face` if models of transformers are loaded.
    """
    os.environ[devices.VARIABLE] = "cuda" if device == "cuda" else "cpu"
    torch.set_num_threads(1)
    os.chdir(folder)
    with in_reach(kind == "hugging_face") if device == NAME else contextlib.nullcontext():
        return said(commands)
