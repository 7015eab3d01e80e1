"""What hooks see of watched forward passes: the layers' hidden states, and parameters in use."""

from __future__ import annotations

import contextlib
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from aegis_cli.common.errors import AegisError
from aegis_cli.methods.base import Pass
from aegis_cli.models import structure

# The function, the parameter, the names of the modules that own it, and the function's arguments.
Report = Callable[[Callable[..., Any], nn.Parameter, Sequence[str], tuple[Any, ...]], None]


class Removable(ABC):
    """An owner of hooks; as a context manager, it removes them when the block ends."""

    @abstractmethod
    def remove(self) -> None:
        """Remove the hooks."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.remove()


# --- hidden states --------------------------------------------------------------------------------


class LayerHooks:
    """Hooks that keep what the layers return while a block is open.

    Only the hooks connect it to the model, so that copying the model does not copy this object.
    """

    def __init__(self, layers: Mapping[str, nn.Module]) -> None:
        self._names = list(layers)
        self._places = {id(layer): i for i, layer in enumerate(layers.values())}
        self._noted: set[int] = set()  # layers whose hidden states were given by hand
        self._calls: list[list[Tensor]] | None = None
        self._graph = False
        _forget_compiled()
        self._handles = [
            layer.register_forward_hook(partial(self._note, i))
            for i, layer in enumerate(layers.values())
        ]

    def remove(self) -> None:
        """Take the hooks off."""
        for handle in self._handles:
            handle.remove()

    @property
    def open(self) -> bool:
        return self._calls is not None

    def forget(self) -> None:
        """Close a block that has failed, without a pass."""
        self._calls = None

    @contextlib.contextmanager
    def watch(
        self, mask: Tensor | None, image: Tensor | None, done: Callable[[Pass], None]
    ) -> Generator[None]:
        """Hand what the layers return inside the block to `done`, unless it ends by an exception.

        Args:
            mask: [B, T] over all tokens that a layer sees in the block, in the order of its calls;
                None: all count.
            image: [T] or [B, T], true at image tokens; None: there are none.

        Raises:
            AegisError: a block inside another, layers that were not called or whose outputs do not
                fit together, or masks that do not fit the tokens.
        """
        if self.open:
            raise AegisError(
                "a watched block inside a watched block",
                "one at a time",
                "close the first before the second",
            )
        # `_graph`: whether hidden states should have a graph, which a layer may fail to give them.
        self._calls, self._graph = [[] for _ in self._names], torch.is_grad_enabled()
        self._noted = set()
        try:
            yield
            hidden = [
                self._joined(name, calls)
                for name, calls in zip(self._names, self._calls, strict=True)
            ]
        finally:
            self._calls = None
        # Only now that the next block can open, whatever `done` raises.
        done(_pass(hidden, mask, image))

    def note(self, layer: int | nn.Module, hidden: Tensor) -> None:
        """Take a layer's output from a loop that calls the layer's submodules itself.

        Outside a watched block this does nothing, like a layer's hook.

        Args:
            layer: one of the layers, or its number.
            hidden: [B, T, D], for the tokens of the mask.

        Raises:
            AegisError: not one of the layers, no hidden states, or a layer whose own output was
                already seen.
        """
        if self._calls is None:
            return
        index = layer if isinstance(layer, int) else self._places.get(id(layer), -1)
        if not 0 <= index < len(self._names):
            found = layer if isinstance(layer, int) else f"a {type(layer).__name__}"
            raise AegisError(
                f"hidden states noted of layer {found}",
                f"0 to {len(self._names) - 1}, or one of the layers {self._names[0]} ... "
                f"{self._names[-1]}",
                "give the number of the layer, or the module itself",
            )
        if self._calls[index] and index not in self._noted:
            raise self._called_and_noted(index)
        self._noted.add(index)
        self._keep(index, hidden)

    def _note(self, index: int, _: nn.Module, __: tuple[object, ...], output: object) -> None:
        if self._calls is None:
            return
        if index in self._noted:
            raise self._called_and_noted(index)
        self._keep(index, output)

    def _called_and_noted(self, index: int) -> AegisError:
        return AegisError(
            f"hidden states noted of layer '{self._names[index]}', which is called too",
            "one of both",
            "leave out note for layers that the loop calls: what they return is seen",
        )

    def _keep(self, index: int, output: object) -> None:
        assert self._calls is not None
        first = output[0] if isinstance(output, (tuple, list)) and output else output
        if not isinstance(first, Tensor) or first.ndim < 3:
            found = f"a {type(first).__name__}"
            if isinstance(first, Tensor):
                found = f"a tensor {list(first.shape)}"
            raise AegisError(
                f"{found} from layer '{self._names[index]}'",
                "hidden states [B, T, D], alone or first in a tuple",
                "give layers= modules that return hidden states",
            )
        if self._graph and not torch.is_grad_enabled():
            raise AegisError(
                f"layer '{self._names[index]}' runs without a graph: checkpointed with "
                "use_reentrant=True, or under no_grad",
                "hidden states with their graph",
                "use_reentrant=False; Hugging Face: "
                'gradient_checkpointing_kwargs={"use_reentrant": False}; in the place of '
                "torch.no_grad(), layer.requires_grad_(False) before the guard is made",
            )
        # [B, ..., D] -> [B, T, D], also for a layer that returns [B, H, W, D].
        self._calls[index].append(first.flatten(1, -2))

    def _joined(self, name: str, calls: list[Tensor]) -> Tensor:
        if not calls:
            raise AegisError(
                f"layer '{name}' was not called in the watched block",
                "a forward pass through every layer in the block",
                "run the model inside `with ...watch(mask):`; set the hooks before "
                "torch.compile, and drop no layers; where a loop calls the parts of a layer "
                "itself, give what it makes of them: note(layer, hidden)",
            )
        if len({len(hidden) for hidden in calls}) > 1:
            raise AegisError(
                f"layer '{name}' was called with batches of "
                f"{', '.join(str(len(hidden)) for hidden in calls)}",
                "one batch per watched block",
                "watch one forward pass at a time",
            )
        # A layer may be called for some of the tokens at a time, for example a cached prefix first.
        return calls[0] if len(calls) == 1 else torch.cat(calls, dim=1)


def _forget_compiled() -> None:
    """Discard what torch.compile has compiled, since that code misses hooks added later.

    Code that was compiled for another model of the same class is used for this one, too.
    """
    # If dynamo is not loaded, nothing is compiled; it loads slowly.
    if (dynamo := sys.modules.get("torch._dynamo")) is not None:
        dynamo.reset()


def _pass(hidden: list[Tensor], mask: Tensor | None, image: Tensor | None) -> Pass:
    shape, device = hidden[0].shape[:2], hidden[0].device
    if any(h.shape[:2] != shape for h in hidden):
        raise AegisError(
            "layers that see different numbers of tokens",
            "the same tokens in every layer",
            "give layers= of one kind",
        )
    valid = _valid(mask, shape, device)
    if image is None:
        no_image = torch.zeros(shape[1], dtype=torch.bool, device=device)
        return Pass(step=0, inputs=None, hidden=hidden, mask=valid, image=no_image)
    is_image = boolean(image, "an image mask").to(device)
    if is_image.shape not in (shape, shape[1:]):
        raise AegisError(
            f"an image mask {list(is_image.shape)}",
            f"{list(shape)} or {list(shape[1:])}",
            "mark each token the layers see",
        )
    return Pass(step=0, inputs=None, hidden=hidden, mask=valid, image=is_image)


def _valid(mask: Tensor | None, shape: torch.Size, device: torch.device) -> Tensor:
    """Which of the layers' tokens count, [B, T] bool; at least one.

    Raises:
        AegisError: a mask that does not fit the tokens, or by which none counts.
    """
    if mask is None:
        valid = torch.ones(shape, dtype=torch.bool, device=device)
    else:
        valid = boolean(mask, "a mask").to(device)
    if valid.shape != shape:
        raise AegisError(
            f"a mask {list(valid.shape)} for hidden states of {list(shape)} tokens",
            "a mask [B, T] of exactly these tokens",
            "give the mask of the tokens that the layers see, image tokens among them; None if "
            "every one counts",
        )
    refuse_empty(valid)
    return valid


def refuse_empty(valid: Tensor) -> None:
    """Raise AegisError for a mask by which no token counts."""
    if not valid.any():
        raise AegisError(
            "a mask without a single valid token", "at least one", "leave empty batches out"
        )


def boolean(mask: Tensor, what: str) -> Tensor:
    """A mask of zeros and ones in any dtype as booleans.

    Raises:
        AegisError: other values, such as those of an additive mask.
    """
    if mask.dtype == torch.bool:
        return mask
    if not ((mask == 0) | (mask == 1)).all():
        raise AegisError(
            f"{what} with values other than 0 and 1",
            "True or 1 at tokens that count",
            "give it as [B, T] booleans",
        )
    return mask.bool()


# --- what maps read -------------------------------------------------------------------------------


@dataclass
class SharedInput:
    """A tensor that linear maps have read one after the other, or a convolution.

    Attributes:
        x: the tensor itself.
        module: its first reader.
        sites: names of its readers so far.
    """

    x: Tensor
    module: nn.Module
    sites: list[str]

    @property
    def of_convolution(self) -> bool:
        """Whether its reader is a convolution; then no other map reads the same rows."""
        return not isinstance(self.module, nn.Linear)

    def serves(self, site: str, module: nn.Module, x: Tensor) -> bool:
        """Whether this is also what a module reads that has been called with x."""
        # The same object, since another tensor with equal values may be changed independently. With
        # a bias the rows end with a 1, so readers with and without a bias have different rows.
        return (
            x is self.x
            and not self.of_convolution
            and isinstance(module, nn.Linear)
            and (module.bias is None) == (self.module.bias is None)
            and site not in self.sites
        )


# --- parameters in use ----------------------------------------------------------------------------


def modules_of_sites(model: nn.Module, maps: structure.Maps) -> dict[str, str]:
    """Names of the modules whose parameters belong to a measured site -> that site.

    The site is the module itself, or the module whose parameters it shares.
    """
    sites = {name: maps.twins.get(name, name) for name in structure.owning(model)}
    return {name: site for name, site in sites.items() if site in maps.kinds}


@contextlib.contextmanager
def watch_uses(model: nn.Module, report: Report) -> Generator[None]:
    """Report each use of a parameter inside the block while its module's forward is not running.

    No hook on a module sees such a use: a call of a function that takes the parameter and returns
    tensors.
    """
    owners = structure.owners(model)
    # Only modules that own parameters are pushed; the innermost is the last.
    inside: list[str] = []

    def used(
        function: Callable[..., Any], parameter: nn.Parameter, arguments: tuple[Any, ...]
    ) -> None:
        names = owners.get(id(parameter), ())
        if names and not (inside and inside[-1] in names):
            report(function, parameter, names, arguments)

    with contextlib.ExitStack() as hooks:
        for name, module in structure.owning(model).items():
            hooks.callback(module.register_forward_pre_hook(partial(_begin, inside, name)).remove)
            hooks.callback(module.register_forward_hook(partial(_end, inside)).remove)
        hooks.enter_context(_Functions(used))
        yield


def _begin(inside: list[str], name: str, *_: Any) -> None:
    inside.append(name)


def _end(inside: list[str], *_: Any) -> None:
    inside.pop()


def describe_use(function: Callable[..., Any]) -> str:
    """How an anchor's file describes the use of a parameter by this function."""
    return f"{getattr(function, '__name__', function)} reads its parameters outside its forward"


class _Functions(TorchFunctionMode):
    def __init__(
        self, report: Callable[[Callable[..., Any], nn.Parameter, tuple[Any, ...]], None]
    ) -> None:
        super().__init__()
        self._report = report

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, (Tensor, list, tuple)):  # asking for a shape is not a use
            for parameter in _parameters((*args, *(kwargs or {}).values())):
                self._report(func, parameter, args)
        return result


def _parameters(arguments: Iterable[Any]) -> Iterator[nn.Parameter]:
    """The parameters among a function's arguments, also in lists such as `torch.cat` takes."""
    for given in arguments:
        for x in given if isinstance(given, (list, tuple)) else (given,):
            if isinstance(x, nn.Parameter):
                yield x
