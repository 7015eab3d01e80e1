"""Bad artifacts: one clear error for each kind of bad file, and nothing half-written."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from samples.artifacts import FINGERPRINT, SAMPLES, anchor, demos, forge, write
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError


def altered(kind: str, name: str, value: Tensor | None) -> dict[str, Tensor]:
    """The kind's sample tensors with one replaced, added or (None) removed."""
    tensors = {**SAMPLES[kind]()["tensors"], name: value}
    return {k: v for k, v in tensors.items() if v is not None}


def refused(path: Path, *words: str, kind: str | None = None, **options: Any) -> None:
    """`load` fails, and its error says all the words and has a fix."""
    with pytest.raises(AegisError) as caught:
        artifacts.load(path, kind, **options)
    assert caught.value.fix and not [word for word in words if word not in str(caught.value)], str(
        caught.value
    )


def test_missing_file_and_folder(tmp_path: Path) -> None:
    refused(tmp_path / "a.safetensors", "no file", "a.safetensors", "aegis anchor", kind="anchor")
    refused(tmp_path, "cannot read", "folder", kind="anchor")
    with pytest.raises(AegisError, match="no file"):
        artifacts.read_header(tmp_path / "a.safetensors")
    with pytest.raises(AegisError, match="no file"):
        artifacts.sha256_file(tmp_path / "a.safetensors")


def test_a_file_that_is_cut_after_its_header_was_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With torch's own text about the mapping; other errors of a reader pass."""
    path = write(tmp_path, "demos")
    said = f"file <{path}> size <4096> is smaller than the required mapping size <617656>"

    def cut(*_: object, **__: object) -> None:
        raise RuntimeError(said)

    monkeypatch.setattr("safetensors.safe_open", cut)
    refused(path, "truncated", "aegis demos", kind="demos")
    said = "a defect"
    with pytest.raises(RuntimeError, match="a defect"):
        artifacts.load(path, "demos")


@pytest.mark.parametrize("keep", [0, 4, 20, 0.5, -1])
def test_truncated_file(tmp_path: Path, keep: float) -> None:
    path = write(tmp_path, "demos")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep) if keep == 0.5 else int(keep)])
    refused(path, "truncated", "demos.safetensors", "aegis demos", kind="demos")
    with pytest.raises(AegisError, match="truncated"):
        artifacts.read_header(path)


def test_not_safetensors_at_all(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    path.write_bytes(b"%PDF-1.7 something else entirely " * 40)
    refused(path, "not a safetensors file")


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}])
def test_foreign_safetensors(tmp_path: Path, metadata: dict[str, str] | None) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.torch.save_file(anchor()["tensors"], path, metadata)
    refused(path, "without an 'aegis' header", "'anchor'", "aegis anchor", kind="anchor")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "[" * 100_000,
        '{"kind":"anchor","schema":1}',
        '{"kind":"anchor","schema": "x"}',
    ],
)
def test_damaged_header(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.torch.save_file(anchor()["tensors"], path, {"aegis": text})
    refused(path, "header of", "damaged")


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 0},
        {"schema": -3},
        {"seed": "one"},
        {"fingerprint": 3},
        {"meta": []},
        {"inputs": {"demos": 1}},
        {"inputs": []},
        {"version": None, "digest": 5},
        {"tensors": {"count": {"shape": [2.5], "dtype": "int64", "unit": "1"}}},
        {"tensors": {"count": {"shape": [2], "dtype": "int64", "unit": None}}},
        {"more": 1},
        {"seed": float("nan")},
        {"meta": {"loss": float("inf")}},
    ],
)
def test_header_of_other_types(tmp_path: Path, change: dict[str, Any]) -> None:
    path = write(tmp_path, "anchor")
    forge(path, lambda header: header.update(change))
    refused(path, "header of", "damaged")


@pytest.mark.parametrize(
    "change",
    [
        {"instructions": [["go", "to", "red"], "go to blue"]},
        {"colors": 2},
        {"control_hz": "fast"},
        {"control_hz": -1},
        {"task": None},
        {"action_names": {"a": 1, "b": 2}},
        {"proprio_names": [1, 2, 3]},
    ],
)
def test_words_of_other_types_in_demonstrations_without_a_digest(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    path = write(tmp_path, "demos")
    forge(path, lambda header: header["meta"].update(change))
    refused(path, "of another type", kind="demos")


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("ledger", {"groups": 5}),
        ("experts", {"structure": [1]}),
        ("experts", {"structure": {"map": None}}),
        ("stream-task", {"parts": [1, 2]}),
        ("stream-task", {"classes": None}),
    ],
)
def test_metadata_of_other_types_without_a_digest(
    tmp_path: Path, kind: str, change: dict[str, Any]
) -> None:
    path = write(tmp_path, kind)
    forge(path, lambda header: header["meta"].update(change))
    refused(path, "metadata of other types", kind=kind)


