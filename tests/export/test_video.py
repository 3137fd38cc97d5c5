"""Videos and pictures of a path, read back by ffmpeg and Pillow."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.export.path import of_cameras, recorded
from sparsestreet.export.video import path_pictures, side_by_side, write_pictures
from sparsestreet.scene.effects import MotionBlur, MotionBlurSettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Shutter
from tests.export.street import stored_street, street_views


def smooth_pictures(count: int, width: int = 64, height: int = 48) -> list[np.ndarray]:
    """Gradients that move: what a video can hold."""
    y, x = np.mgrid[0:height, 0:width]
    return [np.stack((x + 20 * i, y + x, 200 - y), axis=-1).astype(np.uint8) for i in range(count)]


def read_video(path) -> tuple[float, np.ndarray]:
    """Frames a second, and the frames. (imageio-ffmpeg's own reader leaves its pipes open.)"""
    # Without these flags ffmpeg rounds down on the way to RGB: one level too dark.
    raw = ["-sws_flags", "accurate_rnd+full_chroma_int", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), *raw], capture_output=True, check=True)
    stream = re.search(r"Video: h264.*, (\d+)x(\d+).*, ([\d.]+) fps", done.stderr.decode())
    width, height = int(stream[1]), int(stream[2])
    return float(stream[3]), np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / ((a.astype(np.float64) - b) ** 2).mean()))


@pytest.mark.lengthy
def test_a_video_of_a_scene_shows_what_it_renders(tmp_path):
    stored = stored_street()
    path = of_cameras(recorded(street_views(width=64, height=48)), [1, 0])
    pictures = list(path_pictures(stored, path))
    assert write_pictures(tmp_path / "drive.mp4", iter(pictures), fps=12.0, quality=9.0) == 5
    fps, frames = read_video(tmp_path / "drive.mp4")
    assert (fps, frames.shape) == (12.0, (5, 48, 128, 3))
    for picture, frame in zip(pictures, frames, strict=True):
        # Color at half the resolution costs most at the edges of Gaussians; two neighboring frames are 15 dB apart.
        assert psnr(picture, frame) > 30
    assert psnr(pictures[1], frames[2]) < 25


def test_pictures_are_the_scenes_renderings_side_by_side():
    stored = stored_street()
    path = of_cameras(recorded(street_views()), [2, 0])
    pictures = list(path_pictures(stored, path))
    rgb = stored.render(path[3][1]).rgb.clamp(0, 1).numpy()
    # Half a level of rounding.
    np.testing.assert_allclose(pictures[3][:, 48:] / 255, rgb, atol=0.5 / 255 + 1e-6)
    assert pictures[3].shape == (32, 96, 3)


def test_pictures_are_sharp_whatever_the_cameras_say():
    stored, path = stored_street(), of_cameras(recorded(street_views()), [0])
    exposed = tuple(tuple(replace(view, camera=replace(view.camera, exposure=0.02)) for view in rig) for rig in path)
    moved = Shutter(torch.tensor([0.5, 0.0, 0.0]), torch.zeros(3), seconds=0.02)
    scene = stored.scene
    blur = MotionBlur(MotionBlurSettings(), {view.indices: moved for rig in path for view in rig}, 3)
    blurred = replace(stored, scene=SceneGraph(dict(scene.nodes.items()), dict(scene.effects.items()) | {"blur": blur}))
    view = exposed[0][0]
    assert (blurred.render(view).rgb - stored.render(view).rgb).abs().max() > 0.02
    for sharp, found in zip(path_pictures(stored, path), path_pictures(blurred, exposed), strict=True):
        np.testing.assert_array_equal(sharp, found)


def test_lower_images_stand_in_the_middle():
    tall, low = np.full((6, 3, 3), 9, np.uint8), np.full((3, 2, 3), 7, np.uint8)
    row = side_by_side([tall, low])
    assert row.shape == (6, 5, 3)
    assert (row[:, :3] == 9).all()
    assert (row[1:4, 3:] == 7).all()
    assert (row[0, 3:] == 0).all()
    assert (row[4:, 3:] == 0).all()


def test_colors_survive_and_quality_costs_bytes(tmp_path):
    """And every pixel of odd sizes."""
    pictures = smooth_pictures(6, width=33, height=21)
    for quality in (2.0, 9.0):
        write_pictures(tmp_path / f"{quality:g}.mp4", pictures, fps=10.0, quality=quality)
    _, frames = read_video(tmp_path / "9.mp4")
    assert frames.shape == (6, 22, 34, 3)
    frames = frames[:, :21, :33]
    assert psnr(frames, np.stack(pictures)) > 35
    # A wrong color matrix moves gray by nothing but these colors by 5 levels and more.
    assert np.abs((frames.astype(np.float64) - pictures).mean(axis=(1, 2))).max() < 0.6
    assert (tmp_path / "2.mp4").stat().st_size < (tmp_path / "9.mp4").stat().st_size


