"""Streets whose files say wrong poses of images and boxes, while images and lidar show the true ones."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.synthetic import StreetSettings, make_street
from sparsestreet.data.synthetic.capture import street_camera
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.street import noisy_box, noisy_camera
from sparsestreet.data.synthetic.tracer import at
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked

NOISY = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=2.0, supersampling=1, num_parked_cars=4,
    num_moving_cars=2, num_pedestrians=1, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100),
    pose_noise=(0.2, 1.0), box_noise=(0.3, 2.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("streets")
    with unchecked():
        clean = make_street(replace(NOISY, pose_noise=(), box_noise=()), folder / "clean")
        return clean, make_street(NOISY, folder / "noisy")


@pytest.mark.lengthy
def test_only_the_files_of_poses_and_boxes_differ(roots):
    clean, noisy = roots
    files = {path.relative_to(clean) for path in clean.rglob("*") if path.is_file()}
    assert files == {path.relative_to(noisy) for path in noisy.rglob("*") if path.is_file()}
    changed = {path for path in files if (clean / path).read_bytes() != (noisy / path).read_bytes()}
    poses = {Path(f"extrinsics/{frame:03d}_{camera}.txt") for frame in range(2) for camera in range(2)}
    assert changed == poses | {Path("instances/instances_info.json"), Path("street.json")}


@pytest.mark.lengthy
def test_files_say_the_noise_around_what_is_true(roots):
    """Boxes against the world's actors, images against the rig; 99.9 % of three normal numbers are below 3.5 rms."""
    world, (_, root) = build_world(NOISY), roots
    for frame in range(2):
        for camera in range(2):
            true = street_camera(NOISY, camera, world.ego.pose(frame / 2)).world_from_camera
            motion = np.linalg.inv(true) @ np.loadtxt(root / f"extrinsics/{frame:03d}_{camera}.txt")
            assert 1e-3 < np.linalg.norm(motion[:3, 3]) < 3.5 * 0.2
            assert 1e-3 < np.degrees(np.arccos((np.trace(motion[:3, :3]) - 1) / 2)) < 3.5
    actors = {actor.name: actor for actor in world.actors}
    objects = json.loads((root / "instances/instances_info.json").read_text()).values()
    assert len(objects) > 3
    for one in objects:
        notes = one["frame_annotations"]
        for frame, said in zip(notes["frame_idx"], notes["obj_to_world"], strict=True):
            motion = np.linalg.inv(actors[one["id"]].pose(frame / 2)) @ np.array(said)
            assert 1e-3 < np.linalg.norm(motion[:3, 3]) < 3.5 * 0.3
            np.testing.assert_allclose(motion[2, :3], (0, 0, 1), atol=1e-12)
            assert 0 < abs(np.degrees(np.arctan2(motion[1, 0], motion[0, 0]))) < 3.5 * 2


def test_noise_has_the_size_of_the_settings():
    """Root mean squares of 500 motions: the standard error of the poorest is 3 %."""
    pose = at(3.0, 2.0, 1.0, 0.7)
    images = [np.linalg.inv(pose) @ noisy_camera(NOISY, pose, frame, 1) for frame in range(500)]
    boxes = [np.linalg.inv(pose) @ noisy_box(NOISY, pose, "a car", frame) for frame in range(500)]
    for motions, meters, degrees in ((images, 0.2, 1.0), (boxes, 0.3, 2.0)):
        moved = np.array([motion[:3, 3] for motion in motions])
        turned = np.degrees([np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)) for motion in motions])
        np.testing.assert_allclose(np.sqrt((moved**2).sum(1).mean()), meters, rtol=0.06)
        np.testing.assert_allclose(moved.std(0), meters / np.sqrt(3), rtol=0.12)
        np.testing.assert_allclose(np.sqrt((turned**2).mean()), degrees, rtol=0.07)


@pytest.mark.parametrize("noise", [(0.1,), (0.1, 0.2, 0.3), (-0.1, 0.0), (0.1, float("nan"))])
@pytest.mark.parametrize("name", ["pose_noise", "box_noise"])
def test_noise_that_cannot_be(name, noise):
    with pytest.raises(ValueError, match=rf"{name} must be empty or \[meters, degrees\]"):
        replace(NOISY, **{name: noise})
