"""`aegis extract` and `aegis insert` with what LeRobot's own policies save, in miniature."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import torch
import transformers
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from programs import command, remove, run
from safetensors.torch import load_file, save_model
from smolvla_in_miniature import hf, save_smolvla, save_vlm
from torch import Tensor, nn

WEIGHTS = "model.safetensors"
WIDTH, DEPTH, HEADS, KEY_HEADS, HEAD, MLP = 32, 2, 4, 1, 16, 64
PADDING = 64  # rows that transformers has behind pi0's vocabulary
BY = 0.05  # how far the VLM's weights are moved


def smolvla_gives_and_takes_its_vlm(folder: Path) -> str:
    """One that computes the first of its VLM's two layers, as SmolVLA 16 of 32."""
    home = remove(folder / "foreign-smolvla")
    home.mkdir()
    save_vlm(home / "base")
    save_smolvla(home / "start", home / "base", folder / "dataset", layers=1)
    policy = SmolVLAPolicy.from_pretrained(home / "start", strict=True)
    shake(policy.model.vlm_with_expert.vlm)
    policy.save_pretrained(home / "policy")
    report = there_and_back(home)
    probe(home)
    prefix, own = "model.vlm_with_expert.vlm.", load_file(home / "policy" / WEIGHTS)
    check_taken(home, {n.removeprefix(prefix): t for n, t in own.items() if n.startswith(prefix)})
    (kept,) = report["kept"]
    assert kept["what"] == "language layer 1", kept
    again = SmolVLAPolicy.from_pretrained(home / "back", strict=True)
    check_equal(policy, again)
    go_on(home, folder / "dataset")
    SmolVLAPolicy.from_pretrained(home / "after", strict=True)
    return f"{report['taken']} of {report['tensors']} tensors, {kept['what']} put back"


def pi0_gives_and_takes_its_vlm(folder: Path) -> str:
    said = _pi(folder, modeling_pi0, modeling_pi0.PI0Policy, PI0Config)
    probe(folder / "foreign-pi0")
    return said


def pi05_gives_and_takes_its_vlm(folder: Path) -> str:
    return _pi(folder, modeling_pi05, modeling_pi05.PI05Policy, PI05Config)


def pi0_fast_gives_its_vlm(folder: Path) -> str:
    """Its network alone, since the policy around it fetches its tokenizers."""
    home = remove(folder / "foreign-pi0_fast")
    home.mkdir()
    words = save_paligemma(home / "base")
    config = PI0FastConfig(device="cpu", dtype="float32")
    with small(modeling_pi0_fast, words):
        policy = nn.Module()
        policy.model = modeling_pi0_fast.PI0FastPytorch(config)
    shake(policy.model.paligemma_with_expert.paligemma)
    (home / "policy").mkdir()
    save_model(policy, str(home / "policy" / WEIGHTS))
    (home / "policy" / "config.json").write_text('{"type": "pi0_fast"}')
    report = there_and_back(home)
    return f"{report['taken']} of {report['tensors']} tensors"


def _pi(folder: Path, module: ModuleType, kind: Any, config: Any) -> str:
    home = remove(folder / f"foreign-{kind.name}")
    home.mkdir()
    words = save_paligemma(home / "base")
    features = {
        "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, hf.SIZE, hf.SIZE)),
        "observation.state": PolicyFeature(FeatureType.STATE, (4,)),
    }
    chosen = config(
        input_features=features,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        image_resolution=(hf.SIZE, hf.SIZE),
        device="cpu",
        push_to_hub=False,
    )
    with small(module, words):
        policy = kind(chosen)
        shake(policy.model.paligemma_with_expert.paligemma)
        policy.save_pretrained(home / "policy")
        report = there_and_back(home)
        again = kind.from_pretrained(home / "back", strict=True)
    check_equal(policy, again)
    own = policy.model.paligemma_with_expert.paligemma.state_dict()
    base = load_file(home / "base" / WEIGHTS)
    taken = load_file(home / "vlm" / WEIGHTS)
    table = "model.language_model.embed_tokens.weight"
    # Of the words that pi0 does not have, the rows are the base's.
    rest = next(tensor for name, tensor in base.items() if name.endswith("embed_tokens.weight"))
    own[table] = torch.cat([own[table], rest[words:]])
    found = transformers.AutoModelForImageTextToText.from_pretrained(home / "vlm").state_dict()
    unequal = [name for name, tensor in found.items() if not torch.equal(tensor, own[name])]
    # Its head is not tied to its table in LeRobot, and PaliGemma has no other head.
    assert set(unequal) <= {"lm_head.weight"}, unequal[:3]
    kept = sum(share["parameters"] for share in report["kept"])
    assert kept == PADDING * WIDTH and len(taken) == report["taken"], report["kept"]
    return f"{report['taken']} of {report['tensors']} tensors, {PADDING} rows of words put back"