def test_a_name_without_ending_is_a_folder_of_pngs(tmp_path):
    pictures = smooth_pictures(3)
    (tmp_path / "still").mkdir()
    assert write_pictures(tmp_path / "still", pictures, fps=10.0) == 3
    names = sorted(path.name for path in (tmp_path / "still").iterdir())
    assert names == ["00000.png", "00001.png", "00002.png"]
    for name, picture in zip(names, pictures, strict=True):
        assert np.array_equal(np.asarray(Image.open(tmp_path / "still" / name)), picture)
    assert [path.name for path in tmp_path.iterdir()] == ["still"]


@pytest.mark.parametrize("name", ["drive.mp4", "still"])
def test_an_interrupted_film_leaves_nothing(tmp_path, name):
    def interrupted():
        yield from smooth_pictures(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_pictures(tmp_path / name, interrupted(), fps=10.0)
    assert list(tmp_path.iterdir()) == []


def profile(path) -> tuple[str, str]:
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", f"file:{path}"], capture_output=True, check=False)
    found = re.search(r"Video: (\S+ \([^)]*\)).*?(yuv\w+)", done.stderr.decode())
    return found[1], found[2]


@pytest.mark.parametrize("name", ["12:30.mp4", "-y.mp4", "50%d%%.mp4", "concat:a|ü b.mp4", "http://a.mp4"])
def test_any_name_is_a_name(tmp_path, monkeypatch, name):
    """A colon is no protocol, a dash no option, a percent sign no number of a picture."""
    monkeypatch.chdir(tmp_path)
    # A quality of 10 would be crf 0, lossless, in a profile that browsers and phones do not show.
    assert write_pictures(name, smooth_pictures(2), fps=10.0, quality=10.0) == 2
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.mp4")] == [str(Path(name))]
    assert profile(tmp_path / name) == ("h264 (High)", "yuv420p")


FFMPEGS = {
    "fails behind the last picture": (
        "cat > /dev/null; echo 'The moon is full' >&2; exit 3",
        "status 3, .*The moon is",
    ),
    "ends at once": ("exec <&-; exit 4", "failed with status 4"),
    "is killed": ("read -n 9 _; kill -9 $$", "was ended by signal 9"),
    "says success and writes nothing": ("cat > /dev/null; exit 0", "took 30 pictures, and 0 of them are in its video"),
    "says success behind the first picture": (
        'case "$*" in *copy*) exec REAL "$@";; *) head -c 9216 | REAL "$@";; esac',
        "failed with status 0",
    ),
    "says success and leaves one out": (
        'case "$*" in *copy*) exec REAL "$@";; *) tail -c +9217 | REAL "$@";; esac',
        "took 30 pictures, and 29 of them are in its video",
    ),
    "says success and stops taking pictures": ("head -c 99 > /dev/null; exec <&-; exit 0", "failed with status 0"),
}


@pytest.mark.parametrize("how", FFMPEGS)
def test_when_ffmpeg_fails_the_old_video_stays_and_its_words_are_said(tmp_path, monkeypatch, how):
    script, said = FFMPEGS[how]
    program, path = tmp_path / "ffmpeg", tmp_path / "drive.mp4"
    program.write_text("#!/bin/bash\n" + script.replace("REAL", imageio_ffmpeg.get_ffmpeg_exe()))
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    path.write_bytes(b"old")
    with pytest.raises(OSError, match=said) as found:
        write_pictures(path, smooth_pictures(30), fps=10.0)
    assert len(str(found.value).splitlines()) == 1
    assert path.read_bytes() == b"old"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["drive.mp4", "ffmpeg"]


def test_what_cannot_be_filmed_is_said(tmp_path):
    with pytest.raises(ValueError, match="got none"):
        write_pictures(tmp_path / "a.mp4", [], fps=10.0)
    with pytest.raises(ValueError, match=r"at most 16,384 pixels a side, got 16,386 x 2: take a smaller width="):
        write_pictures(tmp_path / "a.mp4", [np.zeros((2, 16385, 3), np.uint8)], fps=10.0)
    with pytest.raises(ValueError, match=r"one size, got \(8, 8, 3\) after \(48, 64, 3\)"):
        write_pictures(tmp_path / "a.mp4", [*smooth_pictures(1), np.zeros((8, 8, 3), np.uint8)], fps=10.0)
    with pytest.raises(ValueError, match=r"ends in \.mp4.*got 'a\.gif'"):
        write_pictures(tmp_path / "a.gif", smooth_pictures(1), fps=10.0)
    assert list(tmp_path.iterdir()) == []


def test_without_ffmpeg_the_extra_is_named_but_pngs_go_on(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sparsestreet\[video\]'"):
        write_pictures(tmp_path / "a.mp4", smooth_pictures(1), fps=10.0)
    assert write_pictures(tmp_path / "still", smooth_pictures(1), fps=10.0) == 1
