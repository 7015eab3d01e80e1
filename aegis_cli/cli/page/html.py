"""Builds HTML from elements, so that text from files cannot become markup."""

from __future__ import annotations

from html import escape
from typing import Any

from aegis_cli.cli.render.output import visible


class Markup(str):
    """Text that is already HTML."""

    __slots__ = ()


VOID = ("meta", "link", "img", "br", "source")  # elements without an end tag
Child = Any  # Markup, text or a number, a list of these, or None for nothing


def element(tag: str, /, *children: Child, **attributes: Any) -> Markup:
    """One element. Attributes are escaped, and so are children that are not `Markup`.

    Args:
        attributes: `class_` stands for `class`, and `_` for `-`; None omits an attribute.
    """
    written = ""
    for key, value in attributes.items():
        if value is not None:
            name = key.rstrip("_").replace("_", "-")
            written += f' {name}="{_text(value)}"'
    if tag in VOID:
        return Markup(f"<{tag}{written}>")
    return Markup(f"<{tag}{written}>{join(*children)}</{tag}>")


def join(*children: Child) -> Markup:
    """The children in sequence, without an enclosing element."""
    return Markup("".join(map(_child, children)))


def _child(child: Child) -> str:
    if child is None:
        return ""
    if isinstance(child, Markup):
        return child
    if isinstance(child, (list, tuple)):
        return join(*child)
    return _text(child)


def _text(value: Any) -> str:
    """A value as HTML, without control characters and with special characters escaped."""
    return escape(visible(str(value)))
