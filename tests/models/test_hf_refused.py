"""Hugging Face models that cannot be used: exit 2, one error with its fix."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from huggingface_hub.utils import filter_repo_objects
from PIL import Image
from safetensors.torch import load_file, save_file
from samples.backbones import TEXTS, encode, images
from samples.hf import FAMILIES as MADE
from samples.hf import SIZE, WITH_TORCHVISION, make_tokenizer, save_processor, write
from samples.user_folder import LFS_POINTER, TRAIN
from transformers.utils import is_torchvision_available

from aegis_cli import inspection
from aegis_cli.common.errors import AegisError
from aegis_cli.models import backbones
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.families import FAMILIES

Bad = Callable[..., str]
MEASURE = ("anchor", "--samples", "7", "--out", "a.safetensors", "--backbone")


@pytest.fixture
def model(hf_folder: Callable[[str], Path], place: Path) -> Path:
    """A copy of a PaliGemma 2 that tests damage."""
    return Path(shutil.copytree(hf_folder("paligemma"), place / "model"))


# --- not the right model --------------------------------------------------------------------------


def test_a_hub_id_without_network(bad: Bad) -> None:
    name = "someone/no-such-model"
    for command in ((*MEASURE, name), (*TRAIN, "--set", f"backbone={name}"), ("probe", name)):
        bad(
            *command,
            says=(
                "'someone/no-such-model'",
                "hub",
                "hf download someone/no-such-model",
                "--set backbone=MODEL",
            ),
        )


def test_a_path_that_is_no_text_is_named_as_the_reason(model: Path, bad: Bad) -> None:
    """transformers finds no model there."""
    moved = model.rename(model.with_name(os.fsdecode(b"caf\xe9")))
    bad(*MEASURE, moved, says=("caf\\udce9", "not UTF-8", "rename"))


def test_weights_that_a_repository_has_twice_are_fetched_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As in Mistral's repositories, which have them for transformers and for Mistral's programs."""
    there = ["config.json", "model-00001-of-2.safetensors", "consolidated.safetensors", "a.bin"]

    def download(
        _: str,
        repo_type: str,
        allow_patterns: list[str],
        ignore_patterns: list[str],
        local_files_only: bool,
    ) -> str:
        assert repo_type == "model" and not local_files_only
        for name in filter_repo_objects(
            there, allow_patterns=allow_patterns, ignore_patterns=ignore_patterns
        ):
            (tmp_path / name).touch()
        return str(tmp_path)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert {p.name for p in model_folder.fetch("org/name").iterdir()} == set(there[:2])


SHARDED = ("config.json", "model.safetensors.index.json", "model-1-of-2.safetensors")


