"""The truth beside the path: at recorded views it is what was recorded."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.capture import StreetCamera
from sparsestreet.data.synthetic.render import Instant, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.textures import Plain, random_weather
from sparsestreet.data.synthetic.tracer import Part, Scene, SunView, at
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import View

SETTINGS = StreetSettings(
    seed=3, num_frames=3, width=97, height=61, num_cameras=2, frame_rate=2.0, supersampling=1,
    annotation_range=25.0,
    lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=200),
)  # fmt: skip

BEHIND_A_LENS = replace(SETTINGS, num_frames=2, num_cameras=1, lens=(-0.3, 0.1, 0.004, -0.006, 0.02))

pytestmark = pytest.mark.lengthy


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    return StreetReader(SETTINGS, tmp_path_factory.mktemp("streets") / "tiny").read()


@pytest.mark.parametrize("settings", [SETTINGS, BEHIND_A_LENS], ids=["pinhole", "lens"])
def test_at_recorded_views_it_is_what_was_recorded(settings, request, tmp_path):
    """Pixels before compression; masks as they were written, from the annotations."""
    log = request.getfixturevalue("log") if settings is SETTINGS else StreetReader(settings, tmp_path / "lens").read()
    world = build_world(settings)
    traced = [render_frame(settings, world, index) for index in range(settings.num_frames)]
    people, vehicles = 0, 0
    for frame in log.frames:
        found = log.truth(frame)
        expected = torch.from_numpy(traced[frame.frame_index].images[frame.camera_index].rgb)
        # A log's poses are float32: 1e-6 m, which a ray along an edge or at 60 m may meet in another way.
        different = (found.image.int() - expected.int()).abs().amax(-1) > 1
        assert different.float().mean() < 2e-3
        for name in ("sky", "human", "vehicle"):
            assert (getattr(found, name) != getattr(frame, name)).float().mean() < 1e-3
        assert (found.frame_index, found.camera_index) == (frame.frame_index, frame.camera_index)
        assert (found.seconds, found.stamp) == (frame.frame_index / 2, frame.frame_index * 500_000_000)
        people, vehicles = people + int(frame.human.sum()), vehicles + int(frame.vehicle.sum())
    assert people > 20
    assert vehicles > 200


def test_a_view_of_nobody_has_its_own_size_and_no_numbers(log):
    front = log.views[0]
    intrinsics = front.camera.intrinsics.clone()
    intrinsics[:2] /= 2
    small = replace(front.camera, intrinsics=intrinsics, width=49, height=31)
    found = log.truth(View(small, 0.25))
    assert found.image.shape == (31, 49, 3)
    assert (found.frame_index, found.camera_index, found.time) == (None, None, 0.25)
    # Another time, another picture: a quarter of a second is 2 m of the car and more of the traffic.
    assert not torch.equal(found.image, log.truth(View(small, 0.0)).image)


def test_nobody_looks_out_of_a_car(log):
    track = next(track for track in log.tracks if track.class_name == "Vehicle" and track.frames[0] == 0)
    inside = torch.eye(4, dtype=torch.float64)
    inside[:3, 3] = track.world_from_object[0][:3, 3]
    front = log.views[0]
    camera = replace(front.camera, camera_from_world=inverse(inside).float())
    assert log.truth(View(camera, 0.0)) is None


@pytest.mark.parametrize(("x", "inside"), [(0.0, True), (2.2, True), (2.4, False), (-2.4, False)])
def test_a_camera_is_in_a_box_of_30_cm_more(x, inside):
    """A box of 4 m along x that stands at (10, 5) and faces y: the camera lies at x of its own axes."""
    scene = Scene.of([Part(box(1.0, 1.0, 1.0), Plain((0.5, 0.5, 0.5)), at(0.0, 0.0, 0.0))])
    weather = random_weather(0)
    actors = ((at(10.0, 5.0, 0.0, yaw=np.pi / 2), (4.0, 2.0, 1.5)),)
    camera = StreetCamera(at(10.0, 5.0 + x, 0.0), np.eye(3), 1, 1)
    assert Instant(scene, SunView.of(scene, weather.sun), weather, actors).inside_an_actor(camera) == inside
