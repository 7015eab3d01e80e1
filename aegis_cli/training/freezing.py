"""What `train.freeze` names: parts of the backbone that stay frozen, whatever the method.

A pattern matches whole names, of two kinds. Groups have the names that ledgers and dry runs give
them, much the same in every backbone: `vision` or `stem`, `embeddings`, `layers.0`, `final_norm`,
`head`. Modules and parameters have their dotted names in the model itself, as in its repository.
Everything below a named part is frozen with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.methods.base import Method
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.structure import names
from aegis_cli.recipes import patterns
from aegis_cli.recipes.strict_yaml import did_you_mean

_KEY = "train.freeze"
_BEHIND = {"final_norm", "head"}  # the groups after everything that the action expert reads


def adapt(
    method: Method,
    backbone: Backbone,
    options: Mapping[str, Any],
    freeze: str | Sequence[str] | None,
    on_event: OnEvent,
) -> None:
    """Let the method make trainable what it trains, and freeze what is named.

    Args:
        freeze: `train.freeze` of the recipe.

    Raises:
        AegisError: no part has a given name, or nothing is left to learn.
    """
    maps = backbone.language_maps()
    # Before the method replaces modules by its own.
    still = named(backbone, freeze)
    free = still.without(maps)
    method.adapt(backbone, free, options)
    if not still.given:
        return
    # Freezing has an effect in two cases: on parameters that the method would train, and on maps to
    # which a method that adds modules would add one.
    adds_less = method.export is not None and len(free) < len(maps)
    stops = adds_less or any(p.requires_grad for p in still.parameters.values())
    still.hold()
    if not stops:
        text = f"{still.said} changes nothing: method '{method.name}' trains none of it anyway"
        on_event(Warned("train", text))
        return
    with_method = f"{still.said} with method '{method.name}'"
    check_something_learns(
        with_method,
        list(backbone.learning_groups()),
        "freeze less; or --method stop-gradient, which trains the action expert alone",
    )
    still.warn_of_tied(on_event)


@dataclass(frozen=True)
class Still:
    """What `train.freeze` names in a backbone.

    Attributes:
        given: the names and patterns, as the recipe has them.
        parameters: the parameters that they name, by their names in the model itself.
        tied: further names of tied parameters -> the name that was given.
    """

    given: tuple[str, ...] = ()
    parameters: Mapping[str, nn.Parameter] = field(default_factory=dict)
    tied: Mapping[str, str] = field(default_factory=dict)

    @property
    def said(self) -> str:
        """The key and its value, with which messages begin."""
        return f"{_KEY}: {', '.join(self.given)}"

    def hold(self) -> None:
        """Freeze these parameters."""
        for parameter in self.parameters.values():
            parameter.requires_grad_(False)

    def without(self, maps: Mapping[str, nn.Linear]) -> dict[str, nn.Linear]:
        """The maps that are not frozen: adding a low-rank term would change a frozen one."""
        still = set(map(id, self.parameters.values()))
        return {name: linear for name, linear in maps.items() if id(linear.weight) not in still}

    def left(self, groups: Mapping[str, Sequence[nn.Parameter]]) -> list[str]:
        """The groups with at least one parameter that is not frozen."""
        still = set(map(id, self.parameters.values()))
        return [name for name, own in groups.items() if any(id(p) not in still for p in own)]

    def warn_of_tied(self, on_event: OnEvent) -> None:
        """Warn of other names of the frozen weights."""
        for other, name in self.tied.items():
            text = f"{self.said} freezes {other} too, the same weight as {name}: name both"
            on_event(Warned("train", text))


def named(backbone: Backbone, freeze: str | Sequence[str] | None) -> Still:
    """What `train.freeze` names in a backbone without a method's own modules.

    Raises:
        AegisError: no part has a given name.
    """
    given, every = names(freeze or ()), _every(backbone)
    own = {name: every[name] for name in sorted(_named(backbone, given))}
    # A tied weight has several names and is one parameter: it is frozen under each of them.
    first = {id(parameter): name for name, parameter in own.items()}
    tied = {}
    for name, parameter in every.items():
        if id(parameter) in first and name not in own:
            tied[name] = first[id(parameter)]
    return Still(given, own, tied)


def sentence(freeze: str | Sequence[str] | None, before: str) -> str:
    """What a model card says of `train.freeze`, after `before`; empty if nothing is named."""
    given = names(freeze or ())
    return f"{before}Of the backbone `{'`, `'.join(given)}` did not learn." if given else ""


def check_something_learns(said: str, left: Sequence[str], fix: str) -> None:
    """Raise AegisError unless some part that the action expert reads is trainable.

    Args:
        said: what freezes the rest.
        left: the groups with trainable parameters.
        fix: what to do if nothing does.
    """
    if set(left) <= _BEHIND:
        but = f" but {' and '.join(left)}, which the action expert does not read" if left else ""
        raise AegisError(
            f"{said}: nothing of the backbone is left to learn{but}",
            "a part that learns",
            fix,
        )


# --- names ----------------------------------------------------------------------------------------


def _named(backbone: Backbone, given: Sequence[str]) -> set[str]:
    """Names of the parameters that the patterns match, directly or through an enclosing part.

    Raises:
        AegisError: a pattern matches nothing, or a range exceeds what there is.
    """
    found: set[str] = set()
    for pattern in given:
        # A range has to have both of its ends, or `layers.0-99` would pass in a model of 24 layers.
        # The pattern itself comes last, so that `matched` ends up with everything it names.
        for needed in (*patterns.at_its_ends(pattern), pattern):
            matched = _matched(backbone, needed)
            if not matched:
                raise _unknown(backbone, pattern, needed)
        found |= matched
    return found


def _matched(backbone: Backbone, pattern: str) -> set[str]:
    matches = patterns.compiled(pattern).fullmatch
    found = {name for name in _every(backbone) if any(map(matches, _and_above(name)))}
    for group, own in _groups(backbone).items():
        if matches(group):
            found.update(own)
    return found


def _every(backbone: Backbone) -> dict[str, nn.Parameter]:
    """The parameters by all their names in the model itself, including tied ones."""
    named = backbone.named_parameters(remove_duplicate=False)
    return {name.removeprefix(backbone.inside): parameter for name, parameter in named}


def _groups(backbone: Backbone) -> dict[str, list[str]]:
    """The names of each group's parameters; for a tied parameter its first name."""
    first: dict[int, str] = {}
    for name, parameter in _every(backbone).items():
        first.setdefault(id(parameter), name)
    groups = backbone.parameter_groups().items()
    return {group: [first[id(parameter)] for parameter in own] for group, own in groups}


