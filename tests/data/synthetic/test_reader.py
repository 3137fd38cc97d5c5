"""A street read as a log: the reader's frames, tracks and points are the tracer's."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.capture import StreetCamera
from sparsestreet.data.synthetic.reader import street_truth
from sparsestreet.data.synthetic.render import Instant, recorded_gains, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.textures import Plain, random_weather
from sparsestreet.data.synthetic.tracer import Part, Scene, SunView, at
from sparsestreet.data.synthetic.world import Actor, build_world
from sparsestreet.geometry.cameras import inverse, project
from sparsestreet.types import View
from tests.typed import there

SETTINGS = StreetSettings(
    seed=1, num_frames=2, width=64, height=40, num_cameras=2, supersampling=1, frame_rate=12.0,
    lidar=replace(WAYMO_TOP, beams=12, azimuth_steps=120),
)  # fmt: skip


def test_a_street_opens_as_a_log(tmp_path):
    log = StreetReader(SETTINGS, tmp_path / "street").read()
    assert (log.num_frames, log.num_cameras, len(log.sweeps)) == (2, 2, 2)
    assert log.masks == dict.fromkeys(("sky", "human", "vehicle"), "true")
    # Written in decimals of a nanosecond.
    assert log.frame_rate == pytest.approx(12.0, rel=1e-8)
    assert log.sweeps[1].seconds == pytest.approx(1 / 12, abs=1e-9)
    world = build_world(SETTINGS)
    ego_from_world = torch.linalg.inv(torch.from_numpy(world.ego.pose(0.0)))
    seen_from_camera = torch.stack([_in_camera(ego_from_world, actor) for actor in world.actors])
    starting = [track for track in log.tracks if track.frames[0] == 0]
    assert len(starting) > 5
    for track in starting:
        # The log's world is shifted: compare where the first frame's front camera has the box.
        center = (log.frames[0].camera.camera_from_world.double() @ track.world_from_object[0])[:3, 3]
        distances = (seen_from_camera - center).norm(dim=1)
        # Camera matrices are float32: 1e-4 m at 60 m.
        assert distances.min() < 1e-4
        actor = world.actors[int(distances.argmin())]
        assert track.class_name == actor.model.class_name
        np.testing.assert_allclose(track.size.numpy(), actor.model.size, rtol=1e-6)


def test_every_setting_has_a_folder_of_its_own_and_the_seed_comes_last():
    folders = {}
    others = {"lidar": replace(SETTINGS.lidar, dropout=0.5), "num_cameras": 3, "lens": (-0.3, 0.1, 0.0, 0.0, 0.0)}
    others |= {"delays": (0.0, 0.01), "delays_known": False, "pose_noise": (0.1, 0.0), "box_noise": (0.0, 1.0)}
    others |= {"readout": 0.01, "readout_direction": "left", "readout_known": False}
    others |= {"hood": 0.1, "hood_cameras": "all", "hood_known": True, "tunnel": True, "limp": 0.5}
    others |= {"shutter_time": 0.01, "shutter_time_known": False, "dirt": 0.01}
    for field in fields(StreetSettings):
        changed = others[field.name] if field.name in others else getattr(SETTINGS, field.name) + 1
        folders[field.name] = StreetReader(replace(SETTINGS, **{field.name: changed})).folder
    plain = StreetReader(SETTINGS).folder
    assert len({plain, *folders.values()}) == len(folders) + 1
    assert re.fullmatch(r"outputs/streets/64x40x2_[0-9a-f]{8}_seed1", str(plain))
    # As it was before cameras could fire on their own: recorded results name it.
    assert StreetReader(StreetSettings()).folder.name == "320x192x40_191593c5_seed0"
    # What a report needs to see that two streets differ in nothing but the seed.
    assert str(folders["seed"]) == str(plain).removesuffix("1") + "2"


def test_a_street_lies_where_it_is_told_to(tmp_path):
    assert StreetReader(SETTINGS, root=tmp_path / "a", parent="b").folder == tmp_path / "a"
    assert StreetReader(SETTINGS, parent=tmp_path).folder.parent == tmp_path


def _in_camera(ego_from_world: torch.Tensor, actor: Actor) -> torch.Tensor:
    """Center of the actor's box in the front camera, which sits 1.6 m ahead of the ego origin and 1.65 m above it."""
    ahead = (ego_from_world @ torch.from_numpy(actor.pose(0.0)))[:3, 3]
    x, y, z = ahead - torch.tensor([1.6, 0.0, 1.65], dtype=torch.float64)
    return torch.stack((-y, -z, x))


def test_a_street_can_be_read_without_its_lidar(tmp_path):
    log = StreetReader(SETTINGS, tmp_path / "street", lidar=False).read()
    assert (len(log.sweeps), log.frames[0].depth) == (0, None)
    assert len(StreetReader(SETTINGS, tmp_path / "street").read().sweeps) == 2


