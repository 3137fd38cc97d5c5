"""Sweeps over the wire: what Python draws, byte for byte; where objects are placed; and what is refused."""

import ctypes
import gc
import random
from typing import Any

import grpc
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from sparsestreet.data.lidar_models import lidar_model
from sparsestreet.scene.edits import Edits
from sparsestreet.scene.sweeps import Returns, render_sweep
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import pose_message
from sparsestreet.serving.lidar import lidar_message, sweep, turn_of
from tests.export.street import stored_street
from tests.serving.client import pb2, theirs
from tests.serving.street import START_US, STEP_US, at, place, served
from tests.serving.test_hostile import ALLOWED, spoil
from tests.stress.forked import resident_mb

TURN_US = 100_000
FROM, TO = at(2.0, 0.2, 1.7, yaw=0.1), at(3.5, 0.3, 1.8, yaw=0.2)
END = 2 * STEP_US + START_US


def request_for(start_pose: np.ndarray = FROM, end_pose: np.ndarray = TO, **changes: Any) -> Any:
    request = wire.kind("LidarRenderRequest")(scene_id="street", frame_start_us=END - TURN_US, frame_end_us=END)
    request.lidar_config.lidar_type = wire.number("LidarDeviceType", "AT128")
    request.sensor_pose.start_pose.CopyFrom(pose_message(start_pose))
    request.sensor_pose.end_pose.CopyFrom(pose_message(end_pose))
    for name, value in changes.items():
        setattr(request, name, value)
    return request


def sent(pose: np.ndarray) -> np.ndarray:
    """The pose after it was a message."""
    message = pose_message(pose)
    made = np.eye(4)
    quat = message.quat
    made[:3, :3] = Rotation.from_quat([quat.x, quat.y, quat.z, quat.w]).as_matrix()
    made[:3, 3] = message.vec.x, message.vec.y, message.vec.z
    return made


def drawn(scene: Any = None, start_pose: np.ndarray = FROM, end_pose: np.ndarray = TO) -> Returns:
    """What Python draws; poses in between are written apart from the server."""
    first, last = sent(start_pose), sent(end_pose)
    turns = Slerp([-0.1, 0.0], Rotation.from_matrix([first[:3, :3], last[:3, :3]]))

    def pose(seconds: float) -> torch.Tensor:
        made = np.eye(4)
        made[:3, :3] = turns(seconds).as_matrix()
        made[:3, 3] = last[:3, 3] + seconds / 0.1 * (last[:3, 3] - first[:3, 3])
        return torch.from_numpy(made)

    # Frame 2 of 5 is at time 0.5; the log lasts four steps.
    span, duration = (-0.1, 0.0), 4e-6 * STEP_US
    model, scene = lidar_model("at128"), scene or stored_street().scene
    return render_sweep(scene, model, pose, 0.5, stored_street().options, duration=duration, span=span)


def points_of(answer: Any) -> np.ndarray:
    return np.frombuffer(answer.point_xyzs_buffer, "<f4").reshape(-1, 3)


def test_a_sweep_over_the_wire_is_what_python_draws(client, tmp_path):
    here = served(tmp_path / "street")
    answer, expected = client.render_lidar(theirs(request_for())), drawn()
    assert answer.num_points == len(expected) > 5000
    assert (
        answer.SerializeToString()
        == lidar_message(sweep(here, turn_of(request_for(), here.rig), Edits())).SerializeToString()
    )
    # Poses between are computed in another way: the last bit of a float64 may round a float32 otherwise.
    np.testing.assert_allclose(points_of(answer), expected.points.float(), rtol=0, atol=1e-5)
    assert np.asarray(answer.point_xyzs, "<f4").tobytes() == answer.point_xyzs_buffer
    assert np.asarray(answer.point_intensities, "<f4").tobytes() == answer.point_intensities_buffer
    assert answer.point_intensities_buffer == bytes(4 * answer.num_points)
    still = client.render_lidar(theirs(request_for(TO, TO)))
    assert points_of(still).tobytes() == drawn(None, TO, TO).points.numpy().astype("<f4").tobytes()
    assert still.num_points != answer.num_points  # the way of the sensor matters


def test_objects_are_where_a_request_places_them(client):
    below = request_for()
    place(below, "car", at(10.0, 0.0, -99.0))
    place(below, "tram", at(10.0, 0.0, -99.0))
    without = stored_street().scene
    with torch.no_grad():
        without.nodes["rigid"].rows.opacity_logits.fill_(-100)
    answer = client.render_lidar(theirs(below))
    np.testing.assert_allclose(points_of(answer), drawn(without).points.float(), rtol=0, atol=1e-5)
    assert answer.num_points != len(drawn())
    ahead = request_for(TO, TO)
    place(ahead, "tram", at(10.0, 0.0, -99.0))
    place(ahead, "car", TO @ at(4.0, 0.0, 0.0))
    nearest = np.linalg.norm(points_of(client.render_lidar(theirs(ahead))), axis=1)
    assert (nearest < 6).sum() > (np.linalg.norm(drawn(None, TO, TO).points, axis=1) < 6).sum() + 100


