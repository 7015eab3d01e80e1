"""Pixels from image files: upright, for every common format, or refused."""

from __future__ import annotations

import io
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from samples.vqa_files import picture

from aegis_cli.common.errors import AegisError
from aegis_cli.common.pictures import decoded
from aegis_cli.data.lerobot import pictures
from aegis_cli.data.streams import folders
from aegis_cli.data.vqa import images

TURN = 0x0112  # EXIF: how to rotate the picture
Decode = Callable[[bytes], np.ndarray]


def stored(image: Image.Image, format: str = "PNG", **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, format=format, **options)
    return file.getvalue()


def turned() -> bytes:
    """A picture to be shown rotated by 90 degrees clockwise."""
    exif = Image.Exif()
    exif[TURN] = 6
    return stored(picture(1), exif=exif)


def huge() -> bytes:
    """A small file that declares 900 million pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + chunk(b"IDAT", zlib.compress(b"\0" * 100))
        + chunk(b"IEND", b"")
    )


@pytest.fixture(params=["questions", "streams", "robots"])
def decode(request: pytest.FixtureRequest, tmp_path: Path) -> Decode:
    """The decoder of a picture for each of them; for streams, cropped to its middle square."""

    def of_stream(data: bytes) -> np.ndarray:
        (tmp_path / "x.png").write_bytes(data)
        return folders.decode([tmp_path / "x.png"], 30)[0].numpy()

    return {
        "questions": lambda data: images.decode(images.Picture("x", "here", lambda: data), None),
        "streams": of_stream,
        "robots": lambda data: pictures.from_bytes(data, "frame 0"),
    }[request.param]


def middle(pixels: np.ndarray) -> np.ndarray:
    """The square of 30 pixels a side in the middle."""
    top, left = ((side - 30) // 2 for side in pixels.shape[:2])
    return pixels[top : top + 30, left : left + 30]


def test_pictures_are_upright_wherever_they_are_read(decode: Decode) -> None:
    assert np.array_equal(middle(decode(turned())), middle(np.rot90(np.asarray(picture(1)), -1)))


def clear(mode: str) -> Image.Image:
    """A picture whose left half is transparent with black below; the rest is semi-transparent."""
    image = picture(1).convert("L" if mode == "LA" else "RGB")
    alpha = Image.new("L", image.size, 100)
    for target, value in ((image, 0), (alpha, 0)):
        target.paste(value, (0, 0, image.width // 2, image.height))
    image.putalpha(alpha)
    return image.quantize(16) if mode == "P" else image


@pytest.mark.parametrize(
    ("mode", "format"), [("RGBA", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("RGBA", "WEBP")]
)
def test_what_is_transparent_lies_on_white(mode: str, format: str, decode: Decode) -> None:
    """Whatever the installed version of transformers' processors would do with it."""
    image = clear(mode)
    data = stored(image, format, **({"lossless": True} if format == "WEBP" else {}))
    pixels = decode(data)
    half = pixels.shape[1] // 2
    assert (pixels[:, :half] == 255).all() and (pixels[:, half:] < 255).any()
    drawn = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
    share = drawn[..., 3:] / 255
    expected = share * drawn[..., :3] + (1 - share) * 255
    assert np.abs(middle(pixels) - middle(expected)).max() <= 1


@pytest.mark.parametrize("data", [huge(), turned()[:300], b"hello"], ids=["huge", "half", "none"])
def test_what_is_no_picture_is_one_error_wherever_it_is_read(data: bytes, decode: Decode) -> None:
    with pytest.raises(AegisError, match="cannot be read as an image"):
        decode(data)


SCRIPT = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 10 10
(/tmp/never) (w) file
"""


@pytest.mark.parametrize("data", [SCRIPT, b"\xd7\xcd\xc6\x9a" + bytes(40)], ids=["EPS", "WMF"])
def test_a_picture_that_is_a_program_is_never_run(
    data: bytes, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever its name, Pillow would have Ghostscript run the first one."""
    monkeypatch.setattr(subprocess, "check_call", lambda *_, **__: pytest.fail("it was run"))
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("it was run"))
    with pytest.raises(AegisError, match="not in a known raster format"):
        decode(data)


@pytest.mark.parametrize("format", ["PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "PPM"])
def test_every_usual_format_is_read(format: str, decode: Decode) -> None:
    assert decode(stored(picture(1), format)).shape[2] == 3


@pytest.mark.parametrize("format", ["PNG", "TIFF"])
def test_sixteen_bits_of_grey_keep_their_range(format: str) -> None:
    ramp = np.linspace(0, 65535, 64 * 64).astype(np.uint16).reshape(64, 64)
    pixels = decoded(stored(Image.fromarray(ramp), format))
    assert pixels.shape == (64, 64, 3) and np.abs(pixels - ramp[..., None] / 257).max() <= 0.5


@pytest.mark.parametrize("kind", [np.int32, np.float32])
def test_grey_of_no_known_range_is_refused(kind: type) -> None:
    with pytest.raises(ValueError, match="no defined white"):
        decoded(stored(Image.fromarray(np.zeros((4, 4), kind)), "TIFF"))


def test_a_picture_with_damaged_metadata_is_shown_as_it_lies() -> None:
    with pytest.raises(SyntaxError):
        Image.open(io.BytesIO(data := stored(picture(1), exif=b"Exif\0\0no TIFF header"))).getexif()
    assert np.array_equal(decoded(data), np.asarray(picture(1)))
