"""Contact sheets and videos: the place of each picture, and what is drawn on it."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from samples.command import python

from aegis_cli.common import media
from aegis_cli.common.media import Clip, Moment

GREY = np.full((64, 64, 3), 90, np.uint8)
TILE = media._CLIP_TILE


def noise(seed: int, height: int = 64, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def moments(count: int, outcome: bool | None = None) -> list[Moment]:
    """Open until the last one, which has the outcome."""
    open_ = [Moment(GREY, f"step {i}") for i in range(count - 1)]
    return [*open_, Moment(GREY, f"step {count - 1}", outcome)]


def drawn(*clips: Clip) -> list[np.ndarray]:
    return [np.asarray(picture).astype(int) for picture in media._pictures(clips)]


def tile(picture: np.ndarray, i: int = 0, columns: int = 1) -> np.ndarray:
    """One clip's tile [TILE, TILE, 3] of a frame of the video."""
    cell, line = picture.shape[1] // columns, TILE + media._CAPTION + 2 * media._GAP
    y, x = i // columns * line + media._CAPTION, i % columns * cell + media._GAP
    return picture[y : y + TILE, x : x + TILE]


def border(picture: np.ndarray) -> set[tuple[int, ...]]:
    """The colours of a tile's edges, away from the corner with the note."""
    edges = (picture[-1], picture[-media._BORDER], picture[:, -1], picture[TILE // 2 :, 0])
    return {tuple(pixel) for edge in edges for pixel in edge.tolist()}


# --- the tiler ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cells", "columns", "frames"), [(1, 1, 1), (5, 2, 2), (6, 3, 1)])
def test_each_frame_lies_in_its_cell(cells: int, columns: int, frames: int) -> None:
    shown = [("", [noise(10 * i + k) for k in range(frames)]) for i in range(cells)]
    sheet = np.asarray(media.tiled(shown, columns, tile=128, text=10))
    width, height = frames * (128 + 4) + 16, 20 + 128 + 8
    assert sheet.shape == (-(-cells // columns) * height, columns * width, 3)
    for i, (_, pictures) in enumerate(shown):
        for k, picture in enumerate(pictures):
            y, x = i // columns * height + 20, i % columns * width + 4 + k * 132
            enlarged = picture.repeat(2, axis=0).repeat(2, axis=1)
            np.testing.assert_array_equal(sheet[y : y + 128, x : x + 128], enlarged)


def test_a_frame_of_any_shape_is_fitted_whole() -> None:
    sheet = np.asarray(media.tiled([("", [noise(0, 100, 400)])], 1, tile=128, text=10))
    assert (sheet[20 + 32 : 20 + 128, 4:132] == 255).all()  # a quarter as high as wide
    assert (sheet[20 : 20 + 32, 4:132] != 255).any(axis=-1).mean() > 0.9


def test_a_caption_never_reaches_into_the_next_cell() -> None:
    long, none = (
        np.asarray(media.tiled([(text, [GREY]), ("", [GREY])], 2, tile=64, text=10))
        for text in ("wide words " * 20, "")
    )
    cell = long.shape[1] // 2
    assert (long[:, :cell] != none[:, :cell]).any() and (long[:, cell:] == none[:, cell:]).all()


def test_letters_beyond_ascii_are_drawn_in_captions_and_notes() -> None:
    for first, second in (("ü", "ß"), ("к", "ш")):  # what no font has would be one box
        captions = [np.asarray(media.tiled([(x, [GREY])], 1, 64, 10)) for x in (first, second)]
        assert (captions[0] != captions[1]).any()
        notes = [media._framed(Moment(GREY, x), None) for x in (first, second)]
        assert (notes[0] != notes[1]).any()


def test_all_captions_of_a_sheet_are_set_in_one_font() -> None:
    """A character beyond ASCII in one caption determines the font of the others too."""
    ascii_alone, mixed, wide = (
        np.asarray(media.tiled([(text, [GREY]), (other, [GREY])], 2, tile=64, text=10))
        for text, other in (("pick", "place"), ("pick", "für"), ("pick", "ß"))
    )
    cell = ascii_alone.shape[1] // 2
    assert (mixed[:, :cell] != ascii_alone[:, :cell]).any()
    assert (mixed[:, :cell] == wide[:, :cell]).all()


# --- videos ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcome", "color"),
    [(True, media.SUCCESS), (False, media.FAILURE), (None, media.UNDECIDED)],
)
def test_the_border_says_how_it_ended_once_that_is_known(
    outcome: bool | None, color: tuple[int, int, int]
) -> None:
    pictures = drawn(Clip("go", moments(3, outcome)))
    borders = [border(tile(picture)) for picture in pictures]
    assert borders[:2] == [{media.UNDECIDED}] * 2
    assert borders[2:] == [{color}] * (len(pictures) - 2) and len(pictures) == 3 + 10


def test_success_failure_and_neither_differ_in_brightness_too() -> None:
    """A viewer who cannot tell red from green must be able to distinguish them."""
    shades = sorted(
        float(np.dot(color, (0.2126, 0.7152, 0.0722)))
        for color in (media.FAILURE, media.SUCCESS, media.UNDECIDED)
    )
    assert min(np.diff(shades)) > 15


def test_the_step_count_is_written_in_the_corner_and_nowhere_else() -> None:
    first, second, *_ = (tile(picture) for picture in drawn(Clip("go", moments(3))))
    changed = (first != second).any(axis=-1)
    rows, columns = np.nonzero(changed)
    assert changed.any() and rows.max() < 30 and columns.max() < 80


def test_the_ring_is_around_the_target_and_leaves_it_as_it_is() -> None:
    ring = (0.5, 0.75, 0.1)
    plain, ringed = (
        tile(drawn(Clip("go", [Moment(GREY, "")], circle))[0]) for circle in (None, ring)
    )
    rows, columns = np.nonzero((plain != ringed).any(axis=-1))
    side, edge = media._CLIP_PICTURE, media._BORDER
    away = np.hypot(columns + 0.5 - edge - 0.5 * side, rows + 0.5 - edge - 0.75 * side)
    assert 0.1 * side < away.min() and away.max() < 0.1 * side + 20
    angles = np.arctan2(rows - edge - 0.75 * side, columns - edge - 0.5 * side)
    assert len(np.unique(angles.round(1))) > 60  # all the way round
    assert ringed[rows, columns].max() == 255


def test_pictures_are_enlarged_by_whole_pixels() -> None:
    frame = noise(0)
    shown = tile(drawn(Clip("go", [Moment(frame, "")]))[0])
    inner = shown[media._BORDER : -media._BORDER, media._BORDER : -media._BORDER]
    enlarged = frame.repeat(4, axis=0).repeat(4, axis=1)
    np.testing.assert_array_equal(inner[40:], enlarged[40:])


@pytest.mark.parametrize(("count", "columns"), [(1, 1), (4, 4), (6, 3), (8, 4), (11, 4)])
def test_clips_stand_in_at_most_two_rows_and_those_that_are_over_wait(
    count: int, columns: int, tmp_path: Path
) -> None:
    clips = [Clip(f"{i}", moments(i + 1, i % 2 == 0)) for i in range(count)]
    media.save_video(clips, tmp_path / "v.gif")
    shown = min(count, 8)
    with Image.open(tmp_path / "v.gif") as gif:
        cell, line = TILE + 20, TILE + 28
        assert gif.size == (columns * cell, -(-shown // columns) * line)
        gif.seek(gif.n_frames - 1)
        last = np.asarray(gif.convert("RGB")).astype(int)
    for i in range(shown):
        color = media.SUCCESS if i % 2 == 0 else media.FAILURE
        assert np.abs(tile(last, i, columns)[-2, -2] - color).max() < 8


def test_equal_clips_give_equal_videos(tmp_path: Path) -> None:

    shown, written = [], []
    for name in ("a", "b"):
        clip = Clip("go", moments(4, True), (0.5, 0.5, 0.1))
        for suffix in (".gif", ".mp4"):
            media.save_video([clip], tmp_path / f"{name}{suffix}")
        written.append((tmp_path / f"{name}.gif").read_bytes())
        with av.open(str(tmp_path / f"{name}.mp4")) as container:
            shown.append([f.to_ndarray(format="rgb24") for f in container.decode(video=0)])
    assert written[0] == written[1]
    np.testing.assert_array_equal(*shown)


# --- H.264 ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [2, 5])
def test_what_is_appended_begins_with_a_key_frame(every: int, tmp_path: Path) -> None:

    writer = media.Mp4Writer(tmp_path / "v.mp4", 10, keyframe_every=every)
    for count in (7, 4):
        writer.write(np.stack([GREY] * count))
    writer.close()
    with av.open(str(tmp_path / "v.mp4")) as container:
        frames = list(container.decode(video=0))
    keys = [i for i, frame in enumerate(frames) if frame.key_frame]
    assert len(frames) == 11 and {0, 7} <= set(keys)
    assert max(np.diff([*keys, 11])) <= every
    assert [float(frame.time) for frame in frames] == pytest.approx([i / 10 for i in range(11)])


@pytest.mark.parametrize("frames", [1, 60])  # the encoder holds some dozens back
def test_a_disk_without_room_for_a_videos_beginning_is_an_error(frames: int) -> None:
    """FFmpeg would crash if it continued after its first failed write."""
    code = f"""
import errno
import numpy
from pathlib import Path
from aegis_cli.common.media import Mp4Writer

writer = Mp4Writer(Path("/dev/full"), 10, 10)
try:
    try:
        writer.write(numpy.zeros(({frames}, 64, 64, 3), numpy.uint8))
    finally:
        writer.close()
except OSError as error:
    assert error.errno == errno.ENOSPC, error
    print("refused")
"""
    done = python(code)
    assert (done.returncode, done.stdout) == (0, "refused\n"), done.stderr
