"""The settings by which a model's inputs are made: anchors, runs and probes belong to them."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from samples.command import refused as refused_in
from samples.hf import save_processor, write
from samples.small_run import recipe as small

from aegis_cli.anchors import anchor_file
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.evaluation import probe
from aegis_cli.models import backbones
from aegis_cli.models.backbones import preparation
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.training import checkpoint, dry_run, train

Made, Loaded = Callable[[str], Path], Callable[[str], Backbone]  # by a family's name
IMAGES = "preprocessor_config.json"
MEAN = "image_mean [0.4, 0.4, 0.4] instead of [0.5, 0.5, 0.5]"


def change(folder: Path, **values: Any) -> Path:
    """Change settings of a model's images in its folder."""
    path = folder / IMAGES
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    return folder


@pytest.fixture
def edited(hf_folder: Made, tmp_path: Path) -> Path:
    """A copy of a model with the same weights, whose images have another mean."""
    copied = shutil.copytree(hf_folder("smolvlm"), tmp_path / "edited")
    return change(copied, image_mean=[0.4, 0.4, 0.4])


@pytest.mark.parametrize("name", FAMILIES)
def test_settings_outlast_being_saved_by_us_and_by_transformers(
    name: str, hf_backbone: Loaded, tmp_path: Path
) -> None:
    """Else a run could not be resumed, nor compared with the model that it began with."""
    backbone = hf_backbone(name)
    assert isinstance(backbone, HFBackbone)
    known = backbone.preparation()
    assert {"image_mean", "size", "chat template", "vocabulary"} <= known.keys()
    backbone.save(tmp_path / "ours")
    assert backbones.load(str(tmp_path / "ours")).preparation() == known
    theirs = shutil.copytree(tmp_path / "ours", tmp_path / "theirs")
    with backbone._prompter._processors.one() as processor:
        for part in (processor.image_processor, processor.tokenizer):
            part.save_pretrained(theirs)
        if getattr(processor, "video_processor", "none") == "none":
            save_processor(processor, theirs)
    assert backbones.load(str(theirs)).preparation() == known


@pytest.mark.parametrize(
    ("file", "old", "new", "name"),
    [
        (IMAGES, '"do_image_splitting": false', '"do_image_splitting": true', "do_image_splitting"),
        (IMAGES, '"resample": 1', '"resample": 3', "resample"),
        ("chat_template.jinja", "Assistant:", "Robot:", "chat template"),
        ("tokenizer.json", '"<global-img>"', '"<global-image>"', "vocabulary"),
    ],
)
def test_each_change_of_what_the_model_is_shown_is_named(
    file: str, old: str, new: str, name: str, hf_folder: Made, tmp_path: Path
) -> None:
    copied = shutil.copytree(hf_folder("smolvlm"), tmp_path / "changed")
    content = (copied / file).read_text()
    assert old in content
    (copied / file).write_text(content.replace(old, new))
    then = backbones.load(str(hf_folder("smolvlm")))
    now = backbones.load(str(copied))
    assert now.fingerprint() == then.fingerprint()
    found = preparation.differing(now.preparation(), then.preparation())
    assert found is not None and name in found


def test_a_setting_that_only_one_side_has_is_no_difference() -> None:
    assert preparation.differing({"size": "1", "new": "2"}, {"size": "1"}) is None
    assert preparation.differing({"size": "1"}, {}) is None
    assert preparation.differing({"size": "1"}, {"size": "2"}) == "size 1 instead of 2"


def test_training_refuses_an_anchor_of_other_images(
    edited: Path, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(AegisError) as refused:
        dry_run.run(small(edited), "aegis", demos_file, hf_anchor("smolvlm"), tmp_path / "out")
    assert MEAN in refused.value.found and str(hf_anchor("smolvlm")) in refused.value.found
    assert "measure the anchor again" in refused.value.fix


def test_an_anchor_of_before_is_read_with_any_settings(
    edited: Path, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    known = artifacts.load(hf_anchor("smolvlm"))
    meta = {name: value for name, value in known.header.meta.items() if name != preparation.META}
    assert len(meta) == len(known.header.meta) - 1
    fingerprint, path = known.header.fingerprint, tmp_path / "before.safetensors"
    assert fingerprint is not None
    anchor_file.save(path, anchor_file.from_artifact(known), fingerprint=fingerprint, meta=meta)
    dry_run.run(small(edited), "aegis", demos_file, path, tmp_path / "out")


def test_a_probe_warns_of_a_baseline_that_is_shown_other_images_and_does_not_judge(
    edited: Path, hf_folder: Made
) -> None:
    target, seen = str(hf_folder("smolvlm")), list[Event]()
    asked = {"target": target, "vqa": "scenes", "questions": 14, "anchor": None}
    probe.run(**asked, baseline=str(edited), max_drop=None, on_event=seen.append)
    mean = "image_mean [0.5, 0.5, 0.5] instead of [0.4, 0.4, 0.4]"
    (told,) = [e.text for e in seen if isinstance(e, Warned) and mean in e.text]
    assert "a drop is not that of the weights alone" in told
    with pytest.raises(AegisError) as refused:
        probe.run(**asked, baseline=str(edited), max_drop=5.0)
    assert mean in refused.value.found and "gate" in refused.value.expected
    assert probe.run(**asked, baseline=target, max_drop=5.0).passed


def test_a_probe_refuses_an_anchor_of_other_images(edited: Path, hf_anchor: Made) -> None:
    with pytest.raises(AegisError) as refused:
        probe.run(str(edited), "scenes", 14, None, hf_anchor("smolvlm"), None)
    assert MEAN in refused.value.found


def test_a_run_goes_on_only_with_the_images_that_it_began_with(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    own, out = shutil.copytree(hf_folder("smolvlm"), tmp_path / "own"), tmp_path / "run"
    settings = small(own, steps=2, checkpoint_every=2)
    train.run(settings, "naive", demos_file, None, out)
    longer = dataclasses.replace(settings, train=dataclasses.replace(settings.train, steps=4))
    change(own, image_mean=[0.4, 0.4, 0.4])
    with pytest.raises(AegisError) as refused:
        train.run(longer, "naive", demos_file, None, out, resume=True)
    assert MEAN in refused.value.found and "began" in refused.value.found
    change(own, image_mean=[0.5, 0.5, 0.5])
    train.run(longer, "naive", demos_file, None, out, resume=True)
    assert checkpoint.last(out).resolve().name == "000004"


def test_a_merge_warns_of_a_base_that_is_shown_other_images_and_does_not_judge(
    edited: Path, aegis: Callable[..., Any], tmp_path: Path
) -> None:
    tuned, mean = write("smolvlm", tmp_path / "tuned", seed=1), "image_mean [0.5, 0.5, 0.5] instead"
    words = ("merge", tuned, "--base", edited, "--method", "linear")
    code, _, err = aegis(*words, "--strength", 0.5, "--out", tmp_path / "merged")
    assert code == 0 and mean in " ".join(err.split())
    gate = ("--sweep", 1, "--max-drop", 5, "--out", tmp_path / "judged")
    assert mean in " ".join(refused_in(aegis(*words, *gate)).split())
    assert not (tmp_path / "judged").exists()


def test_the_embedded_models_record_no_settings(anchor_file: Path, tiny_folder: Path) -> None:
    assert backbones.load(str(tiny_folder)).preparation() == {}
    assert preparation.META not in artifacts.read_header(anchor_file).meta
