"""``sparsestreet export`` on a hand-made scene."""

import math
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.render import render
from sparsestreet.export.ply import scene_gaussians
from sparsestreet.scene.effects.optics import Lens, LensSettings
from sparsestreet.scene.graph import SceneGraph
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
    said = capsys.readouterr().out
    assert "2 objects and poses.json: car, tram" in said
    assert "meshes: a hull of each, no ground.ply, as nothing tells how high the ground is" in said
    assert export([str(small), str(tmp_path / "a.obj"), "time=1"]) == 0
    assert "a.obj: 0 vertices of the ground, 1 object at time 1" in capsys.readouterr().out
    assert export([str(small), str(tmp_path / "a.obj"), "voxel=0.5"]) == 0
    assert " triangles of what 3 or more views see within 30 m" in capsys.readouterr().out
    assert "o surroundings\n" in (tmp_path / "a.obj").read_text()
    assert export([str(small), str(tmp_path / "a.ply"), "voxel=0.5"]) == 2
    assert "voxel is no option of a .ply" in capsys.readouterr().err
    assert export([str(small), str(tmp_path / "a.obj"), "nodes=[rigid]"]) == 2
    assert "nodes is no option of a .obj" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "objects", "a.html"])
@pytest.mark.parametrize("mip", [False, True])
def test_what_a_file_loses_is_said(tmp_path, name, mip, capsys):
    """Of the street at time 0.6 the tram is gone; its camera has an effect, and small Gaussians may have less blur."""
    write_views(tmp_path / "views.json", street_views(), [], frame_rate=10.0)
    stored = stored_street()
    options = replace(stored.options, settings=replace(stored.options.settings, antialias=mip))
    effects = dict(stored.scene.effects.items()) | {"lens": Lens(LensSettings())}
    scene = SceneGraph(dict(stored.scene.nodes.items()), effects)
    save_scene(tmp_path / "scene.safetensors", replace(stored, options=options, scene=scene))
    moment = [] if name in ("objects", "a.html") else ["time=0.6"]
    assert export([str(tmp_path), str(tmp_path / name), *moment]) == 0
    said = capsys.readouterr().out
    assert ("trained with antialias: opacities are those that its cameras see" in said) == (mip and name != "a.spz")
    assert "effects of the cameras (lens)" in said
    assert ("left out: 3 Gaussians" in said) == bool(moment)
    files = [tmp_path / name] if moment else sorted((tmp_path / name).glob("*.ply")) if name == "objects" else []
    for file in files:
        if file.suffix == ".ply":
            assert b"SplatRenderMode" not in file.read_bytes().partition(b"end_header")[0]
            assert len(PlyData.read(file)["vertex"]) > 0


@pytest.mark.parametrize(("known", "asked"), [(True, "antialias=true"), (False, "nodes=[background]")])
def test_a_ply_says_that_it_wants_antialias_where_that_is_asked_or_no_camera_is_known(tmp_path, known, asked, capsys):
    stored = stored_street()
    options = replace(stored.options, settings=replace(stored.options.settings, antialias=True))
    save_scene(tmp_path / "scene.safetensors", replace(stored, options=options))
    if known:
        write_views(tmp_path / "views.json", street_views(), [], frame_rate=10.0)
    assert export([str(tmp_path), str(tmp_path / "a.ply"), asked]) == 0
    assert ("no camera is known" in capsys.readouterr().out) != known
    assert b"\ncomment SplatRenderMode: mip\n" in (tmp_path / "a.ply").read_bytes()


FORMATS = ["a.ply", "a.spz", "a.obj", "a.html", "objects", "a.usdz", "a.street"]
NUMBERS = [
    ("means", math.inf),
    ("opacity_logits", math.nan),
    ("sh_rest", -math.inf),
]
OVERFLOW = [("log_scales", 100.0), ("log_scales", 60.0)]
"""Finite as they are learned: no scale in float32, and none whose square is one."""


@pytest.mark.parametrize("name", FORMATS)
def test_a_number_that_is_none_is_named_and_no_file_is_written(tmp_path, name, capsys):
    """NaN opacities would be dropped by every comparison; a scale without end becomes one of 365 m in a .spz."""
    write_views(tmp_path / "views.json", street_views(), [], frame_rate=10.0)
    overflow = {"a.street": [], "a.usdz": [], "a.html": OVERFLOW}.get(name, OVERFLOW[:1])
    for (field, value), (node, row) in zip([*NUMBERS, *overflow], cycle([("background", 17), ("rigid", 5)])):
        stored = stored_street()
        with torch.no_grad():
            getattr(stored.scene.nodes[node].rows, field)[row].flatten()[-1:] = value
        save_scene(tmp_path / "scene.safetensors", stored)
        assert export([str(tmp_path), str(tmp_path / name)]) == 1, (node, field, value)
        said = capsys.readouterr().err
        assert len(said.strip().splitlines()) == 1
        raw = f"nodes.{node}.rows.{field} must be finite, but row {row} has {value}: the scene is damaged"
        assert (raw if (field, value) not in OVERFLOW else "scales") in said
        assert "has inf" in said or not math.isfinite(value)
        assert sorted(one.name for one in tmp_path.iterdir()) == ["scene.safetensors", "views.json"]
