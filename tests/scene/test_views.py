"""The cameras of a log as ``views.json``."""

import json
from dataclasses import is_dataclass, replace
from typing import Any

import pytest
import torch

from sparsestreet.scene.views import RecordedViews, read_views, seconds_of, write_views
from sparsestreet.types import Camera, Frame, Shutter, View
from tests.export.street import street_views
from tests.typed import there


def odd_view(frame: int = 3) -> View:
    """Numbers that no short decimal has, a lens and a rolling shutter."""
    generator = torch.Generator().manual_seed(frame)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator) * torch.logspace(-6, 6, shape[-1])

    direction = ("top", "bottom", "left", "right")[frame]
    shutter = Shutter(numbers(3), numbers(3), direction, 0.044, 0.1 / 7)
    camera = Camera(numbers(4, 4), numbers(3, 3), 97, 61, numbers(5), shutter, exposure=0.1 / 7)
    return View(camera, frame / 7, frame, 2, frame / 9.7, 1_532_402_927_600_000_251 + 99_999_997 * frame)


def said(value: Any) -> Any:
    """All that a view says, as plain values."""
    if isinstance(value, torch.Tensor):
        return value.tolist()
    return {name: said(part) for name, part in vars(value).items()} if is_dataclass(value) else value


def test_views_come_back_bit_for_bit(tmp_path):
    path = tmp_path / "run" / "views.json"
    plain, odd = street_views(), [odd_view(frame) for frame in range(4)]  # the first was taken at 0.0 seconds
    write_views(path, odd, plain, frame_rate=12.5)
    views = read_views(path)
    assert [said(view) for view in (*views.training, *views.held_out)] == [said(view) for view in (*odd, *plain)]
    assert views.frame_rate == 12.5
    write_views(path, plain, [])
    assert read_views(path).frame_rate is None
    assert [entry.name for entry in path.parent.iterdir()] == ["views.json"]


def test_all_views_are_in_order_of_frame_and_camera(tmp_path):
    """Though the cameras of an instant fire one after the other, the last one first."""
    views = [replace(view, time=view.time - 0.01 * view.indices[1]) for view in street_views()]
    write_views(tmp_path / "views.json", views[8:12], [*views[12:], *views[:8]])
    order = [(view.frame_index, view.camera_index) for view in read_views(tmp_path / "views.json").all]
    assert order == [(view.frame_index, view.camera_index) for view in views]


def test_a_shutter_without_a_direction_is_of_an_earlier_version_and_read_from_the_top(tmp_path):
    path = tmp_path / "views.json"
    write_views(path, [odd_view(2)], [])
    file = json.loads(path.read_text())
    assert file["views"][0].pop("shutter_direction") == "left"
    path.write_text(json.dumps(file))
    assert there(read_views(path).training[0].camera.shutter).direction == "top"


def test_pixels_are_not_touched(tmp_path):
    """A frame whose image raises when it is read, as one would that loads it from disk."""
    view = street_views()[0]
    frame = object.__new__(Frame)
    for name in ("camera", "time", "frame_index", "camera_index", "seconds", "stamp"):
        object.__setattr__(frame, name, getattr(view, name))
    with pytest.raises(AttributeError):
        _ = frame.image
    write_views(tmp_path / "views.json", [frame], [])
    assert said(read_views(tmp_path / "views.json").training[0]) == said(view)


def test_a_view_that_nobody_recorded_is_refused_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "views.json"
    write_views(path, street_views(), [])
    before = path.read_text()
    with pytest.raises(ValueError, match="frame and a camera index, got None and 0"):
        write_views(path, [View(street_views()[0].camera, 0.5, None, 0)], [])
    assert path.read_text() == before


def test_a_file_that_is_not_there_says_who_writes_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no .*views\.json: training writes"):
        read_views(tmp_path / "views.json")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda file: file.update(format=1), "format 1, this version reads 2: one below 2 is .* train again"),
        (lambda file: file["views"][1].update(split="test"), "view 1 has split 'test'"),
        (lambda file: file["views"][2]["camera_from_world"].pop(), "view 2: camera_from_world must be 4 x 4"),
        (lambda file: file["views"][2]["intrinsics"][1].pop(), "view 2: intrinsics must be 3 x 3"),
        (lambda file: file["views"][0].pop("time"), r"views\[0\].* lacks the keys \['time'\]"),
        (lambda file: file["views"][0].update(distortion=[0.1]), "view 0: distortion must be 5 numbers"),
        (
            lambda file: file["views"][3].update(shutter_direction="up"),
            "view 3: shutter_direction must be one of top, bottom, left, right, got 'up'",
        ),
    ],
)
def test_a_damaged_file_names_the_place(tmp_path, change, said):
    path = tmp_path / "views.json"
    write_views(path, [*street_views()[:3], odd_view()], [])
    file = json.loads(path.read_text())
    change(file)
    path.write_text(json.dumps(file))
    with pytest.raises(ValueError, match=said):
        read_views(path)


def test_seconds_of_a_log_are_those_of_its_clock_else_of_its_frames():
    camera = Camera(torch.eye(4), torch.eye(3), 8, 6)
    clock = [View(camera, time, place, 0, 10.0 * time) for place, time in enumerate((0.1, 0.3, 0.9))]
    assert seconds_of(RecordedViews((clock[2], clock[0]), (clock[1],), 25.0), 5.0) == pytest.approx(10.0)
    frames = [View(camera, place / 4, place, 0) for place in range(5)]
    assert seconds_of(RecordedViews(tuple(frames), ()), 5.0) == pytest.approx(4 / 5)


def test_a_file_that_is_no_text_is_named(tmp_path):
    (tmp_path / "views.json").write_bytes(b'{"format": \xac}')
    with pytest.raises(ValueError, match=r"views\.json: cannot be read"):
        read_views(tmp_path / "views.json")