@pytest.mark.parametrize(
    ("there", "cached"),
    [
        (("config.json", "model.safetensors"), True),
        ((*SHARDED, "model-2-of-2.safetensors"), True),
        (SHARDED, False),  # a download that was interrupted
        (("config.json", "preprocessor_config.json"), False),
        (("model.safetensors",), False),
        ((), False),
        (None, False),
    ],
)
def test_whether_a_model_of_the_hub_is_here_is_found_without_a_download(
    there: tuple[str, ...] | None, cached: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    placed = {"weight_map": {"a": "model-1-of-2.safetensors", "b": "model-2-of-2.safetensors"}}
    for name in there or ():
        (tmp_path / name).write_text(json.dumps(placed if "index" in name else {}))

    def download(_: str, local_files_only: bool, **__: object) -> str:
        assert local_files_only
        if there is None:
            raise FileNotFoundError("not in the cache")
        return str(tmp_path)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert backbones.is_here("org/name") == backbones.is_here("org/name#layers") == cached
    assert backbones.is_here("embedded") and backbones.is_here("random:smolvlm2-256m")
    assert not backbones.is_here("runs/none")


@pytest.mark.parametrize(
    "name", ["runs/none", "./x", "../x", "/no/x", "~/x", "nothing", "a/b/c", "models/x"]
)
def test_a_path_that_is_missing_is_never_asked_of_the_hub(
    name: str, bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(backbones.model_folder, "fetch", asked.append)
    Path("models").mkdir()
    baseline = ("probe", "model.safetensors", "--questions", "7", "--baseline", name)
    for command in (
        (*MEASURE, name),
        (*TRAIN, "--set", f"backbone={name}"),
        ("probe", name),
        baseline,
    ):
        said = bad(
            *command,
            says=(
                f"'{os.path.expanduser(name)}': no such file or folder",
                "run's folder (it holds checkpoints/last)",
                "hub id",
            ),
        )
        assert (
            "--backbone MODEL (anchor, bench)" in said
            and "--set backbone=MODEL (train, run" in said
        )
    assert asked == []


def test_a_folder_without_a_model_says_so(bad: Bad) -> None:
    Path("models/x").mkdir(parents=True)
    bad(*MEASURE, "models/x", says=("no backbone at 'models/x': no model in it", "check the path"))


def test_a_repository_that_is_no_model(
    bad: Bad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hub's repository may be a data set, or hold another library's weights."""
    monkeypatch.setattr(backbones.model_folder, "fetch", lambda name: tmp_path)
    bad(*MEASURE, "someone/a-data-set", says=("no config.json", "Hugging Face model"))


def test_a_model_without_a_head_that_scores_words(
    model: Path, bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some model classes for fine-tuning have outputs other than words."""
    kind = transformers.PaliGemmaForConditionalGeneration
    monkeypatch.setattr(kind, "get_output_embeddings", lambda self: None)
    bad(*MEASURE, model, says=("PaliGemmaForConditionalGeneration without a head", "family"))


def test_a_hub_id_without_transformers_is_a_missing_path(
    bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backbones, "_has_transformers", lambda: False)
    bad(
        *MEASURE,
        "someone/no-such-model",
        says=("no backbone at 'someone/no-such-model'", "pip install 'aegis-vla[hf]'"),
    )


def test_a_model_without_transformers(
    bad: Bad, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backbones, "_has_transformers", lambda: False)
    bad(*MEASURE, "model", says=("'model'", "pip install 'aegis-vla[hf]'"))


def test_a_model_of_text_alone(bad: Bad, place: Path) -> None:
    tokenizer = make_tokenizer("<eos>")
    config = transformers.LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
    )
    transformers.LlamaForCausalLM(config).save_pretrained(place / "llama")
    tokenizer.save_pretrained(place / "llama")
    bad(*MEASURE, "llama", says=("'llama' model", "no images", "paligemma"))


def unknown(folder: Path) -> Path:
    """A SmolVLM whose row of families has been removed: see `without_smolvlm`."""
    return write("smolvlm", folder)


@pytest.fixture
def without_smolvlm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(FAMILIES, "smolvlm")


@pytest.mark.usefixtures("without_smolvlm")
def test_an_unknown_family_until_its_layers_are_named(bad: Bad, place: Path) -> None:
    unknown(place / "new")
    bad(
        *MEASURE, "new", says=("family 'smolvlm'", "paligemma, ", "new#model.language_model.layers")
    )
    bad(
        *MEASURE,
        "new#model.layers",
        says=("'model.layers' is no list of the model's layers", "model.text_model.layers"),
    )
    bad(
        *MEASURE,
        "new#model.vision_model.encoder.layers",
        says=("no rotary_emb beside it", "one of model.text_model.layers"),
    )
    named = backbones.load("new#model.text_model.layers")
    got = encode(named, images(2), TEXTS[:2])
    assert len(got.hidden) == named.depth == 2 and all(h.isfinite().all() for h in got.hidden)


@pytest.mark.usefixtures("without_smolvlm")
def test_an_exported_model_remembers_where_its_layers_are(tmp_path: Path) -> None:
    named = backbones.load(f"{unknown(tmp_path / 'new')}#model.text_model.layers")
    named.save(tmp_path / "saved")
    again = backbones.load(str(tmp_path / "saved"))
    assert (
        again.fingerprint() == named.fingerprint()
        and again.parameter_groups().keys() == named.parameter_groups().keys()
    )
    again.save(tmp_path / "twice")
    assert (tmp_path / "twice" / "aegis.json").read_bytes() == (
        tmp_path / "saved" / "aegis.json"
    ).read_bytes()


def interleaved(x: torch.Tensor) -> torch.Tensor:
    """Channel i is rotated together with its neighbour, as in GPT-J and Cohere."""
    return torch.stack([-x[..., 1::2], x[..., ::2]], dim=-1).flatten(-2)


def none_at_all(
    query: torch.Tensor, key: torch.Tensor, *_: Any, **__: Any
) -> tuple[torch.Tensor, torch.Tensor]:
    return query, key


@pytest.mark.parametrize(
    ("function", "other"), [("rotate_half", interleaved), ("apply_rotary_pos_emb", none_at_all)]
)
def test_keys_that_are_rotated_otherwise_than_the_experts(
    function: str,
    other: Callable[..., Any],
    bad: Bad,
    hf_folder: Callable[[str], Path],
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The expert's rotations would silently differ."""
    folder = shutil.copytree(hf_folder("smolvlm"), place / "other")
    backbones.load(str(folder))
    monkeypatch.setattr(transformers.models.llama.modeling_llama, function, other)
    bad(*MEASURE, "other", says=("layer 0 rotates its keys in a way of its own", "GPT-NeoX"))


# --- families that cannot be used -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("qwen3_5", "linear attention"),
        ("qwen3_5_moe", "linear attention"),
        ("lfm2_vl", "convolutions"),
        ("mllama", "cross-attention layers"),
        ("phi4_multimodal", "a causal language model with inputs of its own"),
        ("phi4mm", "repository's own code"),
        ("internvl_chat", "ends in -hf"),
        ("llava_qwen", "ends in -hf"),
    ],
)
def test_a_family_that_cannot_be_used_is_refused_with_the_reason(
    kind: str, why: str, bad: Bad, place: Path
) -> None:
    """Naming its layers would not help, so the error does not suggest it."""
    (place / "other").mkdir()
    (place / "other" / "config.json").write_text(json.dumps({"model_type": kind}))
    for name in ("other", "other#model.language_model.layers"):
        said = bad(*MEASURE, name, says=(f"'{kind}' model", why, "paligemma, "))
        assert "after a #" not in said and "processor's files" not in said


def test_a_model_without_an_end_of_answers_is_refused(
    place: Path, bad: Bad, hf_folder: Callable[[str], Path]
) -> None:
    folder = place / "endless"
    shutil.copytree(hf_folder("paligemma"), folder)
    for name in ("config.json", "generation_config.json"):
        content = json.loads((folder / name).read_text())
        content["eos_token_id"] = None
        content.get("text_config", {})["eos_token_id"] = None
        (folder / name).write_text(json.dumps(content))
    bad(*MEASURE, "endless", says=("without eos_token_id", "end an answer"))


class SelfAttention(torch.nn.Module):
    """Named like an attention module."""


class CrossAttention(torch.nn.Module):
    """Attention over the image, according to its name."""


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ((torch.nn.Conv1d(2, 2, 3),), "are none"),
        ((CrossAttention(),), "are CrossAttention"),
        ((SelfAttention(), CrossAttention()), "are SelfAttention and CrossAttention"),
    ],
)
def test_a_layer_without_one_attention_over_the_text(
    parts: tuple[torch.nn.Module, ...], says: str
) -> None:
    """The family is unknown, for example a hybrid one."""
    layers = [torch.nn.Sequential(SelfAttention()), torch.nn.Sequential(*parts)]
    check = backbones.model_folder.check_attention
    with pytest.raises(AegisError, match="layer 1, a Sequential") as caught:
        check(torch.nn.ModuleList(layers))
    assert says in caught.value.found
    check(torch.nn.ModuleList(layers[:1]))


