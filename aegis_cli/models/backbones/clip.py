"""CLIP through transformers, as a dual encoder.

It keeps the model's own towers, tokenizer and pixel statistics.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import transformers
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.common.errors import AegisError
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.dual import DualEncoder, early_layer
from aegis_cli.models.backbones.from_hub import SAFE, complete, loading, quiet

_SITES = ("self_attn.out_proj", "mlp.fc1", "mlp.fc2")  # maps in each layer of both towers


class CLIPEncoder(DualEncoder):
    """A `CLIPModel` with its tokenizer.

    Images come as squares of `image_size`: the caller has resized the shorter side and cropped the
    centre, as CLIP's own processor does, so only rescaling and normalisation are left.
    """

    _mean: Tensor
    _std: Tensor

    def __init__(
        self,
        model: transformers.CLIPModel,
        tokenizer: transformers.PreTrainedTokenizerBase,
        mean: Sequence[float],
        std: Sequence[float],
        files: Mapping[str, bytes],
    ) -> None:
        """A CLIP model with its processor.

        `mean` and `std` are those of the three channels in [0, 1]; `files` are the processor's
        files, which `save` writes.
        """
        super().__init__()
        self.clip, self._tokenizer, self._files = model.eval(), tokenizer, dict(files)
        side = model.vision_model.config.image_size
        assert isinstance(side, int)
        self.image_size = side
        self.width = model.visual_projection.out_features
        self._longest = model.text_model.config.max_position_embeddings
        for name, values in (("_mean", mean), ("_std", std)):
            per_channel = torch.tensor(values, dtype=torch.float32).view(3, 1, 1)
            # They belong to the processor's files, and would change the weights' fingerprint.
            self.register_buffer(name, per_channel, persistent=False)

    def pixels(self, images: Tensor) -> Tensor:
        shares = images.to(self.device).permute(0, 3, 1, 2).float() / 255  # [B, 3, S, S]
        return (shares - self._mean) / self._std

    def image_features(self, pixels: Tensor) -> Tensor:
        found = self.clip.get_image_features(pixel_values=pixels)
        return F.normalize(found.pooler_output.float(), dim=-1)

    def looks(self, pixels: Tensor) -> Tensor:
        """The class token is among the positions."""
        seen = self.clip.vision_model(pixel_values=pixels, output_hidden_states=True)
        hidden = seen.hidden_states  # the embeddings, then each layer's output [B, T, W]
        return hidden[early_layer(len(hidden) - 1)].mean(1).float()

    def text_features(self, texts: Sequence[str]) -> Tensor:
        tokens = self._tokenizer(list(texts), padding=True, return_tensors="pt").to(self.device)
        if tokens["input_ids"].shape[1] > self._longest:
            longest = max(texts, key=lambda text: len(self._tokenizer(text)["input_ids"]))
            found = f"a text of more than {self._longest} tokens: '{longest[:60]}…'"
            raise AegisError(found, "a shorter text", "shorten the class or the template")
        found = self.clip.get_text_features(
            input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
        )
        return F.normalize(found.pooler_output.float(), dim=-1)

    def scale(self) -> Tensor:
        return self.clip.logit_scale.exp()

    def sites(self) -> dict[str, nn.Linear]:
        return {
            f"clip.{name}": module
            for name, module in self.clip.named_modules()
            if ".layers." in name and name.endswith(_SITES) and isinstance(module, nn.Linear)
        }

    def in_text(self, site: str) -> bool:
        return site.startswith("clip.text_model.")

    def save(self, folder: Path) -> None:
        """A folder that `CLIPModel.from_pretrained` loads."""
        folder.mkdir(parents=True, exist_ok=True)
        with quiet():
            self.clip.save_pretrained(folder, max_shard_size="1000TB")
        # safetensors makes the file readable by its owner only.
        shutil.copymode(folder / "config.json", folder / "model.safetensors")
        for name, content in self._files.items():
            (folder / name).write_bytes(content)


def load(folder: Path) -> CLIPEncoder:
    """Load the model in a folder, in float32 whatever dtype it is stored in.

    Raises:
        AegisError: it is another kind of model, has missing or unexpected weights, or has no
            processor.
    """
    with quiet(), loading(folder, "model"):
        config = transformers.AutoConfig.from_pretrained(folder, **SAFE)
        if config.model_type != "clip":
            raise AegisError(
                f"'{folder}' is a '{config.model_type}' model",
                "a CLIP model",
                "give the folder of a CLIP model",
            )
        model = complete(transformers.CLIPModel, folder, config)
    model_folder.check_processor(folder)
    with quiet(), loading(folder, "processor"):
        tokenizer = transformers.AutoTokenizer.from_pretrained(folder, **SAFE)
        settings, _ = transformers.CLIPImageProcessor.get_image_processor_dict(folder, **SAFE)
        mean, std = settings["image_mean"], settings["image_std"]
    assert tokenizer is not None
    return CLIPEncoder(model, tokenizer, mean, std, model_folder.processor_files(folder)).eval()