def test_sweeps_fall_on_the_pixels_that_color_them(tmp_path):
    log = StreetReader(SETTINGS, tmp_path / "street").read()
    sweep = log.sweeps[0]
    assert sweep.colored.any()
    frame = log.frames[0]
    pixels, _, inside = project(frame.camera, sweep.points)
    assert (sweep.colored[inside]).all()
    u, v = pixels[inside].floor().long().T
    seen_by_front_only = inside & ~project(log.frames[1].camera, sweep.points)[2]
    expected = frame.image[v, u].float() / 255
    chosen = seen_by_front_only[inside]
    assert chosen.any()
    torch.testing.assert_close(sweep.colors[inside][chosen], expected[chosen], atol=1e-6, rtol=0)


SETTINGS_TRUTH = StreetSettings(
    seed=3, num_frames=3, width=97, height=61, num_cameras=2, frame_rate=2.0, supersampling=1,
    annotation_range=25.0,
    lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=200),
)  # fmt: skip

BEHIND_A_LENS = replace(SETTINGS_TRUTH, num_frames=2, num_cameras=1, lens=(-0.3, 0.1, 0.004, -0.006, 0.02))

pytestmark = pytest.mark.lengthy


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    return StreetReader(SETTINGS_TRUTH, tmp_path_factory.mktemp("streets") / "tiny").read()


@pytest.mark.parametrize("settings", [SETTINGS_TRUTH, BEHIND_A_LENS], ids=["pinhole", "lens"])
def test_at_recorded_views_it_is_what_was_recorded(settings, request, tmp_path):
    """Pixels before compression; masks as they were written, from the annotations."""
    log = (
        request.getfixturevalue("log")
        if settings is SETTINGS_TRUTH
        else StreetReader(settings, tmp_path / "lens").read()
    )
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


CLEAN = StreetSettings(
    seed=3, num_frames=2, width=40, height=12, num_cameras=2, frame_rate=5.0, supersampling=1, ego_speed=12.0,
    num_parked_cars=3, num_moving_cars=3, num_pedestrians=1, num_cyclists=0,
    lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100),
)  # fmt: skip
PLANTED = replace(
    CLEAN, lens=(-0.15, 0.02, 0.0, 0.0, 0.0), delays=(0.0, 0.02), exposure_walk=0.3, white_balance=0.05, readout=0.03,
    readout_direction="bottom", shutter_time=0.01, hood=0.15, hood_known=True, pose_noise=(0.05, 0.2),
    box_noise=(0.1, 1.0), tunnel=True, jpeg=75,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("streets")


@pytest.fixture(scope="module")
def log_effects(folder) -> DrivingLog:
    return StreetReader(PLANTED, folder / "planted").read()


def test_all_at_once_open_as_a_log(folder, log_effects):
    assert StreetReader(PLANTED, folder / "planted").check() == []
    for frame in log_effects.frames:
        camera = frame.camera
        assert (camera.exposure, there(camera.shutter).direction, there(camera.shutter).seconds) == (
            0.01,
            "bottom",
            0.03,
        )
        assert camera.distortion is not None
        assert not there(frame.sky).any()
        assert (frame.ego is not None) == (frame.camera_index == 0)
        # The 8-bit image is that of the truth, times its gains, where neither hood nor motion has a say.
        gains = there(recorded_gains(PLANTED, *frame.indices))
        true = there(street_truth(PLANTED, log_effects.dataset_from_world)(frame)).image.double().numpy() * gains
        off = np.abs(frame.image.double().numpy() - true.clip(max=255))[:8]
        assert np.median(off) < 8
        unexposed = np.abs(frame.image.double().numpy() - true / gains)[:8]
        assert np.median(off) < 0.6 * np.median(unexposed)


def test_the_truth_of_a_view_is_that_of_the_clean_street(log_effects):
    """Of the tunnel as it was built, bit for bit; the view brings its own lens."""
    same_street = {"tunnel": True, "delays": PLANTED.delays}
    view = log_effects.views[2]
    view = replace(view, camera=replace(view.camera, shutter=None, exposure=0.0))
    found, clean = (
        there(street_truth(one, log_effects.dataset_from_world)(view))
        for one in (PLANTED, replace(CLEAN, **same_street))
    )
    for field in fields(found):
        if field.name in ("image", "sky", "human", "vehicle"):
            assert torch.equal(getattr(found, field.name), getattr(clean, field.name))


@pytest.mark.parametrize(("quality", "step"), [(97, 1), (75, 8), (50, 16)])
def test_images_have_the_quality_that_is_asked_for(tmp_path, quality, step):
    """The JPEG standard's step of a block's mean brightness is 16 at quality 50, halved at 75."""
    settings = replace(CLEAN, num_frames=1, num_cameras=1, jpeg=quality)
    StreetReader(settings, tmp_path / "one").read()
    with Image.open(tmp_path / "one/images/000_0.jpg") as image:
        assert isinstance(image, JpegImageFile)
        assert image.quantization[0][0] == step
        assert [layer[1:3] for layer in image.layer] == [(1, 1)] * 3  # no halved color