@pytest.mark.skipif(is_torchvision_available(), reason="torchvision is installed")
def test_a_processor_that_needs_torchvision_says_so(
    bad: Bad, place: Path, hf_folder: Callable[[str], Path]
) -> None:
    model = Path(shutil.copytree(hf_folder("smolvlm"), place / "model"))
    (model / "processor_config.json").write_text('{"processor_class": "PixtralProcessor"}')
    bad(*MEASURE, "model", says=("needs torchvision", "pip install torchvision"))


# --- weights --------------------------------------------------------------------------------------


def rewrite(model: Path, change: Callable[[dict[str, torch.Tensor]], Any]) -> None:
    tensors = load_file(model / "model.safetensors")
    change(tensors)
    save_file(tensors, model / "model.safetensors", {"format": "pt"})


def norm(tensors: dict[str, torch.Tensor]) -> str:
    """The stored name of a language layer's norm: releases of transformers differ in its head."""
    ends = "layers.1.input_layernorm.weight"
    (name,) = (name for name in tensors if "language_model" in name and name.endswith(ends))
    return name


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.pop(norm(t)), ("1 missing", "layers.1.input_layernorm.weight")),
        (
            lambda t: t.__setitem__(norm(t).replace("layers.1.", "extra."), torch.zeros(3)),
            ("1 unexpected", "extra.input_layernorm.weight"),
        ),
        (lambda t: t.__setitem__(norm(t), torch.zeros(31)), ("layers.1.input_layernorm.weight",)),
        (
            lambda t: (t.pop(norm(t)), t.__setitem__("other", torch.zeros(2))),
            ("1 missing", "1 unexpected"),
        ),
    ],
    ids=["missing", "unexpected", "another shape", "both"],
)
def test_weights_that_are_not_the_models(
    change: Any, says: tuple[str, ...], bad: Bad, model: Path
) -> None:
    rewrite(model, change)
    bad(*MEASURE, "model", says=("'model'", *says))


