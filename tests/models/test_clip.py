"""CLIP as a dual encoder: its own features, strict loading, and its processor's crop."""

from __future__ import annotations

import errno
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import transformers
from PIL import Image
from samples.command import refused
from samples.hf import make_tokenizer
from torch import Tensor
from torch.nn import functional as F

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.continual import images
from aegis_cli.continual.report import ImageStreamReport, TaskRecord, sums
from aegis_cli.core.accuracy_matrix import scores
from aegis_cli.data.streams import folders, mtil
from aegis_cli.models.backbones import EMBEDDED_DUAL, clip, load_dual
from aegis_cli.models.backbones.dual import class_weights
from aegis_cli.recipes import StreamRecipe

SIZE = 16
CLASSES = ("red fox", "tabby cat", "zebra")


def _write_model(folder: Path) -> None:
    tokenizer = make_tokenizer("<eos>")
    tower = {
        "hidden_size": 16,
        "intermediate_size": 24,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "initializer_range": 0.3,
    }
    ids = {
        f"{name}_token_id": tokenizer.convert_tokens_to_ids(f"<{name}>")
        for name in ("bos", "eos", "pad")
    }
    config = transformers.CLIPConfig(
        text_config=tower | {"vocab_size": len(tokenizer), "max_position_embeddings": 24} | ids,
        vision_config=tower | {"image_size": SIZE, "patch_size": 8},
        projection_dim=8,
    )
    torch.manual_seed(0)
    transformers.CLIPModel(config).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    _images_processor().save_pretrained(folder)


