"""The VLM in a policy of another program is taken out, measured, and put back bit for bit."""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from samples import foreign
from samples.command import refused
from samples.foreign import FORMS, SCALES, TABLE, WEIGHTS
from samples.hub import Hub
from samples.vqa_files import write_jsonl
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.models import backbones
from aegis_cli.publishing import extract, insert, tensor_files

Aegis = Callable[..., tuple[int, str, str]]
Folder = Callable[[str], Path]
HEAD = "language_model.lm_head.weight"


@pytest.fixture
def paligemma(hf_folder: Folder) -> Path:
    return hf_folder("paligemma")


@pytest.fixture
def smolvlm(hf_folder: Folder) -> Path:
    return hf_folder("smolvlm")


def base_of(form: str, hf_folder: Folder) -> Path:
    return hf_folder("smolvlm" if form == "smolvla" else "paligemma")


def policy(folder: Path, vlm: Mapping[str, Tensor], form: str, shards: int = 1) -> Path:
    return foreign.write(folder, foreign.tensors(vlm, FORMS[form]), FORMS[form], shards)


def files_of(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def equal(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[n], other[n]) for n in one)


def warnings(said: list[Event]) -> list[str]:
    return [event.text for event in said if isinstance(event, Warned)]


def take(source: Path, base: Path, out: Path, **options: str) -> extract.ExtractReport:
    return extract.run(str(source), str(base), out, **options)


# --- extract --------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shards", [1, 3])
def test_what_is_extracted_is_the_policys_and_goes_back_bit_for_bit(
    form: str, shards: int, hf_folder: Folder, tmp_path: Path
) -> None:
    base = base_of(form, hf_folder)
    own = foreign.moved(base)
    source = policy(tmp_path / "policy", own, form, shards)
    report = take(source, base, tmp_path / "vlm")
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own)
    assert report.taken == report.moved == report.tensors == len(own)
    assert report.taken_parameters == report.parameters == sum(t.numel() for t in own.values())
    assert (report.kept, report.rounded, report.type) == ((), 0, FORMS[form].type)
    back = insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)
    assert (back.put, back.changed, back.rounded, back.left_out) == (len(own), 0, 0, ())


@pytest.mark.parametrize("form", ["pi0 of LeRobot", "pi0 of openpi"])
def test_an_expert_of_the_vlms_own_width_is_never_taken(
    form: str, paligemma: Path, tmp_path: Path
) -> None:
    own = foreign.moved(paligemma)
    found = foreign.tensors(own, FORMS[form], width=None)
    source = foreign.write(tmp_path / "policy", found, FORMS[form])
    report = take(source, paligemma, tmp_path / "vlm")
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own)
    assert not any("gemma_expert" in name for name in report.more)


def test_everything_beside_the_weights_is_the_bases(smolvlm: Path, tmp_path: Path) -> None:
    take(policy(tmp_path / "policy", foreign.moved(smolvlm), "smolvla"), smolvlm, tmp_path / "vlm")
    own, other = files_of(tmp_path / "vlm"), files_of(smolvlm)
    assert {n: c for n, c in own.items() if n not in (WEIGHTS, "README.md")} == {
        n: c for n, c in other.items() if n != WEIGHTS
    }
    assert "are the\npolicy's" in own["README.md"].decode()
    assert str(tmp_path) not in own["README.md"].decode()


@pytest.mark.parametrize("depth", [1, 2])
def test_layers_that_the_policy_lacks_are_put_back_and_counted(
    depth: int, paligemma: Path, tmp_path: Path
) -> None:
    own, before = foreign.moved(paligemma), load_file(paligemma / WEIGHTS)
    there = {name: t for name, t in own.items() if not foreign.is_layer(name, depth)}
    source = policy(tmp_path / "policy", there, "pi0 of LeRobot")
    report = take(source, paligemma, tmp_path / "vlm")
    upper = {name: t for name, t in before.items() if name not in there}
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), {**upper, **there})
    (kept,) = report.kept
    assert kept.what == ("language layers 1 to 2" if depth == 1 else "language layer 2")
    assert (kept.tensors, kept.parameters) == (len(upper), sum(t.numel() for t in upper.values()))
    assert report.taken_parameters + kept.parameters == report.parameters
    back = insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)
    assert [share.what for share in back.left_out] == [kept.what]


def test_a_head_alone_is_the_table(paligemma: Path, tmp_path: Path) -> None:
    own = foreign.moved(paligemma)
    alone = {HEAD if name == TABLE else name: tensor for name, tensor in own.items()}
    source = policy(tmp_path / "policy", alone, "pi0 of openpi")
    take(source, paligemma, tmp_path / "vlm")
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own)
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


@pytest.mark.parametrize("alike", [True, False])
def test_a_head_of_the_policys_own_follows_the_table_where_both_are_one(
    alike: bool, paligemma: Path, tmp_path: Path
) -> None:
    own = foreign.moved(paligemma)
    head = own[TABLE].clone() if alike else own[TABLE] + 1
    source = policy(tmp_path / "policy", {**own, HEAD: head}, "pi0 of LeRobot")
    report = take(source, paligemma, tmp_path / "vlm")
    name = "model.paligemma_with_expert.paligemma.lm_head.weight"
    assert any(each.startswith(name) for each in report.more) == (not alike)
    # The VLM moves on, and what is put back has its table, and its head where that was one with it.
    later = foreign.moved(tmp_path / "vlm", seed=1)
    save_file(later, tmp_path / "vlm" / WEIGHTS)
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    back = load_file(tmp_path / "back" / WEIGHTS)
    assert torch.equal(back[name], later[TABLE] if alike else head)


