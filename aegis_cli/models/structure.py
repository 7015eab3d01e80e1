"""The structure of any model: transformer layers, parameter groups, and maps with inputs."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import attrgetter

import torch
from torch import Tensor, nn
from torch.func import functional_call

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here, whole
from aegis_cli.core.numerics import widened
from aegis_cli.models import wrappers
from aegis_cli.models.wrappers import PlainNames, plain_names


def names(given: str | Sequence[str]) -> tuple[str, ...]:
    """The names that a user gave, as one dotted name or as several."""
    return (given,) if isinstance(given, str) else tuple(given)


def plain_parts(model: nn.Module, given: str | Sequence[str]) -> tuple[str, ...]:
    """The plain names of parts that were given with or without the names of wrappers."""
    return tuple(map(plain_names(model), names(given)))


def part_of(model: nn.Module, name: str | None) -> nn.Module:
    """The part of this dotted name, without wrappers around it; for None the model itself.

    Raises:
        AegisError: there is no such part, or this is no model.
    """
    if not isinstance(model, nn.Module):
        raise AegisError(
            f"a {type(model).__name__} in place of the model",
            "a torch.nn.Module",
            "give the model first, then the rest: Guard(model, anchor=FILE)",
        )
    if name is None:
        return model
    found = wrappers.innermost(model, name)
    if found is None:
        parts = ", ".join(child for child, _ in wrappers.unwrapped(model).named_children())
        raise AegisError(
            f"no part '{name}' in {type(model).__name__}",
            f"the dotted name of the VLM in it; its parts are {parts or '(none)'}",
            'part="..."',
        )
    return found


def refuse_offloaded(model: nn.Module) -> None:
    """Refuse weights that are only loaded while their layer is called.

    Raises:
        AegisError: there are some, as `device_map` leaves weights that fit on no device.
    """
    away = [name for name, parameter in model.named_parameters() if parameter.is_meta]
    if away:
        raise AegisError(
            f"'{away[0]}' first of {len(away)} parameters without values: they are offloaded",
            "weights that stay on a device, of one GPU or of several",
            "load the model with a device_map that leaves nothing on 'disk' or to accelerate's "
            "offloading, or in half precision, or on more GPUs",
        )


def compiled(model: nn.Module) -> list[str]:
    """Names of the parts under torch.compile."""
    # `torch.compile(module)` wraps a module, `module.compile()` sets its call.
    return [
        name
        for name, m in model.named_modules()
        if hasattr(m, "_orig_mod") or m._compiled_call_impl is not None
    ]


def fingerprint(model: nn.Module, adapters: bool = False, within: str = "") -> str:
    """sha256 of the weights; for an embedded VLM the same as from its own method.

    Wrappers around the model or its parts do not affect it. Neither do adapters that change
    nothing, such as a fresh LoRA.

    Args:
        adapters: whether adapters count even then.
        within: a prefix of each name, such as `vlm.` for a model that is part of another.
    """
    plain = plain_names(model)
    left_out: set[str] = set()
    if not adapters and wrappers.adapters_are_idle(model):
        left_out = wrappers.adapter_weights(model)
    state = {}
    for name, value in model.state_dict().items():
        if isinstance(value, Tensor) and name not in left_out:
            state[within + plain(name)] = value
    return digest(state)


# --- layers and groups ----------------------------------------------------------------------------


def find_layers(model: nn.Module, layers: str | Sequence[nn.Module] | None) -> dict[str, nn.Module]:
    """The transformer layers in order, by their dotted names in the model.

    Args:
        layers: dotted name of their list, with or without the names of wrappers, or the modules
            themselves; None: the model's only list of equal blocks.

    Raises:
        AegisError: there is no such list or none at all, several lists are possible, or a module is
            not part of the model.
    """
    candidates = _block_lists(model)
    if layers is None:
        if len(candidates) != 1:
            found = "no list of equal blocks"
            if candidates:
                found = f"{len(candidates)} lists of blocks: {_say(candidates)}"
            raise AegisError(
                f"{found} in {type(model).__name__}",
                "one list of transformer layers",
                _name_them(candidates),
            )
        layers = next(iter(candidates))
    chosen = _named_list(model, layers, candidates) if isinstance(layers, str) else list(layers)
    names = {id(module): name for name, module in model.named_modules()}
    if any(id(layer) not in names for layer in chosen):
        raise AegisError(
            "layers that are not part of the model",
            "modules of the model itself",
            _name_them(candidates),
        )
    if not chosen or len({id(layer) for layer in chosen}) != len(chosen):
        found = "the same layer twice" if chosen else "no layers"
        raise AegisError(
            found, "different transformer layers, at least one", _name_them(candidates)
        )
    return {names[id(layer)]: layer for layer in chosen}


def around_blocks(model: nn.Module) -> list[str]:
    """Plain names of the parts that contain lists of blocks, the outer ones first."""
    found = dict[str, None]()
    for name in _block_lists(model):
        words = name.split(".")[:-1]
        found |= dict.fromkeys(".".join(words[: i + 1]) for i in range(len(words)))
    return sorted(found, key=lambda name: name.count("."))


def _block_lists(model: nn.Module) -> dict[str, nn.ModuleList]:
    """Lists of two or more blocks of one type, which have submodules, by plain name.

    Lists inside the blocks of another list do not count.
    """
    found: dict[str, nn.ModuleList] = {}
    plain = plain_names(model)
    for full_name, module in model.named_modules():
        name = plain(full_name)
        inside = any(name.startswith(f"{outer}.") for outer in found)
        if not inside and isinstance(module, nn.ModuleList) and _are_blocks(module):
            found[name] = module
    return found


def _are_blocks(modules: nn.ModuleList) -> bool:
    """Whether these are several modules of one type, with submodules and parameters."""
    blocks = [wrappers.unwrapped(module) for module in modules]
    if len(blocks) < 2 or len({type(block) for block in blocks}) != 1:
        return False
    has_parts = next(blocks[0].children(), None) is not None
    return has_parts and next(modules[0].parameters(), None) is not None


def _named_list(
    model: nn.Module, name: str, candidates: Mapping[str, nn.ModuleList]
) -> list[nn.Module]:
    module = wrappers.innermost(model, name)
    if module is None:
        raise AegisError(
            f"no module '{name}' in {type(model).__name__}",
            "its list of layers",
            _name_them(candidates),
        )
    if not isinstance(module, (nn.ModuleList, nn.Sequential)):
        raise AegisError(
            f"'{name}' is a {type(module).__name__}",
            "a ModuleList of layers",
            _name_them(candidates),
        )
    return list(module)


def _name_them(candidates: Mapping[str, nn.ModuleList]) -> str:
    if not candidates:
        return "give layers= a list of the model's own modules"
    return f"give layers= the name of one: {_say(candidates)}"


def _say(candidates: Mapping[str, nn.ModuleList]) -> str:
    return ", ".join(
        f"'{name}' ({len(blocks)} {type(wrappers.unwrapped(blocks[0])).__name__})"
        for name, blocks in candidates.items()
    )


def parameter_groups(
    model: nn.Module, layers: Mapping[str, nn.Module]
) -> dict[str, list[nn.Parameter]]:
    """Every parameter in exactly one group.

    Each layer is the group `layers.{i}`. Outside the layers, all embedding tables together are the
    group `embeddings`, and each largest part that contains no layer is a group named by its dotted
    name. A parameter that several parts share belongs to the first of them.
    """
    inside = [(f"layers.{i}", layer.parameters()) for i, layer in enumerate(layers.values())]
    # A module around a layer is no group of its own: the walk continues below it.
    ancestors = {id(module) for name in layers for module in _path(model, name)}
    plain = plain_names(model)
    outside = _outside("", model, ancestors, {id(layer) for layer in layers.values()}, plain)
    groups: dict[str, list[nn.Parameter]] = {}
    seen: set[int] = set()
    # The layers come first, so parameters that a layer shares with a part outside belong to the
    # layer.
    for name, parameters in [*inside, *outside]:
        fresh = {id(p): p for p in parameters if id(p) not in seen}
        seen |= fresh.keys()
        # A layer keeps its group even if all its parameters belong to earlier ones: layer groups
        # are counted.
        if fresh or name.startswith("layers."):
            groups.setdefault(name, []).extend(fresh.values())
    return groups


def learning_groups(
    model: nn.Module, layers: Mapping[str, nn.Module]
) -> dict[str, list[nn.Parameter]]:
    """The trainable parameters of each of `parameter_groups`, without groups that have none."""
    return what_learns(parameter_groups(model, layers))


def what_learns(groups: Mapping[str, Sequence[nn.Parameter]]) -> dict[str, list[nn.Parameter]]:
    """The trainable parameters of each group, without groups that have none."""
    found = {}
    for name, group in groups.items():
        if learning := [p for p in group if p.requires_grad]:
            found[name] = learning
    return found


def _path(model: nn.Module, name: str) -> Iterator[nn.Module]:
    """The modules around the module of this name, starting with the model."""
    parts = name.split(".")
    for i in range(len(parts)):
        yield model.get_submodule(".".join(parts[:i]))


def _outside(
    name: str, module: nn.Module, ancestors: set[int], layers: set[int], plain: PlainNames
) -> Iterator[tuple[str, Iterator[nn.Parameter]]]:
    if id(module) in layers:
        return
    if id(module) not in ancestors:  # contains no layer: the whole part is one group
        group = "embeddings" if isinstance(module, nn.Embedding) else plain(name)
        yield group, module.parameters()
        return
    # A part that contains layers is a group of its direct parameters; its children are visited.
    yield plain(name) or "model", module.parameters(recurse=False)
    for child, part in module.named_children():
        yield from _outside(f"{name}.{child}" if name else child, part, ancestors, layers, plain)


# --- maps -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Maps:
    """The modules that own parameters, by what can be measured on them.

    Attributes:
        kinds: the kind (maps, norms, embeddings or stem) of each module whose inputs can be
            measured; lone rows are listed under their own names.
        twins: for a module with exactly the parameters of one in `kinds`, the name of that one.
        heads: for a table in `kinds`, the linear map without bias that scores against its rows.
        unknown: for every other module with parameters, why it cannot be measured.
    """

    kinds: dict[str, str]
    twins: dict[str, str]
    heads: dict[str, str]
    unknown: dict[str, str]


def find_maps(model: nn.Module, vision: Sequence[str]) -> Maps:
    """Find what can be measured and what cannot; modules in the parts `vision` are of kind stem.

    Args:
        vision: their plain names.

    Raises:
        AegisError: the model does not have one of the parts `vision`.
    """
    plain = plain_names(model)
    known = {plain(name) for name, _ in model.named_modules()}
    if missing := [part for part in vision if part not in known]:
        raise AegisError(
            f"no module '{missing[0]}' in {type(model).__name__}",
            "a part that reads pixels",
            "give vision= its dotted name",
        )
    maps = Maps({}, {}, {}, {})
    first: dict[int, str] = {}  # the first owner of each parameter
    modules = owning(model).items()
    # Embedding tables come first, so that a head finds its table.
    for name, module in sorted(modules, key=lambda item: not isinstance(item[1], nn.Embedding)):
        own = [id(parameter) for parameter in module.parameters(recurse=False)]
        shared = next((first[parameter] for parameter in own if parameter in first), None)
        if shared is not None:
            _note_shared(maps, model, name, module, shared)
        elif (kind := site_kind(module)) is not None:
            maps.kinds[name] = "stem" if under(plain(name), vision) else kind
        elif rows := lone_rows(name, module):
            for row in rows:
                maps.kinds[row] = "stem" if under(plain(row), vision) else "embeddings"
        else:
            maps.unknown[name] = _problem(module)
        for parameter in own:
            first.setdefault(parameter, name)
    return maps


def site_modules(model: nn.Module, sites: Iterable[str]) -> dict[str, nn.Module]:
    """The modules among the sites; the others are lone rows."""
    found = dict(model.named_modules())
    return {site: found[site] for site in sites if site in found}


def owning(model: nn.Module) -> dict[str, nn.Module]:
    """The modules with parameters of their own."""
    found = {}
    for name, module in model.named_modules():
        if next(module.parameters(recurse=False), None) is not None:
            found[name] = module
    return found


def owners(model: nn.Module) -> dict[int, list[str]]:
    """Names of the modules that own each parameter, by the parameter's id."""
    found: dict[int, list[str]] = {}
    for name, module in owning(model).items():
        for parameter in module.parameters(recurse=False):
            found.setdefault(id(parameter), []).append(name)
    return found