def test_wrong_kind_comes_first(tmp_path: Path) -> None:
    path = write(tmp_path, "demos")
    forge(path, lambda header: header.update(schema=99), actions=torch.full((5, 2), float("nan")))
    refused(path, "of kind 'demos'", "'anchor'", "aegis anchor", kind="anchor")


def test_unknown_kind(tmp_path: Path) -> None:
    path = write(tmp_path, "anchor")
    forge(path, lambda header: header.update(kind="hologram"))
    refused(path, "unknown kind 'hologram'", "upgrade aegis")


def test_newer_schema(tmp_path: Path) -> None:
    path = write(tmp_path, "anchor")
    forge(path, lambda header: header.update(schema=2, novelty=True))
    refused(path, "schema 2", "schema 1 or older", "upgrade aegis", kind="anchor")


@pytest.mark.parametrize("kind", SAMPLES)
def test_tensors_must_be_those_of_the_header(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind)
    forge(path, stowaway=torch.zeros(1))
    refused(path, "not those its header lists")
    name = min(SAMPLES[kind]()["tensors"])
    path = write(tmp_path, kind)
    forge(path, **{name: torch.zeros(2, 2, 2, 2, 2)})
    refused(path, "not those its header lists")


@pytest.mark.parametrize(
    ("kind", "name", "value", "words"),
    [
        ("anchor", "count", None, "'count' missing"),
        ("anchor", "layers.1.text.var", None, "'layers.1.text.var' missing"),
        (
            "anchor",
            "layers.7.text.mean",
            torch.zeros(4).double(),
            "'layers.7.text.mean' not part of it",
        ),
        (
            "anchor",
            "inputs.map.vectors",
            torch.zeros(2, 2),
            "'inputs.map.vectors' is float32 [2, 2] instead of float32 [3, k of inputs.map]",
        ),
        (
            "anchor",
            "inputs.map.vectors",
            torch.ones(3, 2),
            "'inputs.map.vectors' are not orthonormal",
        ),
        ("anchor", "inputs.map.values", None, "'inputs.map.vectors' not part of it"),
        ("anchor", "inputs.table.values", -torch.ones(3).double(), "negative value"),
        ("anchor", "fisher.map.weight", -torch.ones(2, 3), "negative value"),
        ("anchor", "extra", torch.zeros(1), "'extra' not part of it"),
        (
            "anchor",
            "layers.0.image.var",
            torch.zeros(5).double(),
            "'layers.0.image.var' is float64 [5] instead of float64 [4]",
        ),
        (
            "anchor",
            "layers.0.image.var",
            torch.zeros(4),
            "'layers.0.image.var' is float32 [4] instead of float64 [4]",
        ),
        ("anchor", "layers.0.image.var", -torch.ones(4).double(), "negative variance"),
        (
            "anchor",
            "layers.0.image.mean",
            torch.tensor([0, 1, float("nan"), 0]).double(),
            "'layers.0.image.mean' has 1 NaN",
        ),
        ("anchor", "count", torch.tensor([0, 0]), "count is [0, 0]"),
        (
            "demos",
            "frames",
            torch.zeros(5, 32, 32, 3, dtype=torch.uint8),
            "instead of uint8 [5, 64, 64, 3]",
        ),
        (
            "demos",
            "actions",
            torch.full((5, 2), float("inf")),
            "'actions' has 10 NaN or infinite of 10 values",
        ),
        ("demos", "actions", torch.zeros(5, 3), "'actions' has 3 columns for 2 action_names"),
        ("demos", "proprio", torch.zeros(4, 3), "'proprio' is float32 [4, 3]"),
        ("demos", "episode_starts", torch.tensor([0, 2, 4]), "rise from 0 to the 5 frames"),
        ("demos", "episode_starts", torch.tensor([0, 0, 5]), "rise from 0"),
        ("demos", "episode_starts", torch.tensor([0, 5]), "rise from 0"),
        ("demos", "episode_starts", torch.zeros(0, dtype=torch.int64), "rise from 0"),
        (
            "demos",
            "instruction",
            torch.tensor([0, 2]),
            "'instruction' points outside the 2 instructions",
        ),
        (
            "demos",
            "target_color",
            torch.tensor([-1, 0]),
            "'target_color' points outside the 2 colors",
        ),
        (
            "ledger",
            "w2",
            torch.ones(2, 1).double(),
            "'w2' is float64 [2, 1] instead of float64 [3, L]",
        ),
        ("ledger", "step", torch.tensor([1, 1, 2]), "'step' does not increase"),
        ("ledger", "aa", -torch.ones(3, 2).double(), "'aa' is a square"),
        ("ledger", "w2", torch.ones(3, 2).double(), "'w2' has 2 columns for 1 layers"),
        (
            "stream-task",
            "images",
            torch.zeros(5, 4, 6, 3, dtype=torch.uint8),
            "instead of uint8 [5, 4, 4, 3]",
        ),
        ("stream-task", "images", torch.zeros(5, 4, 4, 3), "'images' is float32 [5, 4, 4, 3]"),
        (
            "stream-task",
            "labels",
            torch.tensor([0, 1, 0, 2, 1]),
            "'labels' points outside the 2 classes",
        ),
        ("dual-encoder", "half", torch.tensor([float("nan")]), "'half' has 1 NaN"),
        ("expert", "half", torch.tensor([float("nan")]), "'half' has 1 NaN"),
        ("experts", "map.experts.2.b", None, "'map.experts.2.b' missing"),
        (
            "experts",
            "map.experts.2.b",
            torch.ones(4, 1),
            "'map.experts.2.b' is float32 [4, 1] instead of float32 [4, 2]",
        ),
        (
            "experts",
            "map.experts.2.a",
            torch.ones(2, 4),
            "'map.experts.2.a' is float32 [2, 4] instead of float32 [2, 3]",
        ),
        ("experts", "map.head", torch.ones(1), "'map.head' not part of it"),
        ("routing", "map.routers.0.scale", None, "'map.routers.0.scale' missing"),
        (
            "routing",
            "map.routers.1.bias",
            torch.ones(1),
            "lists 1 experts, which does not fit its logits",
        ),
        (
            "routing",
            "map.routers.1.read",
            torch.ones(1, 2),
            "lists 1 experts, which does not fit its logits",
        ),
        (
            "routing",
            "map.routers.0.scale",
            torch.ones(2),
            "'map.routers.0.scale' is float32 [2] instead of float32 []",
        ),
        ("routing", "map.routers.0.experts", torch.tensor([2, 0]), "does not increase"),
        (
            "routing",
            "map.routers.0.mass",
            torch.tensor([0.25, 0.5]).double(),
            "sums to 0.75 instead of 1",
        ),
        ("routing", "map.routers.0.mass", torch.tensor([-0.25, 1.25]).double(), "negative share"),
        (
            "routing",
            "tasks.variances",
            torch.zeros(2, 3).double(),
            "'tasks.variances' is not positive",
        ),
        ("routing", "tasks.noise", torch.zeros(2).double(), "'tasks.noise' is not positive"),
        (
            "routing",
            "tasks.directions",
            torch.zeros(2, 5, 3),
            "'tasks.directions' is float32 [2, 5, 3]",
        ),
        ("routing", "tasks.threshold", torch.zeros(3).double(), "'tasks.threshold' is float64 [3]"),
        ("training-state", "half", torch.tensor([float("-inf")]), "'half' has 1 NaN or infinite"),
        # whose sum is NaN, and one beside values whose sum is infinite without it
        (
            "training-state",
            "half",
            torch.tensor([float("inf"), float("-inf")]),
            "'half' has 2 NaN or infinite",
        ),
        (
            "training-state",
            "half",
            torch.tensor([3e38, 3e38, float("nan")]),
            "'half' has 1 NaN or infinite",
        ),
    ],
)
def test_wrong_content_is_neither_written_nor_loaded(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    name: str,
    value: Tensor | None,
    words: str,
) -> None:
    with pytest.raises(AegisError) as caught:
        write(tmp_path, kind, tensors=altered(kind, name, value))
    assert words in caught.value.found and "nothing was written" in caught.value.fix
    assert not list(tmp_path.iterdir())
    with monkeypatch.context() as patch:  # a careless program writes it nevertheless
        patch.setattr(artifacts, "_validate", lambda *_: None)
        path = write(tmp_path, kind, tensors=altered(kind, name, value))
    refused(path, words, artifacts.KINDS[kind].command, kind=kind)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_values_that_are_finite_are_kept_where_their_sum_is_not(
    tmp_path: Path, dtype: torch.dtype
) -> None:
    largest = torch.full((8,), torch.finfo(dtype).max, dtype=dtype)
    path = write(tmp_path, "training-state", tensors=altered("training-state", "half", largest))
    assert torch.equal(artifacts.load(path).tensors["half"], largest)


