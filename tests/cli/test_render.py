"""``sparsestreet render`` on a hand-made scene; the run of a real training is rendered in test_train."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from PIL import Image

from sparsestreet.cli.commands.render import render
from sparsestreet.cli.config.compose import load_run_config
from sparsestreet.export.path import shifted
from sparsestreet.scene.views import write_views
from tests.export.street import stored_street, street_views, write_street
from tests.typed import there


@pytest.fixture
def run(tmp_path) -> Path:
    """A folder with what a training leaves: a scene and views of 5 frames and 4 cameras; frame 2 is held out."""
    return write_street(tmp_path / "run")


def pictures(folder: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)) for path in sorted(folder.iterdir())]


def rendered(stored, view) -> np.ndarray:
    return (stored.render(view).rgb.clamp(0, 1) * 255).round().byte().numpy()


def test_the_recorded_path_shows_every_camera_leftmost_first(run, tmp_path, capsys):
    assert render([f"scene={run}", f"out={tmp_path / 'drive'}"]) == 0
    shown, stored = pictures(tmp_path / "drive"), stored_street()
    assert len(shown) == 5
    by_place = {(view.frame_index, view.camera_index): view for view in street_views()}
    for frame, picture in enumerate(shown):
        expected = np.concatenate([rendered(stored, by_place[frame, camera]) for camera in (3, 1, 0, 2)], axis=1)
        assert np.array_equal(picture, expected)
    said = capsys.readouterr().out
    assert "frame rate is not known: taken as 10 a second" in said
    assert "5 of 5 frames" in said
    assert "5 frames of camera 3, 1, 0, 2 at 10 a second" in said


def test_a_shifted_path_is_seen_from_beside(run, tmp_path):
    words = [f"scene={run}", f"out={tmp_path / 'right'}", "path=shifted", "offset=1.5", "cameras=[0,2]", "frames=1:3"]
    assert render(words) == 0
    shown, stored = pictures(tmp_path / "right"), stored_street()
    assert len(shown) == 2
    rig = [view for view in street_views() if view.frame_index == 2]
    moved = {view.camera_index: view for view in shifted((tuple(rig),), 1.5)[0]}
    expected = np.concatenate([rendered(stored, moved[camera]) for camera in (0, 2)], axis=1)
    assert np.array_equal(shown[1], expected)
    assert not np.array_equal(shown[1][:, :48], rendered(stored, rig[0]))


def test_a_video_lasts_as_long_as_the_drive(run, tmp_path, capsys):
    """Five frames, 0.1 s apart: each is shown for 0.1 s, whatever the frames a second of the video."""
    from tests.export.test_video import read_video

    views = [replace(view, seconds=0.1 * view.indices[0]) for view in street_views(cameras=(0,))]
    write_views(tmp_path / "clock.json", views, [], frame_rate=10.0)
    words = [f"scene={run}", f"views={tmp_path / 'clock.json'}", "cameras=0", "width=24"]
    assert render([*words, f"out={tmp_path / 'own.mp4'}"]) == 0
    fps, frames = read_video(tmp_path / "own.mp4")
    assert (fps, len(frames), len(frames) / fps) == (10.0, 5, 0.5)
    assert "at 10 a second (the log's speed, 10 of its frames a second)" in capsys.readouterr().out
    assert render([*words, f"out={tmp_path / 'fine.mp4'}", "fps=40"]) == 0
    fps, frames = read_video(tmp_path / "fine.mp4")
    # From the first frame to the last, 0.4 s, in steps of 1/40 s, and the last one.
    assert (fps, len(frames)) == (40.0, 17)
    assert "at 40 a second (the log's speed, 10 of its frames a second)" in capsys.readouterr().out


@pytest.mark.lengthy
def test_the_lidar_of_the_log_that_trained_the_run(finished, tmp_path, capsys):
    """Returns of the recorded depth images, which the reader made of the same sweeps in its own way."""
    words = [str(finished), str(tmp_path / "out"), "layers=[lidar]", "frames=2:3", "cameras=0"]
    assert render(words) == 0, capsys.readouterr().err
    (found,) = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "out" / "lidar").iterdir())]
    log = instantiate(load_run_config(finished).data.log, _convert_="all").read()
    (frame,) = [frame for frame in log.frames if frame.indices == (2, 0)]
    assert np.count_nonzero(found) > 50
    np.testing.assert_allclose(found / 1000, there(frame.depth).clamp(max=65.535).numpy(), atol=0.00051)


def test_the_lidar_of_another_log_is_refused(finished, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    description = run / "run.json"
    description.write_text(re.sub(r'"data_hash": "\w{8}', '"data_hash": "00000000', description.read_text()))
    assert render([str(run), str(tmp_path / "out"), "layers=[lidar]"]) == 1
    assert "the log is not the one that" in capsys.readouterr().err
