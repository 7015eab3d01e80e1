"""HTML out of elements, so that no text of a file can become markup."""

from __future__ import annotations

from html import escape
from typing import Any

from aegis_cli.cli.render.output import visible


class Markup(str):
    """A text that is HTML already."""

    __slots__ = ()


VOID = ("meta", "link", "img", "br", "source")  # elements without an end tag
Child = Any  # Markup, text or a number, a list of such, or None for nothing


def element(tag: str, /, *children: Child, **attributes: Any) -> Markup:
    """One element. Children that are no `Markup` are escaped, and so are the attributes.

    Args:
        attributes: `class_` stands for `class`, and `_` for `-`; None leaves one out.
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
    """Children one after the other, without an element around them."""
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
    """A value as HTML, in which control characters have no place and some others a meaning."""
    return escape(visible(str(value)))