@pytest.mark.parametrize(
    "name", ["model.safetensors", "config.json", "tokenizer.json", "processor_config.json"]
)
@pytest.mark.parametrize("keep", [None, 0.5])
def test_a_file_that_is_missing_or_cut(
    name: str, keep: float | None, bad: Bad, model: Path
) -> None:
    path = model / name
    data = path.read_bytes()
    path.unlink()
    if keep is not None:
        path.write_bytes(data[: int(keep * len(data))])
    bad(*MEASURE, "model", says=("model",))


@pytest.mark.parametrize(
    ("name", "said"),
    [("tokenizer.json", "no tokenizer in"), ("processor_config.json", "no image processor in")],
)
def test_a_part_of_the_processor_that_is_missing_is_named(
    name: str, said: str, bad: Bad, model: Path
) -> None:
    """Without a tokenizer, transformers makes one without words, and images have no token."""
    (model / name).unlink()
    bad(*MEASURE, "model", says=(said, "the model that this one was made from"))


@pytest.mark.parametrize("alone", [False, True])
def test_an_adapter_of_peft_is_refused_with_what_makes_a_model_of_it(
    alone: bool, bad: Bad, model: Path
) -> None:
    """transformers would load it into the model, whose checkpoints could then not be written."""
    (model / "adapter_config.json").write_text('{"peft_type": "LORA"}')
    if alone:
        (model / "config.json").unlink()
        for weights in model.glob("*.safetensors"):
            weights.rename(model / "adapter_model.safetensors")
    bad(*MEASURE, "model", says=("adapter", "merge_and_unload"))


@pytest.mark.parametrize("part", [None, "text_config"])
def test_quantised_weights_are_refused_with_what_makes_a_model_of_them(
    part: str | None, bad: Bad, model: Path
) -> None:
    """They cannot be trained, and the error comes before an anchor of them is measured."""
    config = json.loads((model / "config.json").read_text())
    within = config if part is None else config[part]
    within["quantization_config"] = {"quant_method": "bitsandbytes", "load_in_4bit": True}
    (model / "config.json").write_text(json.dumps(config))
    bad(*MEASURE, "model", says=("quantised weights", "bitsandbytes", "dequantize"))