def _images_processor() -> transformers.BaseImageProcessor:
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    return CLIPImageProcessorPil(
        size={"shortest_edge": SIZE}, crop_size={"height": SIZE, "width": SIZE}
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip")
    _write_model(path)
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of several sizes, ten per class and part."""
    root = tmp_path_factory.mktemp("data")
    rng = np.random.default_rng(0)
    for part, count in (("train", 10), ("test", 4)):
        for name in CLASSES:
            where = root / "animals" / part / name.replace(" ", "_")
            where.mkdir(parents=True)
            for i in range(count):
                height, width = rng.integers(SIZE // 2, 3 * SIZE, 2)
                Image.fromarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)).save(
                    where / f"{i:02d}.png"
                )
    return root


def _images(count: int, seed: int = 0) -> Tensor:
    return torch.randint(
        0,
        256,
        (count, SIZE, SIZE, 3),
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.uint8,
    )


@torch.no_grad()
def test_features_are_the_models_own(folder: Path) -> None:
    encoder, images, texts = clip.load(folder), _images(5), ["a photo of a red fox.", "zebra"]
    model, tokenizer = (
        transformers.CLIPModel.from_pretrained(folder).eval(),
        transformers.AutoTokenizer.from_pretrained(folder),
    )
    pixels = _images_processor()(images=list(images.numpy()), return_tensors="pt")["pixel_values"]
    own = model(
        pixel_values=pixels,
        **{
            k: v
            for k, v in tokenizer(texts, padding=True, return_tensors="pt").items()
            if k != "token_type_ids"
        },
    )
    found = (
        encoder.scale()
        * encoder.image_features(encoder.pixels(images))
        @ encoder.text_features(texts).T
    )
    assert torch.allclose(found, own.logits_per_image, atol=1e-4)
    assert (
        found.std() > 0.01
    )  # the towers distinguish images and texts, so equality means something


@torch.no_grad()
def test_features_have_length_one_and_do_not_depend_on_their_neighbours(folder: Path) -> None:
    encoder, images, texts = (
        clip.load(folder),
        _images(6),
        ["a", "a photo of a tabby cat.", "zebra"],
    )
    seen, read = encoder.image_features(encoder.pixels(images)), encoder.text_features(texts)
    assert seen.shape == (6, encoder.width) and read.shape == (3, encoder.width)
    assert torch.allclose(torch.cat([seen, read]).norm(dim=-1), torch.ones(9), atol=1e-5)
    assert torch.allclose(encoder.image_features(encoder.pixels(images[2:3])), seen[2:3], atol=1e-5)
    assert torch.allclose(
        encoder.text_features(texts[:1]), read[:1], atol=1e-5
    )  # padding beside a longer text changes nothing


@torch.no_grad()
def test_looks_are_means_over_positions_of_a_layer_two_thirds_up(folder: Path) -> None:
    encoder = clip.load(folder)
    pixels = encoder.pixels(_images(4))
    hidden = encoder.clip.vision_model(pixel_values=pixels, output_hidden_states=True).hidden_states
    layer = 2 * (len(hidden) - 1) // 3
    assert 1 <= layer < len(hidden) - 1
    assert torch.equal(encoder.looks(pixels), hidden[layer].mean(1))
    assert torch.allclose(encoder.looks(pixels[2:3]), encoder.looks(pixels)[2:3], atol=1e-5)
    assert {name.split(".")[1] for name in encoder.sites() if encoder.in_text(name)} == {
        "text_model"
    }
    assert {name.split(".")[1] for name in encoder.sites() if not encoder.in_text(name)} == {
        "vision_model"
    }


def test_sites_are_the_mlp_and_attention_output_maps_of_both_towers(folder: Path) -> None:
    encoder = clip.load(folder)
    sites = encoder.sites()
    assert len(sites) == 2 * 2 * 3 and all(
        encoder.get_submodule(name) is module for name, module in sites.items()
    )
    assert {name.split(".")[1] for name in sites} == {"text_model", "vision_model"}
    assert {name.split(".", 5)[-1] for name in sites} == {
        "self_attn.out_proj",
        "mlp.fc1",
        "mlp.fc2",
    }
    for name, module in sites.items():  # each is really on the path from input to feature
        (
            encoder.image_features(encoder.pixels(_images(1)))
            if "vision" in name
            else encoder.text_features(["zebra"])
        ).sum().backward()
        assert module.weight.grad is not None and module.weight.grad.abs().sum() > 0, name


def test_what_is_saved_loads_to_the_same_features(folder: Path, tmp_path: Path) -> None:
    encoder = clip.load(folder)
    with torch.no_grad():
        next(iter(encoder.sites().values())).weight.add_(0.5)
    encoder.save(tmp_path / "copy")
    again = clip.load(tmp_path / "copy")
    assert again.fingerprint() == encoder.fingerprint() != clip.load(folder).fingerprint()
    assert torch.equal(again.text_features(["zebra"]), encoder.text_features(["zebra"]))
    assert (
        transformers.CLIPModel.from_pretrained(tmp_path / "copy").config.projection_dim
        == encoder.width
    )


@torch.no_grad()
def test_a_class_is_the_mean_over_its_templates(folder: Path) -> None:
    encoder, templates = clip.load(folder), ("a photo of a {}.", "the {}")
    weights = class_weights(encoder, CLASSES, templates)
    by_hand = [
        F.normalize(sum(encoder.text_features([t.format(c)])[0] for t in templates), dim=0)
        for c in CLASSES
    ]
    assert torch.allclose(weights, torch.stack(by_hand), atol=1e-5)


def test_images_are_cut_as_the_models_processor_cuts_them(folder: Path, dataset: Path) -> None:
    encoder, files = clip.load(folder), sorted((dataset / "animals" / "train").rglob("*.png"))
    own = _images_processor()(
        images=[Image.open(f).convert("RGB") for f in files], return_tensors="pt"
    )["pixel_values"]
    assert torch.allclose(encoder.pixels(folders.decode(files, SIZE)), own, atol=1e-5)


def test_a_folder_becomes_a_task(dataset: Path) -> None:
    task = folders.load(dataset, "animals", SIZE)
    assert task.classes == CLASSES and task.templates == (folders.TEMPLATE,)
    # The shipped encoder can read it, with words that it knows.
    load_dual(EMBEDDED_DUAL).tokenizer.encode(folders.TEMPLATE.format("circle"))
    assert (len(task.test), len(task.train) + len(task.validation)) == (12, 30) and len(
        task.validation
    ) >= 1
    rows = torch.tensor([0, 11, 5])
    assert (
        task.test.images(rows).shape == (3, SIZE, SIZE, 3)
        and task.test.images(rows).dtype == torch.uint8
    )
    assert torch.equal(task.test.images(rows)[1], task.test.images(torch.tensor([11]))[0])
    assert task.test.labels.tolist() == [0] * 4 + [1] * 4 + [2] * 4


def told(encoder: Path, root: Path) -> list[str]:
    """The warnings about a stream of the folder's task before training."""
    heard: list[Event] = []
    where = {"encoder": str(encoder), "path": str(root)}
    made = StreamRecipe(name="own", stream="own", order=("animals",), **where)
    images.build(made, root.parent / "run", heard.append)
    return [event.text for event in heard if isinstance(event, Warned)]


@pytest.mark.parametrize("part", ["test", "validation"])
def test_a_held_out_image_that_is_also_learned_from_is_told(
    part: str, folder: Path, dataset: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    assert not told(folder, root)
    source = root / "animals" / "train" / "zebra" / "00.png"
    copy = root / "animals" / part / "red_fox" / "copy.png"
    copy.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, copy)
    (text,) = told(folder, root)
    # 12 images to test on, and one or more to validate on
    assert text.startswith("1 of the 1") and f"'{copy}' is '{source}'" in text


def test_copies_of_training_images_that_are_held_back_are_told(
    folder: Path, dataset: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    source = root / "animals" / "train" / "zebra" / "00.png"
    for number in range(40):
        shutil.copy(source, source.with_name(f"copy{number}.png"))
    held_back = len(folders.load(root, "animals", SIZE).validation)
    (text,) = told(folder, root)
    assert 1 <= int(text.split()[0]) <= held_back


def test_an_images_part_does_not_depend_on_the_others(dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    before = {
        tuple(image.flatten().tolist())
        for image in folders.load(root, "animals", SIZE).validation.images(torch.tensor([0]))
    }
    for extra in range(40):
        source = root / "animals" / "train" / "zebra" / "00.png"
        shutil.copy(source, source.with_name(f"more{extra}.png"))
    part = folders.load(root, "animals", SIZE).validation
    after = {tuple(image.flatten().tolist()) for image in part.images(torch.arange(len(part)))}
    assert len(part) > 1 and before <= after


def shortened(dataset: Path, out: Path, images: dict[str, int]) -> Path:
    """A copy in which this many training images of these classes remain."""
    root = shutil.copytree(dataset, out)
    for name, count in images.items():
        for path in sorted((root / "animals" / "train" / name).iterdir())[count:]:
            path.unlink()
    return root


@pytest.mark.parametrize("first", range(10))
def test_something_of_every_class_is_left_to_learn_from(
    first: int, dataset: Path, tmp_path: Path
) -> None:
    """Whichever image a class has, and also if all other classes have a single one."""
    root = shortened(dataset, tmp_path / "copy", {"red_fox": 1, "tabby_cat": 1})
    for name in ("red_fox", "tabby_cat"):
        (only,) = (root / "animals" / "train" / name).iterdir()
        only.rename(only.with_name(f"other{first}.png"))
    task = folders.load(root, "animals", SIZE)
    assert set(task.train.labels.tolist()) == {0, 1, 2} and set(
        task.validation.labels.tolist()
    ) == {2}
    assert len(task.train) + len(task.validation) == 12


def test_one_image_of_each_class_leaves_none_to_validate_on(dataset: Path, tmp_path: Path) -> None:
    root = shortened(dataset, tmp_path / "copy", {"red_fox": 1, "tabby_cat": 1, "zebra": 1})
    with pytest.raises(AegisError, match="one image of each class"):
        folders.load(root, "animals", SIZE)
    shutil.copytree(root / "animals" / "train", root / "animals" / "validation")
    assert len(folders.load(root, "animals", SIZE).train) == 3


@pytest.mark.parametrize("place", [".thumbnails/00.png", "close/.cache/00.png", ".00.png"])
def test_hidden_files_and_folders_hold_no_images(place: str, dataset: Path, tmp_path: Path) -> None:
    """They belong to some program, such as thumbnails of the images."""
    root = shutil.copytree(dataset, tmp_path / "copy")
    kept = root / "animals" / "test" / "zebra"
    (kept / place).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(kept / "00.png", kept / place)
    assert len(folders.load(root, "animals", SIZE).test) == 12
    (kept / "close").mkdir(exist_ok=True)
    shutil.copy(kept / "00.png", kept / "close" / "00.png")  # those of a plain folder are read
    assert len(folders.load(root, "animals", SIZE).test) == 13


def test_words_for_folders(dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    (root / "animals" / folders.CLASSES).write_text(json.dumps({"zebra": "striped horse"}))
    assert folders.load(root, "animals", SIZE).classes == ("red fox", "tabby cat", "striped horse")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda task: shutil.rmtree(task / "test"), "no folder"),
        (lambda task: (task / "test" / "lion").mkdir(), "lion"),
        (
            lambda task: [shutil.rmtree(task / "train" / c) for c in ("red_fox", "tabby_cat")],
            "1 folders",
        ),
        (lambda task: [p.unlink() for p in (task / "test").rglob("*.png")], "no image"),
        (lambda task: (task / folders.CLASSES).write_text("{"), "not JSON"),
        (
            lambda task: (task / folders.CLASSES).write_text('{"zebra": 3}'),
            "values that are not words",
        ),
        (lambda task: (task / folders.CLASSES).write_text('{"wolf": "wolf"}'), "wolf"),
        (
            lambda task: (task / folders.CLASSES).write_text('{"zebra": "tabby cat"}'),
            "all different",
        ),
        (
            lambda task: (task / folders.CLASSES).write_bytes(
                '{"zebra": "zèbre"}'.encode("latin-1")
            ),
            "not JSON",
        ),
        (
            lambda task: (task / folders.TEMPLATES).write_bytes(
                "une scène de {}".encode("latin-1")
            ),
            "not UTF-8",
        ),
        (lambda task: (task / folders.TEMPLATES).write_text("a {}\na {} of {x}"), "no other brace"),
        (lambda task: (task / folders.TEMPLATES).write_text("a {} in a {"), "no other brace"),
        (lambda task: (task / folders.TEMPLATES).write_text("a {{}}"), "no other brace"),
        (lambda task: (task / folders.TEMPLATES).write_text("\n"), "no sentence"),
    ],
)
def test_a_folder_that_is_no_task_is_one_error(
    dataset: Path, tmp_path: Path, damage: object, said: str
) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    damage(root / "animals")  # type: ignore[operator]
    with pytest.raises(AegisError) as caught:
        folders.load(root, "animals", SIZE)
    assert said in caught.value.found + caught.value.expected


@pytest.mark.parametrize("name", [folders.CLASSES, folders.TEMPLATES])
def test_a_file_of_words_that_cannot_be_read_is_one_error(
    name: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    (root / "animals" / name).write_text("{}")
    whole = Path.read_bytes

    def read(path: Path, *_: object, **__: object) -> bytes:
        if path.name == name:
            raise PermissionError(errno.EACCES, "Permission denied")
        return whole(path)

    for reading in ("read_bytes", "read_text"):
        monkeypatch.setattr(Path, reading, read)
    with pytest.raises(AegisError, match=f"cannot read '.*{name}': Permission denied"):
        folders.load(root, "animals", SIZE)


def test_words_that_the_embedded_encoder_does_not_know_have_their_files_named(
    aegis: object, dataset: Path, tmp_path: Path
) -> None:
    recipe = tmp_path / "own.yaml"
    recipe.write_text(f"kind: stream\nname: own\nstream: own\npath: {dataset}\norder: [animals]\n")
    said = refused(aegis("train", recipe, "--out", tmp_path / "run"))  # type: ignore[operator]
    said = said.replace("\n", "")
    assert str(dataset / "animals" / folders.TEMPLATES) in said
    assert str(dataset / "animals" / folders.CLASSES) in said


def test_a_damaged_image_is_named(dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(dataset, tmp_path / "copy")
    file = root / "animals" / "test" / "zebra" / "03.png"
    file.write_bytes(file.read_bytes()[:100])
    task = folders.load(root, "animals", SIZE)
    with pytest.raises(AegisError, match="03.png"):
        task.test.images(torch.arange(12))


def _without_a_weight(folder: Path) -> None:
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "model.safetensors")
    tensors.pop("visual_projection.weight")
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_without_a_weight, "1 missing (visual_projection.weight)"),
        (lambda f: (f / "model.safetensors").unlink(), "does not load"),
        (lambda f: (f / "preprocessor_config.json").unlink(), "processor"),
        (lambda f: (f / "tokenizer.json").unlink(), "no tokenizer"),
    ],
)
def test_a_model_that_is_not_whole_is_one_error(
    folder: Path, tmp_path: Path, damage: object, said: str
) -> None:
    copy = shutil.copytree(folder, tmp_path / "copy")
    damage(copy)  # type: ignore[operator]
    with pytest.raises(AegisError) as caught:
        clip.load(copy)
    assert said in caught.value.found


