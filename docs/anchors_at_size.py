"""What an anchor costs at the true shape of SmolVLM2-256M: the table of docs/performance.md.

    PYTHONPATH=tests python docs/anchors_at_size.py --part inputs --questions 30

The model has random weights and is made from its configuration alone, so nothing is downloaded. It
is asked about rendered scenes at 512 px. What is printed: the CPU seconds of one thread, the peak
memory of the process, the size of the file, and how many directions some maps keep. `moments` and
`backward` (a forward and a backward pass, nothing else) are what the others are compared with. Each
part has to run in a process of its own, since a peak never falls.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
import transformers
from samples import hf
from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil

from aegis_cli.anchors import anchor_file, curvature, inputs, moments, passes
from aegis_cli.common.events import ignore
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data.vqa.dataset import VQASet, load_scenes
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone

PIXELS, PATCH, SCALE = 512, 16, 4
ENERGY = 0.9999


def write_model(folder: Path, layers: int, vision_layers: int) -> None:
    """Write a model folder with random weights; 30 and 12 layers are the true shape."""
    tokenizer = hf.make_tokenizer(
        "<end_of_utterance>", image_token="<image>", fake_image_token="<fake_token_around_image>"
    )
    edge = {"longest_edge": PIXELS}
    images = SmolVLMImageProcessorPil(size=edge, max_image_size=edge, do_image_splitting=False)
    tokens = (PIXELS // PATCH // SCALE) ** 2
    processor = hf.without_video(
        transformers.SmolVLMProcessor, images, tokenizer, hf.SMOL, image_seq_len=tokens
    )
    torch.manual_seed(0)
    model = transformers.SmolVLMForConditionalGeneration(_config(tokenizer, layers, vision_layers))
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if parameter.ndim == 1:
                parameter += 0.1 * torch.randn_like(parameter)
            elif "lm_head" not in name and "embed_tokens" not in name:
                parameter.copy_(torch.randn_like(parameter) / parameter[0].numel() ** 0.5)
    model.save_pretrained(folder)
    hf.save_processor(processor, folder)


def _config(tokenizer: Any, layers: int, vision_layers: int) -> transformers.SmolVLMConfig:
    ids = tokenizer.convert_tokens_to_ids
    text = {
        "model_type": "llama",
        "vocab_size": 49280,
        "hidden_size": 576,
        "intermediate_size": 1536,
        "num_hidden_layers": layers,
        "num_attention_heads": 9,
        "num_key_value_heads": 3,
        "max_position_embeddings": 8192,
        "initializer_range": 0.04,
        "pad_token_id": ids("<pad>"),
        "bos_token_id": ids("<bos>"),
        "eos_token_id": ids("<end_of_utterance>"),
    }
    vision = {
        "hidden_size": 768,
        "intermediate_size": 3072,
        "num_hidden_layers": vision_layers,
        "num_attention_heads": 12,
        "image_size": PIXELS,
        "patch_size": PATCH,
    }
    return transformers.SmolVLMConfig(
        text_config=text,
        vision_config=vision,
        image_token_id=ids("<image>"),
        scale_factor=SCALE,
        tie_word_embeddings=False,
    )


def measure(
    part: str, model: Backbone, asked: VQASet, batch: int, memory: int | None, tokens: float
) -> Anchor:
    """The part of an anchor; nothing of a mere backward pass."""
    if part == "moments":
        image, text = moments.measure(model, asked.batches(batch), len(asked.questions))
        return Anchor(image, text)
    if part == "inputs":
        drawn = inputs.Drawn(tokens)
        found = inputs.measure(model, asked, ENERGY, batch, memory=memory, drawn=drawn)
        return Anchor(inputs=found)
    if part == "curvature":
        return Anchor(curvature=curvature.measure(model, asked, ENERGY, 0, batch, memory=memory))
    for answered in passes.run(model, asked, batch, part, ignore):
        total = answered.scores.float().log_softmax(-1).amax(-1).sum()
        torch.autograd.grad(total, list(model.parameters()), allow_unused=True)
    return Anchor()


def _kept(name: str, spectrum: Spectrum) -> str:
    assert spectrum.vectors is not None
    width, kept = spectrum.vectors.shape
    share = spectrum.values[:kept].sum() / spectrum.values.sum()
    how = "exact" if spectrum.whole else "sketch"
    return f"{name}: {kept} of {width}, {100 * share:.2f} % of the energy, {how}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--part", choices=("moments", "backward", "inputs", "curvature"), default="inputs"
    )
    parser.add_argument("--questions", type=int, default=30)
    parser.add_argument("--batch-size", type=int, default=2)
    parser.add_argument("--memory", type=int, help="MB that the sums may take")
    parser.add_argument("--tokens", type=float, default=1.0, help="share that inputs count")
    parser.add_argument("--layers", type=int, default=30)
    parser.add_argument("--vision-layers", type=int, default=12)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        # In a process of its own, whose memory does not count.
        shape = (Path(folder), given.layers, given.vision_layers)
        making = multiprocessing.get_context("spawn").Process(target=write_model, args=shape)
        making.start()
        making.join()
        model = backbones.load(folder)
        asked = load_scenes("anchor", given.questions).sized(model.image_size)
        memory = None if given.memory is None else given.memory * 10**6
        start = time.process_time()
        anchor = measure(given.part, model, asked, given.batch_size, memory, given.tokens)
        seconds = time.process_time() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"{given.part}: {seconds:.1f} CPU s, peak {peak:.2f} GB")
        spectra = anchor.inputs or anchor.curvature
        if not spectra:
            return
        path = Path(folder) / "anchor.safetensors"
        anchor_file.save(path, anchor, fingerprint="0" * 64, meta={})
        print(f"file: {path.stat().st_size / 1e6:.0f} MB")
        for name, spectrum in spectra.items():
            if spectrum.kind == "dense" and (".0." in name or "layers" not in name):
                print(_kept(name, spectrum))


if __name__ == "__main__":
    main()
