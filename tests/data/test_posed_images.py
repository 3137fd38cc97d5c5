"""Which images are of one camera, and which of one instant: by their names."""

from pathlib import Path, PurePosixPath

import pytest
import torch

from sparsestreet.data.posed_images import PosedImage, sort_images
from sparsestreet.data.problems import LogError
from sparsestreet.geometry.lenses import BrownConrady

NEAR, FAR = (BrownConrady(fx=focal, fy=focal, cx=16.0, cy=12.0) for focal in (30.0, 60.0))


def image(name: str, lens: BrownConrady = NEAR, time: float | None = None) -> PosedImage:
    pose = torch.eye(4, dtype=torch.float64)
    return PosedImage(Path("/data") / name, PurePosixPath(name), lens, (32, 24), pose, time=time)


def instants(*images: PosedImage, **choice: object) -> list[dict[str, str]]:
    options = {"cameras": None, "first_frame": 0, "last_frame": -1} | choice
    found = sort_images(images, Path("/data/table"), **options)  # pyright: ignore[reportArgumentType]
    return [{camera: str(image.name) for camera, image in instant.items()} for instant in found.instants]


def test_images_of_one_folder_are_an_instant_each_in_the_order_of_their_numbers():
    assert instants(image("f10.png"), image("f9.png"), image("f1.png")) == [
        {"camera": "f1.png"},
        {"camera": "f9.png"},
        {"camera": "f10.png"},
    ]


def test_equal_names_in_several_folders_are_an_instant():
    images = [image("b/2.png"), image("a/1.png"), image("a/2.jpg"), image("b/1.png"), image("rig/c/2.png")]
    assert instants(*images) == [
        {"a": "a/1.png", "b": "b/1.png"},
        {"b": "b/2.png", "a": "a/2.jpg", "rig/c": "rig/c/2.png"},
    ]
    assert instants(*images, cameras=["rig/c"]) == [{"rig/c": "rig/c/2.png"}]
    assert instants(*images, cameras=["b"], first_frame=1) == [{"b": "b/2.png"}]


def test_several_lenses_of_a_folder_are_several_cameras():
    assert instants(image("1.png"), image("2.png", FAR), image("3.png")) == [
        {"camera_0": "1.png"},
        {"camera_1": "2.png"},
        {"camera_0": "3.png"},
    ]


def test_times_come_before_names():
    images = [image("a/1.png", time=0.5), image("a/2.png", time=0.25), image("b/9.png", time=0.5)]
    assert instants(*images) == [{"a": "a/2.png"}, {"a": "a/1.png", "b": "b/9.png"}]
    with pytest.raises(LogError, match=r"a/1\.png and a/2\.png are of one camera and one instant"):
        instants(image("a/1.png", time=0.5), image("a/2.png", time=0.5))


def test_what_is_not_there():
    with pytest.raises(ValueError, match=r"cameras \['b'\] must be different ones of the log's \['a'\]"):
        instants(image("a/1.png"), cameras=["b"])
    with pytest.raises(ValueError, match="frames 1 to -1 are not within"):
        instants(image("a/1.png"), first_frame=1)
    with pytest.raises(LogError, match="are of one camera and one instant"):
        instants(image("a/1.png"), image("a/1.jpg"))
