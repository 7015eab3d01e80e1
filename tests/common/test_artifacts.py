"""Artifacts: saved data loads again, equal inputs give equal bytes, old files are migrated."""

from __future__ import annotations

import os
import stat
import threading
import weakref
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from samples.artifacts import SAMPLES, forge, write
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.kinds import is_finite

# sha256 of the header's other fields as canonical JSON, followed by the bytes of a and b
DIGEST = b"23b564200209684dce5694bd1ae0cce93416017390b19a6fcbe313bef61714af"
GOLDEN = b"".join(
    (
        (488).to_bytes(8, "little"),
        rb'{"__metadata__":{"aegis":"{\"digest\":\"',
        DIGEST,
        rb"\",\"fingerprint\":\"f0\",\"inputs\":{\"x\":\"00\"},\"kind\":\"expert\",",
        rb"\"meta\":{\"k\":1},\"schema\":1,\"seed\":1,",
        rb"\"tensors\":{\"a\":{\"dtype\":\"float32\",\"shape\":[1,2],\"unit\":\"1\"},",
        rb'\"b\":{\"dtype\":\"uint8\",\"shape\":[2],\"unit\":\"1\"}},\"version\":\"0.0.0\"}"},',
        rb'"a":{"data_offsets":[0,8],"dtype":"F32","shape":[1,2]},',
        rb'"b":{"data_offsets":[8,10],"dtype":"U8","shape":[2]}}    ',
        b"\x00\x00\x80\x3f\x00\x00\x00\xc0",  # a: 1.0, -2.0
        b"\x01\x02",  # b
    )
)


def test_samples_cover_every_kind() -> None:
    assert SAMPLES.keys() == artifacts.KINDS.keys()


def test_no_name_is_a_pattern_when_a_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each for each of the others, it took seconds to read the state of a large training."""
    tensors = {"weight.a[0]": torch.ones(2), "weight.a0": torch.ones(2)}
    units = {"weight.a0": "m"}
    path = tmp_path / "x.safetensors"
    saved = artifacts.save(path, "training-state", tensors, units=units)
    monkeypatch.setattr(artifacts, "_matcher", lambda pattern: pytest.fail(pattern))
    assert artifacts.load(path).header == saved
    found = {name: spec.unit for name, spec in saved.tensors.items()}
    assert found == {**units, "weight.a[0]": "1"}


@pytest.mark.parametrize("kind", SAMPLES)
def test_what_is_saved_is_loaded(tmp_path: Path, kind: str) -> None:
    sample, path = SAMPLES[kind](), tmp_path / "x.safetensors"
    header = artifacts.save(
        path, kind, **sample, inputs={"demos": "ab" * 32}, units={"*.var": "m^2"}
    )
    loaded = artifacts.load(path, kind)
    assert loaded.header == header == artifacts.read_header(path)
    assert (
        header.kind == kind
        and header.meta == sample.get("meta", {})
        and header.inputs == {"demos": "ab" * 32}
    )
    assert loaded.tensors.keys() == sample["tensors"].keys() == header.tensors.keys()
    foreign = safetensors.torch.load_file(path)  # the file is plain safetensors
    for name, tensor in sample["tensors"].items():
        for copy in (loaded.tensors[name], foreign[name]):
            assert copy.dtype == tensor.dtype and torch.equal(copy, tensor)
        spec = header.tensors[name]
        assert (spec.shape, f"torch.{spec.dtype}") == (tuple(tensor.shape), str(tensor.dtype))
        assert spec.unit == ("m^2" if name.endswith(".var") else "1")


def test_golden_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If these bytes change, every cached result is stale: this needs a new schema."""
    monkeypatch.setattr(artifacts, "__version__", "0.0.0")
    tensors = {"b": torch.tensor([1, 2], dtype=torch.uint8), "a": torch.tensor([[1.0, -2.0]])}
    path = write(
        tmp_path,
        "expert",
        tensors=tensors,
        seed=1,
        fingerprint="f0",
        inputs={"x": "00"},
        meta={"k": 1},
    )
    assert path.read_bytes() == GOLDEN


@pytest.mark.parametrize("kind", SAMPLES)
def test_no_flipped_bit_is_loaded(tmp_path: Path, kind: str) -> None:
    """Anywhere in the file: it is refused, or the bit is never read and the content is the same."""
    path = write(tmp_path, kind)
    whole, kept = path.read_bytes(), artifacts.load(path)
    kept_tensors = {name: t.clone() for name, t in kept.tensors.items()}
    generator = torch.Generator().manual_seed(0)
    refused = 0
    for bit in torch.randint(len(whole) * 8, (150,), generator=generator).tolist():
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        other = tmp_path / f"{bit}.safetensors"
        other.write_bytes(damaged)
        try:
            found = artifacts.load(other)
        except AegisError:
            refused += 1
        else:
            assert found.header == kept.header
            assert all(torch.equal(t, kept_tensors[name]) for name, t in found.tensors.items())
    assert refused > 100


@pytest.mark.parametrize("kind", SAMPLES)
def test_a_file_of_before_there_were_digests_is_loaded(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind)
    assert artifacts.read_header(path).digest is not None
    forge(path)
    assert artifacts.load(path, kind).header.digest is None


