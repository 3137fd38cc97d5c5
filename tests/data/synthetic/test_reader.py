"""A street read as a log: the reader's frames, tracks and points are the tracer's."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.world import Actor, build_world
from sparsestreet.geometry.cameras import project

SETTINGS = StreetSettings(
    seed=1, num_frames=2, width=64, height=40, num_cameras=2, supersampling=1, frame_rate=12.0,
    lidar=replace(WAYMO_TOP, beams=12, azimuth_steps=120),
)  # fmt: skip


@pytest.mark.lengthy
def test_a_street_opens_as_a_log(tmp_path):
    log = StreetReader(SETTINGS, tmp_path / "street").read()
    assert (log.num_frames, log.num_cameras, len(log.sweeps)) == (2, 2, 2)
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


@pytest.mark.lengthy
def test_a_street_can_be_read_without_its_lidar(tmp_path):
    log = StreetReader(SETTINGS, tmp_path / "street", lidar=False).read()
    assert (len(log.sweeps), log.frames[0].depth) == (0, None)
    assert len(StreetReader(SETTINGS, tmp_path / "street").read().sweeps) == 2


@pytest.mark.lengthy
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