def there_and_back(home: Path) -> dict[str, Any]:
    """Extract and insert; what `aegis extract` says, after the files were compared."""
    out = ("--out", home / "vlm", "--json")
    done = run("aegis", "extract", home / "policy", "--base", home / "base", *out)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["moved"] == report["taken"] and report["rounded"] == 0, report
    command("aegis", "insert", home / "vlm", "--into", home / "policy", "--out", home / "back")
    for path in (home / "policy").iterdir():
        same = path.read_bytes() == (home / "back" / path.name).read_bytes()
        assert same, f"'{path.name}' is another one"
    return report


def probe(home: Path) -> None:
    """Measure what the policy has forgotten, if only whether that can be done."""
    command("aegis", "probe", home / "vlm", "--baseline", home / "base", "--questions", "14")


def go_on(home: Path, dataset: Path) -> None:
    """Train the extracted VLM further with a new expert, merge it, and put it into the policy."""
    anchor, run, vlm = home / "anchor.safetensors", home / "run", home / "vlm"
    measured = ("--samples", "20", "--parts", "inputs", "--out", anchor)
    command("aegis", "anchor", "--backbone", vlm, *measured)
    settings = (f"backbone={vlm}", "train.steps=4", "train.warmup=1", "train.batch_size=4")
    changes = [word for each in settings for word in ("--set", each)]
    given = ("--demos", dataset, "--anchor", anchor, "--out", run)
    command("aegis", "train", "quickstart", "--method", "nullspace", *given, *changes)
    half = ("--method", "linear", "--strength", "0.5", "--out", home / "merged")
    command("aegis", "merge", run, *half)
    command("aegis", "insert", home / "merged", "--into", home / "policy", "--out", home / "after")


def check_taken(home: Path, own: Mapping[str, Tensor]) -> None:
    """What was taken out is what LeRobot saved, and all else the base's."""
    base, taken = load_file(home / "base" / WEIGHTS), load_file(home / "vlm" / WEIGHTS)
    assert own and taken.keys() == base.keys()
    unequal = [n for n, t in taken.items() if not torch.equal(t, own.get(n, base[n]))]
    assert not unequal, unequal[:3]


def check_equal(one: nn.Module, other: nn.Module) -> None:
    own, found = one.state_dict(), other.state_dict()
    unequal = [name for name, tensor in own.items() if not torch.equal(tensor, found[name])]
    assert not unequal, unequal[:3]


def shake(vlm: nn.Module) -> None:
    """Move all weights, as a training would."""
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in vlm.parameters():
            parameter += BY * torch.randn_like(parameter)


# --- pi0 in miniature -----------------------------------------------------------------------------


def save_paligemma(folder: Path) -> int:
    """The first PaliGemma, untrained, with a padded vocabulary; how many words pi0 has of it."""
    config, processor = hf.FAMILIES["paligemma"]()
    text = config.text_config
    words = text.vocab_size
    config.text_config = transformers.GemmaConfig(
        vocab_size=words + PADDING,
        hidden_size=WIDTH,
        intermediate_size=MLP,
        num_hidden_layers=DEPTH,
        num_attention_heads=HEADS,
        num_key_value_heads=KEY_HEADS,
        head_dim=HEAD,
        pad_token_id=text.pad_token_id,
        bos_token_id=text.bos_token_id,
        eos_token_id=text.eos_token_id,
    )
    torch.manual_seed(0)
    transformers.PaliGemmaForConditionalGeneration(config).save_pretrained(folder)
    hf.save_processor(processor, folder)
    return words


def small(module: ModuleType, words: int) -> Any:
    """Inside the block, LeRobot's classes of pi0 make models of a few thousand weights."""
    sizes = modeling_pi0.GemmaConfig(WIDTH, DEPTH, MLP, HEADS, KEY_HEADS, HEAD)
    of_expert = modeling_pi0.GemmaConfig(WIDTH // 2, DEPTH, MLP, HEADS, KEY_HEADS, HEAD)
    made: Callable[..., Any] = module.PaliGemmaForConditionalGenerationWithPiGemma

    def paligemma(config: Any) -> Any:
        base, _ = hf.FAMILIES["paligemma"]()
        config.vision_config = base.vision_config
        config.vision_config.projection_dim = WIDTH
        config.text_config.vocab_size = words
        return made(config=config)

    changes = {
        "get_gemma_config": lambda name: sizes if name == "gemma_2b" else of_expert,
        "PaliGemmaForConditionalGenerationWithPiGemma": paligemma,
    }
    if hasattr(module, "PiGemmaForCausalLM"):
        expert: Callable[..., Any] = module.PiGemmaForCausalLM

        def smaller(config: Any) -> Any:
            config.vocab_size = words
            return expert(config=config)

        changes["PiGemmaForCausalLM"] = smaller
    return mock.patch.multiple(module, **changes)