def test_a_weight_of_another_size_is_found_by_its_digest(tmp_path: Path) -> None:
    """One bit of an exponent makes it 4.6e36, which is finite."""
    path = write(tmp_path, "expert", tensors={"w": torch.full((3,), 0.02)})
    data = bytearray(path.read_bytes())
    data[-1] ^= 0x40
    path.write_bytes(data)
    assert safetensors.torch.load_file(path)["w"][-1] > 1e36
    with pytest.raises(AegisError, match="its content does not match its digest"):
        artifacts.load(path)


@pytest.mark.parametrize("kind", SAMPLES)
def test_equal_inputs_give_equal_bytes(tmp_path: Path, kind: str) -> None:
    first = write(tmp_path, kind).read_bytes()
    sample = SAMPLES[kind]()
    backwards = dict(reversed(sample["tensors"].items()))
    strided = {name: t.mT.contiguous().mT if t.ndim > 1 else t for name, t in backwards.items()}
    meta = dict(reversed(sample.get("meta", {}).items()))
    assert write(tmp_path, kind, tensors=strided, meta=meta).read_bytes() == first


def test_shared_memory_and_gradients_are_no_obstacle(tmp_path: Path) -> None:
    tied = torch.randn(4, 6, generator=torch.Generator().manual_seed(0)).requires_grad_()
    path = write(tmp_path, "backbone", tensors={"embed": tied, "head": tied, "rows": tied[1:3]})
    assert all(
        torch.equal(t, e)
        for t, e in zip(artifacts.load(path).tensors.values(), (tied, tied, tied[1:3]))
    )


def test_a_gpus_tensors_come_to_the_cpu_one_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the CPU is made to copy, as it would from a GPU."""
    there: weakref.WeakSet[Tensor] = weakref.WeakSet()
    most = 0

    def copied(tensor: Tensor) -> Tensor:
        nonlocal most
        made = tensor.clone()
        there.add(made)
        most = max(most, len(there))
        return made

    tensors = {f"{i}": torch.full((100,), float(i)) for i in range(20)}
    monkeypatch.setattr(Tensor, "cpu", copied)
    artifacts.save(tmp_path / "x.safetensors", "expert", tensors)
    monkeypatch.undo()
    assert 1 <= most <= 2
    found = artifacts.load(tmp_path / "x.safetensors", "expert").tensors
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


def test_it_is_hashed_while_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, pour, digest = threading.Event(), artifacts.pour, artifacts._digest

    def noted(*given: Any) -> None:
        pour(*given)
        written.set()

    def late(*given: Any) -> str:
        assert written.wait(20), "nothing is written before all is hashed"
        return digest(*given)

    monkeypatch.setattr(artifacts, "pour", noted)
    monkeypatch.setattr(artifacts, "_digest", late)
    path = write(tmp_path, "anchor")
    monkeypatch.undo()
    assert artifacts.load(path).header == artifacts.read_header(path)


def test_finite_numbers_are_so_though_their_sum_is_not() -> None:
    large = torch.full((4,), 3e38)
    assert is_finite(large) and not large.sum().isfinite()
    assert is_finite(torch.empty(0)) and is_finite(torch.tensor([1, 2]))
    for bad in (float("nan"), float("inf"), -float("inf")):
        assert not is_finite(torch.tensor([1.0, bad])) and not is_finite(torch.tensor([bad, -bad]))


def test_loaded_tensors_are_private(tmp_path: Path) -> None:
    path = write(tmp_path, "anchor")
    artifacts.load(path).tensors["layers.0.image.mean"].zero_()
    assert artifacts.load(path).tensors["layers.0.image.mean"].tolist() == [0, 1, 2, 3]


def test_mode_follows_the_umask(tmp_path: Path) -> None:
    previous = os.umask(0o022)
    try:
        assert stat.S_IMODE(write(tmp_path, "anchor").stat().st_mode) == 0o644
    finally:
        os.umask(previous)


def test_older_schemas_are_migrated_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(
        tmp_path, "expert", tensors={"w": torch.ones(2)}, units={"w": "m"}, meta={"past": []}
    )

    def renames(
        tensors: dict[str, Tensor], meta: dict[str, Any]
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        return {"weight": tensors["w"], "w": tensors["w"]}, {"past": [*meta["past"], "renamed"]}

    def doubles(
        tensors: dict[str, Tensor], meta: dict[str, Any]
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        return {"weight": tensors["weight"] * 2, "w": tensors["w"]}, {
            "past": [*meta["past"], "doubled"]
        }

    monkeypatch.setitem(artifacts.MIGRATIONS, "expert", (renames, doubles))
    loaded = artifacts.load(path, "expert")
    assert loaded.header.schema == 3 and loaded.header.meta == {"past": ["renamed", "doubled"]}
    assert loaded.tensors["weight"].tolist() == [2, 2] and loaded.header.tensors[
        "weight"
    ].shape == (2,)
    assert loaded.header.tensors["w"].unit == "m"
    assert artifacts.read_header(path).schema == 1  # what is on the disk
    artifacts.save(path, "expert", loaded.tensors, meta=loaded.header.meta)
    assert artifacts.load(path).header.meta == {
        "past": ["renamed", "doubled"]
    }  # not migrated twice
