"""Texts that are no YAML, or that are larger than a recipe may be: one error, immediately."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import yaml

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes.strict_yaml import dump, line_of, parse

SHIPPED = Path(__file__).parent.parent.parent / "recipes"


def bomb(levels: int) -> str:
    """A text of aliases of aliases: nine to the power of `levels` values when written out."""
    lines = [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(["l0: &l0 [x, x, x, x, x, x, x, x, x]", *lines])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('a: !!int ""', "not of the kind"),
        ("a: !!bool maybe", "not of the kind"),
        ("a: !!float x", "could not convert"),
        ("a: !!timestamp x", "not of the kind"),
        ('a: !!int "0x"', "invalid literal"),
        ("a: !!str {}", "expected a scalar"),
        ("? [a]\n: 1", "unhashable"),
        ("a: !!python/object:os.system x", "could not determine a constructor"),
        ("a: &a [*a]", "more than 100000 values"),
        ("a: &a {b: *a}", "more than 100000 values"),
        (bomb(12), "more than 100000 values"),
        ("[" * 3000, "nested too deeply"),
        ("- " * 3000, "nested too deeply"),
    ],
)
def test_it_is_one_error(text: str, found: str) -> None:
    started = time.process_time()
    with pytest.raises(AegisError, match=found) as caught:
        parse(text, "small.yaml")
    assert caught.value.found.startswith("small.yaml:") and caught.value.fix
    assert time.process_time() - started < 20  # expanding the bomb would take hours


def test_aliases_are_no_fault() -> None:
    value, problems = parse("a: &rate 0.1\nb: *rate\nc: &d {e: 1}\nf: *d", "small.yaml")
    assert value == {"a": 0.1, "b": 0.1, "c": {"e": 1}, "f": {"e": 1}} and problems == []


@pytest.mark.parametrize("value", ["null", "3", "{a: 1}", "[1]", "true"])
def test_a_text_or_list_of_another_type_is_named(value: str, tmp_path: Path) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(f"kind: policy\nname: x\nprobe:\n  vqa: {value}\n")
    with pytest.raises(AegisError, match=r"probe.vqa: .*line 4"):
        recipes.load(path)


def said(value: object) -> object:
    """A value with the line number of each of its keys."""
    if isinstance(value, dict):
        return [(name, line_of(value, name), said(inner)) for name, inner in value.items()]
    return [said(item) for item in value] if isinstance(value, list) else value


def test_a_recipe_is_the_same_without_libyaml(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [path.read_text(encoding="utf-8") for path in SHIPPED.glob("*.yaml")]
    assert len(texts) > 10
    # Duplicate keys, scalars of YAML 1.2, quotes, a merge, and many lines.
    texts += ["a: no\nb: 1e-4\na: 010\nc: [2024-01-01, ~, .inf, 'x: y']\nd: &d {e: 1}\nf: {<<: *d}"]
    texts += [dump({"words": ["yes", "über", "1.0", "a: b", "# c", "x" * 200 + " y"]}), "# nothing"]
    with_it = [parse(text, "small.yaml") for text in texts]
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    without = [parse(text, "small.yaml") for text in texts]
    assert [said(value) for value, _ in with_it] == [said(value) for value, _ in without]
    assert [problems for _, problems in with_it] == [problems for _, problems in without]
    assert any(problems for _, problems in with_it)


def test_what_libyaml_refuses_is_told_in_pyyamls_words(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for there in (yaml.__with_libyaml__, False):
        monkeypatch.setattr(yaml, "__with_libyaml__", there)
        with pytest.raises(AegisError) as caught:
            parse("a: 1\nb: [1, 2\nc: 3", "small.yaml")
        found.append(caught.value.found)
    assert found[0] == found[1]
    assert "line 3" in found[0]