def test_weights_that_git_lfs_has_not_fetched(bad: Bad, model: Path) -> None:
    (model / "model.safetensors").write_text(LFS_POINTER)
    for command in ((*MEASURE, "model"), ("inspect", "model")):
        bad(*command, says=("model.safetensors", "Git LFS pointer", "git lfs pull"))


def test_the_configuration_of_another_size(bad: Bad, model: Path) -> None:
    config = json.loads((model / "config.json").read_text())
    text = config["text_config"]
    text["num_hidden_layers"] = 2
    (model / "config.json").write_text(json.dumps(config))
    bad(*MEASURE, "model", says=("model", "num_hidden_layers"))
    text["layer_types"] = text["layer_types"][:2]
    (model / "config.json").write_text(json.dumps(config))
    bad(*MEASURE, "model", says=("unexpected", "layers.2"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "is not JSON"),
        ("[]", "names no model_type"),
        ('{"model_type": 3}', "names no model_type"),
        ('{"model_type": "vlm9"}', "'vlm9', which this transformers"),
    ],
)
def test_a_configuration_that_says_nothing(text: str, says: str, bad: Bad, model: Path) -> None:
    (model / "config.json").write_text(text)
    bad(*MEASURE, "model", says=("model", says))


@pytest.mark.parametrize("text", ["[]", "{}", '{"model_type": ["x"]}'])
def test_a_configuration_that_says_nothing_is_not_inspected(
    text: str, bad: Bad, model: Path
) -> None:
    (model / "config.json").write_text(text)
    bad("inspect", "model", says=("config.json", "without a model_type"))


def test_what_a_configuration_leaves_empty_is_not_shown(model: Path) -> None:
    config = json.loads((model / "config.json").read_text())
    (model / "config.json").write_text(
        json.dumps(config | {"text_config": None, "num_hidden_layers": 3})
    )
    assert inspection.run(model).facts["layers"] == 3


def test_weights_that_are_pickles(bad: Bad, model: Path) -> None:
    (model / "model.safetensors").rename(model / "pytorch_model.bin")
    bad(*MEASURE, "model", says=("no *.safetensors", "but pytorch_model.bin", "save_pretrained"))


def test_the_weights_of_a_model_without_its_folder(bad: Bad, model: Path) -> None:
    bad(*MEASURE, "model/model.safetensors", says=("weights of a Hugging Face", "give 'model'"))


@pytest.mark.parametrize("named", ["folder", "file", "folder with a config.json"])
def test_a_model_of_llama_cpp(named: str, bad: Bad, model: Path) -> None:
    (model / "model.safetensors").unlink()
    (model / "model-Q8_0.gguf").write_bytes(b"GGUF" + bytes(60))
    if named == "folder":
        (model / "config.json").unlink()
    given = "model/model-Q8_0.gguf" if named == "file" else "model"
    bad(*MEASURE, given, says=("GGUF: 'model/model-Q8_0.gguf'", "the model that it was made from"))


def test_layers_of_the_embedded_vlm_are_not_named(bad: Bad, place: Path) -> None:
    for name in ("embedded", "model.safetensors"):
        bad(*MEASURE, f"{name}#layers", says=("'#layers'", "leave it out"))


# --- processors and anchors -----------------------------------------------------------------------


def test_the_processor_of_another_family(
    bad: Bad, model: Path, hf_folder: Callable[[str], Path]
) -> None:
    for path in model.iterdir():
        if path.name not in ("config.json", "generation_config.json", "model.safetensors"):
            path.unlink()
    for path in hf_folder("smolvlm").iterdir():
        if not (model / path.name).exists():
            shutil.copy(path, model)
    bad(*MEASURE, "model", says=("processor",))


