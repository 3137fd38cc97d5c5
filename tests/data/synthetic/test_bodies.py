"""A posed skeleton stands where the rendered pedestrian stands."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.models import Clothes, Pedestrian
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.street import joint_rotations
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import HEIGHT, JOINTS, posed_bones, rest_joints

GRAY = Clothes(*((0.5, 0.5, 0.5),) * 4)
PERSON = Pedestrian(1.6, GRAY)
PHASES = np.arange(8) / 8 * PERSON.stride


def posed_joints(person: Pedestrian, rotations: np.ndarray) -> dict[str, np.ndarray]:
    """Joints in axes of the box about the pelvis, of a body as tall as the person."""
    joints = (person.height / HEIGHT * rest_joints().double())[None]
    joints = joints - joints[:, :1]
    bones = posed_bones(joints, quat.from_matrix(torch.from_numpy(rotations))[None]).transforms[0]
    places = (bones[..., :3] @ joints[0, :, :, None])[..., 0] + bones[..., 3]
    return dict(zip(JOINTS, places.numpy(), strict=True))


@pytest.mark.parametrize("traveled", PHASES)
def test_joints_are_where_the_limbs_are(traveled):
    joints = posed_joints(PERSON, joint_rotations(PERSON, float(traveled)))
    distances = {}
    for side, name in ((1, "left"), (-1, "right")):
        limbs = (*PERSON.leg(side, traveled), *PERSON.arm(side, traveled))
        rendered = dict(zip(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"), limbs, strict=True))
        distances |= {f"{name}_{joint}": joints[f"{name}_{joint}"] - place for joint, place in rendered.items()}
    # The pelvis is where it brings the hips together; the rendered limbs change their length with the gait.
    pelvis = (distances["left_hip"] + distances["right_hip"]) / 2
    farthest = {name: np.linalg.norm(distance - pelvis) for name, distance in distances.items()}
    assert max(farthest.values()) < 0.1, farthest


def test_limbs_point_exactly_where_they_are_rendered():
    joints = posed_joints(PERSON, joint_rotations(PERSON, 0.3))
    for side, name in ((1, "left"), (-1, "right")):
        hip, knee, foot = np.array(PERSON.leg(side, 0.3))
        shoulder, elbow, hand = np.array(PERSON.arm(side, 0.3))
        for start, end, direction in (
            ("hip", "knee", knee - hip), ("knee", "ankle", foot - knee),
            ("shoulder", "elbow", elbow - shoulder), ("elbow", "wrist", hand - elbow),
        ):  # fmt: skip
            bone = joints[f"{name}_{end}"] - joints[f"{name}_{start}"]
            assert bone @ direction / np.linalg.norm(bone) / np.linalg.norm(direction) == pytest.approx(1, abs=1e-9)


SETTINGS = StreetSettings(
    seed=4, num_frames=6, width=96, height=60, num_cameras=2, supersampling=1, frame_rate=2.0, num_parked_cars=0,
    num_moving_cars=0, num_cyclists=1, num_pedestrians=4, lidar=replace(WAYMO_TOP, beams=4, azimuth_steps=40),
)  # fmt: skip


@pytest.mark.lengthy
def test_a_street_is_read_with_its_bodies(tmp_path):
    exact, noisy = (
        StreetReader(replace(SETTINGS, body_pose_noise=noise), tmp_path / str(noise)) for noise in (0.0, 3.0)
    )
    log, others = exact.read(), noisy.read().tracks
    world = build_world(SETTINGS)
    actors = [(actor.model, actor.path) for actor in world.actors if isinstance(actor.model, Pedestrian)]
    people = [track for track in log.tracks if track.body is not None]
    assert 1 < len(people) <= len(actors)
    assert all(track.body is None for track in log.tracks if track.class_name != "Pedestrian")
    angles = []
    for track in people:
        person, path = min(actors, key=lambda actor: abs(actor[0].height - float(track.size[2])))
        other = next(again for again in others if again.name == track.name)
        assert other.body.valid.tolist() == track.body.valid.tolist()
        for place in track.body.valid.nonzero().flatten().tolist():
            rotations = joint_rotations(person, path.traveled(int(track.frames[place]) / SETTINGS.frame_rate))
            rotations[0] = track.world_from_object[place, :3, :3].numpy() @ rotations[0]
            expected = quat.from_matrix(torch.from_numpy(rotations)).float()
            cosines = (track.body.rotations[place] * expected).sum(1).abs()
            assert float(cosines.min()) > 1 - 1e-6
            between = (track.body.rotations[place] * other.body.rotations[place]).sum(1).abs().clamp(max=1)
            angles += torch.rad2deg(2 * between.acos()).tolist()
    # 24 joints in a dozen poses: a root mean square is known to 1 / sqrt(2 * 3 * 300), 2 %.
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(3.0, rel=0.1)
    assert len(angles) >= 24 * 6
    assert all(track.body is None for track in replace(exact, bodies=False).read().tracks)