def test_another_model_is_refused(folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(folder, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"model_type": "siglip"}))
    with pytest.raises(AegisError, match="'siglip' model"):
        clip.load(copy)


def test_a_text_that_is_too_long_is_refused(folder: Path) -> None:
    with pytest.raises(AegisError, match="more than 24 tokens"):
        clip.load(folder).text_features(["zebra", "zebra " * 40])


# --- MTIL, whole ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mtil_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The eleven data sets, each with two classes of a distinct colour and few images."""
    root = tmp_path_factory.mktemp("mtil")
    rng = np.random.default_rng(1)
    for name in mtil.TEMPLATES:
        for label in ("one", "two"):
            colour = rng.integers(0, 256, 3)
            for part, count in (("train", 6), ("test", 3)):
                where = root / name / part / label
                where.mkdir(parents=True)
                for i in range(count):
                    noisy = np.clip(colour + rng.normal(0, 20, (SIZE, SIZE + 2, 3)), 0, 255).astype(
                        np.uint8
                    )
                    Image.fromarray(noisy).save(where / f"{i}.png")
    return root


def test_the_mtil_recipe_runs_on_a_small_clip(
    aegis: object, folder: Path, mtil_root: Path, tmp_path: Path
) -> None:
    recipe = Path(__file__).parent.parent.parent / "recipes" / "igsp-mtil.yaml"
    settings = {
        "path": mtil_root,
        "encoder": folder,
        "train.steps": 4,
        "train.batch_size": 4,
        "train.precision": "float32",
        "igsp.rank": 2,
        "igsp.check_every": 2,
    }
    options = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
    code, out, err = aegis("train", recipe, "--out", tmp_path / "run", *options)  # type: ignore[operator]
    assert code == 0, err
    assert all(f"after {name}" in out for name in mtil.TEMPLATES)
    assert f"on the folder {mtil_root}" in out.replace("\n", " ")
    shown = aegis("inspect", tmp_path / "run", "--json")[1]  # type: ignore[operator]
    assert json.loads(shown)["report"]["path"] == str(mtil_root)
    for method, figures in mtil.PUBLISHED["mtil-1"].items():
        assert re.search(
            rf"^ *{method} +" + " +".join(f"{x:.1f}" for x in figures), out, re.MULTILINE
        ), method
    code, out, err = aegis("probe", tmp_path / "run", "--json")  # type: ignore[operator]
    assert code == 0 and json.loads(out)["largest_difference"] == 0, err
    assert json.loads(out)["tasks"] == list(mtil.STREAMS["mtil-1"])