def test_experts_must_be_those_of_the_structure(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="does not list these experts"):
        write(tmp_path, "experts", meta={"structure": {"map": {"experts": {"0": {}}}}})
    with pytest.raises(AegisError, match="missing"):
        write(tmp_path, "experts", tensors={})


def test_no_episodes_and_no_tensors(tmp_path: Path) -> None:
    none = {
        "episode_starts": 1,
        "instruction": 0,
        "target_color": 0,
        "frames": 0,
        "proprio": 0,
        "actions": 0,
    }
    with pytest.raises(AegisError, match="0 episodes"):
        write(
            tmp_path,
            "demos",
            tensors={name: demos()["tensors"][name][:n] for name, n in none.items()},
        )
    with pytest.raises(AegisError, match="no tensors"):
        write(tmp_path, "backbone", tensors={})


def test_meta_is_finite_and_complete(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="metadata"):
        write(tmp_path, "demos", meta={**demos()["meta"], "control_hz": float("nan")})
    with pytest.raises(AegisError, match="meta lacks 'colors', 'task'"):
        write(
            tmp_path,
            "demos",
            meta={k: v for k, v in demos()["meta"].items() if k not in ("colors", "task")},
        )
    words = SAMPLES["stream-task"]()["meta"]
    with pytest.raises(AegisError, match="meta lacks 'classes'"):
        write(tmp_path, "stream-task", meta={k: v for k, v in words.items() if k != "classes"})
    with pytest.raises(AegisError, match="parts of 6 images together, but 5 labels"):
        write(
            tmp_path,
            "stream-task",
            meta={**words, "parts": {"train": 2, "validation": 2, "test": 2}},
        )


