"""The card of a checkpoint's backbone: it names what went into the weights, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from aegis_cli import methods
from aegis_cli.core.ledger import Ledger
from aegis_cli.recipes import Recipe
from aegis_cli.training import card

INPUTS = {"demos": "d" * 64, "backbone": "b" * 64, "anchor": "a" * 64}


@pytest.mark.parametrize(
    ("name", "reads"), [("naive", False), ("stop-gradient", False), ("ewc", True)]
)
def test_an_anchor_is_named_where_the_method_reads_one(name: str, reads: bool) -> None:
    method, data = methods.get(name), card.Data("reach", (), 90, 10)
    said = card.text(Recipe("x"), method, 3, data, INPUTS, Ledger(["layers.0"], ["layers.0"]))
    assert ("- anchor: `aaa" in said) is reads and ("--anchor ANCHOR" in said) is reads
    assert "- demos: `ddd" in said


@pytest.mark.parametrize(
    ("freeze", "said"),
    [
        (None, ""),
        ("vision", "Of the backbone `vision` did not learn."),
        (("vision", "layers.0-3"), "Of the backbone `vision`, `layers.0-3` did not learn."),
    ],
)
def test_what_was_frozen_is_named(freeze: str | tuple[str, ...] | None, said: str) -> None:
    plain = Recipe("x")
    recipe = replace(plain, train=replace(plain.train, freeze=freeze))
    method, data = methods.get("naive"), card.Data("reach", (), 90, 10)
    text = card.text(recipe, method, 3, data, INPUTS, Ledger([], []))
    assert said in text and ("did not learn" in text) is bool(said)


def test_nobody_is_told_where_the_backbone_lies() -> None:
    method, data = methods.get("naive"), card.Data("reach", (), 90, 10)
    ledger = Ledger(["layers.0"], ["layers.0"])
    said = card.text(Recipe("x", backbone="/home/ann/vlm"), method, 3, data, INPUTS, ledger)
    assert "model `vlm` as" in said and "--baseline vlm\n" in said and "/home" not in said
    said = card.text(Recipe("x", backbone="org/vlm"), method, 3, data, INPUTS, ledger)
    assert "model `org/vlm` as" in said


def test_a_card_names_the_model_before_and_not_the_run_that_had_it() -> None:
    method, data, ledger = methods.get("naive"), card.Data(None, (), 1, 1), Ledger([], [])
    recipe = Recipe("x", backbone="runs/first")
    said = card.text(recipe, method, 3, data, INPUTS, ledger, began_as="org/vlm")
    assert "model `org/vlm` (which Aegis had fine-tuned before) as" in said
    assert "--baseline org/vlm\n" in said and "runs/" not in said