@pytest.mark.parametrize("head", [True, False])
def test_a_base_that_stores_table_and_head_alike_takes_both_from_one(
    head: bool, smolvlm: Path, tmp_path: Path
) -> None:
    base = shutil.copytree(smolvlm, tmp_path / "base")
    table, named = "model.text_model.embed_tokens.weight", "lm_head.weight"
    stored = load_file(base / WEIGHTS)
    stored[named] = stored[table].clone()
    save_file(stored, base / WEIGHTS, {"format": "pt"})
    own = foreign.moved(base)
    gone, there = (table, named) if head else (named, table)
    del own[gone]
    take(policy(tmp_path / "policy", own, "smolvla"), base, tmp_path / "vlm")
    found = load_file(tmp_path / "vlm" / WEIGHTS)
    assert torch.equal(found[gone], own[there]) and torch.equal(found[there], own[there])


def test_an_untied_head_that_is_missing_is_the_bases(smolvlm: Path, tmp_path: Path) -> None:
    own = foreign.moved(smolvlm)
    del own["lm_head.weight"]
    report = take(policy(tmp_path / "policy", own, "smolvla"), smolvlm, tmp_path / "vlm")
    head = load_file(tmp_path / "vlm" / WEIGHTS)["lm_head.weight"]
    assert torch.equal(head, load_file(smolvlm / WEIGHTS)["lm_head.weight"])
    assert [share.what for share in report.kept] == ["behind the layers"]


@pytest.mark.parametrize("rows", [-5, 5])
def test_a_vocabulary_of_another_length_shares_its_first_rows(
    rows: int, paligemma: Path, tmp_path: Path
) -> None:
    own = foreign.moved(paligemma)
    table, before = own[TABLE], load_file(paligemma / WEIGHTS)[TABLE]
    words = len(table)
    longer = torch.cat([table, table[:5]])[: words + rows]
    source = policy(tmp_path / "policy", {**own, TABLE: longer}, "pi0 of openpi")
    said: list[Event] = []
    report = extract.run(str(source), str(paligemma), tmp_path / "vlm", on_event=said.append)
    found = load_file(tmp_path / "vlm" / WEIGHTS)[TABLE]
    shared = words + min(rows, 0)
    assert torch.equal(found, torch.cat([table[:shared], before[shared:]]))
    assert any("rows of the vocabulary" in e.text for e in said if isinstance(e, Warned))
    kept = sum(share.parameters for share in report.kept)
    assert kept == max(-rows, 0) * table.shape[1]
    assert report.taken_parameters + kept == report.parameters
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


def test_a_head_in_a_wider_type_follows_the_table(paligemma: Path, tmp_path: Path) -> None:
    own = foreign.moved(paligemma)
    own[TABLE] = own[TABLE].bfloat16()
    source = policy(tmp_path / "policy", {**own, HEAD: own[TABLE].float()}, "pi0 of LeRobot")
    report = take(source, paligemma, tmp_path / "vlm")
    assert report.more == ()
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "same")
    assert files_of(tmp_path / "same") == files_of(source)
    back = insert.run(str(paligemma), str(source), tmp_path / "back")
    name = "model.paligemma_with_expert.paligemma.lm_head.weight"
    assert torch.equal(
        load_file(tmp_path / "back" / WEIGHTS)[name], load_file(paligemma / WEIGHTS)[TABLE]
    )
    assert back.left_out == ()


def test_a_head_that_stays_is_reported(paligemma: Path, tmp_path: Path) -> None:
    own = foreign.moved(paligemma)
    source = policy(tmp_path / "policy", {**own, HEAD: own[TABLE] + 1}, "pi0 of LeRobot")
    said: list[Event] = []
    back = insert.run(str(paligemma), str(source), tmp_path / "back", said.append)
    name = "model.paligemma_with_expert.paligemma.lm_head.weight"
    assert [(s.what, s.tensors, s.parameters) for s in back.left_out] == [
        (name, 1, own[TABLE].numel())
    ]
    assert any(f"'{name}' stays as it was" in text for text in warnings(said))


