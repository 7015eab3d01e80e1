"""Small Hugging Face VLMs of the true architectures, with random weights and real processors."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers.utils import is_torchvision_available

from aegis_cli.data.vqa.questions import vocabulary

SIZE, PATCH, WIDTH = 32, 8, 32  # pixels, pixels, hidden size
CHATML = (
    "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{% if m['content'] is string %}{{ "
    "m['content'] }}{% else %}"
    "{% for c in m['content'] %}{% if c['type'] == 'image' %}IMAGE{% else %}{{ c['text'] }}{% "
    "endif %}{% endfor %}{% endif %}"
    "<|im_end|>\n{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
SMOL = (
    "<|im_start|>{% for m in messages %}{{ m['role'] | capitalize }}"
    "{% if m['content'][0]['type'] == 'image' %}:{% else %}: {% endif %}"
    "{% for c in m['content'] %}{% if c['type'] == 'image' %}<image>{% else %}{{ c['text'] }}{% "
    "endif %}{% endfor %}"
    "<end_of_utterance>\n{% endfor %}{% if add_generation_prompt %}Assistant:{% endif %}"
)
# transformers 5.5 reads it as a regular expression.
GEMMA_IMAGE = "<global-img>"
SPECIAL = [
    "<pad>",
    "<bos>",
    "<eos>",
    "<image>",
    "<video>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|image_pad|>",
    "<|video_pad|>",
    "<fake_token_around_image>",
    "<global-img>",
    "<end_of_utterance>",
]


@cache
def _bpe() -> str:
    """A byte-level BPE that has learned the questions' words, as JSON."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    words = [
        *vocabulary(),
        "answer",
        "user",
        "assistant",
        "User",
        "Assistant",
        "move",
        "finger",
        "touch",
        "go",
        "pad",
        "on",
    ]
    trainer = trainers.BpeTrainer(
        vocab_size=800,
        show_progress=False,
        special_tokens=SPECIAL,
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
    )
    tokenizer.train_from_iterator(
        [" ".join(words), " ".join(reversed(words)), "answer en "] * 20, trainer
    )
    return tokenizer.to_str()


def make_tokenizer(eos: str, **named: str) -> Any:
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=Tokenizer.from_str(_bpe()),
        pad_token="<pad>",
        bos_token="<bos>",
        eos_token=eos,
        extra_special_tokens=named,
        model_max_length=4096,
    )


def _text(tokenizer: Any, eos: str, **more: Any) -> dict[str, Any]:
    """What all language models here share: grouped queries, few layers, a real end token."""
    return {
        "vocab_size": len(tokenizer),
        "hidden_size": WIDTH,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "max_position_embeddings": 2048,
        "initializer_range": 0.2,
        "pad_token_id": tokenizer.convert_tokens_to_ids("<pad>"),
        "bos_token_id": tokenizer.convert_tokens_to_ids("<bos>"),
        "eos_token_id": tokenizer.convert_tokens_to_ids(eos),
    } | more


_VISION = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": SIZE,
    "patch_size": PATCH,
}


