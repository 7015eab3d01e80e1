"""The embedded stream: the contract of every task, and that pictures match their words."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from aegis_cli.common import artifacts, palette
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.data import streams
from aegis_cli.data.streams import corpus, embedded, masks, names, photo
from aegis_cli.data.streams.contract import StreamTask
from aegis_cli.data.vqa import things
from aegis_cli.models import backbones

COUNTS = {"train": 20, "validation": 12, "test": 16}
DRAWN = [name for name in names.TASKS if not name.startswith("digits")]
Tasks = Callable[[str], StreamTask]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("stream")


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embedded, "COUNTS", COUNTS)


@pytest.fixture
def load(cache: Path) -> Tasks:
    return lambda name: embedded.task(name, names.SIZE, cache, ignore)


def pictures(task: StreamTask, part: str) -> torch.Tensor:
    rows = getattr(task, part)
    return rows.images(torch.arange(len(rows)))


@pytest.mark.parametrize("name", names.TASKS)
def test_a_task_keeps_to_the_contract(name: str, load: Tasks) -> None:
    task = load(name)
    assert task.name == name and (task.classes, task.templates) == (
        names.TASKS[name].classes,
        names.TASKS[name].templates,
    )
    expected = COUNTS | ({"train": embedded.REAL - 28} if name.startswith("digits") else {})
    seen: set[bytes] = set()
    for part, count in expected.items():
        images, labels = pictures(task, part), getattr(task, part).labels
        assert images.shape == (count, names.SIZE, names.SIZE, 3) and images.dtype == torch.uint8
        assert labels.shape == (count,) and labels.dtype == torch.int64
        own = {image.numpy().tobytes() for image in images}
        assert len(own) == count and not own & seen  # no picture twice, in this part or another
        seen |= own
        assert images.float().std((1, 2, 3)).min() > 5  # every one shows something
    often = Counter(task.train.labels.tolist())
    assert (
        set(often) == set(range(len(task.classes)))
        and max(often.values()) <= 1.3 * min(often.values()) + 1
    )


@pytest.mark.parametrize("name", names.TASKS)
def test_rows_come_in_the_order_asked_for(name: str, load: Tasks) -> None:
    part = load(name).validation
    whole, some = part.images(torch.arange(len(part))), torch.tensor([3, 0, 3, 7])
    assert torch.equal(part.images(some), whole[some])


@pytest.mark.parametrize("name", names.TASKS)
def test_the_shipped_encoder_can_read_every_class_in_every_template(name: str) -> None:
    words = names.TASKS[name]
    texts = [template.format(c) for template in words.templates for c in words.classes]
    dual = backbones.load_dual("embedded-dual")
    assert len(set(texts)) == len(texts) and dual.text_features(texts).isfinite().all()


@pytest.mark.parametrize("name", ["colors", "counts", "digits-permuted", "domains", "places"])
def test_equal_bytes_each_time(name: str, load: Tasks, cache: Path, tmp_path: Path) -> None:
    load(name)
    embedded.task(name, 32, tmp_path, ignore)  # whatever size is requested
    assert (tmp_path / f"{name}.safetensors").read_bytes() == (
        cache / f"{name}.safetensors"
    ).read_bytes()


def test_what_is_in_the_cache_is_not_made_again(
    cache: Path, load: Tasks, monkeypatch: pytest.MonkeyPatch
) -> None:
    load("digits")
    monkeypatch.setattr(embedded, "make", lambda *_: pytest.fail("made again"))
    assert len(load("digits").test) == COUNTS["test"]


def test_pictures_of_another_edition_are_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, told = (
        pictures(embedded.task("shapes", names.SIZE, tmp_path, ignore), "test"),
        streams.edition("primer-1"),
    )
    monkeypatch.setattr(embedded, "EDITION", embedded.EDITION + 1)
    second = pictures(embedded.task("shapes", names.SIZE, tmp_path, ignore), "test")
    assert (
        artifacts.read_header(tmp_path / "shapes.safetensors").meta["edition"] == embedded.EDITION
    )
    assert not torch.equal(first, second) and streams.edition("primer-1") != told


def test_a_damaged_cache_is_one_error_that_says_what_to_delete(tmp_path: Path) -> None:
    embedded.task("digits", names.SIZE, tmp_path, ignore)
    path = tmp_path / "digits.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(AegisError, match="truncated") as caught:
        embedded.task("digits", names.SIZE, tmp_path, ignore)
    assert f"rm '{path}'" in caught.value.fix


def test_a_cache_that_cannot_be_written_is_refused_before_anything_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(embedded, "make")
    (tmp_path / "file").touch()
    with pytest.raises(AegisError, match="cannot create the folder") as nowhere:
        streams.load("primer-1", names.SIZE, tmp_path / "file" / "streams")
    assert "set AEGIS_CACHE" in nowhere.value.fix


@pytest.mark.parametrize("size", [24, 32, 96])
def test_another_size_is_the_same_picture(size: int, cache: Path, load: Tasks) -> None:
    rows = torch.arange(8)
    large, other = (
        load("digits").test.images(rows),
        embedded.task("digits", size, cache, ignore).test.images(rows),
    )
    assert other.shape == (8, size, size, 3) and other.dtype == torch.uint8
    back = embedded.resized(other, names.SIZE)
    assert (back.float() - large.float()).abs().mean() < 6


# --- streams --------------------------------------------------------------------------------------


def test_a_stream_is_its_tasks_in_order(cache: Path) -> None:
    tasks = streams.load("pair-permuted", 48, cache)
    assert tuple(t.name for t in tasks) == names.STREAMS["pair-permuted"]


def test_both_orders_have_all_tasks_but_the_variants() -> None:
    first, second = (names.STREAMS[order] for order in ("primer-1", "primer-2"))
    assert (
        len(first) >= 8 and set(first) == set(second) == set(DRAWN) | {"digits"} and first != second
    )
    assert len(first) == len(second) and set().union(*names.STREAMS.values()) == set(names.TASKS)


def test_an_unknown_stream(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="no stream 'mtil'") as caught:
        streams.load("mtil", 48, tmp_path)
    assert "primer-1" in caught.value.expected and not list(tmp_path.iterdir())


def test_pair_a_is_the_same_digits_inverted_under_the_same_names(load: Tasks) -> None:
    plain, inverted = load("digits"), load("digits-inverted")
    assert plain.classes == inverted.classes
    for part in COUNTS:
        assert torch.equal(pictures(inverted, part), 255 - pictures(plain, part))
        assert torch.equal(getattr(inverted, part).labels, getattr(plain, part).labels)


def test_pair_b_is_the_same_pictures_under_names_that_none_had(load: Tasks) -> None:
    plain, permuted = load("digits"), load("digits-permuted")
    assert sorted(plain.classes) == sorted(permuted.classes)
    assert all(a != b for a, b in zip(plain.classes, permuted.classes, strict=True))
    for part in COUNTS:
        assert torch.equal(pictures(permuted, part), pictures(plain, part))
        assert torch.equal(getattr(permuted, part).labels, getattr(plain, part).labels)


def test_names_are_those_of_the_scenes_they_are_rendered_from() -> None:
    assert (
        names.COLORS == palette.COLORS
        and names.SOLIDS == things.SHAPES
        and set(names.SHAPES) == set(masks.OUTLINES)
    )


# --- pictures show what their labels say ----------------------------------------------------------


@pytest.mark.parametrize("character", [*"0123456789", *map(str.upper, names.LETTERS)])
def test_a_glyph_is_as_tall_as_asked_and_where_asked(character: str) -> None:
    mask = masks.glyph(character, 24, np.array([20.0, 28.0]))
    rows, columns = np.flatnonzero(mask.max(1) > 0.5), np.flatnonzero(mask.max(0) > 0.5)
    assert abs(rows[-1] + 1 - rows[0] - 24) <= 2
    assert (
        abs((rows[0] + rows[-1] + 1) / 2 - 28) <= 1
        and abs((columns[0] + columns[-1] + 1) / 2 - 20) <= 1
    )


@pytest.mark.parametrize("direction", range(8))
@pytest.mark.parametrize("outline", [masks.ARROW, masks.DART], ids=["arrow", "dart"])
def test_a_pointer_points_where_it_says(direction: int, outline: np.ndarray) -> None:
    """The tip is the outermost point, in that direction on the screen, where y points down."""
    points = masks.place(outline, np.zeros(2), 1.0, direction * np.pi / 4)
    tip = points[(outline == [1, 0]).all(1)][0]
    words = names.DIRECTIONS[direction].split()
    assert (tip[0] > 0.5) == ("right" in words) and (tip[0] < -0.5) == ("left" in words)
    assert (tip[1] < -0.5) == ("up" in words) and (tip[1] > 0.5) == ("down" in words)


@pytest.mark.parametrize("direction", range(8))
def test_a_pad_lies_where_its_label_says(direction: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the only coloured thing on a grey floor, rendered without noise."""
    rendered = importlib.import_module("aegis_cli.data.streams.rendered")
    monkeypatch.setattr(rendered.Photo, "take", lambda self, picture, rng: photo.to_bytes(picture))
    picture = rendered.pad_place(direction, np.random.default_rng(direction)).astype(float)
    y, x = np.argwhere(np.ptp(picture, axis=-1) > 60).mean(0) - names.SIZE / 2
    found = np.degrees(np.arctan2(-y, x)) % 360
    assert abs((found - direction * 45 + 180) % 360 - 180) < 22.5


