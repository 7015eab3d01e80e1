"""The campaign's own parts: repeatable damage, and a judge that finds what is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

import pytest
from campaign import figures, mutations, subjects
from campaign.forks import Ended
from campaign.mutations import damage
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import artifacts as samples

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)
TEXT = b"name: x\ntrain:\n  steps: 3\n  lr: 1e-3\n"


def original(folder: Path, suffix: str) -> Path:
    """A file of a kind, the same each time."""
    folder.mkdir(exist_ok=True)
    if suffix == ".safetensors":
        return samples.write(folder, "anchor")
    path = folder / f"file{suffix}"
    path.write_bytes(b'{"a": [1, {"b": "c"}], "d": 2.5}\n' if "json" in suffix else TEXT)
    return path


def look(path: Path) -> bytes | str:
    """The content, without waiting for a pipe."""
    if path.is_symlink():
        return str(path.readlink())
    if path.is_file():
        return path.read_bytes()
    return "nothing" if not path.exists() else oct(path.stat().st_mode)


@pytest.mark.parametrize("suffix", [".safetensors", ".json", ".jsonl", ".yaml", ".png"])
def test_equal_seeds_do_equal_damage(suffix: str, tmp_path: Path) -> None:
    seen = set()
    for seed in range(60):
        done = []
        for repetition in ("a", "b"):
            folder = tmp_path / f"{seed}-{repetition}"
            path = original(folder, suffix)
            what = damage(Random(seed), path)
            done.append((what, look(path)))
            assert [p for p in folder.iterdir() if p != path] == []
        assert done[0] == done[1]
        seen.add(done[0][0].name)
    assert len(seen) > 8


def test_a_file_that_lost_its_digest_is_not_taken_for_a_sealed_one(tmp_path: Path) -> None:
    for seed in range(100):
        path = original(tmp_path / str(seed), ".safetensors")
        what = damage(Random(seed), path)
        if what.name.endswith("no digest"):
            assert not what.sealed and b'"digest' not in path.read_bytes()
            return
    pytest.fail("no such damage in 100 draws")


@settings(derandomize=True, database=None, max_examples=60)
@given(document=JSON, seed=st.integers(0, 2**32))
def test_any_json_can_be_damaged(document: object, seed: int) -> None:
    """And the result can be written again, so a case never ends the campaign."""
    text = json.dumps(document).encode()
    changed = mutations.damaged_json(Random(seed), text)
    json.loads(changed)


FINE = "found: x\nexpected: y\nfix: z\n"


@pytest.mark.parametrize(
    ("ended", "problem"),
    [
        (Ended(0, "", "", False, False), ""),
        (Ended(2, "", FINE, False, False), ""),
        (Ended(2, "", "found: 2 problems\nexpected:\n  1. a\nfix:\n  1. b\n", False, False), ""),
        (Ended(3, "", "Traceback", False, False), "exit 3"),
        (Ended(1, "", "", False, False), "exit 1"),
        (Ended(-11, "", "", False, False), "exit -11"),
        (Ended(0, "", "Traceback (most recent call last)", False, False), "a traceback"),
        (Ended(-9, "", "", True, False), "hung"),
        (Ended(0, "", "", False, True), "processes outlived it"),
        (Ended(2, "", "Usage: aegis", False, False), "exit 2 with"),
        (Ended(2, "", FINE + FINE, False, False), "exit 2 with"),
        (Ended(0, "\x1b[31m", "", False, False), "control characters"),
    ],
)
def test_the_judge_sees_a_bad_end(ended: Ended, problem: str) -> None:
    found = subjects.wrong_end(ended)
    assert found.startswith(problem) and bool(found) == bool(problem)


def test_the_judge_sees_what_was_left_behind(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "ledger.safetensors").touch()
    assert subjects.leftovers(tmp_path) == []
    (tmp_path / "run" / ".000004.tmp").mkdir()
    assert subjects.leftovers(tmp_path) == ["run/.000004.tmp"]


def test_times_are_no_difference_and_figures_are() -> None:
    said = '{"loss": 0.5, "step_s": %s, "rows": [{"minutes": %s, "a": %s}]}'
    assert subjects.figures(said % (1, 2, 3)) == subjects.figures(said % (4, 5, 3))
    assert subjects.figures(said % (1, 2, 3)) != subjects.figures(said % (1, 2, 4))


def test_the_page_gets_the_last_result_of_every_case(tmp_path: Path) -> None:
    old, new, page = (tmp_path / name for name in ("old", "new", "page.md"))
    shared = {"kind": "mutations", "subject": "anchor", "damage": "x"}
    failed = shared | {"case": 1, "code": 3, "problem": "exit 3"}
    lines = [failed, shared | {"case": 2, "code": 0, "problem": ""}]
    old.write_text("".join(json.dumps(line) + "\n" for line in lines))
    again = failed | {"code": 2, "problem": ""}
    kill = {"kind": "kills", "work": "run", "case": 1, "codes": [-9, 143, 0], "problem": ""}
    new.write_text(json.dumps(again) + "\n" + json.dumps(kill) + "\n")
    assert len(figures.failures(figures.read([old]))) == 1
    page.write_text(
        "# Page\n\n<!-- figures of the campaign -->\nx\n<!-- end of the figures -->\nz\n"
    )
    for _ in range(2):
        figures.write(page, figures.read([old, new, tmp_path / "none"]))
    said = page.read_text()
    assert "| damaged: anchor | 2 | 1 | 1 | 0 | 0 |" in said
    assert "| signals: run | 1 | 1 | 0 | 2 | 0 |" in said
    assert said.startswith("# Page\n") and said.endswith("z\n") and said.count("all |") == 1