def test_a_file_of_another_backbone_is_refused_by_the_names_that_the_user_gave(
    tmp_path: Path,
) -> None:
    """The digests only help to compare; a file of an earlier Aegis has nothing else."""
    path, other = write(tmp_path, "anchor"), "fedcba9876543210" * 4

    def owner(fingerprint: str, name: str = "models/mine") -> artifacts.Owner:
        return artifacts.Owner(fingerprint, name, "aegis anchor")

    own = artifacts.load(path, "anchor", owner=owner(FINGERPRINT))
    assert own.header.fingerprint == FINGERPRINT
    both = f"(digest {FINGERPRINT[:12]}, not {other[:12]})"
    before = "made with weights that are not those of 'models/mine'"
    refused(path, before, both, "aegis anchor", kind="anchor", owner=owner(other))
    refused(write(tmp_path, "expert"), "digest unknown", other[:12], owner=owner(other))
    meta = {artifacts.BACKBONE: "models/yours"}
    named = write(tmp_path, "anchor", meta=meta)
    assert artifacts.made_with(artifacts.read_header(named)) == "models/yours"
    before = "made with 'models/yours', whose weights are not those of 'models/mine'"
    refused(named, before, both, owner=owner(other))
    before = f"'models/yours' when that had other weights (digest {FINGERPRINT[:12]}, now"
    refused(named, before, owner=owner(other, "models/yours"))
    odd = write(tmp_path, "anchor", meta={artifacts.BACKBONE: 3})
    assert artifacts.made_with(artifacts.read_header(odd)) is None


def failing(error: BaseException) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    ("code", "cure"),
    [(errno.ENOSPC, "free space"), (errno.EROFS, "writable"), (errno.EIO, "choose another output")],
)
def test_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, cure: str
) -> None:
    path = write(tmp_path, "anchor")
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", failing(OSError(code, os.strerror(code))))
    with pytest.raises(AegisError) as caught:
        write(tmp_path, "anchor", seed=99)
    assert os.strerror(code) in caught.value.found and cure in caught.value.fix
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == before


def test_disk_that_fills_up_half_way(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (20_000, limits[1])
    )  # the frames alone are 61,440 bytes
    try:
        with pytest.raises(AegisError, match="cannot write .*demos.safetensors") as caught:
            write(tmp_path, "demos")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "free space" in caught.value.fix and not list(tmp_path.iterdir())


def test_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", failing(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, "anchor")
    assert not list(tmp_path.iterdir())


def test_missing_output_folder(tmp_path: Path) -> None:
    with pytest.raises(AegisError) as caught:
        write(tmp_path / "no" / "such", "anchor")
    assert f"mkdir -p {tmp_path / 'no' / 'such'}" in caught.value.fix and not list(
        tmp_path.iterdir()
    )
    (tmp_path / "file").touch()
    with pytest.raises(AegisError, match="Not a directory"):
        write(tmp_path / "file", "anchor")


def test_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # simulated, since for root, as in many containers, permission bits forbid nothing
    monkeypatch.setattr(
        "builtins.open", failing(PermissionError(errno.EACCES, "Permission denied"))
    )
    with pytest.raises(AegisError) as caught:
        write(tmp_path, "anchor")
    monkeypatch.undo()
    assert "Permission denied" in caught.value.found and str(tmp_path) in caught.value.fix
    assert not list(tmp_path.iterdir())


def test_output_that_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "anchor.safetensors").mkdir()
    with pytest.raises(AegisError, match="Is a directory"):
        write(tmp_path, "anchor")
    assert [p.name for p in tmp_path.iterdir()] == ["anchor.safetensors"]