@pytest.mark.parametrize(
    ("template", "says"),
    [
        (None, "no chat template"),
        ("{% for", "end of template"),
        ("{{ messages[0]['content'][-1]['text'] }}", "the chat template places no image"),
    ],
)
def test_a_template_that_asks_about_no_image(
    template: str | None, says: str, bad: Bad, place: Path, hf_folder: Callable[[str], Path]
) -> None:
    model = Path(shutil.copytree(hf_folder("smolvlm"), place / "model"))
    (model / "chat_template.jinja").unlink()
    if template is not None:
        (model / "chat_template.jinja").write_text(template)
    bad(
        *MEASURE,
        "model",
        says=("a model and a processor that do not fit together", says, "processor's files"),
    )


@pytest.mark.parametrize(
    "name", ["processor_config.json", "tokenizer_config.json", "tokenizer.json"]
)
def test_a_processors_file_that_holds_something_else(name: str, bad: Bad, model: Path) -> None:
    (model / name).write_text("[]")
    bad(*MEASURE, "model", says=("model",))


def test_a_vocabulary_that_is_larger_than_the_models(bad: Bad, model: Path, place: Path) -> None:
    """Its last words would be looked up beyond the table's end."""
    _, processor = MADE["paligemma"]()
    rows = len(processor.tokenizer)
    processor.tokenizer.add_tokens(["many", "cyan"])
    processor.tokenizer.save_pretrained(model)
    for asked, said in (("how many", "red"), ("what color is it", "cyan")):
        for i in range(12):  # about half of them are for probes
            Image.new("RGB", (8, 8)).save(place / f"{i}.png")
        lines = [{"image": f"{i}.png", "question": asked, "answers": [said]} for i in range(12)]
        (place / "asked.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        says = (
            "a model and a processor that do not fit together",
            f"where the model has {rows} words",
        )
        bad("probe", "model", "--vqa", "asked.jsonl", "--questions", "1", says=says)


def test_the_processor_of_larger_images(bad: Bad, model: Path) -> None:
    _, processor = MADE["paligemma"]()
    processor.image_processor.size = {"height": 2 * SIZE, "width": 2 * SIZE}
    save_processor(processor, model)
    bad(*MEASURE, "model", says=("a model and a processor that do not fit together",))


def test_the_processor_of_more_image_tokens(bad: Bad, model: Path) -> None:
    _, processor = MADE["paligemma"]()
    processor.image_processor.image_seq_length = 25
    save_processor(processor, model)
    bad(
        *MEASURE, "model", says=("a model and a processor that do not fit together", "do not match")
    )


def test_an_anchor_of_another_size(bad: Bad, model: Path) -> None:
    """The folder's anchor is of the embedded VLM: two layers, where this model has three."""
    bad(
        *TRAIN,
        "--set",
        "backbone=model",
        says=("anchor.safetensors", "not those of 'model'", "aegis anchor --backbone model"),
    )
    says = ("anchor.safetensors", "not those of 'model'", "--baseline")
    bad("probe", "model", "--anchor", "anchor.safetensors", "--questions", "7", says=says)