def _paligemma(**changes: Any) -> tuple[Any, Any]:
    from transformers.models.siglip.image_processing_pil_siglip import SiglipImageProcessorPil

    images = SiglipImageProcessorPil(size={"height": SIZE, "width": SIZE})
    images.image_seq_length = (SIZE // PATCH) ** 2
    tokenizer = make_tokenizer("<eos>", image_token="<image>")
    processor = transformers.PaliGemmaProcessor(
        images, tokenizer
    )  # it adds location and segmentation tokens
    text = _text(
        tokenizer,
        "<eos>",
        num_hidden_layers=3,
        head_dim=16,
        query_pre_attn_scalar=16,
        sliding_window=8,
        num_attention_heads=4,
    )
    config = transformers.PaliGemmaConfig(
        text_config={"model_type": "gemma2", **text},
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        vision_config={"model_type": "siglip_vision_model", **_VISION, "vision_use_head": False},
        projection_dim=WIDTH,
        hidden_size=WIDTH,
        vocab_size=len(tokenizer),
        **changes,
    )
    return config, processor


def _qwen_images() -> Any:
    """The image processor of every Qwen VL, without torchvision."""
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    area = {"shortest_edge": SIZE**2, "longest_edge": SIZE**2}
    return Qwen2VLImageProcessorPil(
        patch_size=PATCH, merge_size=2, temporal_patch_size=2, size=area
    )


def _qwen(**changes: Any) -> tuple[Any, Any]:
    tokenizer = make_tokenizer("<|im_end|>")
    images = _qwen_images()
    template = CHATML.replace("IMAGE", "<|vision_start|><|image_pad|><|vision_end|>")
    processor = without_video(transformers.Qwen2_5_VLProcessor, images, tokenizer, template)
    ids = tokenizer.convert_tokens_to_ids
    rope = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 10000.0}
    config = transformers.Qwen2_5_VLConfig(
        text_config=_text(tokenizer, "<|im_end|>", rope_parameters=rope),
        vision_config={
            "depth": 2,
            "hidden_size": 16,
            "intermediate_size": 32,
            "num_heads": 2,
            "patch_size": PATCH,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
            "window_size": 16,
            "out_hidden_size": WIDTH,
            "fullatt_block_indexes": [1],
        },
        image_token_id=ids("<|image_pad|>"),
        video_token_id=ids("<|video_pad|>"),
        vision_start_token_id=ids("<|vision_start|>"),
        vision_end_token_id=ids("<|vision_end|>"),
        tie_word_embeddings=True,
        **changes,
    )
    return config, processor


def _smolvlm(**changes: Any) -> tuple[Any, Any]:
    from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil

    tokenizer = make_tokenizer(
        "<end_of_utterance>", image_token="<image>", fake_image_token="<fake_token_around_image>"
    )
    edge = {"longest_edge": SIZE}
    images = SmolVLMImageProcessorPil(size=edge, max_image_size=edge, do_image_splitting=False)
    processor = without_video(
        transformers.SmolVLMProcessor, images, tokenizer, SMOL, image_seq_len=4
    )
    config = transformers.SmolVLMConfig(
        text_config={"model_type": "llama", **_text(tokenizer, "<end_of_utterance>")},
        vision_config=_VISION,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        scale_factor=2,
        tie_word_embeddings=False,
        **changes,
    )
    return config, processor


def _llava(**changes: Any) -> tuple[Any, Any]:
    from transformers.models.llava_onevision.image_processing_pil_llava_onevision import (
        LlavaOnevisionImageProcessorPil,
    )

    tokenizer = make_tokenizer("<|im_end|>", image_token="<image>", video_token="<video>")
    pinpoints = [[SIZE, SIZE], [SIZE, 2 * SIZE], [2 * SIZE, SIZE]]
    images = LlavaOnevisionImageProcessorPil(
        size={"height": SIZE, "width": SIZE}, image_grid_pinpoints=pinpoints
    )
    processor = without_video(
        transformers.LlavaOnevisionProcessor,
        images,
        tokenizer,
        CHATML.replace("IMAGE", "<image>\n"),
        num_image_tokens=(SIZE // PATCH) ** 2,
        vision_feature_select_strategy="full",
    )
    ids = tokenizer.convert_tokens_to_ids
    config = transformers.LlavaOnevisionConfig(
        text_config={"model_type": "qwen2", **_text(tokenizer, "<|im_end|>")},
        vision_config={"model_type": "siglip_vision_model", **_VISION, "vision_use_head": False},
        image_token_index=ids("<image>"),
        video_token_index=ids("<video>"),
        image_grid_pinpoints=pinpoints,
        tie_word_embeddings=True,
        **changes,
    )
    return config, processor


def _idefics3(**changes: Any) -> tuple[Any, Any]:
    from transformers.models.idefics3.image_processing_pil_idefics3 import Idefics3ImageProcessorPil

    tokenizer = make_tokenizer(
        "<end_of_utterance>", image_token="<image>", fake_image_token="<fake_token_around_image>"
    )
    edge = {"longest_edge": SIZE}
    images = Idefics3ImageProcessorPil(size=edge, max_image_size=edge, do_image_splitting=False)
    processor = transformers.Idefics3Processor(
        images, tokenizer, image_seq_len=4, chat_template=SMOL
    )
    config = transformers.Idefics3Config(
        text_config={"model_type": "llama", **_text(tokenizer, "<end_of_utterance>")},
        vision_config=_VISION,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        scale_factor=2,
        tie_word_embeddings=True,
        **changes,
    )
    return config, processor


def _qwen2(**changes: Any) -> tuple[Any, Any]:
    tokenizer = make_tokenizer("<|im_end|>")
    images = _qwen_images()
    processor = without_video(transformers.Qwen2VLProcessor, images, tokenizer, QWEN)
    rope = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 10000.0}
    config = transformers.Qwen2VLConfig(
        text_config=_text(tokenizer, "<|im_end|>", rope_parameters=rope),
        vision_config={
            "depth": 2,
            "embed_dim": 16,
            "hidden_size": WIDTH,
            "mlp_ratio": 2,
            "num_heads": 2,
            "patch_size": PATCH,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
        },
        **_qwen_tokens(tokenizer),
        tie_word_embeddings=True,
        **changes,
    )
    return config, processor


