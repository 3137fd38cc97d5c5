"""What the commands that open a scene have in common: slips in one line, what they import, and small commands."""

import itertools
import sys
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.cli.commands import bench, evaluate, export, objects, presets, render, report, scenes, serve, view
from sparsestreet.cli.commands.effects import effects
from sparsestreet.cli.commands.evaluate import Options, extra_words
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.export.objects import scene_objects
from sparsestreet.export.ply import scene_gaussians, write_ply
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import write_views
from tests.export.street import CAR_ROWS, stored_street, street_views, write_street
from tests.serving.street import write_run

MODULES = {
    "bench": bench, "evaluate": evaluate, "export": export, "objects": objects, "presets": presets, "render": render,
    "report": report, "serve": serve, "view": view,
}  # fmt: skip


def command(name: str) -> Callable[[list[str]], int]:
    return getattr(MODULES[name], name)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A folder with what a training leaves: a scene and views of 5 frames and 4 cameras; frame 2 is held out."""
    return write_street(tmp_path_factory.mktemp("commands") / "run", frame_rate=4.0)


SLIPS = [
    # Command, words behind those that it needs, status, what is said.
    ("render", "widht=5", 2, "did you mean 'width'?"),
    ("render", "offset=1", 2, "needs both: path=shifted offset=METERS"),
    ("render", "path=circle", 2, "or a .json, got 'circle'"),
    ("render", "path=a.json frames=0:2", 2, "frames= chooses of the log's"),
    ("render", "path=a.json", 1, "there is no path at a.json"),
    ("render", "layers=rgb,radar", 2, "layers are rgb, depth, alpha, nodes, instances, seen, lidar, each once"),
    ("render", "layers=rgb,lidar", 1, "the layer lidar needs the log that the scene was trained on"),
    ("render", "fov=180", 2, "fov lies between 0 and 180 degrees"),
    ("render", "quality=11", 2, "quality lies in 1 to 10, got 11"),
    ("render", "fps=1e5", 2, "fps lies in 0.001 to 1000, got 100000"),
    ("render", "quality=nan", 2, "quality must be a number, got 'nan'"),
    ("render", "width=6000", 1, "at most 16,384 pixels a side, got 24,000 x 4,000: take a smaller width="),
    ("render", "out=drive.avi", 2, "ends in .mp4"),
    ("render", "scene=nowhere", 1, "there is no scene at nowhere"),
    ("render", "views=nowhere.json", 1, "there is no nowhere.json: training writes"),
    ("render", "cameras=7", 1, "no camera 7 in frame 0, only [0, 1, 2, 3]"),
    ("render", "frames=9:", 1, "the path has 0 to 4"),
    ("render", "device=tpu", 1, "device must be cpu or cuda, got 'tpu'"),
    ("render", "edits=edits.yaml", 1, "no object 'cart': the nearest names are car"),
    ("export", "tme=0.5", 2, "no key 'tme'; did you mean 'time'?"),
    ("export", "out=street.html time=1", 2, "time is no option of a .html: leave it out"),
    ("export", "shapes=4", 2, "shapes is no option of a .ply: leave it out"),
    ("export", "out=a.fbx", 2, "must end in .street, .ply, .spz, .obj, .html, .usdz, got 'a.fbx'"),
    ("export", "out=a.compressed.ply", 2, ".spz, .obj, .html, .usdz, got 'a.compressed.ply'"),
    ("export", "car=[4,2,1]", 2, "car is no option of a .ply: leave it out"),
    ("export", "out=folder check=true", 2, "check is no option of a folder: leave it out"),
    ("export", "nodes=rigid instance=car", 2, "exclude each other"),
    ("export", "instance=bus", 1, "no instance 'bus'; it has car, tram"),
    ("export", "instance=tram time=1", 1, "it is there from 0.000 to 0.500"),
    ("export", "time=2", 1, "time runs from 0"),
    ("objects", "out=sheet.jpg", 2, "must end in .png"),
    ("serve", "port=70000", 2, "port lies in 0 to 65535"),
    ("serve", "mount=1,2", 2, "mount is three numbers"),
    ("view", "fps=0", 2, "fps lies in 1 to 60, got 0"),
    ("view", "port=99999", 2, "a port lies in 0 to 65535"),
    ("view", "known_as=[http://a]", 2, "without http:// and port, got 'http://a'"),
    ("view", "scene=nowhere", 1, "there is no scene at nowhere"),
    ("evaluate", "novel=1,0", 2, "novel"),
    ("evaluate", "presets=fast,quick", 2, "no settings preset 'quick': choose one of"),
    ("report", "basline=plain", 2, "no key 'basline'; did you mean 'baseline'?"),
    ("report", "figure=a.png", 2, "the figure is of a sweep: say sweep=DIR"),
    ("report", "sweep=x", 2, "name folders of runs, or sweep=DIR"),
    ("presets", "nerf", 2, "no method=nerf of DriveStudio: choose one of 3dgs, deformgs, omnire, pvg, streetgs"),
    ("presets", "pvg preset=drivestudio_legacy", 2, "choose one of omnire, streetgs"),
    ("bench", "setting", 2, "mode must be one of settings, step, got 'setting'"),
    ("bench", "settings sed=1", 2, "no key 'sed'; there are mode, quick, street, threads, out"),
    ("bench", "step street=RUN", 2, "street=RUN is for the mode settings, got step: leave it out"),
]
OUT = {"render": ["out=drive.mp4"], "export": ["out=street.ply"]}
"""What is asked for where the words of a slip say no other."""


@pytest.mark.parametrize(("name", "words", "status", "said"), SLIPS, ids=[f"{one[0]} {one[1]}" for one in SLIPS])
def test_a_slip_is_one_line_and_leaves_nothing(run, tmp_path, name, words, status, said, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "edits.yaml").write_text("remove: [cart]\n")
    given = words.split()
    keys = {word.partition("=")[0] for word in given}
    out = [word for word in OUT.get(name, []) if word.partition("=")[0] not in keys]
    scene = [] if name in ("bench", "presets") or "scene" in keys else [str(run)]
    assert command(name)([*scene, *given, *out]) == status
    error = capsys.readouterr().err
    assert error.startswith(f"sparsestreet {name}: ")
    assert said in error
    assert len(error.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["edits.yaml"]


@pytest.mark.parametrize(
    ("name", "request_kind"),
    [("render", "RenderRequest"), ("export", "ExportRequest"), ("serve", "ServeRequest"), ("view", "ViewRequest")],
)
def test_the_help_names_every_option(name, request_kind):
    module = MODULES[name]
    for field in fields(getattr(module, request_kind)):
        assert f"\n  {field.name} " in module.USAGE


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("render", ["out"]), ("view", ["port=0"]), ("export", ["a.spz"]), ("export", ["a.usdz"]),
        ("export", ["a.street"]), ("objects", []), ("serve", ["port=0"]), ("evaluate", []),
    ],
)  # fmt: skip
def test_every_command_names_a_file_of_another_kind(name, more, tmp_path, monkeypatch, capsys):
    """Our own .ply, which is for viewers, comes back to us."""
    monkeypatch.chdir(tmp_path)
    write_ply("car.ply", scene_gaussians(stored_street(), 0.0))
    assert command(name)(["car.ply", *more]) == 1
    said = capsys.readouterr().err
    assert "car.ply holds Gaussians of one moment for viewers, or points, not a scene: open the run's folder" in said
    assert len(said.strip().splitlines()) == 1
    assert [one.name for one in tmp_path.iterdir()] == ["car.ply"]


@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("asked", [None, "cpu", "cuda"])
def test_a_scene_opens_where_it_is_asked_for(tmp_path, monkeypatch, gpu, asked):
    """Of a run its configuration is looked at first; a file alone says nothing of them."""
    done: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(scenes, "open_run_config", lambda run, parts: done.append((run, *parts)))
    stored = stored_street()
    monkeypatch.setattr(scenes, "load_scene", lambda *given: done.append(given) or stored)
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    device = asked or ("cuda" if gpu else "cpu")
    if device == "cuda" and not gpu:
        with pytest.raises(ValueError, match="device=cuda needs a CUDA device and torch sees none: say device=cpu"):
            open_scene(tmp_path / "run", asked)
        return
    run, file = tmp_path / "run", tmp_path / "run" / "scene.safetensors"
    assert open_scene(run, asked, ["mine"]) is open_scene(file, asked) is stored
    assert done == [(run, "mine"), (run, torch.device(device)), (file, torch.device(device))]


def test_objects_are_listed_with_a_sheet_of_pictures(run, tmp_path, capsys):
    assert command("objects")([str(run), f"out={tmp_path / 'objects.png'}"]) == 0
    said = capsys.readouterr().out.splitlines()
    lines = {line.split()[0]: line for line in said[1:3]}
    assert list(lines) == ["car", "tram"]  # the car is seen larger
    assert f"{CAR_ROWS}    0.0    1.0  frame" in lines["car"]  # 5 frames at 4 a second are one second
    assert "   0.0    0.5  frame" in lines["tram"]
    sheet = np.asarray(Image.open(tmp_path / "objects.png"))
    assert sheet.shape[1] == 2 * 180 + 6 + 20
    assert sheet.std() > 5


def test_names_that_a_terminal_would_obey_are_written_out(tmp_path, capsys):
    """A received scene may call its objects anything."""
    stored = stored_street()
    for node in stored.scene.nodes.values():
        if isinstance(node, Tracked):
            node.names = tuple(f"\x1b]0;owned\x07\n{name}\u202e" for name in node.names)
    save_scene(tmp_path / "scene.safetensors", stored)
    write_views(tmp_path / "views.json", street_views(), [], frame_rate=4.0)
    assert command("objects")([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert r"\x1b]0;owned\x07\ncar\u202e" in said
    assert sum("owned" in line for line in said.split("\n")) == 2
    assert not {"\x1b", "\x07", "\u202e"} & {*said}


def test_times_behind_the_end_of_the_log_are_said(run, tmp_path, capsys):
    """The log lasts one second: 5 frames at 4 a second."""
    edits = tmp_path / "edits.yaml"
    edits.write_text(
        "hide: {car: [5, 9]}\nmove: {tram: {hold: 99}}\ncopy: {a: {of: car, right: 3, during: [0.5, 2]},"
        " b: {of: car, path: [[-3, 1, 1], [-2, 2, 2]]}, c: {of: car, right: 2, during: [0, 1], hide: [0.5, 1]}}"
    )
    words = [str(run), str(tmp_path / "out"), "frames=0:1", "cameras=0", f"edits={edits}"]
    assert command("render")(words) == 0
    said = capsys.readouterr().out
    assert "car: hide 5 to 9 s: the log ends at 1 s, nothing of that is seen" in said
    assert "tram: hold 99 s: the log ends at 1 s, it is as it is there" in said
    assert "a: during 0.5 to 2 s: the log ends at 1 s, it is as it is there" in said
    assert "b: path -3 to -2 s: the log begins at 0 s, nothing of that is seen" in said
    assert "c: " not in said
    assert "where tram stood" in said  # and not the car, which is never hidden


def test_the_view_that_shows_an_object_largest_is_chosen():
    row = next(row for row in scene_objects(stored_street(), street_views()) if row.name == "car")
    areas = []
    for one in street_views():
        # The car drives from (8, 1, 1) to (12, -1, 1) without turning; its box is a cube of 1 m.
        center = np.array([8.0, 1.0, 1.0]) + one.time * np.array([4.0, -2.0, 0.0])
        corners = [center + 0.5 * np.array(signs) for signs in itertools.product((-1, 1), repeat=3)]
        seen = np.array([one.camera.camera_from_world.numpy() @ [*corner, 1.0] for corner in corners])[:, :3]
        pixels = seen @ one.camera.intrinsics.numpy().T
        pixels = pixels[:, :2] / pixels[:, 2:]
        size = np.array([one.camera.width, one.camera.height])
        low, high = np.clip(pixels.min(0), 0, size), np.clip(pixels.max(0), 0, size)
        areas.append(float(np.prod(high - low)) if seen[:, 2].min() > 0.5 else 0.0)
    assert row.view is not None
    assert row.box is not None
    left, top, right, bottom = row.box
    # Corners are rounded outwards to whole pixels.
    assert (right - left - 2) * (bottom - top - 2) <= max(areas) <= (right - left) * (bottom - top)


def test_render_takes_a_file_of_edits(run, tmp_path, capsys):
    edits = tmp_path / "edits.yaml"
    edits.write_text("remove: [car]\nhide: {tram: [0.0, 0.25]}\n")
    words = [str(run), "cameras=0", "frames=0:2"]
    assert command("render")([*words, f"out={tmp_path / 'empty'}", f"edits={edits}"]) == 0
    assert "where car, tram stood" in capsys.readouterr().out
    shown = np.asarray(Image.open(min((tmp_path / "empty").iterdir())))
    stored = stored_street()
    view = next(view for view in street_views() if (view.frame_index, view.camera_index) == (0, 0))
    alone = type(stored)(stored.scene.without("rigid"), stored.options, "", 5)
    np.testing.assert_array_equal(shown, (alone.render(view).rgb.clamp(0, 1) * 255).round().numpy())
    assert np.abs(shown - (stored.render(view).rgb.clamp(0, 1) * 255).round().numpy()).max() > 10


def test_the_plan_of_effects_of_a_street(tiny_street, tmp_path, capsys):
    assert effects([*tiny_street, "effects.affine=on", f"out={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert "of 2 cameras" in said
    assert "lens          off  declared  0 px (on from 0.5)" in said
    assert "affine        on   forced" in said
    assert f"drawn: {tmp_path / 'evidence.png'}" in said
    assert (tmp_path / "evidence.png").is_file()
    for wrong in ("effects.lens=maybe", "lenz=1", "data=auto"):
        assert effects([wrong]) == 2
        assert capsys.readouterr().err.startswith("sparsestreet effects: ")


def test_an_evaluation_measures_what_the_runs_configuration_asks_for_unless_it_is_told_otherwise():
    of_run = ExtraMetrics(novel=[1.5], presets=["fast"])
    assert Options(Path("run")).extra(of_run) == of_run
    told = Options(Path("run"), novel=(2.0,), ramp=True, presets=(), training_lpips=True).extra(of_run)
    assert told == ExtraMetrics(novel=(2.0,), ramp=True, presets=(), training_lpips=True)
    assert extra_words(of_run) == ["novel=1.5", "presets=fast"]
    assert extra_words(told) == ["novel=2", "ramp=true", "training_lpips=true"]


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "street")


def test_without_grpc_a_sentence_names_the_extra(served, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "sparsestreet.serving.server", raising=False)
    monkeypatch.setitem(sys.modules, "grpc", None)
    assert command("serve")([str(served)]) == 1
    assert "pip install 'sparsestreet[serve]'" in capsys.readouterr().err


def test_serve_tells_the_interface_and_needs_no_scene(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("serve")(["--proto"]) == 0
    text = capsys.readouterr().out
    assert "package nre.grpc.protos.sensorsim;" in text
    assert "service SensorsimService {" in text
    assert command("serve")(["--proto", "street.proto"]) == 0
    assert Path("street.proto").read_text() == text
    for words, said in (["street.txt"], "written to a .proto"), (["a.proto", "b.proto"], "no option"):
        assert command("serve")(["--proto", *words]) == 2
        assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["street.proto"]


def test_the_artifact_of_a_run(served, tmp_path, capsys):
    assert command("export")([str(served), str(tmp_path / "street.usdz"), "car=4,1.8,1.5"]) == 0
    assert "scene 'street' with 5 poses, 4 cameras, 0 objects" in capsys.readouterr().out
    with zipfile.ZipFile(tmp_path / "street.usdz") as found:
        assert len(found.namelist()) == 3
