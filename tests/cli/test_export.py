"""``sparsestreet export`` on a hand-made scene."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from sparsestreet.cli.export import USAGE, ExportRequest, export
from sparsestreet.cli.render import render
from sparsestreet.export.ply import scene_gaussians
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import write_views
from tests.export.street import CAR_ROWS, ROAD_ROWS, TRAM_ROWS, stored_street, street_views


@pytest.fixture
def run(tmp_path) -> Path:
    save_scene(tmp_path / "run" / "scene.safetensors", stored_street())
    return tmp_path / "run"


def means(path: Path) -> np.ndarray:
    vertices = PlyData.read(path)["vertex"]
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


def test_the_whole_street_at_a_time(run, tmp_path, capsys):
    out = tmp_path / "street.ply"
    assert export([f"scene={run}", "time=0.5", f"out={out}"]) == 0
    assert np.array_equal(means(out), scene_gaussians(stored_street(), 0.5).means.numpy())
    assert f"{ROAD_ROWS + CAR_ROWS + TRAM_ROWS} Gaussians at time 0.5" in capsys.readouterr().out


def test_nodes_and_an_instance(run, tmp_path):
    assert export([f"scene={run}", f"out={tmp_path / 'road.ply'}", "nodes=[background]"]) == 0
    assert len(means(tmp_path / "road.ply")) == ROAD_ROWS
    assert export([f"scene={run / 'scene.safetensors'}", f"out={tmp_path / 'car.ply'}", "instance=car"]) == 0
    expected = scene_gaussians(stored_street(), 0.0, instances=["car"]).means.numpy()
    assert np.array_equal(means(tmp_path / "car.ply"), expected)


def test_edits_are_honored(run, tmp_path):
    write_views(run / "views.json", street_views(), [], frame_rate=10.0)
    (tmp_path / "edits.yaml").write_text("remove: [tram]")
    assert export([f"{run}", f"{tmp_path / 'a.ply'}", f"edits={tmp_path / 'edits.yaml'}"]) == 0
    assert len(means(tmp_path / "a.ply")) == ROAD_ROWS + CAR_ROWS


def test_a_street_is_one_file_that_commands_open(run, tmp_path, capsys):
    write_views(run / "views.json", street_views(), [], frame_rate=10.0)
    small = tmp_path / "small.street"
    assert export([str(run), str(small)]) == 0
    assert "37 Gaussians" in capsys.readouterr().out
    (run / "views.json").unlink()
    # It has its views, also where it is packed once more.
    assert export([str(small), str(tmp_path / "again.street")]) == 0
    assert render([str(tmp_path / "again.street"), str(tmp_path / "pictures"), "frames=0:2"]) == 0
    assert len(list((tmp_path / "pictures").iterdir())) == 2
    assert export([str(small), str(tmp_path / "objects")]) == 0
    assert "2 objects and poses.json: car, tram" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["street.spz", "street.sog", "street.compressed.ply"])
def test_a_frame_for_viewers_and_what_it_lost(run, tmp_path, name, capsys):
    write_views(run / "views.json", street_views(), [], frame_rate=10.0)
    assert export([str(run), str(tmp_path / name), "time=0.25", "nodes=background", "check=true"]) == 0
    said = capsys.readouterr().out
    assert "30 Gaussians at time 0.25" in said
    assert "dB beside what was written" in said
    assert "lost: time, as this is the moment 0.25; the sky" in said


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        ({"tme": 0.5}, 2, "no key 'tme'; did you mean 'time'?"),
        ({"out": "street.html", "time": 1}, 2, "time is no option of a .html: leave it out"),
        ({"shapes": 4}, 2, "shapes is no option of a .ply: leave it out"),
        ({"out": "street.html", "shapes": 0}, 2, "shapes must be above 0 a second, got 0"),
        ({"out": "street.html"}, 1, "training writes a views.json"),
        (
            {"out": "street.obj"},
            2,
            "must end in .street, .ply, .compressed.ply, .spz, .sog, .html, .usdz, got 'street.obj'",
        ),
        ({"out": "street.ply", "car": "[4,2,1]"}, 2, "car is no option of a .ply: leave it out"),
        ({"out": "a.street", "time": 0.5}, 2, "time is no option of a .street: leave it out"),
        ({"out": "a.ply", "check": "true"}, 2, "check is no option of a .ply: leave it out"),
        ({"out": "folder", "check": "true"}, 2, "check is no option of a folder: leave it out"),
        ({"nodes": "rigid", "instance": "car"}, 2, "exclude each other"),
        ({"instance": "bus"}, 1, "no instance 'bus'; it has car, tram"),
        ({"nodes": "roads"}, 1, "no node 'roads'; it has background, rigid"),
        ({"instance": "tram", "time": 1}, 1, "it is there from 0.000 to 0.500"),
        ({"time": 2}, 1, "time runs from 0"),
        ({"scene": "nowhere"}, 1, "there is no scene at nowhere"),
    ],
)
def test_a_slip_is_one_line_and_leaves_nothing(run, tmp_path, change, status, said, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = {"scene": run, "out": "street.ply"} | change
    assert export([f"{key}={value}" for key, value in words.items()]) == status
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_help_names_every_option():
    for field in fields(ExportRequest):
        assert f"\n  {field.name} " in USAGE