def _and_above(name: str) -> Iterator[str]:
    """A dotted name, and the names of all parts that enclose it."""
    words = name.split(".")
    for count in range(1, len(words) + 1):
        yield ".".join(words[:count])


def _unknown(backbone: Backbone, pattern: str, needed: str) -> AegisError:
    """The error if a pattern matches nothing; `needed` is the pattern or an end of its range."""
    groups = list(_groups(backbone))
    below = {part: None for name in _every(backbone) for part in _and_above(name)}
    own = ", ".join(_largest(below))
    others = [group for group in groups if not group.startswith("layers.")]
    listed = f"{', '.join(others)}, layers.0 to layers.{backbone.depth - 1}"
    fix, of_range = f"--set {_KEY}={others[0]}", ""
    if needed != pattern:
        fix, of_range = "let the range end where the names do", f" (of {pattern})"
    elif near := _near(needed, groups, list(below)):
        fix = f"did you mean '{near}'?"
    return AegisError(
        f"{_KEY}: '{needed}'{of_range}, but no part of the backbone has that name",
        f"a group ({listed}), or the dotted name of a module or parameter in or below {own}",
        fix,
    )


def _largest(below: Iterable[str]) -> list[str]:
    """The parts that an error lists: the outermost ones, or those inside the only large one."""
    known = list(below)
    outer = [name for name in known if "." not in name]
    found = []
    for name in outer:
        inner = [n for n in known if n.startswith(f"{name}.") and n.count(".") == 1]
        # A model of the hub has its two towers in a module `model`, and a head beside it.
        towers = len(outer) <= 2 and len(inner) > 1
        found += inner if towers else [name]
    return found


def _near(name: str, groups: Sequence[str], below: Sequence[str]) -> str | None:
    """What may have been meant: a part whose name ends like this or is spelled similarly."""
    ends = [known for known in below if known.endswith(f".{name}")]
    return min(ends, key=len, default=None) or did_you_mean(name, [*groups, *below])