MTIL = mtil.STREAMS["mtil-1"]
RECORD = TaskRecord("dtd", None, None, 1, 1.0, 1, None, None, None, ())


@pytest.mark.parametrize(
    ("changes", "shown"),
    [
        ({}, True),
        ({"tasks": ("dtd", "eurosat")}, False),
        ({"tasks": MTIL[::-1]}, False),
        ({"stream": "mine"}, False),
        ({"stream": "mtil-2", "tasks": mtil.STREAMS["mtil-2"]}, False),  # nothing is known of it
        ({"split": "validation"}, False),
    ],
)
def test_published_figures_stand_under_the_same_tasks_only(
    changes: dict[str, object], shown: bool
) -> None:
    matrix = [[0.5] * 11] * 11
    asked = {"stream": "mtil-1", "split": "test", "tasks": MTIL} | changes
    report = ImageStreamReport(
        name="x",
        method="igsp",
        oracle=matrix,
        inferred=matrix,
        scores=scores(matrix),
        inferred_scores=scores(matrix),
        inference_parameters=0,
        records=(RECORD,),
        inputs={},
        out="",
        minutes=0.0,
        **sums([RECORD]),
        **asked,
    )
    assert bool(report.published) == shown


def test_mtil_is_eleven_tasks_in_two_orders() -> None:
    first, second = mtil.STREAMS["mtil-1"], mtil.STREAMS["mtil-2"]
    assert (
        len(first) == 11
        and list(first) == sorted(first)
        and sorted(second) == list(first)
        and second[0] == "stanford-cars"
    )
    assert all(template.count("{}") == 1 for template in mtil.TEMPLATES.values())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"stream": "mine"}, "no 'order'"),
        ({"order": "[dtd, nothing]"}, "nothing/train"),
        ({"encoder": "{missing}"}, "no backbone"),
    ],
)
def test_a_stream_of_folders_that_cannot_be_read_is_one_error(
    aegis: object,
    folder: Path,
    mtil_root: Path,
    tmp_path: Path,
    settings: dict[str, str],
    said: str,
) -> None:
    recipe = Path(__file__).parent.parent.parent / "recipes" / "igsp-mtil.yaml"
    given = {
        "path": mtil_root,
        "encoder": folder,
        **{k: v.format(missing=tmp_path / "none") for k, v in settings.items()},
    }
    options = [part for key, value in given.items() for part in ("--set", f"{key}={value}")]
    code, out, err = aegis("train", recipe, "--out", tmp_path / "run", *options)  # type: ignore[operator]
    assert (code, out) == (2, "") and said in err and "Traceback" not in err
    assert not (tmp_path / "run").exists()
