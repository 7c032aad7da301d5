"""Pictures: what is written is what was computed, correctly rounded."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import png
import pytest
from PIL import Image

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.pictures.picture import rounded, write_picture
from voxtool.pictures.rendering import averaged

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "blue": (0.1, 0.25, 0.7), "none": None}


def noise(height: int, width: int, seed: int = 1) -> np.ndarray:
    """Premultiplied, with wholly transparent, hardly visible and opaque pixels."""
    random = np.random.default_rng(seed)
    opacity = random.random((height, width, 1))
    opacity[random.random((height, width, 1)) < 0.2] = 0
    opacity[random.random((height, width, 1)) < 0.2] = 1
    opacity[random.random((height, width, 1)) < 0.1] = 1e-6
    colour = opacity * random.random((height, width, 3))
    return np.concatenate([colour, opacity], axis=2).astype(np.float32)


def read_back(data: bytes, bits: int) -> np.ndarray:
    """By a reader that is not the writer: pypng reads what Pillow writes, and both what it does."""
    width, height, rows, info = png.Reader(bytes=data).read()
    assert info["bitdepth"] == bits
    assert "gamma" not in info
    return np.array([list(row) for row in rows]).reshape(height, width, info["planes"])


def exact(value: Fraction, bits: int) -> int:
    return math.floor(min(max(value, Fraction(0)), Fraction(1)) * (2**bits - 1) + Fraction(1, 2))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", BACKGROUNDS)
def test_png_holds_the_rounded_values(bits: int, name: str, tmp_path: Path) -> None:
    picture, background = noise(70, 9), BACKGROUNDS[name]
    write_picture(picture, tmp_path / "a.png", bits=bits, background=background)
    found = read_back((tmp_path / "a.png").read_bytes(), bits)
    assert found.shape == (70, 9, 4 if background is None else 3)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (9, 70)
        assert bits == 16 or np.array_equal(np.asarray(image), found)
    # against fractions: float64 may only tip a value that is a hair from a half
    rows = zip(picture.reshape(-1, 4), found.reshape(-1, found.shape[2]), strict=True)
    for pixel, integers in rows:
        *colour, opacity = (Fraction(float(v)) for v in pixel)
        if background is not None:
            behind = [(1 - opacity) * Fraction(b) for b in background]
            expected = [c + b for c, b in zip(colour, behind, strict=True)]
        elif exact(opacity, bits) == 0:
            expected = [Fraction(0)] * 4
        else:
            expected = [*(c / opacity for c in colour), opacity]
        for value, integer in zip(expected, integers.tolist(), strict=True):
            hair = Fraction(1, 1 << 40)
            assert exact(value - hair, bits) <= integer <= exact(value + hair, bits)


def test_half_is_rounded_up() -> None:
    values = [0, 0.5 / 255, 1.5 / 255, 127.5 / 255, 254.5 / 255, 1]
    picture = np.ones((1, 6, 4), np.float32)
    picture[0, :, 0] = values
    nearest = [math.floor(Fraction(float(v)) * 255 + Fraction(1, 2)) for v in picture[0, :, 0]]
    assert rounded(picture)[0, :, 0].tolist() == nearest
    half = np.array([[[0.5, 0.5, 0.5, 1]]], np.float32)  # 127.5 and 32767.5, exactly
    assert rounded(half)[0, 0].tolist() == [128] * 3
    assert rounded(half, 16)[0, 0].tolist() == [32768] * 3


def test_straight_colour_of_what_is_half_transparent() -> None:
    picture = np.array([[[0.25, 0.5, 0, 0.5], [0, 0, 0, 0], [1e-6, 0, 0, 1e-3]]], np.float32)
    assert rounded(picture, 8, None)[0].tolist() == [[128, 255, 0, 128], [0] * 4, [0] * 4]
    assert rounded(picture, 16, None)[0, 2].tolist() == [66, 0, 0, 66]
    assert rounded(picture, 8, (0, 0, 1))[0].tolist() == [[64, 128, 128], [0, 0, 255], [0, 0, 255]]

    beyond = np.array([[[1.5, -0.5, 0.5, 1.0000001]]], np.float32)
    assert rounded(beyond)[0, 0].tolist() == [255, 0, 128]


def test_npy_is_the_picture(tmp_path: Path) -> None:
    picture = noise(5, 4)
    write_picture(picture, tmp_path / "a.npy", format="npy")
    with pytest.raises(FileError, match="exists"):
        write_picture(noise(2, 2), tmp_path / "a.npy", clobber=False)
    found = np.load(tmp_path / "a.npy")
    assert found.dtype == np.float32
    assert np.array_equal(found, picture)


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_averages_are_means(samples: int) -> None:
    fine = noise(4 * samples, 5 * samples)
    blocks = fine.reshape(4, samples, 5, samples, 4).astype(np.float64)
    found = averaged(fine, samples)
    assert (found.shape, found.dtype) == ((4, 5, 4), np.float32)
    assert np.abs(found - blocks.mean(axis=(1, 3))).max() < 1e-7
    assert np.array_equal(averaged(np.ones((6, 6, 4), np.float32), samples)[0, 0], [1, 1, 1, 1])


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    for shape, dtype in (((2, 2, 3), "f4"), ((2, 2, 4), "f8"), ((2, 4), "f4")):
        wrong = np.zeros(shape, dtype)
        with pytest.raises(VoxtoolError, match="no picture"):
            write_picture(wrong, tmp_path / "a.png")
    broken = np.zeros((2, 2, 4), np.float32)
    broken[1, 1, 2] = np.nan
    with pytest.raises(VoxtoolError, match="not finite"):
        write_picture(broken, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch) -> None:
    for bits, library, module in ((8, "Pillow", "PIL"), (16, "pypng", "png")):
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, module, None)
            with pytest.raises(
                FileError, match=rf"need {library}: pip install 'voxtool\[pictures\]'"
            ):
                write_picture(noise(2, 2), tmp_path / "a.png", bits=bits)
    assert list(tmp_path.iterdir()) == []
