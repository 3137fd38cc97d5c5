"""``sparsestreet render`` on a hand-made scene; the run of a real training is rendered in test_train."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from sparsestreet.cli.commands import scenes
from sparsestreet.cli.commands.render import render
from sparsestreet.cli.config.compose import load_run_config
from sparsestreet.export import rig, video
from sparsestreet.export.layers import LAYERS, layer_values
from sparsestreet.export.path import recorded, resized, shifted
from sparsestreet.export.seen import count_images
from sparsestreet.geometry.cameras import inverse
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.scene.edits import REMOVED, Edits, edited
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import read_views, write_views
from tests.export.street import stored_street, street_views
from tests.typed import there


@pytest.fixture
def run(tmp_path) -> Path:
    """A folder with what a training leaves: a scene and views of 5 frames and 4 cameras; frame 2 is held out."""
    folder = tmp_path / "run"
    save_scene(folder / "scene.safetensors", stored_street())
    views = street_views()
    write_views(
        folder / "views.json", [v for v in views if v.frame_index != 2], [v for v in views if v.frame_index == 2]
    )
    return folder


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


@pytest.mark.parametrize(
    "error",
    [None, MemoryError(), RuntimeError("CUDA out of memory.\nTried to"), torch.OutOfMemoryError("out of memory")],
)
def test_where_memory_does_not_do_it_is_one_line(run, tmp_path, error, capsys, monkeypatch):
    def out_of_memory(*told):
        raise error

    if error is None:
        monkeypatch.setattr(rasterizer, "PAIR_LIMIT", 5)
    else:
        monkeypatch.setattr(video, "side_by_side", out_of_memory)
    assert render([f"scene={run}", f"out={tmp_path / 'drive.mp4'}"]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert ("more than the 5 that may be held" if error is None else "render: memory is out") in said
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


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


def test_a_place_that_cannot_be_written_is_found_before_the_first_frame(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(video, "side_by_side", lambda images: pytest.fail("a frame was rendered"))
    (tmp_path / "file").write_text("")
    assert render([f"scene={run}", f"out={tmp_path / 'file' / 'drive.mp4'}"]) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_ctrl_c_leaves_nothing(run, tmp_path, monkeypatch, capsys):
    def interrupt(images):
        raise KeyboardInterrupt

    monkeypatch.setattr(video, "side_by_side", interrupt)
    assert render([f"scene={run}", f"out={tmp_path / 'drive.mp4'}"]) == 130
    assert "stopped, nothing was written" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], {"fps": 4.0, "quality": 7.0, "device": None, "count": 5, "size": (48, 32)}),
        (["quality=2.5", "fps=8", "device=cpu", "width=24", "frames=1:4"],
         {"fps": 8.0, "quality": 2.5, "device": "cpu", "count": 5, "size": (24, 16)}),
        (["log_fps=2", "fps=1"], {"fps": 1.0, "quality": 7.0, "device": None, "count": 3, "size": (48, 32)}),
    ],
)  # fmt: skip
def test_everything_that_is_asked_for_arrives(run, tmp_path, monkeypatch, capsys, words, expected):
    """Five frames at 4 a second; a video of 8 a second of three of them has five, one of half the speed three."""
    views = read_views(run / "views.json")
    write_views(run / "views.json", views.training, views.held_out, frame_rate=4.0)
    opened, given = [], {}
    stored = stored_street()
    monkeypatch.setattr(scenes, "open_scene", lambda *place: opened.append(place) or stored)
    monkeypatch.setattr(video, "path_pictures", lambda *told: given.update(path=told) or iter(()))
    monkeypatch.setattr(video, "write_pictures", lambda *told, **how: given.update(written=(told, how)) or 77)
    assert render([f"scene={run}", f"out={tmp_path / 'o'}", "cameras=[2,0]", *words]) == 0
    assert opened == [(run, expected["device"], ())]
    shown, path = given["path"]
    assert shown is stored
    assert len(path) == expected["count"]
    assert {(view.camera.width, view.camera.height) for rig in path for view in rig} == {expected["size"]}
    assert {tuple(view.camera_index for view in rig) for rig in path} == {(2, 0)}
    (out, _), how = given["written"]
    assert out == tmp_path / "o"
    assert how == {"fps": expected["fps"], "quality": expected["quality"]}
    assert f"{tmp_path / 'o'}: 77 frames of camera 2, 0 at {expected['fps']:g} a second" in capsys.readouterr().out


def test_a_path_of_poses_of_ones_own(run, tmp_path, capsys):
    views = read_views(run / "views.json").all
    front = [view for view in views if view.camera_index == 0]
    poses = [
        {"seconds": 0.1 * view.indices[0], "world_from_camera": inverse(view.camera.camera_from_world).tolist()}
        for view in front[:3]
    ]
    (tmp_path / "poses.json").write_text(json.dumps({"poses": poses}))
    assert render([f"{run}", f"{tmp_path / 'own'}", f"path={tmp_path / 'poses.json'}"]) == 0
    shown = pictures(tmp_path / "own")
    assert len(shown) == 3
    for picture, view in zip(shown, front, strict=False):
        # The pose goes through its inverse twice.
        assert np.abs(picture.astype(int) - rendered(stored_street(), view)).max() <= 1
    assert f"3 frames of {tmp_path / 'poses.json'} at 10 a second, made" in capsys.readouterr().out


def test_another_rig(run, tmp_path):
    words = ["cameras=0", "frames=0:1", "up=1.0", "fov=100", "width=60", "height=30"]
    assert render([f"{run}", f"{tmp_path / 'a'}", *words]) == 0
    (shown,) = pictures(tmp_path / "a")
    path = recorded(street_views(cameras=(0,)))[:1]
    expected = rig.pinholes(rig.cropped(resized(rig.raised(path, 1.0), 60), 30), 100.0)[0][0]
    assert np.array_equal(shown, rendered(stored_street(), expected))


def test_layers_are_folders_of_exact_values_with_tables(run, tmp_path):
    out = tmp_path / "layers"
    words = ["layers=[rgb,depth,alpha,nodes,instances]", "cameras=[0,2]", "frames=1:3"]
    assert render([f"{run}", f"{out}", *words]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "alpha", "depth", "instances", "instances.json", "nodes", "nodes.json", "rgb",
    ]  # fmt: skip
    view = next(view for view in street_views() if view.indices == (2, 2))
    expected = layer_values(stored_street(), view, LAYERS)
    for layer in LAYERS:
        found = np.asarray(Image.open(out / layer / "camera_2" / "00001.png"))
        assert np.array_equal(found, expected[layer])
        assert found.dtype == expected[layer].dtype
    assert json.loads((out / "nodes.json").read_text()) == {"1": "background", "2": "rigid"}
    assert json.loads((out / "instances.json").read_text())["2"]["name"] == "tram"


def test_seen_images_are_training_images_and_counted_before_edits(run, tmp_path):
    (tmp_path / "edits.yaml").write_text("remove: [car]", encoding="utf-8")
    words = ["layers=[seen]", f"edits={tmp_path / 'edits.yaml'}", "cameras=0", "frames=1:2"]
    assert render([f"{run}", f"{tmp_path / 'out'}", *words]) == 0
    stored, views = stored_street(), read_views(run / "views.json")
    count_images(stored, views.training)
    bare = replace(stored, scene=edited(stored.scene.eval(), Edits({"car": REMOVED})))
    view = next(view for view in views.all if view.indices == (1, 0))
    (shown,) = pictures(tmp_path / "out" / "seen")
    assert np.array_equal(shown, layer_values(bare, view, ["seen"])["seen"])
    count_images(bare, views.all)
    assert not np.array_equal(shown, layer_values(bare, view, ["seen"])["seen"])