def under(name: str, parts: Sequence[str]) -> bool:
    """Whether a module lies in one of these parts of the model, by plain names."""
    return any(f"{name}.".startswith(f"{part}.") for part in parts)


def _note_shared(maps: Maps, model: nn.Module, name: str, module: nn.Module, owner: str) -> None:
    other = model.get_submodule(owner)
    alike = type(module) is type(other) and _same(module, other)
    # A tied head scores its input against the table's rows; a bias would be its own parameter.
    scores = isinstance(other, nn.Embedding) and type(module) is nn.Linear and module.bias is None
    if owner in maps.kinds and alike:
        maps.twins[name] = owner
    elif owner in maps.kinds and scores and owner not in maps.heads:
        maps.heads[owner] = name
    else:
        maps.unknown[name] = f"shares some of its parameters with {owner}"


def _same(module: nn.Module, other: nn.Module) -> bool:
    mine, others = (list(m.parameters(recurse=False)) for m in (module, other))
    return len(mine) == len(others) and all(p is q for p, q in zip(mine, others, strict=True))


def _problem(module: nn.Module) -> str:
    found = f"a {type(module).__name__}"
    if isinstance(module, nn.Conv2d | nn.Conv3d):
        found += " with groups, or whose padding is not zeros given as numbers"
    return found