def test_tensors_are_the_same_however_few_rows_are_in_memory(
    paligemma: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = foreign.moved(paligemma)
    longer = {**own, TABLE: own[TABLE][:-5]}
    source = policy(tmp_path / "policy", longer, "pi0 of openpi")
    whole = take(source, paligemma, tmp_path / "whole")
    monkeypatch.setattr(tensor_files, "_AT_ONCE", 1000)
    parts = take(source, paligemma, tmp_path / "parts")
    assert files_of(tmp_path / "whole") == files_of(tmp_path / "parts")
    assert (whole.moved, whole.kept) == (parts.moved, parts.kept)
    insert.run(str(tmp_path / "parts"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


# --- types ----------------------------------------------------------------------------------------


def test_an_untouched_policy_in_half_precision_has_moved_nowhere(
    smolvlm: Path, tmp_path: Path
) -> None:
    """The base's own values, rounded, are no training."""
    own = {name: t.bfloat16() for name, t in foreign.moved(smolvlm, by=0).items()}
    one = next(iter(own))
    own[one] = own[one] + 1
    said: list[Event] = []
    source = policy(tmp_path / "policy", own, "smolvla")
    report = extract.run(str(source), str(smolvlm), tmp_path / "vlm", on_event=said.append)
    assert (report.moved, report.moved_parameters) == (1, own[one].numel())
    assert (report.dtype, report.rounded) == ("float32", 0)
    assert [e.done for e in said if isinstance(e, Progress)] == [*range(report.tensors + 1)]
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), {n: t.float() for n, t in own.items()})
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


def test_a_base_in_half_precision_rounds_and_says_so(hf_folder: Folder, tmp_path: Path) -> None:
    from samples import hf

    base = hf.write("smolvlm", tmp_path / "base", dtype=torch.bfloat16)
    own = {n: t.float() + 1e-4 for n, t in load_file(base / WEIGHTS).items()}
    source = policy(tmp_path / "policy", own, "smolvla")
    said: list[Event] = []
    report = extract.run(str(source), str(base), tmp_path / "vlm", on_event=said.append)
    assert report.dtype == "bfloat16" and 0 < report.rounded <= report.moved == report.tensors
    warned = [event.text for event in said if isinstance(event, Warned)]
    assert any("--dtype float32 keeps them" in text for text in warned)
    wide = take(source, base, tmp_path / "wide", dtype="float32")
    assert (wide.dtype, wide.rounded) == ("float32", 0)
    assert equal(load_file(tmp_path / "wide" / WEIGHTS), own)
    config = json.loads((tmp_path / "wide" / "config.json").read_text())
    assert config["dtype"] == "float32"
    backbones.load(str(tmp_path / "wide"))
    insert.run(str(tmp_path / "wide"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


SHAPES = ((4, 6), (2, 3), (3, 4, 2), (8,), (2,), (1, 2), (0, 3))


@pytest.mark.parametrize(("dtype", "bits"), [("F4", 4), ("F6_E2M3", 6), ("F8_E8M0", 8)])
def test_packed_types_beside_the_vlm_are_copied_whole(
    dtype: str,
    bits: int,
    paligemma: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of such types several numbers share a byte, and a row may end inside of one."""
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    for place, shape in enumerate(SHAPES):
        if math.prod(shape) * bits % 8:
            shape = (*shape, 4)  # a file holds whole bytes of each tensor
        count = math.prod(shape) * bits // 8
        packed = bytes((number + place) % 251 for number in range(count))
        add_tensor(source / WEIGHTS, f"action_in_proj.packed_{place}", dtype, shape, packed)
    monkeypatch.setattr(tensor_files, "_AT_ONCE", 2)
    take(source, paligemma, tmp_path / "vlm")
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


def add_tensor(path: Path, name: str, dtype: str, shape: tuple[int, ...], data: bytes) -> None:
    """Add a tensor of a type that PyTorch may not have to a safetensors file."""
    raw = path.read_bytes()
    size = int.from_bytes(raw[:8], "little")
    table, rest = json.loads(raw[8 : 8 + size]), raw[8 + size :]
    place = [len(rest), len(rest) + len(data)]
    table[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": place}
    head = json.dumps(table).encode()
    head += b" " * (-len(head) % 8)
    path.write_bytes(len(head).to_bytes(8, "little") + head + rest + data)


def test_a_base_in_shards_gives_its_shards_and_a_true_index(
    paligemma: Path, tmp_path: Path
) -> None:
    import transformers

    base = shutil.copytree(paligemma, tmp_path / "base")
    (base / WEIGHTS).unlink()
    model = transformers.AutoModelForImageTextToText.from_pretrained(paligemma)
    model.save_pretrained(base, max_shard_size="60KB")
    own = foreign.moved(paligemma)
    source = policy(tmp_path / "policy", own, "pi0 of LeRobot")
    take(source, base, tmp_path / "vlm", dtype="bfloat16")
    shards = sorted(path.name for path in base.glob("*.safetensors"))
    assert len(shards) > 1
    assert sorted(path.name for path in (tmp_path / "vlm").glob("*.safetensors")) == shards
    index = json.loads((tmp_path / "vlm" / f"{WEIGHTS}.index.json").read_text())
    assert index["metadata"]["total_size"] == 2 * sum(tensor.numel() for tensor in own.values())
    found = backbones.load(str(tmp_path / "vlm")).state_dict()
    take(source, paligemma, tmp_path / "one", dtype="bfloat16")
    assert equal(found, backbones.load(str(tmp_path / "one")).state_dict())


def test_types_that_pytorch_alone_knows_are_copied_by_rows(
    paligemma: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a table with fewer words, the first rows are the policy's and the others the base's."""
    base = shutil.copytree(paligemma, tmp_path / "base")
    stored = load_file(base / WEIGHTS)
    stored[TABLE] = stored[TABLE].to(torch.float8_e4m3fn)
    save_file(stored, base / WEIGHTS, {"format": "pt"})
    own = {**foreign.moved(paligemma), TABLE: (stored[TABLE].float() + 1).to(torch.float8_e4m3fn)}
    source = policy(tmp_path / "policy", {**own, TABLE: own[TABLE][:-5]}, "pi0 of openpi")
    monkeypatch.setattr(tensor_files, "_AT_ONCE", 1000)
    take(source, base, tmp_path / "vlm")
    found = load_file(tmp_path / "vlm" / WEIGHTS)[TABLE].float()
    expected = torch.cat([own[TABLE][:-5].float(), stored[TABLE][-5:].float()])
    assert torch.equal(found, expected)
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)


def test_infinite_values_that_both_have_are_kept(paligemma: Path, tmp_path: Path) -> None:
    base = shutil.copytree(paligemma, tmp_path / "base")
    mask = {"vision_tower.mask": torch.tensor([0.0, -torch.inf])}
    save_file({**load_file(base / WEIGHTS), **mask}, base / WEIGHTS, {"format": "pt"})
    own = {**foreign.moved(paligemma), **mask}
    source = policy(tmp_path / "policy", own, "pi0 of openpi")
    take(source, base, tmp_path / "vlm")
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own)
    insert.run(str(tmp_path / "vlm"), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back") == files_of(source)
    worse = policy(tmp_path / "worse", {**own, **{n: -t for n, t in mask.items()}}, "pi0 of openpi")
    with pytest.raises(AegisError, match="NaN or infinite"):
        take(worse, base, tmp_path / "out")


def test_numbers_that_the_policys_type_cannot_hold_are_refused(
    smolvlm: Path, tmp_path: Path
) -> None:
    """Each command says what to do about its own output."""
    half = {name: t.half() for name, t in foreign.moved(smolvlm).items()}
    source = policy(tmp_path / "policy", half, "smolvla")
    large = Path(shutil.copytree(smolvlm, tmp_path / "large"))
    found = load_file(large / "model.safetensors")
    name = next(name for name in found if name.endswith("q_proj.weight"))
    found[name] = found[name] + 1e6  # float16 ends at 65,504
    save_file(found, large / "model.safetensors", {"format": "pt"})
    with pytest.raises(AegisError, match="float16 is too small") as caught:
        insert.run(str(large), str(source), tmp_path / "out")
    assert "store the policy in bfloat16 or float32" in caught.value.fix
    assert not (tmp_path / "out").exists()


def test_shards_of_one_name_in_two_folders_stay_apart(paligemma: Path, tmp_path: Path) -> None:
    base = shutil.copytree(paligemma, tmp_path / "base")
    stored = load_file(base / WEIGHTS)
    (base / WEIGHTS).unlink()
    places = {
        name: f"{('', 'more/')[i % 2]}part.safetensors" for i, name in enumerate(sorted(stored))
    }
    for place in set(places.values()):
        (base / place).parent.mkdir(exist_ok=True)
        part = {name: tensor for name, tensor in stored.items() if places[name] == place}
        save_file(part, base / place, {"format": "pt"})
    index = {"metadata": {}, "weight_map": places}
    (base / f"{WEIGHTS}.index.json").write_text(json.dumps(index))
    own = foreign.moved(paligemma)
    take(policy(tmp_path / "policy", own, "pi0 of openpi"), base, tmp_path / "vlm")
    parts = sorted((tmp_path / "vlm").rglob("part.safetensors"))
    found = {name: tensor for part in parts for name, tensor in load_file(part).items()}
    assert equal(found, own)
    assert (tmp_path / "vlm" / f"{WEIGHTS}.index.json").is_file()


# --- what others make of it -----------------------------------------------------------------------


def test_a_probe_tells_what_the_policy_has_forgotten(
    smolvlm: Path, tmp_path: Path, aegis: Aegis
) -> None:
    questions = write_jsonl(tmp_path / "questions")
    probed = {}
    for name, by in (("untouched", 0.0), ("trained", 0.3)):
        source = policy(tmp_path / name, foreign.moved(smolvlm, by), "smolvla")
        vlm, answers = tmp_path / f"vlm-{name}", tmp_path / f"{name}.jsonl"
        code, said, err = aegis("extract", source, "--base", smolvlm, "--out", vlm)
        assert code == 0, err
        assert "what it has forgotten: aegis probe" in said
        assert ("nothing to forget" in err) == (name == "untouched")
        command = ("probe", vlm, "--baseline", smolvlm, "--vqa", questions)
        code, said, err = aegis(*command, "--predictions", answers, "--json")
        assert code == 0, err
        probed[name] = json.loads(said), answers.read_text()
    command = ("probe", smolvlm, "--vqa", questions, "--predictions", tmp_path / "base.jsonl")
    code, said, err = aegis(*command, "--json")
    before = json.loads(said)
    untouched, answers = probed["untouched"]
    assert untouched["drop_points"] == 0
    assert untouched["cross_entropy"] == before["cross_entropy"]
    assert answers == (tmp_path / "base.jsonl").read_text()
    trained = probed["trained"][0]
    assert trained["cross_entropy"] != before["cross_entropy"]
    assert probed["trained"][1] != answers


@pytest.mark.parametrize("form", ["smolvla", "pi0 of openpi"])
def test_a_merge_of_it_goes_back_into_the_policy(
    form: str, hf_folder: Folder, tmp_path: Path, aegis: Aegis
) -> None:
    base = base_of(form, hf_folder)
    source = policy(tmp_path / "policy", foreign.moved(base), form)
    for command in (
        ("extract", source, "--base", base, "--out", tmp_path / "vlm"),
        (
            *("merge", tmp_path / "vlm", "--base", base, "--method", "linear"),
            *("--strength", "0.5", "--out", tmp_path / "merged"),
        ),
        ("insert", tmp_path / "merged", "--into", source, "--out", tmp_path / "back"),
        ("extract", tmp_path / "back", "--base", base, "--out", tmp_path / "again"),
    ):
        code, _, err = aegis(*command)
        assert code == 0, err
    before, back = load_file(source / WEIGHTS), load_file(tmp_path / "back" / WEIGHTS)
    expert = {n: tensor for n, tensor in before.items() if n.startswith(FORMS[form].expert)}
    assert expert and before.keys() == back.keys()
    assert equal({name: back[name] for name in expert}, expert)
    merged = load_file(tmp_path / "merged" / WEIGHTS)
    assert equal(load_file(tmp_path / "again" / WEIGHTS), merged)
    assert not equal(merged, load_file(tmp_path / "vlm" / WEIGHTS))


def test_both_tell_their_report_as_json(smolvlm: Path, tmp_path: Path, aegis: Aegis) -> None:
    source = policy(tmp_path / "policy", foreign.moved(smolvlm), "smolvla")
    out = tmp_path / "vlm"
    code, said, _ = aegis("extract", source, "--base", smolvlm, "--out", out, "--json")
    report = json.loads(said)
    assert code == 0 and report["taken"] == report["tensors"]
    assert report["prefix"] == "model.vlm_with_expert.vlm." and report["type"] == "smolvla"
    code, said, _ = aegis("insert", out, "--into", source, "--out", tmp_path / "x", "--json")
    assert code == 0 and json.loads(said)["put"] == report["taken"]


def test_a_policy_comes_from_the_hub_by_its_id(
    smolvlm: Path, hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    own = foreign.moved(smolvlm)
    hub.committed |= files_of(policy(tmp_path / "sent", own, "smolvla", shards=2))
    report = extract.run("somebody/smolvla", str(smolvlm), Path("vlm"))
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own) and report.type == "smolvla"
    insert.run("vlm", "somebody/smolvla", Path("back"))
    assert files_of(tmp_path / "back") == files_of(tmp_path / "sent")


def test_the_state_of_an_optimiser_is_left_out(
    smolvlm: Path, hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    source = policy(tmp_path / "policy", foreign.moved(smolvlm), "smolvla")
    before = files_of(source)
    (source / "optimizer.pt").write_bytes(b"x")
    (source / "training_state").mkdir()
    (source / "training_state" / "optimizer_state.safetensors").write_bytes(b"x")
    said: list[Event] = []
    insert.run(str(smolvlm), str(source), tmp_path / "back", said.append)
    assert files_of(tmp_path / "back").keys() == before.keys()
    assert any("optimizer.pt, training_state" in text for text in warnings(said))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    hub.committed |= files_of(source)
    extract.run("somebody/smolvla", str(smolvlm), Path("vlm"))
    assert not [*tmp_path.glob("cache/**/optimizer*"), *tmp_path.glob("cache/**/training_state")]


def test_the_index_of_a_variant_is_not_taken_for_the_models(
    paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    own = foreign.moved(paligemma)
    source = policy(tmp_path / "policy", own, "pi0 of openpi", shards=2)
    form = FORMS["pi0 of openpi"]
    save_file(
        {n: t.half() for n, t in foreign.tensors(own, form).items()},
        source / "model.fp16-00001.safetensors",
    )
    variant = source / "model.fp16.safetensors.index.json"
    places = dict.fromkeys(foreign.tensors(own, form), "model.fp16-00001.safetensors")
    variant.write_text(json.dumps({"weight_map": places}))
    take(source, paligemma, tmp_path / "vlm")
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), own)
    said: list[Event] = []
    insert.run(str(paligemma), str(source), tmp_path / "back", said.append)
    assert any("copied unchanged: model.fp16-00001.safetensors" in text for text in warnings(said))
    (source / f"{WEIGHTS}.index.json").rename(source / "model.ema.safetensors.index.json")
    assert "2 indices" in bad("extract", source, "--base", paligemma)


# --- the whole way --------------------------------------------------------------------------------


def test_an_extracted_vlm_is_trained_further_merged_and_put_back(
    smolvlm: Path, demos_file: Path, tmp_path: Path, aegis: Aegis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole way of a policy that was trained elsewhere, command by command."""
    monkeypatch.chdir(tmp_path)
    own = foreign.moved(smolvlm)
    there = {name: t for name, t in own.items() if not foreign.is_layer(name, 1)}
    source = policy(tmp_path / "policy", there, "smolvla")

    def done(*words: object) -> str:
        code, _, said = aegis(*words)
        assert code == 0, said
        return said

    done("extract", source, "--base", smolvlm, "--out", "vlm")
    samples = ("--samples", 8, "--batch-size", 8)
    done("anchor", "--backbone", "vlm", *samples, "--parts", "inputs", "--out", "anchor.sft")
    assert artifacts.made_with(artifacts.read_header("anchor.sft")) == "vlm"
    short = ("train.steps=2", "train.warmup=1", "train.batch_size=4", "train.backbone_lr=1e-2")
    settings = [word for each in ("backbone=vlm", *short) for word in ("--set", each)]
    given = ("--demos", demos_file, "--anchor", "anchor.sft", "--out", "run")
    done("train", "quickstart", "--method", "nullspace", *given, *settings)
    done("probe", "run", "--baseline", "vlm", "--questions", 7)
    done("merge", "run", "--method", "linear", "--strength", 0.5, "--out", "merged")
    said = done("insert", "merged", "--into", source, "--out", "back")
    assert "has not learned with it" in said
    merged = backbones.load("merged").state_dict()
    old, new = load_file(source / WEIGHTS), load_file("back" / Path(WEIGHTS))
    prefix = FORMS["smolvla"].prefix
    for name, tensor in new.items():
        inside = name.startswith(prefix)
        wanted = merged[f"vlm.{name.removeprefix(prefix)}"] if inside else old[name]
        assert torch.equal(tensor, wanted), name
    assert any(not torch.equal(new[name], old[name]) for name in new)
    # The VLM by itself is no policy, and no recipe.
    for command in (("export", "vlm", "--out", "x"), ("rollout", "vlm"), ("push", "vlm", "a/b")):
        said = refused(aegis(*command))
        assert "without an action expert" in said and "aegis insert vlm --into POLICY" in said
        assert "--set backbone=vlm" in said
    assert "--set backbone=vlm" in refused(aegis("train", "vlm"))


# --- several VLMs ---------------------------------------------------------------------------------


@pytest.fixture
def averaged(paligemma: Path, tmp_path: Path) -> tuple[Path, dict[str, dict[str, Tensor]]]:
    """A policy with the average of its weights beside them, and the VLM's tensors of both."""
    vlms = {"": foreign.moved(paligemma), "ema.": foreign.moved(paligemma, seed=1)}
    form = FORMS["pi0 of openpi"]
    found: dict[str, Tensor] = {}
    for before, vlm in vlms.items():
        found |= {before + name: t for name, t in foreign.tensors(vlm, form).items()}
    return foreign.write(tmp_path / "policy", found, form), vlms


@pytest.mark.parametrize("command", ["extract", "insert"])
def test_the_command_that_is_named_for_two_vlms_takes_one(
    command: str,
    averaged: tuple[Path, dict[str, dict[str, Tensor]]],
    paligemma: Path,
    tmp_path: Path,
    aegis: Aegis,
) -> None:
    source, _ = averaged
    words = {
        "extract": ("extract", source, "--base", paligemma, "--dtype", "bfloat16"),
        "insert": ("insert", paligemma, "--into", source),
    }
    said = refused(aegis(*words[command], "--out", tmp_path / "out"))
    assert "2 VLMs in" in said and "'ema.paligemma_with_expert.paligemma.'" in said
    named = shlex.split(said.rpartition("choose it: ")[2].splitlines()[0])
    assert named[-2:] == ["--prefix", "paligemma_with_expert.paligemma"]
    code, _, _ = aegis(*named[1:])
    assert code == 0 and (tmp_path / "out" / WEIGHTS).is_file()


@pytest.mark.parametrize("prefix", ["ema", "paligemma_with_expert"])
def test_one_of_two_vlms_is_taken_and_put_back_alone(
    prefix: str,
    averaged: tuple[Path, dict[str, dict[str, Tensor]]],
    paligemma: Path,
    tmp_path: Path,
) -> None:
    source, vlms = averaged
    before = "ema." if prefix == "ema" else ""
    report = take(source, paligemma, tmp_path / "vlm", prefix=prefix)
    assert equal(load_file(tmp_path / "vlm" / WEIGHTS), vlms[before])
    again = take(source, paligemma, tmp_path / "again", prefix=report.prefix)
    assert again.taken == report.taken == len(vlms[before])
    said: list[Event] = []
    back = insert.run(str(paligemma), str(source), tmp_path / "back", said.append, prefix)
    assert back.changed == report.taken
    assert any("another VLM" in text and "stays as it was" in text for text in warnings(said))
    old, new = load_file(source / WEIGHTS), load_file(tmp_path / "back" / WEIGHTS)
    other = "" if prefix == "ema" else "ema."
    own = FORMS["pi0 of openpi"].prefix
    stay = [n for n in old if n.startswith(other + own) or "paligemma." not in n]
    assert all(torch.equal(old[name], new[name]) for name in stay)


# --- refused --------------------------------------------------------------------------------------


@pytest.fixture
def bad(aegis: Aegis, tmp_path: Path) -> Callable[..., str]:
    """What a command says that is refused, and leaves nothing where it would have written."""

    def call(*command: object, out: Path | None = None) -> str:
        place = out or tmp_path / "out"
        there = sorted(tmp_path.iterdir())
        said = refused(aegis(*command, "--out", place))
        assert sorted(tmp_path.iterdir()) == there
        return said

    return call


def test_what_is_no_policy_of_the_base_is_refused(
    paligemma: Path, smolvlm: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    own = foreign.moved(paligemma)
    source = policy(tmp_path / "policy", own, "pi0 of LeRobot")
    said = bad("extract", source, "--base", smolvlm)
    assert "give the VLM that the policy was made from" in said
    assert "and none of its language layers" in said
    gone = {n: t for n, t in own.items() if ".layers.1." not in n or "vision" in n}
    middle = policy(tmp_path / "middle", gone, "pi0 of LeRobot")
    said = bad("extract", middle, "--base", paligemma)
    assert "not behind its last layer" in said and "layers.1." in said
    cut = {**own, "vision_tower.embeddings.position_embedding.weight": torch.zeros(4, 16)}
    shape = policy(tmp_path / "shape", cut, "pi0 of LeRobot")
    assert "[4, 16] instead of F32 [16, 16]" in bad("extract", shape, "--base", paligemma)
    worse = {**own, TABLE: own[TABLE] * torch.nan}
    diverged = policy(tmp_path / "diverged", worse, "pi0 of LeRobot")
    assert "NaN or infinite" in bad("extract", diverged, "--base", paligemma)


def test_what_is_no_policy_at_all_is_refused(
    paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    def asked(source: object) -> str:
        return bad("extract", source, "--base", paligemma)

    assert "no policy" in asked(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    assert "no *.safetensors" in asked(tmp_path / "empty")
    inside = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    inside.mkdir(parents=True)
    assert f"give '{inside}'" in asked(tmp_path / "train")
    (tmp_path / "jax" / "params").mkdir(parents=True)
    assert "convert_jax_model_to_pytorch.py" in asked(tmp_path / "jax")
    (tmp_path / "pickled").mkdir()
    (tmp_path / "pickled" / "policy.pt").write_bytes(b"x")
    assert "policy.pt" in asked(tmp_path / "pickled")
    (tmp_path / "cut.safetensors").write_bytes(b"x" * 20)
    assert "truncated or not a safetensors file" in asked(tmp_path / "cut.safetensors")
    (tmp_path / "policy.bin").write_bytes(b"x" * 20)
    assert "no .safetensors file" in asked(tmp_path / "policy.bin")
    (tmp_path / "adapter").mkdir()
    (tmp_path / "adapter" / "adapter_config.json").write_text("{}")
    assert "an adapter of PEFT" in asked(tmp_path / "adapter")
    own = policy(tmp_path / "torn", foreign.moved(paligemma), "pi0 of openpi", shards=2)
    next(own.glob("model-00002*")).unlink()
    assert "1 of 2 are missing" in asked(own)


def test_a_policy_of_ours_is_refused_with_what_to_do(
    paligemma: Path, run_folder: Path, tiny_folder: Path, bad: Callable[..., str]
) -> None:
    for ours in (run_folder, run_folder / "checkpoints" / "last", tiny_folder):
        said = bad("extract", ours, "--base", paligemma)
        assert "which Aegis has trained" in said and f"aegis probe {ours}" in said


def test_a_base_that_is_no_vlm_is_refused(
    paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    assert "no Hugging Face model" in bad("extract", source, "--base", "embedded")
    assert "no backbone at" in bad("extract", source, "--base", tmp_path / "missing")
    text = tmp_path / "text"
    text.mkdir()
    (text / "config.json").write_text('{"model_type": "llama"}')
    save_file({"model.layers.0.x": torch.zeros(2)}, text / WEIGHTS)
    assert "takes no images" in bad("extract", source, "--base", text)


def test_nothing_that_is_there_is_written_over(
    paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    before = files_of(source)
    for command in (
        ("extract", source, "--base", paligemma),
        ("insert", paligemma, "--into", source),
    ):
        assert "is there already" in bad(*command, out=source)
    assert "inside of the policy" in bad("insert", paligemma, "--into", source, out=source / "x")
    one = source / WEIGHTS
    assert f"give '{source}'" in bad("insert", paligemma, "--into", one)
    assert files_of(source) == before


@pytest.mark.parametrize("absolute", [True, False])
def test_an_index_that_names_a_file_elsewhere_is_refused(
    absolute: bool, paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi", shards=2)
    index, part = source / f"{WEIGHTS}.index.json", "model-00002-of-00002.safetensors"
    place = (source / part).rename(tmp_path / "weights.safetensors")
    before = place.read_bytes()
    named = str(place) if absolute else "../weights.safetensors"
    index.write_text(index.read_text().replace(part, named))
    for command in (
        ("insert", paligemma, "--into", source),
        ("extract", source, "--base", paligemma),
    ):
        assert "names a file outside of its folder" in bad(*command)
    assert place.read_bytes() == before


def test_writing_never_replaces_a_file(paligemma: Path, tmp_path: Path) -> None:
    path = tmp_path / WEIGHTS
    path.write_text("mine")
    with tensor_files.opened([paligemma / WEIGHTS]) as tensors, pytest.raises(FileExistsError):
        tensor_files.write(path, tensors.parts[0], tensors.rows)
    assert path.read_text() == "mine"


def test_a_frozen_vlm_with_more_beside_it_may_have_learned(paligemma: Path, tmp_path: Path) -> None:
    own = foreign.moved(paligemma, by=0)
    more = {**own, "multi_modal_projector.scale": torch.ones(2)}
    source = policy(tmp_path / "policy", more, "pi0 of LeRobot")
    said: list[Event] = []
    extract.run(str(source), str(paligemma), tmp_path / "vlm", on_event=said.append)
    (text,) = warnings(said)
    assert "nothing to forget" not in text and "multi_modal_projector.scale" in text


def test_a_policy_that_is_read_only_gives_folders_that_are_not(
    paligemma: Path, tmp_path: Path
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    folders = (source, source / "assets")
    try:
        for folder in folders:
            folder.chmod(0o555)
        insert.run(str(paligemma), str(source), tmp_path / "back")
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert all(os.stat(tmp_path / "back" / at).st_mode & 0o700 == 0o700 for at in ("", "assets"))
    assert files_of(tmp_path / "back").keys() == files_of(source).keys()


def test_only_links_within_the_policy_are_followed(
    paligemma: Path, tmp_path: Path, bad: Callable[..., str]
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key").write_text("mine")

    def asked() -> str:
        return bad("insert", paligemma, "--into", source)

    link = source / "assets" / "link"
    for target, said in {
        tmp_path / "secret": "leads out of the policy's folder",
        tmp_path / "secret" / "key": "leads out of the policy's folder",
        tmp_path / "nowhere": "a broken link",
        source: "a link to a folder that it lies in",
    }.items():
        link.symlink_to(target)
        found = asked()
        assert said in found and str(link) in found
        link.unlink()
    os.mkfifo(link)
    assert "neither a file nor a folder" in asked()
    link.unlink()
    link.symlink_to("norm_stats.json")
    (source / "again").symlink_to("assets")
    insert.run(str(paligemma), str(source), tmp_path / "back")
    assert (tmp_path / "back" / "again" / "link").read_text() == "{}"
    assert not [path for path in (tmp_path / "back").rglob("*") if path.is_symlink()]


def test_what_belongs_to_a_clone_or_a_download_is_not_copied(
    paligemma: Path, tmp_path: Path
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")
    before = files_of(source)
    for name in (".git", ".cache", "assets/.git", "assets/.cache"):
        (source / name).mkdir()
        (source / name / "config").write_text("token")
    insert.run(str(paligemma), str(source), tmp_path / "back")
    assert files_of(tmp_path / "back").keys() == before.keys()


def test_a_disk_that_is_full_leaves_nothing(
    paligemma: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = policy(tmp_path / "policy", foreign.moved(paligemma), "pi0 of openpi")

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(tensor_files, "write", full)
    for run in (
        lambda: extract.run(str(source), str(paligemma), tmp_path / "out"),
        lambda: insert.run(str(paligemma), str(source), tmp_path / "out"),
    ):
        with pytest.raises(AegisError, match="free space"):
            run()
        assert [path.name for path in tmp_path.iterdir()] == ["policy"]


def test_other_commands_say_how_a_foreign_policy_is_measured(
    paligemma: Path, smolvlm: Path, tmp_path: Path, aegis: Aegis
) -> None:
    lerobot = policy(tmp_path / "smolvla", foreign.moved(smolvlm), "smolvla")
    openpi = policy(tmp_path / "openpi", foreign.moved(paligemma), "pi0 of openpi")
    for command in (
        ("probe", lerobot),
        ("probe", lerobot / WEIGHTS),
        ("rollout", lerobot),
        ("export", lerobot, "--out", tmp_path / "x"),
        ("merge", lerobot, "--base", smolvlm, "--strength", "1", "--out", tmp_path / "x"),
        ("anchor", "--backbone", lerobot, "--out", tmp_path / "x"),
        ("inspect", lerobot),
    ):
        if command[0] == "inspect":
            code, said, _ = aegis(*command)
            assert code == 0
        else:
            said = refused(aegis(*command))
            assert "of the type 'smolvla'" in said
        assert f"aegis extract {lerobot} --base VLM" in said, command
    merge = ("merge", openpi, "--base", smolvlm, "--strength", "1", "--out", tmp_path / "x")
    for command in (("probe", openpi), merge):
        said = refused(aegis(*command))
        assert "another program wrote it" in said and f"aegis extract {openpi} --base" in said
    code, said, _ = aegis("inspect", lerobot, "--json")
    report = json.loads(said)
    weights = load_file(lerobot / WEIGHTS)
    assert (report["kind"], report["facts"]["type"]) == ("lerobot-policy", "smolvla")
    assert report["facts"]["parameters"] == sum(tensor.numel() for tensor in weights.values())


@pytest.mark.parametrize("form", FORMS)
def test_a_file_of_weights_is_inspected_as_what_it_likely_is(
    form: str, hf_folder: Folder, tmp_path: Path, aegis: Aegis
) -> None:
    base = base_of(form, hf_folder)
    source = policy(tmp_path / "policy", foreign.moved(base), form)
    (source / "config.json").unlink(missing_ok=True)

    def inspected(path: Path) -> dict[str, Any]:
        code, said, _ = aegis("inspect", path, "--json")
        report = json.loads(said)
        assert (code, report["kind"]) == (0, "safetensors")
        weights = load_file(path)
        facts: dict[str, Any] = report["facts"]
        assert {tensor["name"] for tensor in report["tensors"]} == weights.keys()
        assert sum(facts["types"].values()) == len(weights)
        assert facts["parameters"] == sum(tensor.numel() for tensor in weights.values())
        return facts

    found = inspected(source / WEIGHTS)
    assert found["likely"] == "a robot policy with a VLM"
    assert f"aegis extract {source / WEIGHTS} --base VLM" in found["vlm"]
    # The advice holds.
    take(source / WEIGHTS, base, tmp_path / "vlm")
    found = inspected(base / WEIGHTS)
    assert found["likely"] == "a vision-language model" and str(base) in found["folder"]
    assert "likely" not in inspected(source / SCALES)
    _, said, _ = aegis("inspect", source / WEIGHTS)
    assert "another program" in said and "F32" in said


def test_nothing_of_another_program_is_verified(paligemma: Path, aegis: Aegis) -> None:
    said = refused(aegis("inspect", paligemma / WEIGHTS, "--verify"))
    assert "another program wrote" in said and "leave out --verify" in said


def test_the_weights_have_the_header_of_the_bases(smolvlm: Path, tmp_path: Path) -> None:
    """transformers refuses a file whose metadata does not say which program's it is."""
    take(policy(tmp_path / "policy", foreign.moved(smolvlm), "smolvla"), smolvlm, tmp_path / "vlm")
    with (
        safe_open(tmp_path / "vlm" / WEIGHTS, "np") as found,
        safe_open(smolvlm / WEIGHTS, "np") as own,
    ):
        assert found.metadata() == own.metadata() == {"format": "pt"}
    assert (tmp_path / "policy" / SCALES).is_file()
