"""``sparsestreet objects`` and ``render edits=``: what is there, and what a file of edits makes of it."""

import itertools

import numpy as np
import pytest
from PIL import Image

from sparsestreet.cli.commands.objects import objects
from sparsestreet.cli.commands.render import render
from sparsestreet.export.objects import scene_objects
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.storage import save_scene
from sparsestreet.scene.views import write_views
from tests.export.street import CAR_ROWS, stored_street, street_views


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    save_scene(folder / "scene.safetensors", stored_street())
    write_views(folder / "views.json", street_views(), [], frame_rate=4.0)
    return folder


def test_objects_are_listed_with_a_sheet_of_pictures(run, capsys):
    assert objects([str(run)]) == 0
    said = capsys.readouterr().out.splitlines()
    lines = {line.split()[0]: line for line in said[1:3]}
    assert list(lines) == ["car", "tram"]  # the car is seen larger
    assert f"{CAR_ROWS}    0.0    1.0  frame" in lines["car"]  # 5 frames at 4 a second are one second
    assert "   0.0    0.5  frame" in lines["tram"]
    sheet = np.asarray(Image.open(run / "pictures" / "objects.png"))
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
    assert objects([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert r"\x1b]0;owned\x07\ncar\u202e" in said
    assert sum("owned" in line for line in said.split("\n")) == 2
    (tmp_path / "edits.yaml").write_text("remove: ['\\e[2J']\n".replace("'", '"'))
    assert render([str(tmp_path), str(tmp_path / "a.mp4"), f"edits={tmp_path / 'edits.yaml'}"]) == 1
    captured = capsys.readouterr()
    assert "the scene has no object" in captured.err
    assert not {"\x1b", "\x07", "\u202e"} & {*said, *captured.out, *captured.err}


def test_times_behind_the_end_of_the_log_are_said(run, tmp_path, capsys):
    """The log lasts one second: 5 frames at 4 a second."""
    edits = tmp_path / "edits.yaml"
    edits.write_text(
        "hide: {car: [5, 9]}\nmove: {tram: {hold: 99}}\ncopy: {a: {of: car, right: 3, during: [0.5, 2]},"
        " b: {of: car, path: [[-3, 1, 1], [-2, 2, 2]]}, c: {of: car, right: 2, during: [0, 1], hide: [0.5, 1]}}"
    )
    assert render([str(run), str(tmp_path / "out"), "frames=0:1", "cameras=0", f"edits={edits}"]) == 0
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
    for view in street_views():
        # The car drives from (8, 1, 1) to (12, -1, 1) without turning; its box is a cube of 1 m.
        center = np.array([8.0, 1.0, 1.0]) + view.time * np.array([4.0, -2.0, 0.0])
        corners = [center + 0.5 * np.array(signs) for signs in itertools.product((-1, 1), repeat=3)]
        seen = np.array([view.camera.camera_from_world.numpy() @ [*corner, 1.0] for corner in corners])[:, :3]
        pixels = seen @ view.camera.intrinsics.numpy().T
        pixels = pixels[:, :2] / pixels[:, 2:]
        size = np.array([view.camera.width, view.camera.height])
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
    assert render([*words, f"out={tmp_path / 'whole'}"]) == 0
    assert render([*words, f"out={tmp_path / 'empty'}", f"edits={edits}"]) == 0
    assert "where car, tram stood" in capsys.readouterr().out
    whole, empty = (
        [np.asarray(Image.open(path)).astype(int) for path in sorted((tmp_path / name).iterdir())]
        for name in ("whole", "empty")
    )
    stored = stored_street()
    view = next(view for view in street_views() if (view.frame_index, view.camera_index) == (0, 0))
    without = (stored.scene.without("rigid"), stored)
    alone = (type(stored)(without[0], stored.options, "", 5).render(view).rgb.clamp(0, 1) * 255).round().numpy()
    np.testing.assert_array_equal(empty[0], alone)
    assert np.abs(whole[0] - empty[0]).max() > 10
    assert np.abs(whole[1] - empty[1]).max() > 10


def test_what_is_wrong_is_one_sentence(run, tmp_path, capsys):
    edits = tmp_path / "edits.yaml"
    edits.write_text("remove: [cart]\n")
    assert render([str(run), f"out={tmp_path / 'a'}", f"edits={edits}"]) == 1
    assert "no object 'cart': the nearest names are car" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
    assert objects([str(run), "out=sheet.jpg"]) == 2
    assert "must end in .png" in capsys.readouterr().err


def test_a_scene_without_objects_says_so(tmp_path, capsys):
    stored = stored_street()
    save_scene(tmp_path / "scene.safetensors", type(stored)(stored.scene.without("rigid"), stored.options, "", 5))
    write_views(tmp_path / "views.json", street_views(), [])
    assert objects([str(tmp_path)]) == 0
    assert "no objects of their own" in capsys.readouterr().out