def frozen(model: nn.Module, site: str) -> bool:
    """Whether none of a site's own parameters is trainable.

    Raises:
        AegisError: only the site's weight or only its bias is trainable; a frozen bias cannot
            compensate for its weight.
    """
    module = attrgetter(site)(model)
    if isinstance(module, Tensor):
        return not module.requires_grad
    learns = {name: p.requires_grad for name, p in module.named_parameters(recurse=False)}
    if len(set(learns.values())) > 1:
        still = ", ".join(name for name, does in learns.items() if not does)
        raise AegisError(
            f"{site}, a {type(module).__name__}, of which only the {still} is frozen",
            "both frozen, or neither",
            "freeze both or neither",
        )
    return not any(learns.values())


def averaging(model: nn.Module) -> dict[str, nn.Module]:
    """The modules, by name, that keep a running average of their inputs, as BatchNorm does."""
    found = {}
    for name, module in model.named_modules():
        kept = getattr(module, "track_running_stats", False)
        if kept and getattr(module, "running_mean", None) is not None:
            found[name] = module
    return found


def learning(model: nn.Module) -> dict[str, nn.Parameter]:
    """The trainable parameters by every name they have."""
    return {
        name: p for name, p in model.named_parameters(remove_duplicate=False) if p.requires_grad
    }