def test_what_cannot_be_measured_is_named(
    bad: Bad, place: Path, aegis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A projector with a matrix of its own."""
    from transformers.models.llava_onevision import modeling_llava_onevision as llava

    class Mixing(llava.LlavaOnevisionMultiModalProjector):
        def __init__(self, config: Any) -> None:
            super().__init__(config)
            self.mix = torch.nn.Parameter(torch.eye(config.text_config.hidden_size))

        def forward(self, features: torch.Tensor) -> torch.Tensor:
            return super().forward(features) @ self.mix

    monkeypatch.setattr(llava, "LlavaOnevisionMultiModalProjector", Mixing)
    write("llava_onevision", place / "llava")
    bad(*MEASURE, "llava", says=("vlm.model.multi_modal_projector (Mixing)", "--parts moments"))
    code, _, err = aegis(*MEASURE, "llava", "--parts", "moments,fisher", "--fisher-samples", "3")
    assert code == 0, err


# --- texts and settings ---------------------------------------------------------------------------


def test_a_question_with_the_models_own_marker(hf_folder: Callable[[str], Path]) -> None:
    """It is refused before anything is asked, so `--skip-bad` can leave it out."""
    for family in FAMILIES.keys() - WITH_TORCHVISION:
        backbone = backbones.load(str(hf_folder(family)))
        for marker in backbone._prompter._markers:
            for ask in (
                lambda text: backbone.prepare(images(1), [text]),
                lambda text: backbone.check_text(text, "red"),
                lambda text: backbone.check_text("what", text),
            ):
                with pytest.raises(AegisError, match="processor refuses") as caught:
                    ask(f"is there an {marker} here")
                assert marker in caught.value.found
                ask("is there an image here")


@pytest.mark.parametrize(
    ("family", "marker"),
    [("smolvlm", "<video>"), ("llava_onevision", "<video>"), ("gemma3", "<global-img>")],
)
def test_other_media_have_markers_too(
    hf_folder: Callable[[str], Path], family: str, marker: str
) -> None:
    backbone = backbones.load(str(hf_folder(family)))
    assert marker in backbone._prompter._markers
    with pytest.raises(AegisError, match="processor refuses"):
        backbone.check_text(f"what is a {marker}", "red")


def test_a_text_that_is_too_long_is_told_before_anything_is_asked(
    hf_folder: Callable[[str], Path],
) -> None:
    backbone = backbones.load(str(hf_folder("smolvlm")))
    long = "how many " * backbone._prompter._longest
    for question, answer in ((long, "red"), ("what", long)):
        with pytest.raises(AegisError, match=r"'how many .* \.\.\.': \d+ tokens"):
            backbone.check_text(question, answer)


def test_an_image_that_the_processor_refuses(hf_folder: Callable[[str], Path]) -> None:
    """The error does not call it a text."""
    narrow = torch.zeros(1, 1000, 2, 3, dtype=torch.uint8)
    with pytest.raises(
        AegisError, match="^found: an image or a text .* refuses: .*: absolute aspect ratio"
    ) as caught:
        backbones.load(str(hf_folder("qwen2_5_vl"))).prepare(narrow, ["is there a cube"])
    assert "question" in caught.value.fix


def test_of_many_questions_the_one_is_named_that_the_processor_refuses(
    hf_folder: Callable[[str], Path],
) -> None:
    backbone = backbones.load(str(hf_folder("qwen2_5_vl")))
    narrow = torch.zeros(1000, 2, 3, dtype=torch.uint8)
    wide = torch.zeros(64, 64, 3, dtype=torch.uint8)
    asked = ["is there a cube", "what is this", "is there a ball"]
    with pytest.raises(AegisError, match="'what is this' about 2 x 1000 pixels: absolute aspect"):
        backbone.prepare([wide, narrow, wide], asked)
    backbone.check_text("what is this", "red", wide)
    backbone.check_text("what is this", "red")  # the check sees no image
    with pytest.raises(AegisError, match="absolute aspect"):
        backbone.check_text("what is this", "red", narrow)


def test_what_checkpoints_is_not_compiled(bad: Bad, place: Path, model: Path, aegis: Any) -> None:
    assert aegis(*MEASURE, "model", "--parts", "moments")[0] == 0
    command = [word if word != "anchor.safetensors" else "a.safetensors" for word in TRAIN]
    both = ("train.compile", "train.gradient_checkpointing")
    options = [part for key in both for part in ("--set", f"{key}=true")]
    bad(*command, "--set", "backbone=model", *options, says=both)


@pytest.mark.parametrize(
    ("key", "value"), [("gradient_checkpointing", "true"), ("weights", "bf16")]
)
def test_what_the_embedded_backbone_has_not(key: str, value: str, bad: Bad) -> None:
    bad(*TRAIN, "--set", f"train.{key}={value}", says=(f"train.{key}", "embedded", "Hugging Face"))
