"""Pixels of every type that files have: what becomes of them as images and as masks."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.images import (
    GivenMasks,
    check_camera_images,
    check_image_sizes,
    image_notes,
    read_image,
    read_mask,
    read_transparent,
)
from sparsestreet.data.problems import LogError
from sparsestreet.data.rig import Undistortion
from sparsestreet.geometry.lenses import Fisheye
from tests.typed import there

WIDTH, HEIGHT = 9, 5
SIZE = (WIDTH, HEIGHT)
RNG = np.random.default_rng(5)
RGB = RNG.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
GRAY = RNG.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8)
DEEP = RNG.integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
CLEAR = np.zeros((HEIGHT, WIDTH), bool)
CLEAR[:, :4] = True
ALPHA = np.where(CLEAR, 0, 255).astype(np.uint8)
GRAYS = np.repeat(GRAY[..., None], 3, -1)


def saved(image: Image.Image, path: Path, **how) -> Path:
    image.save(path, **how)
    return path


def palette_image(numbers: np.ndarray, colors: list[int]) -> Image.Image:
    image = Image.fromarray(numbers.astype(np.uint8), "L")
    image = image.convert("P")
    image.putpalette(colors + [0] * (768 - len(colors)))
    image.putdata(numbers.astype(np.uint8).reshape(-1).tolist())
    return image


def deep_color(path: Path) -> Path:
    """Pillow writes none."""
    assert cv2.imwrite(str(path), (RGB[..., ::-1].astype(np.uint16) << 8) + 37)
    return path


COLORS = [10, 20, 30, 200, 100, 50]
NUMBERS = CLEAR.astype(np.uint8)
BY_PALETTE = np.array(COLORS, np.uint8).reshape(2, 3)[NUMBERS]
IMAGES: dict[str, tuple[Callable[[Path], Path], np.ndarray]] = {
    "RGB.png": (lambda path: saved(Image.fromarray(RGB), path), RGB),
    "L.png": (lambda path: saved(Image.fromarray(GRAY), path), GRAYS),
    "1.png": (lambda path: saved(Image.fromarray(CLEAR), path), 255 * np.repeat(CLEAR[..., None], 3, -1)),
    "P.png": (lambda path: saved(palette_image(NUMBERS, COLORS), path), BY_PALETTE),
    "16.png": (lambda path: saved(Image.fromarray(DEEP), path), np.repeat(DEEP[..., None], 3, -1) / 257),
    "16.tiff": (lambda path: saved(Image.fromarray(DEEP), path), np.repeat(DEEP[..., None], 3, -1) / 257),
    "16B.tiff": (
        lambda path: saved(Image.frombytes("I;16B", SIZE, DEEP.astype(">u2").tobytes()), path),
        np.repeat(DEEP[..., None], 3, -1) / 257,
    ),
    "color16.png": (deep_color, RGB),
    "color16.tiff": (deep_color, RGB),
    "CMYK.tiff": (lambda path: saved(Image.fromarray(255 - RGB).convert("CMYK"), path), 255 - RGB),
    "RGBA.png": (lambda path: saved(Image.fromarray(np.dstack([RGB, ALPHA])), path), RGB),
    "LA.png": (lambda path: saved(Image.fromarray(np.dstack([GRAY, ALPHA]), "LA"), path), GRAYS),
    "trns.png": (lambda path: saved(palette_image(NUMBERS, COLORS), path, transparency=1), BY_PALETTE),
}
ALPHAS = {"RGBA.png", "LA.png", "trns.png"}


@pytest.mark.parametrize("name", IMAGES)
def test_every_type_of_image_has_its_pixels_and_says_what_is_done(name, tmp_path):
    write, expected = IMAGES[name]
    path = write(tmp_path / name)
    assert check_camera_images("front", [path], [], decode=True) == []
    np.testing.assert_allclose(read_image(path, SIZE).numpy(), expected, atol=0.5)  # 16 bits are rounded to 8
    hidden = read_transparent(path, SIZE)
    assert (hidden is not None) == (name in ALPHAS)
    notes = image_notes("front", [path, path])
    words = ["2 images of camera front have 16 bits a channel"] * ("16" in name)
    words += ["2 images of camera front have alpha"] * (name in ALPHAS)
    assert len(notes) == len(words)
    assert all(word in note for word, note in zip(words, notes, strict=True))
    if hidden is not None:
        assert torch.equal(hidden, torch.from_numpy(CLEAR))
        assert there(read_transparent(path, (3, 2)))[:, :2].all()  # every pixel that a transparent one touches


@pytest.mark.parametrize(("kind", "words"), [("f4", "F (32-bit floats)"), ("i4", "I (32-bit integers)")])
def test_types_that_have_no_white_are_refused_before_any_pixel_is_decoded(kind, words, tmp_path):
    path = saved(Image.fromarray(GRAY.astype(kind)), tmp_path / "a.tiff")
    (problem,) = check_camera_images("front", [path], [], decode=False)
    assert f"pixels are of the type {words}" in problem.message
    with pytest.raises(LogError, match="write gray or RGB of 8 or 16 bits"):
        read_image(path, SIZE)
    (problem,) = check_camera_images(0, [saved(Image.fromarray(RGB), tmp_path / "a.png")], [path], decode=True)
    assert "the mask has pixels of the type" in problem.message


MASK = CLEAR.copy()
MASK[2:] = False
NOISE = RNG.integers(0, 9, MASK.shape).astype(np.uint8)
BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
RED = np.where(MASK[..., None], np.array([200, 0, 0], np.uint8), BLACK)
MASKS: dict[str, Callable[[], Image.Image]] = {
    "1": lambda: Image.fromarray(MASK),
    "gray": lambda: Image.fromarray(255 * MASK.astype(np.uint8)),
    "gray of 0 and 1": lambda: Image.fromarray(MASK.astype(np.uint8)),
    "16 bits": lambda: Image.fromarray(MASK.astype(np.uint16) * 65535),
    "16 bits of 0 and 1": lambda: Image.fromarray(MASK.astype(np.uint16)),
    "black palette": lambda: palette_image(MASK, [0]),
    "labels with a palette": lambda: palette_image(MASK * 9, [0, 0, 0, 128, 0, 0]),
    "RGB": lambda: Image.fromarray(np.repeat(255 * MASK[..., None].astype(np.uint8), 3, -1)),
    "red on black": lambda: Image.fromarray(RED),
    "opaque": lambda: Image.fromarray(np.dstack([RED, np.full_like(GRAY, 255)])),
    "gray, opaque": lambda: Image.fromarray(np.dstack([255 * MASK, np.full_like(GRAY, 255)]).astype(np.uint8), "LA"),
    "noise of an encoder": lambda: Image.fromarray(np.where(MASK, 255 - NOISE, NOISE)),
    "dark white": lambda: Image.fromarray(np.where(MASK, 240, 12).astype(np.uint8)),
}


@pytest.mark.parametrize("name", MASKS)
def test_every_type_of_mask_covers_what_it_must(name, tmp_path, caplog):
    path = saved(MASKS[name](), tmp_path / "mask.png")
    image = saved(Image.fromarray(RGB), tmp_path / "image.png")
    assert check_camera_images("front", [image], [path], decode=True) == []
    assert torch.equal(read_mask(path, SIZE, sky=True), torch.from_numpy(MASK))
    assert read_mask(path, (3, HEIGHT), sky=False).tolist() == [[True, True, False]] * 2 + [[False] * 3] * 3
    said = [record.message for record in caplog.records]
    assert ["near black and white: they are split at the middle" in line for line in said] == [True] * (
        name in ("noise of an encoder", "dark white")
    )


LABELS = np.where(MASK, 10, np.where(CLEAR, 2, 0)).astype(np.uint8)
NO_MASKS: dict[str, tuple[Callable[[], Image.Image], str]] = {
    "labels": (lambda: Image.fromarray(LABELS), r"the mask has 3 values \(0, 2, 10\)"),
    "labels and one for none": (lambda: Image.fromarray(np.where(MASK, 255, LABELS + CLEAR)), "the mask has 3 values"),
    "labels in 16 bits": (lambda: Image.fromarray(LABELS.astype(np.uint16) * 1000), "the mask has 3 values"),
    "labels with a palette": (lambda: palette_image(LABELS, COLORS), "the mask has 3 values"),
    "two labels": (lambda: Image.fromarray(1 + MASK.astype(np.uint8)), r"2 values \(1, 2\), not black"),
    "gray edges": (lambda: Image.fromarray(GRAY), "values .*, not black and one other"),
    "colors": (lambda: Image.fromarray(RGB), "the mask has 45 colors"),
    "white, in alpha": (lambda: Image.fromarray(np.dstack([BLACK + 255, ALPHA])), "an alpha that differs"),
    "black, in alpha": (lambda: Image.fromarray(np.dstack([BLACK, ALPHA])), "an alpha that differs"),
    "gray, in alpha": (lambda: Image.fromarray(np.dstack([GRAY, ALPHA]), "LA"), "an alpha that differs"),
    "white is number 0": (lambda: palette_image(MASK, [255, 255, 255, 0, 0, 0]), "palette has white as number 0"),
}


@pytest.mark.parametrize("name", NO_MASKS)
def test_what_is_no_mask_is_refused_with_what_it_is(name, tmp_path):
    make, said = NO_MASKS[name]
    path = saved(make(), tmp_path / "mask.png")
    image = saved(Image.fromarray(RGB), tmp_path / "image.png")
    with pytest.raises(LogError, match=said):
        read_mask(path, SIZE, sky=False)
    with pytest.raises(LogError, match=said):
        raise LogError(check_camera_images("front", [image], [path], decode=True))


def test_a_jpeg_under_a_masks_name_is_split_at_the_middle(tmp_path, caplog):
    mask = np.zeros((48, 64), np.uint8)
    mask[8:40, 16:] = 255
    path = saved(Image.fromarray(np.clip(mask, 3, 250)), tmp_path / "mask.png", format="JPEG", quality=98)
    assert torch.equal(read_mask(path, (64, 48), sky=True), torch.from_numpy(mask > 0))
    assert f"masks such as {path} have" in caplog.text


@pytest.mark.parametrize("ending", ["jpg", "png", "webp"])
def test_an_exif_orientation_is_said_and_named_where_the_size_is_wrong(ending, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 8
    path = saved(Image.fromarray(RGB), tmp_path / f"a.{ending}", exif=exif)
    (note,) = image_notes("front", [path, path])
    assert note == "2 images of camera front carry EXIF orientation 8: read as stored, as COLMAP does"
    assert read_image(path, SIZE).shape == (HEIGHT, WIDTH, 3)
    (problem,) = check_image_sizes("front", (HEIGHT, WIDTH), [path])
    assert "the image is 9x5, camera front is calibrated for 5x9; its EXIF orientation 8 turns it" in problem.message
    assert "turn the pixels" in problem.remedy
    (problem,) = check_image_sizes("front", (18, 10), [path])
    assert "EXIF" not in problem.message


def test_a_tiff_that_pillow_would_turn_is_refused(tmp_path):
    path = saved(Image.fromarray(RGB), tmp_path / "a.tiff", tiffinfo={0x0112: 3})
    (problem,) = check_camera_images("front", [path], [], decode=True)
    assert "the TIFF carries orientation 3" in problem.message


SIZES = {"recorded_size": (8, 4), "size": (8, 4)}


@pytest.fixture
def masks(tmp_path: Path) -> GivenMasks:
    """Sky of one image of the camera front: its upper half."""
    folder = tmp_path / "sky" / "front"
    folder.mkdir(parents=True)
    pixels = np.zeros((4, 8), np.uint8)
    pixels[:2] = 255
    Image.fromarray(pixels).save(folder / "000.png")
    return GivenMasks(tmp_path)


def test_a_mask_is_found_by_kind_camera_and_stem(masks):
    found = masks.read("front", "000", **SIZES)
    assert (masks.kinds, list(found)) == ({"sky"}, ["sky"])
    assert found["sky"].any(1).tolist() == [True, True, False, False]
    assert masks.read("front", "000", recorded_size=(8, 4), size=(4, 2))["sky"].shape == (2, 4)


def test_a_camera_without_a_folder_has_none_and_one_with_a_folder_has_all(masks):
    assert masks.read("rear", "000", **SIZES) == {}
    with pytest.raises(LogError, match=r"001\.png: the mask is missing"):
        masks.read("front", "001", **SIZES)
    (problem,) = masks.check([("front", "000"), ("front", "001"), ("rear", "000")])
    assert problem.path.name == "001.png"


def test_a_mask_of_another_size_and_a_folder_of_none_are_refused(masks, tmp_path):
    with pytest.raises(LogError, match="the mask is 8x4, the camera's images are 16x8"):
        masks.read("front", "000", recorded_size=(16, 8), size=(8, 4))
    (problem,) = GivenMasks(tmp_path / "sky").check([])
    assert "none of the folders sky, human, vehicle, ego" in problem.message


def test_a_lens_is_taken_out_of_masks_too(masks):
    lens = Fisheye(fx=4.0, fy=4.0, cx=4.0, cy=2.0)
    take_out = Undistortion.of(lens, lens.pinhole, (8, 4), (8, 4))
    plain, seen = masks.read("front", "000", **SIZES), masks.read("front", "000", undistortion=take_out, **SIZES)
    expected = take_out(255 * plain["sky"].numpy().astype(np.uint8)) > 0
    assert (seen["sky"].numpy() == expected).all()
    assert not torch.equal(seen["sky"], plain["sky"])
