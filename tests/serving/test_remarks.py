"""What the log says of requests, once each: objects that are not there, that nobody annotated, or that float."""

import logging

import pytest

from sparsestreet.scene.edits.ground import Ground
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Tracked
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene
from sparsestreet.serving import remarks
from sparsestreet.serving.artifact import box_center
from sparsestreet.serving.remarks import Remarks
from sparsestreet.serving.renderer import ServedScene, edits_of, view_of
from tests.scene.people import smpl, walker
from tests.serving.street import at, place, request_for, served, timed_views


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> ServedScene:
    """The tram's name is that of a found object. Both are boxes of 1 m whose feet are at 0.5 m."""
    made = served(tmp_path_factory.mktemp("runs") / "street")
    node = made.stored.scene.nodes["rigid"]
    assert isinstance(node, Tracked)
    node.names = ("car", "found_1")
    return made


@pytest.fixture
def said(street, caplog):
    """Give a server's lines of a request with objects at places."""
    caplog.set_level(logging.WARNING)
    made, view = Remarks(), timed_views()[8]

    def lines(**objects: tuple[float, float, float]) -> list[str]:
        caplog.clear()
        request = request_for(view)
        for name, where in objects.items():
            place(request, name, at(*where))
        made.on_names(street, request)
        if all(name in ("car", "found_1") for name in objects):
            made.on_heights(street, view_of(request, street.rig).time, edits_of(request, street))
        return caplog.messages

    return lines


def test_a_name_that_no_object_has_is_said_once(said):
    (line,) = said(caar=(0.0, 0.0, 0.0))
    assert line == "street: requests that name caar are refused: there is no such object"
    assert said(caar=(0.0, 0.0, 0.0)) == []
    (line,) = said(**{"a\nb" + "x" * 10**5: (0.0, 0.0, 0.0)})
    assert "a\\nbxxx" in line
    assert len(line) < 250


def test_an_object_that_nobody_annotated_is_a_guess(said):
    (line,) = said(found_1=(9.0, 0.0, 1.0))
    assert line == "street: found_1 was found in lidar, nobody annotated it: size and place of its box are guesses"
    assert said(found_1=(9.0, 0.0, 1.0)) == []


def test_an_object_off_the_ground_is_said_once_and_a_removed_one_never(street, said):
    """The car drove at (10, 0) with its feet at 0.5 m; a row of road lies there, or none."""
    ground = Ground(street.stored.scene).below(10.0, 0.0)
    assert ground == pytest.approx(0.5, abs=0.5)
    assert said(car=(10.0, 0.0, -99.0)) == []
    assert said(car=(10.0, 0.0, ground + 0.5 + 0.4)) == []
    other = said(found_1=(10.0, 0.0, ground + 0.5 - 0.8))
    assert other[1] == (
        "street: found_1 is 0.8 m below the ground: a pose is that of the middle of its box, in the scene's world"
    )
    assert said(found_1=(10.0, 0.0, ground - 0.3)) == []


def test_a_floating_object_is_said_to_float(street, said):
    ground = Ground(street.stored.scene).below(10.0, 0.0)
    (line,) = said(car=(10.0, 0.0, ground + 3.0))
    assert line.startswith("street: car is 2.5 m above the ground")
    assert said(car=(10.0, 0.0, ground + 3.0)) == []


def test_where_nothing_tells_of_the_ground_nothing_is_said(said):
    assert said(car=(500.0, 0.0, 7.0)) == []


def test_the_log_ends_somewhere(street, said, monkeypatch):
    monkeypatch.setattr(remarks, "MAX_REMARKS", 5)
    lines = [line for number in range(9) for line in said(**{f"stranger {number}": (0.0, 0.0, 0.0)})]
    assert len(lines) == 5


def test_a_person_is_measured_at_its_feet(street, caplog):
    """Its frame is at the pelvis, a pose of a request is that of its box."""
    node = smpl(walker("anna", height=1.8), walker("berta", y=2.0, seed=1))
    scene = SceneGraph({"people": node}).eval()
    people = ServedScene("people", StoredScene(scene, RenderOptions(), "people", 5), street.rig)
    tall, view = float(node.sizes[0, 2]), timed_views()[8]
    x, y, z = box_center(node, 0, view.time)[:3, 3]
    for center, lines in ((z, 0), (z - tall / 2, 1)):  # as who takes a pose for that of the feet
        request, made = request_for(view), Remarks()
        place(request, "anna", at(x, y, center))
        caplog.clear()
        made.on_heights(people, view_of(request, people.rig).time, edits_of(request, people))
        assert len(caplog.messages) == lines
    assert f"anna is {tall / 2:.1f} m below the ground" in caplog.text