@pytest.mark.parametrize("color", range(8))
def test_solids_and_targets_have_their_colour(color: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The palette's colour whose hue is nearest to that of the most saturated pixels."""
    rendered = importlib.import_module("aegis_cli.data.streams.rendered")
    monkeypatch.setattr(rendered.Photo, "take", lambda self, picture, rng: photo.to_bytes(picture))
    for paint in (rendered.lamplit_solid, rendered.night_target):
        picture = paint(color, np.random.default_rng(color)).reshape(-1, 3) / 255
        strong = picture[np.ptp(picture, axis=1) > 0.7 * np.ptp(picture, axis=1).max()].mean(0)
        chroma = np.array(list(palette.RGB.values())) - np.mean(
            list(palette.RGB.values()), 1, keepdims=True
        )
        own = strong - strong.mean()
        cosine = chroma @ own / np.linalg.norm(chroma, axis=1) / np.linalg.norm(own)
        assert color in np.argsort(-cosine)[:2]  # red and pink differ in brightness, not in hue


@pytest.mark.parametrize("count", range(6))
def test_as_many_things_as_the_label_says(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.ndimage import label

    drawn = importlib.import_module("aegis_cli.data.streams.drawn")
    masks_made: list[np.ndarray] = []
    real = masks.shape
    monkeypatch.setattr(
        masks, "shape", lambda *args: masks_made.append(real(*args)) or masks_made[-1]
    )
    for paint in (drawn.mixed_count, lambda c, rng: drawn.plain_count(c, 0, rng)):
        masks_made.clear()
        paint(count, np.random.default_rng(count))
        assert label(sum(masks_made) > 0.1)[1] == count + 1 == len(masks_made)


def test_photo_without_faults_changes_nothing() -> None:
    picture = np.random.default_rng(0).random((48, 48, 3))
    perfect = photo.Photo(noise=(0.0, 0.0), contrast=(1.0, 1.0))
    assert (perfect.take(picture, np.random.default_rng(1)) == photo.to_bytes(picture)).all()


def test_a_blur_keeps_the_mean_and_takes_variance() -> None:
    picture = np.zeros((48, 48, 3))
    picture[20:28, 20:28] = 1
    soft = photo.blurred(picture, 1.5)
    assert (
        soft.shape == picture.shape
        and soft.sum() == pytest.approx(picture.sum())
        and soft.var() < picture.var()
    )
    assert (photo.blurred(picture, 0.0) == picture).all()


# --- the corpus of pre-training -------------------------------------------------------------------


def test_a_caption_is_true_of_pictures_that_have_what_it_says() -> None:
    said = corpus.captions()
    kinds = list(corpus.KINDS)
    cube = [kinds.index("solids"), names.COLORS.index("red"), names.SOLIDS.index("cube")]
    ring = [kinds.index("shapes"), names.SHAPES.index("ring"), names.COLORS.index("red")]
    seven = [kinds.index("digits"), 7, corpus.UNSAID]
    true = corpus.true_of(said.says, np.array([cube, ring, seven]))
    assert [{said.texts[i] for i in np.flatnonzero(row)} for row in true] == [
        {"a red object", "a cube", "a red cube"},
        {"a ring", "a red ring"},
        {"the digit seven"},
    ]
    assert len(set(said.texts)) == len(said.texts) == len(said.says)


def test_every_task_is_named_as_some_caption_names_it() -> None:
    """Zero-shot accuracy is about new pictures, not new words.

    The permuted names are words too, namely those of other digits.
    """
    told = {opening + text for opening in corpus.OPENINGS for text in corpus.captions().texts}
    for words in names.TASKS.values():
        assert {t.format(c) for t in words.templates for c in words.classes} <= told


def test_the_corpus_is_the_same_for_a_seed_and_another_for_another_split() -> None:
    first, again = corpus.render(3, 24), corpus.render(3, 24)
    assert (first.images == again.images).all() and (first.facts == again.facts).all()
    other = {image.tobytes() for image in corpus.render(3, 24, "validation").images}
    assert not other & {image.tobytes() for image in first.images}
    said = corpus.captions()
    assert corpus.true_of(said.says, first.facts).any(1).all()  # some caption is true of each


# --- what is missing ------------------------------------------------------------------------------


def test_a_missing_package_names_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    importlib.import_module("aegis_cli.data.streams.scanned").digits.cache_clear()
    monkeypatch.setitem(sys.modules, "sklearn.datasets", None)
    with pytest.raises(AegisError) as caught:
        embedded.task("digits", names.SIZE, tmp_path / "cache", ignore)
    assert "pip install 'aegis-vla[streams]'" in caught.value.fix and not list(
        tmp_path.rglob("*.safetensors")
    )