def _qwen3(**changes: Any) -> tuple[Any, Any]:
    """Its vision tower also passes features to the first language layers."""
    tokenizer = make_tokenizer("<|im_end|>")
    images = _qwen_images()
    processor = without_video(transformers.Qwen3VLProcessor, images, tokenizer, QWEN)
    rope = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 10000.0}
    config = transformers.Qwen3VLConfig(
        text_config=_text(tokenizer, "<|im_end|>", rope_parameters=rope, head_dim=8),
        vision_config={
            "depth": 2,
            "hidden_size": 16,
            "intermediate_size": 32,
            "num_heads": 2,
            "patch_size": PATCH,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
            "out_hidden_size": WIDTH,
            "num_position_embeddings": (SIZE // PATCH) ** 2,
            "deepstack_visual_indexes": [0],
        },
        **_qwen_tokens(tokenizer),
        tie_word_embeddings=True,
        **changes,
    )
    return config, processor


QWEN = CHATML.replace("IMAGE", "<|vision_start|><|image_pad|><|vision_end|>")


def _qwen_tokens(tokenizer: Any) -> dict[str, int]:
    ids = tokenizer.convert_tokens_to_ids
    return {
        "image_token_id": ids("<|image_pad|>"),
        "video_token_id": ids("<|video_pad|>"),
        "vision_start_token_id": ids("<|vision_start|>"),
        "vision_end_token_id": ids("<|vision_end|>"),
    }


_CLIP = {
    "model_type": "clip_vision_model",
    **_VISION,
    "projection_dim": 16,
}


def _llava_1_5(**changes: Any) -> tuple[Any, Any]:
    """It reads the output of CLIP's last layer but one, so the last layer is unused."""
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    tokenizer = make_tokenizer("<|im_end|>", image_token="<image>")
    side = {"height": SIZE, "width": SIZE}
    images = CLIPImageProcessorPil(size={"shortest_edge": SIZE}, crop_size=side)
    processor = transformers.LlavaProcessor(
        images,
        tokenizer,
        patch_size=PATCH,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template=CHATML.replace("IMAGE", "<image>\n"),
    )
    config = transformers.LlavaConfig(
        text_config={"model_type": "llama", **_text(tokenizer, "<|im_end|>")},
        vision_config=_CLIP,
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        vision_feature_layer=-2,
        **changes,
    )
    return config, processor


def _llava_next(**changes: Any) -> tuple[Any, Any]:
    from transformers.models.llava_next.image_processing_pil_llava_next import (
        LlavaNextImageProcessorPil,
    )

    tokenizer = make_tokenizer("<|im_end|>", image_token="<image>")
    pinpoints = [[SIZE, SIZE], [SIZE, 2 * SIZE], [2 * SIZE, SIZE]]
    images = LlavaNextImageProcessorPil(
        size={"shortest_edge": SIZE},
        crop_size={"height": SIZE, "width": SIZE},
        image_grid_pinpoints=pinpoints,
    )
    processor = transformers.LlavaNextProcessor(
        images,
        tokenizer,
        patch_size=PATCH,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template=CHATML.replace("IMAGE", "<image>\n"),
    )
    config = transformers.LlavaNextConfig(
        text_config={"model_type": "llama", **_text(tokenizer, "<|im_end|>")},
        vision_config=_CLIP,
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        image_grid_pinpoints=pinpoints,
        vision_feature_layer=-2,
        **changes,
    )
    return config, processor


def _internvl(**changes: Any) -> tuple[Any, Any]:
    """Its positions are a table that no torch module looks up."""
    from transformers.models.got_ocr2.image_processing_pil_got_ocr2 import (
        GotOcr2ImageProcessorPil,
    )

    named = {
        "start_image_token": "<|vision_start|>",
        "end_image_token": "<|vision_end|>",
        "context_image_token": "<|image_pad|>",
        "video_token": "<video>",
    }
    tokenizer = make_tokenizer("<|im_end|>", **named)
    images = GotOcr2ImageProcessorPil(size={"height": SIZE, "width": SIZE}, crop_to_patches=False)
    processor = without_video(
        transformers.InternVLProcessor,
        images,
        tokenizer,
        CHATML.replace("IMAGE", "<|image_pad|>\n"),
        image_seq_length=4,
    )
    config = transformers.InternVLConfig(
        text_config={"model_type": "qwen2", **_text(tokenizer, "<|im_end|>")},
        vision_config=_VISION | {"image_size": [SIZE, SIZE], "patch_size": [PATCH, PATCH]},
        image_token_id=tokenizer.convert_tokens_to_ids("<|image_pad|>"),
        image_seq_length=4,
        downsample_ratio=0.5,
        **changes,
    )
    return config, processor


def _gemma3(**changes: Any) -> tuple[Any, Any]:
    """Its sliding-window layers have their own rotary embedding."""
    from transformers.models.gemma3.image_processing_pil_gemma3 import Gemma3ImageProcessorPil

    named = {"boi_token": GEMMA_IMAGE, "eoi_token": "<|vision_end|>"}
    tokenizer = make_tokenizer("<|im_end|>", image_token="<image>", **named)
    images = Gemma3ImageProcessorPil(size={"height": SIZE, "width": SIZE})
    processor = transformers.Gemma3Processor(
        images,
        tokenizer,
        image_seq_length=4,
        chat_template=CHATML.replace("IMAGE", GEMMA_IMAGE),
    )
    text = _text(
        tokenizer,
        "<|im_end|>",
        num_hidden_layers=3,
        head_dim=16,
        query_pre_attn_scalar=16,
        sliding_window=8,
        layer_types=["sliding_attention", "full_attention", "sliding_attention"],
        rope_parameters={
            "sliding_attention": {"rope_type": "default", "rope_theta": 100.0},
            "full_attention": {"rope_type": "linear", "factor": 4.0, "rope_theta": 10000.0},
        },
    )
    ids = tokenizer.convert_tokens_to_ids
    config = transformers.Gemma3Config(
        text_config=text,
        vision_config={"model_type": "siglip_vision_model", **_VISION, "vision_use_head": False},
        mm_tokens_per_image=4,
        image_token_index=ids("<image>"),
        boi_token_index=ids(GEMMA_IMAGE),
        eoi_token_index=ids("<|vision_end|>"),
        **changes,
    )
    return config, processor


def _mistral3(**changes: Any) -> tuple[Any, Any]:
    """Its processor is one of those that need torchvision."""
    import pytest  # here, since plugins/check makes models without pytest

    pytest.importorskip("torchvision", exc_type=ImportError)
    tokenizer = make_tokenizer("<|im_end|>", image_token="<image>")
    side = {"height": PATCH, "width": PATCH}
    images = transformers.PixtralImageProcessor(size={"longest_edge": SIZE}, patch_size=side)
    processor = transformers.PixtralProcessor(
        images,
        tokenizer,
        patch_size=PATCH,
        spatial_merge_size=2,
        chat_template=CHATML.replace("IMAGE", "<image>"),
        image_token="<image>",
        image_break_token="<global-img>",
        image_end_token="<|vision_end|>",
    )
    config = transformers.Mistral3Config(
        text_config={"model_type": "mistral", **_text(tokenizer, "<|im_end|>", head_dim=8)},
        vision_config=_VISION | {"model_type": "pixtral", "head_dim": 8},
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        spatial_merge_size=2,
        **changes,
    )
    return config, processor


FAMILIES: dict[str, Callable[..., tuple[Any, Any]]] = {
    "paligemma": _paligemma,
    "qwen2_5_vl": _qwen,
    "smolvlm": _smolvlm,
    "idefics3": _idefics3,
    "llava_onevision": _llava,
    "qwen2_vl": _qwen2,
    "qwen3_vl": _qwen3,
    "llava": _llava_1_5,
    "llava_next": _llava_next,
    "internvl": _internvl,
    "gemma3": _gemma3,
    "mistral3": _mistral3,
}
# Families of which nothing can be made without torchvision.
WITH_TORCHVISION = {"mistral3"}


def without_video(kind: type, images: Any, tokenizer: Any, template: str, **options: Any) -> Any:
    """The family's processor on a machine without torchvision, which only its video part needs."""

    class Images(kind):  # type: ignore[misc, valid-type]
        def check_argument_for_proper_class(self, name: str, argument: Any) -> Any:
            return (
                None
                if argument is None
                else super().check_argument_for_proper_class(name, argument)
            )

    processor = Images(images, tokenizer, None, chat_template=template, **options)
    processor.family_class, processor.options = kind.__name__, options
    return processor


def save_processor(processor: Any, folder: Path) -> None:
    """The files that `AutoProcessor` reads, in the layout of the hub's older repositories."""
    if not hasattr(processor, "family_class"):
        processor.save_pretrained(folder)
        return
    processor.tokenizer.save_pretrained(folder)
    processor.image_processor.save_pretrained(folder)
    (folder / "chat_template.jinja").write_text(processor.chat_template)
    (folder / "processor_config.json").write_text(
        json.dumps({"processor_class": processor.family_class, **processor.options})
    )


def write(
    family: str, folder: Path, seed: int = 0, dtype: torch.dtype = torch.float32, **changes: Any
) -> Path:
    """A model folder as the hub has them; equal arguments give equal weights."""
    config, processor = FAMILIES[family](**changes)
    kind = transformers.AutoModelForImageTextToText._model_mapping[type(config)]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = kind(config)
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if (
                    parameter.ndim == 1
                ):  # norms and biases: their usual initial values would hide mistakes
                    parameter += 0.1 * torch.randn_like(parameter)
                elif "lm_head" not in name and "embed_tokens" not in name:
                    parameter.copy_(torch.randn_like(parameter) / parameter[0].numel() ** 0.5)
    model.to(dtype).save_pretrained(folder)
    save_processor(processor, folder)
    return folder


# --- by hand, for comparison ----------------------------------------------------------------------


def load_processor(family: str, folder: Path) -> Any:
    """The processor as a user of transformers would build it, without the code under test."""
    written = (folder / "chat_template.jinja").exists()
    if not written or family == "idefics3" or is_torchvision_available():
        return transformers.AutoProcessor.from_pretrained(folder)
    _, made = FAMILIES[family]()
    return made


def prompt_of(family: str, text: str, images: int = 1) -> str:
    """The prompt for a question about images according to the family's own documentation."""
    pads = "<|vision_start|><|image_pad|><|vision_end|>" * images
    return {
        "paligemma": f"{'<image>' * images}answer en {text}",
        "qwen2_5_vl": f"<|im_start|>user\n{pads}{text}<|im_end|>\n<|im_start|>assistant\n",
        "smolvlm": f"<|im_start|>User:{'<image>' * images}{text}<end_of_utterance>\nAssistant:",
        "idefics3": f"<|im_start|>User:{'<image>' * images}{text}<end_of_utterance>\nAssistant:",
        "llava_onevision": "<|im_start|>user\n"
        + "<image>\n" * images
        + f"{text}<|im_end|>\n<|im_start|>assistant\n",
        "qwen2_vl": chatml("<|vision_start|><|image_pad|><|vision_end|>", text, images),
        "qwen3_vl": chatml("<|vision_start|><|image_pad|><|vision_end|>", text, images),
        "llava": chatml("<image>\n", text, images),
        "llava_next": chatml("<image>\n", text, images),
        "internvl": chatml("<|image_pad|>\n", text, images),
        "gemma3": chatml(GEMMA_IMAGE, text, images),
        "mistral3": chatml("<image>", text, images),
    }[family]


def chatml(image: str, text: str, images: int) -> str:
    shown = image * images
    return f"<|im_start|>user\n{shown}{text}<|im_end|>\n<|im_start|>assistant\n"
