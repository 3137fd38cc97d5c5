"""``bench edits``: what is compared where, and how much of a removed object is left."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.bench import edits
from sparsestreet.bench.edits import Beside, covered_by, in_words
from sparsestreet.bench.edits_insert import TracedStreet, _is_free, _way, run_inserts
from sparsestreet.bench.records import Provenance, RecordFile
from sparsestreet.data.synthetic.models.car import STYLES, Car
from sparsestreet.data.synthetic.motion import Path
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import Actor, build_world
from sparsestreet.geometry.cameras import inverse
from sparsestreet.records.provenance import this_machine, this_source
from sparsestreet.types import Camera, Frame, View
from tests.export.street import stored_street, street_views

CAR = Actor("car", Car(STYLES[0], (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)), Path(start=0.0, y=1.0, speed=4.0), 0.0)


def traced(level: int):
    """A street whose middle half, of 48 x 32 pixels, has a gray level."""

    def truth(view):
        image = torch.full((32, 48, 3), 40, dtype=torch.uint8)
        image[8:24, 12:36] = level
        return Frame.of(view, image=image)

    return truth


@pytest.mark.parametrize(
    ("left", "ghost", "psnr"),
    # What is left of the object, as a share of its contrast of 100 of 255: its energy, and the error in its region.
    [(0.0, 0.0, np.inf), (0.1, 0.01, -20 * np.log10(10 / 255)), (1.0, 1.0, -20 * np.log10(100 / 255))],
)
def test_a_ghost_is_the_energy_of_what_is_left_of_an_object(left, ghost, psnr, monkeypatch):
    monkeypatch.setattr(edits, "LEAST", 24 * 16)
    before, after, views = traced(140), traced(40), street_views()[:3]
    shown = traced(round(40 + 100 * left))

    def show(view):
        return shown(view).image.double().numpy() / 255

    with np.errstate(divide="ignore"):
        record = edits.compared("removed", "car", CAR, (show, show), views, (before, after))
    assert record is not None
    assert (record.views, record.pixels) == (3, 3 * 24 * 16)
    assert record.ghost == pytest.approx(ghost, abs=1e-12)
    assert record.psnr == pytest.approx(psnr)
    # What was rendered is also compared with the street as it was.
    expected = np.inf if left == 1 else -20 * np.log10(100 * (1 - left) / 255)
    assert record.psnr_before == pytest.approx(expected)


def test_views_that_an_edit_hardly_changes_do_not_count(monkeypatch):
    monkeypatch.setattr(edits, "LEAST", 24 * 16 + 1)
    views = street_views()[:2]

    def show(view):
        raise AssertionError("nothing is rendered")

    assert edits.compared("removed", "car", CAR, (show, show), views, (traced(140), traced(40))) is None


@pytest.mark.parametrize(
    ("wrong", "inside", "outline"),
    # Rows of the region that are 10 levels off: within the object's rows 12 .. 19, on its outline, above it.
    [(slice(13, 19), 1.0, 0.0), (slice(12, 13), 0.0, 1.0), (slice(11, 12), 0.0, 1.0), (slice(8, 10), 0.0, 0.0)],
)
def test_the_error_is_split_by_where_the_object_is(wrong, inside, outline, monkeypatch):
    monkeypatch.setattr(edits, "LEAST", 24 * 16)
    before, after, views = traced(140), traced(40), street_views()[:3]

    def show(view):
        image = after(view).image.double().numpy() / 255
        image[wrong, 14:34] += 10 / 255
        return image

    def covers(view):
        covered = np.zeros((32, 48), bool)
        covered[12:20, 12:36] = True
        return covered

    record = edits.compared("moved", "car", CAR, (show, show), views, (before, after), covers)
    assert record is not None
    assert (record.inside, record.outline) == (pytest.approx(inside), pytest.approx(outline))
    assert f"{inside:.0%} inside, {outline:.0%} outline, {1 - inside - outline:.0%} elsewhere" in in_words(record)


def test_an_actor_covers_the_pixels_that_it_hides_the_sky_in():
    """A camera 10 m behind a saloon of 1.82 x 1.45 m, at half of its height."""
    settings = StreetSettings(num_frames=11, supersampling=1)
    world_from_camera = torch.eye(4)
    world_from_camera[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    world_from_camera[:3, 3] = torch.tensor([-10.0 - 2.3, 1.0, 1.45 / 2])
    intrinsics = torch.tensor([[160.0, 0.0, 24.0], [0.0, 160.0, 16.0], [0.0, 0.0, 1.0]])
    camera = Camera(inverse(world_from_camera), intrinsics, width=48, height=32)
    covers = covered_by(CAR, build_world(settings), settings, torch.eye(4, dtype=torch.float64))
    covered = covers(View(camera, 0.0))
    rows, columns = np.flatnonzero(covered.any(1)), np.flatnonzero(covered.any(0))
    # 16 pixels a meter at the near end; the roof begins farther away.
    assert columns[-1] - columns[0] + 1 == pytest.approx(1.82 * 16, abs=2)
    assert 0.6 * 1.45 * 16 < rows[-1] - rows[0] + 1 <= 1.45 * 16 + 1


def test_an_actor_beside_its_way_keeps_heading_and_steps():
    beside = replace(CAR, path=Beside(CAR.path, 3.0))
    for time in (0.0, 1.5):
        moved, own = beside.pose(time), CAR.pose(time)
        np.testing.assert_allclose(moved[:3, :3], own[:3, :3])
        np.testing.assert_allclose(moved[:3, 3] - own[:3, 3], [0.0, -3.0, 0.0], atol=1e-12)
        assert beside.path.traveled(time) == CAR.path.traveled(time)


def test_an_object_of_another_street_goes_its_actors_way():
    """Both worlds are turned and shifted; the trained frame is half a meter above the middle of the actor's box."""
    settings = StreetSettings(num_frames=11)

    def street(yaw: float, x: float) -> TracedStreet:
        street_from_world = torch.eye(4, dtype=torch.float64)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        street_from_world[:2, :2], street_from_world[0, 3] = torch.from_numpy(turn), x
        return TracedStreet(stored_street(), settings, street_from_world)

    here, other = street(0.5, 3.0), street(-0.7, 20.0)
    actor = replace(CAR, ground=1.0 - 0.5 - CAR.model.size[2] / 2)  # the trained car is 1 m above the ground
    way = _way(here, other, "car", actor)
    for time in (0.0, 0.3, 1.0):
        expected = np.linalg.inv(here.street_from_world.numpy()) @ actor.pose(time * settings.recorded[1])
        expected[2, 3] += 0.5
        np.testing.assert_allclose(way.frame(time, lambda _: np.eye(4)), expected, atol=1e-6)


def test_who_stands_in_another_actor_is_not_compared():
    settings = StreetSettings()
    street = TracedStreet(stored_street(), settings, torch.eye(4, dtype=torch.float64))
    world = build_world(settings)
    near, far = (replace(world, actors=(replace(CAR, path=Beside(CAR.path, right)),)) for right in (2.0, 6.0))
    assert not _is_free(street, near, CAR, 0.5)
    assert _is_free(street, far, CAR, 0.5)


def test_streets_of_two_lengths_are_refused(tmp_path):
    short, long = (
        TracedStreet(stored_street(), StreetSettings(num_frames=count), torch.eye(4, dtype=torch.float64))
        for count in (10, 20)
    )
    with pytest.raises(ValueError, match="both logs must last as long"):
        run_inserts(short, long, [], RecordFile(tmp_path / "a", Provenance("", 1, this_machine(), this_source())))