# --- sites: modules whose inputs say what they do -------------------------------------------------

# What a module does to tokens is linear in its own parameters, so its inputs show which part of the
# module VQA uses.
SITES: dict[type[nn.Module], str] = {
    nn.Linear: "maps",
    nn.LayerNorm: "norms",
    nn.Embedding: "embeddings",
}


@contextlib.contextmanager
def of_type(parameters: Sequence[nn.Parameter], dtype: torch.dtype) -> Generator[None]:
    """Give parameters another dtype inside the block, and their own values afterwards.

    They must have no gradients, which have the parameter's dtype.
    """
    own = [p.data for p in parameters]
    # Through `.data`: optimizers and methods hold references to the parameter objects.
    for parameter, values in zip(parameters, of_one_type(own, dtype), strict=True):
        parameter.data = values
    try:
        yield
    finally:
        for parameter, values in zip(parameters, own, strict=True):
            parameter.data = values


@torch.no_grad()
def of_one_type(tensors: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Copies with a dtype, or the tensor itself if it has it; on a GPU in few kernels."""
    found = [t if t.dtype == dtype else torch.empty_like(t, dtype=dtype) for t in tensors]
    changed = [pair for pair in zip(found, tensors, strict=True) if pair[0] is not pair[1]]
    copy_all([copy for copy, _ in changed], [tensor for _, tensor in changed])
    return found


@torch.no_grad()
def copy_all(into: Sequence[Tensor], tensors: Sequence[Tensor]) -> None:
    """Copy tensors into others, on a GPU in few kernels instead of one for each."""
    if tensors:
        torch._foreach_copy_([rows_here(t) for t in into], [rows_here(t) for t in tensors])


def widest(parameters: Iterable[Tensor]) -> torch.dtype:
    """The dtype that can hold the values of all of them."""
    return reduce(torch.promote_types, {p.dtype for p in parameters})


def digest(state: Mapping[str, Tensor]) -> str:
    """sha256 of weights: names, shapes and values in float32."""
    found = hashlib.sha256()
    # Sorted by name and widened, so the digest depends neither on the order of the parts nor on a
    # narrower dtype of the same values.
    for name, tensor in sorted(state.items()):
        values = whole(tensor.detach()).float().cpu().contiguous()
        found.update(f"{name} {tuple(tensor.shape)}".encode())
        found.update(values.numpy().data)
    return found.hexdigest()


def outermost_lists(module: nn.Module) -> list[nn.ModuleList]:
    """The lists of modules that are inside no other list, such as a transformer's layers."""
    if isinstance(module, nn.ModuleList):
        return [module]
    return [found for child in module.children() for found in outermost_lists(child)]


def owning_modules(model: nn.Module) -> dict[str, nn.Module]:
    """The modules that own parameters, by name.

    A module whose parameters all belong to an earlier one owns none.
    """
    taken: set[int] = set()
    found: dict[str, nn.Module] = {}
    for name, module in model.named_modules():
        own = {id(p) for p in module.parameters(recurse=False)}
        if own - taken:
            found[name] = module
        taken |= own
    return found


def lone_rows(name: str, module: nn.Module) -> list[str]:
    """Names of the lone rows of a module that has submodules and owns nothing else itself.

    No input shows what such a row does. It is the same for every question, so freezing it keeps all
    that depends on it. A row that scales something is thereby protected more than necessary, never
    less. A table of rows [1, N, D], such as of positions, is frozen as a whole.
    """
    own = dict(module.named_parameters(recurse=False))
    made_of_others = next(module.children(), None) is not None
    if not made_of_others or not all(map(_is_same_for_all, own.values())):
        return []
    return [f"{name}.{row}" if name else row for row in own]


def _is_same_for_all(parameter: nn.Parameter) -> bool:
    """Whether it is a row, or a table that is added to the tokens of every image of a batch.

    A row has all its entries along one dimension; such a table has a leading dimension of 1.
    """
    shape = parameter.shape
    is_row = parameter.numel() == max(shape, default=1)  # includes a scalar
    is_table_for_all = len(shape) == 3 and shape[0] == 1
    return is_row or is_table_for_all


def site_kind(module: nn.Module) -> str | None:
    """The kind of a site: maps, norms or embeddings.

    None for a module whose inputs do not show what it does to tokens.
    """
    if isinstance(module, nn.Conv2d | nn.Conv3d):
        plain = module.groups == 1 and module.padding_mode == "zeros" and module.padding != "same"
        return "maps" if plain else None  # otherwise its input is not the unfolded patch
    if type(module) in SITES:
        return SITES[type(module)]
    if isinstance(module, nn.Embedding):  # subclasses may scale the row: still linear in it
        return "embeddings"
    return "norms" if is_rms_norm(module) else None


@torch.no_grad()
def is_rms_norm(module: nn.Module) -> bool:
    """Whether the module only scales x / rms(x) by its weight, or by 1 + its weight."""
    parameters = dict(module.named_parameters())
    if parameters.keys() != {"weight"} or rms_epsilon(module, torch.float32) is None:
        return False
    if parameters["weight"].ndim != 1:
        return False
    weight = whole(parameters["weight"])
    # Every family has its own class for it, so the module's output decides, not its type. The test
    # row has a non-zero mean, which a layer norm would remove.
    x = torch.linspace(-1, 2, len(weight), dtype=weight.dtype, device=weight.device)[None]
    # If the weight is sharded, the module itself holds only part of it.
    found = functional_call(module, {"weight": weight}, (x,)).float()
    normed = rms_normed(module, x).float()
    # Gemma scales by 1 + its weight. The tolerance is wide enough for a module in bfloat16.
    return any(
        torch.allclose(found, normed * scale.float(), rtol=2e-2, atol=1e-3)
        for scale in (weight, 1 + weight)
    )


def rms_epsilon(module: nn.Module, dtype: torch.dtype) -> float | None:
    """The epsilon under the module's root, if it has one.

    Args:
        dtype: of its arithmetic, whose machine epsilon is the default of PyTorch's RMSNorm.
    """
    if isinstance(module, nn.RMSNorm) and module.eps is None:
        return torch.finfo(dtype).eps
    for name in ("eps", "variance_epsilon"):
        if hasattr(module, name):
            return getattr(module, name)
    return None


def rms_normed(module: nn.Module, x: Tensor) -> Tensor:
    """x / rms(x) over the last dimension [..., D], with the module's own epsilon.

    The arithmetic is in float32 or wider.
    """
    wide = widened(x)
    epsilon = rms_epsilon(module, wide.dtype)
    assert epsilon is not None
    return wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + epsilon)