NOWHERE = FROM.copy()
NOWHERE[0, 3] = np.nan


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({"start_pose": NOWHERE}, "INVALID_ARGUMENT", "sensor_pose.start_pose must be finite"),
        ({"frame_start_us": END + 1}, "INVALID_ARGUMENT", "a turn ends at most 1 s after it starts"),
        ({"frame_start_us": END - 1_000_001}, "INVALID_ARGUMENT", "a turn ends at most 1 s after it starts"),
        ({"frame_start_us": 0, "frame_end_us": 0}, "INVALID_ARGUMENT", "ask for instants of its clock"),
        ({"scene_id": "elsewhere"}, "NOT_FOUND", "there is no scene 'elsewhere'"),
        ({"lidar": 0}, "UNIMPLEMENTED", "lidar_type PANDAR128 has no published table of angles by that name"),
        ({"lidar": 77}, "UNIMPLEMENTED", "lidar_type 77 is no lidar of the interface"),
        ({"lidar": None}, "UNIMPLEMENTED", "send AT128"),
        ({"pose": None}, "INVALID_ARGUMENT", "sensor_pose.start_pose has the quaternion"),
        ({"object": "nobody"}, "INVALID_ARGUMENT", "nobody"),
    ],
)
def test_what_no_lidar_does_is_refused_in_a_line(client, changes, status, said):
    special = {name: one for name, one in changes.items() if name in ("lidar", "pose", "object")}
    request = request_for(**{name: one for name, one in changes.items() if name not in special})
    if "lidar" in special:
        request.lidar_config.lidar_type = special["lidar"] or 0
        if special["lidar"] is None:
            request.ClearField("lidar_config")
    if "pose" in special:
        request.ClearField("sensor_pose")
    if "object" in special:
        place(request, special["object"], at(1.0, 1.0, 1.0))
    with pytest.raises(grpc.RpcError) as caught:
        client.render_lidar(theirs(request))
    assert caught.value.code().name == status
    assert said in str(caught.value.details())
    assert "\n" not in str(caught.value.details())


MAX_GROWTH = 10.0
"""MB of server and client together, of what is in use: 1 to 4 are seen. A kept answer has 0.2 MB, kept rays have 10."""
METHOD = "/nre.grpc.protos.sensorsim.SensorsimService/render_lidar"


def anywhere(dice: random.Random) -> np.ndarray:
    """A pose of any turn, from a millimeter to thousands of kilometers away."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([dice.gauss(0, 1) for _ in range(4)]).as_matrix()
    pose[:3, 3] = [10.0 ** dice.randint(-3, 6) * dice.gauss(0, 1) for _ in range(3)]
    return pose


def hostile(dice: random.Random) -> bytes:
    """A message that is spoiled, cut short, changed in some bytes, made of dice, or of poses that no car has."""
    way = dice.randrange(6)
    if way == 0:
        return dice.randbytes(dice.choice((0, 1, 10, 300)))
    if way == 1:
        first = anywhere(dice)
        request = request_for(first, dice.choice((first, anywhere(dice))))
        place(request, "car", dice.choice((first, anywhere(dice))), anywhere(dice))
        return request.SerializeToString()
    request = request_for()
    place(request, "car", at(9.0, 0.2, 1.0))
    for _ in range(dice.randint(1, 4)):
        spoil(request, dice)
    data = bytearray(request.SerializeToString())
    if way == 2:
        return bytes(data[: dice.randrange(len(data))])
    if way == 3:
        for _ in range(3):
            data[dice.randrange(len(data))] = dice.randrange(256)
    return bytes(data)


def used_mb() -> float:
    """What the process holds once the allocator gave back what it only keeps, which varies by 100 MB."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return resident_mb()


def status_of(client: Any, data: bytes, timeout: float) -> str:
    try:
        answer = pb2.LidarRenderReturn.FromString(client.channel.unary_unary(METHOD)(data, timeout=timeout))
    except grpc.RpcError as error:
        return error.code().name if len(str(error.details())) <= 1000 else "a long error"
    assert np.isfinite(points_of(answer)).all()
    return "OK"


@pytest.mark.parametrize(
    "count", [pytest.param(120, marks=pytest.mark.lengthy), pytest.param(1000, marks=pytest.mark.slow)]
)
def test_hostile_requests_leave_the_server_as_it_was(client, caplog, count):
    """Some are given up at once. After each hundred a good one has its answer, byte for byte; of many, memory stays."""
    expected = client.render_lidar(theirs(request_for())).point_xyzs_buffer
    dice, statuses = random.Random(48), dict.fromkeys(ALLOWED | {"DEADLINE_EXCEEDED"}, 0)
    held: list[float] = []
    for number in range(count):
        status = status_of(client, hostile(dice), timeout=dice.choice((60, 60, 60, 60, 60, 0.001)))
        statuses[status] += 1  # a status that is not allowed is a KeyError
        if number % 100 == 99:
            assert client.render_lidar(theirs(request_for())).point_xyzs_buffer == expected
            held.append(used_mb())
    named = ("OK", "INVALID_ARGUMENT", "NOT_FOUND", "UNIMPLEMENTED", "DEADLINE_EXCEEDED")
    assert min(statuses[name] for name in named) > count // 50, statuses
    assert "a request failed" not in caplog.text
    assert client.render_lidar(theirs(request_for())).point_xyzs_buffer == expected
    if count >= 600:  # a request that was given up may still be drawn while one looks: least of three against three
        assert min(held[-3:]) - min(held[:3]) < MAX_GROWTH, held
