"""The server over a loopback, called by a client that was made of AlpaSim's messages."""

import re
import shlex
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
import torch

from sparsestreet.cli.commands.serve import serve
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.scene.storage import load_scene
from sparsestreet.serving import renderer, wire
from sparsestreet.serving import server as server_module
from sparsestreet.serving.renderer import Scenes, named_runs
from sparsestreet.serving.server import start
from tests.export.street import stored_street
from tests.serving.client import Client, common_pb2, pb2, theirs
from tests.serving.street import START_US, STEP_US, as_sent, at, place, request_for, timed_views, write_run
from tests.typed import there


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    runs = named_runs([write_run(tmp_path_factory.mktemp("runs") / "street")])
    server, port = start(Scenes(runs, load_scene, memory=10**9), "127.0.0.1", 0, workers=4)
    made = Client(port)
    yield made
    made.channel.close()
    server.stop(None).wait()


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def rendered(view) -> np.ndarray:
    return (stored_street().render(view).rgb.clamp(0, 1) * 255).round().byte().numpy()


def picture(client: Client, view, **changes) -> bytes:
    return client.render_rgb(theirs(request_for(view, **changes))).image_bytes


def test_a_png_is_what_render_shows_bit_for_bit(client):
    view = timed_views()[9]
    assert np.array_equal(decoded(picture(client, view)), rendered(as_sent(view)))


def test_the_same_calls_by_nurecs_newer_name(client):
    view = timed_views()[9]
    newer = Client(int(client.channel._channel.target().decode().rpartition(":")[2]), "sensorsim.SensorsimService")
    with newer.channel:
        assert newer.render_rgb(theirs(request_for(view))).image_bytes == picture(client, view)


def test_the_log_says_once_that_a_picture_from_elsewhere_is_a_guess(client, caplog):
    """Beside the street, and on the recorded path where the log's cameras were half a second earlier or later."""
    first, later = timed_views()[0], timed_views()[12]
    picture(client, later)
    assert "guess" not in caplog.text
    elsewhere = request_for(first, frame_start_us=START_US + 3 * STEP_US, frame_end_us=START_US + 3 * STEP_US)
    for _ in range(2):
        client.render_rgb(theirs(elsewhere))
    # 3 m of path, with turns of 9 degrees of a vehicle whose cameras are 1.5 m ahead of its axle.
    (said,) = re.findall(r"street: a camera is ([\d.]+) m from .* what none of them saw is a guess", caplog.text)
    assert 2.5 < float(said) < 3.5


def test_the_client_of_the_page_gets_a_picture(client, tmp_path, monkeypatch):
    """Compiled by protoc, as the page says."""
    protoc = pytest.importorskip("grpc_tools.protoc", reason="pip install grpcio-tools")
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "serving.md").read_text().partition("## In Python, without")[0]
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.S)
    assert serve(shlex.split(re.findall(r"^sparsestreet serve (--proto .*)", page, flags=re.M)[0])) == 0
    (compiles,) = re.findall(r"^python -m grpc_tools.protoc (.*)", page, flags=re.M)
    assert protoc.main(["protoc", *shlex.split(compiles)]) == 0
    port = client.channel._channel.target().decode().rpartition(":")[2]
    (tmp_path / "client.py").write_text(code.replace("127.0.0.1:50051", f"127.0.0.1:{port}"))
    subprocess.run([sys.executable, "client.py"], check=True, timeout=60)  # its messages are no others of ours
    seen = decoded((tmp_path / "street.png").read_bytes()).astype(int)
    assert np.abs(seen - rendered(timed_views()[0])).max() <= 2  # two float32 poses one after the other


def test_a_batch_is_its_singles_and_says_which_camera_failed(client):
    views = timed_views()[4:8]
    batch = pb2.BatchRGBRenderRequest()
    for view in views:
        batch.items.add(camera_name=f"camera {view.camera_index}", request=theirs(request_for(view)))
    batch.items[2].request.scene_id = "elsewhere"
    answer = client.batch_render_rgb(batch)
    assert [item.camera_name for item in answer.items] == [f"camera {view.camera_index}" for view in views]
    assert [item.success for item in answer.items] == [True, True, False, True]
    for item, view in zip(answer.items, views, strict=True):
        assert item.result.image_bytes == (picture(client, view) if item.success else b"")
    assert "no scene 'elsewhere'" in answer.items[2].error_message
    batch.items[1].camera_name = "camera 0"
    with pytest.raises(grpc.RpcError) as caught:
        client.batch_render_rgb(batch)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT


TOO_MUCH = [
    MemoryError(),
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"),
    RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried to allocate 9 bytes"),
]


def batch_of(*sides: int) -> Any:
    batch = pb2.BatchRGBRenderRequest()
    for side in sides:
        request = request_for(timed_views()[1], resolution_w=side, resolution_h=side)
        batch.items.add(camera_name=f"camera {side}", request=theirs(request))
    return batch


def test_splats_beyond_the_limit_are_one_cameras_fault(client, monkeypatch):
    monkeypatch.setattr(rasterizer, "PAIR_LIMIT", 300)
    answer = client.batch_render_rgb(batch_of(8, 900, 9))
    assert [item.success for item in answer.items] == [True, False, True]
    assert "more than the 300 that may be held" in answer.items[1].error_message
    with pytest.raises(grpc.RpcError) as caught:
        picture(client, timed_views()[1], resolution_w=900, resolution_h=900)
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


@pytest.mark.parametrize("error", [*TOO_MUCH, KeyError("of our own")], ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("place", ["picture", "encoded"])
def test_any_error_belongs_to_its_camera_and_the_server_goes_on(client, monkeypatch, caplog, error, place):
    plain = getattr(server_module, place)

    def fails(*told):
        size = told[1].camera.width if place == "picture" else told[0].shape[1]
        if size == 9:
            raise error
        return plain(*told)

    monkeypatch.setattr(server_module, place, fails)
    answer = client.batch_render_rgb(batch_of(8, 9, 10))
    assert [item.success for item in answer.items] == [True, False, True]
    said = "KeyError: 'of our own'" if isinstance(error, KeyError) else "memory is out"
    assert said in answer.items[1].error_message
    with pytest.raises(grpc.RpcError) as caught:
        picture(client, timed_views()[1], resolution_w=9, resolution_h=9)
    code = grpc.StatusCode.INTERNAL if isinstance(error, KeyError) else grpc.StatusCode.RESOURCE_EXHAUSTED
    assert caught.value.code() == code
    assert said in str(caught.value.details())
    assert ("a request failed" in caplog.text) == isinstance(error, KeyError)
    assert picture(client, timed_views()[1], resolution_w=8, resolution_h=8)


def test_full_hd_passes_alpasims_channel(client):
    """As the largest PNG that there can be: of noise."""
    view = timed_views()[0]
    data = picture(client, view, resolution_w=1920, resolution_h=1080)
    assert decoded(data).shape == (1080, 1920, 3)
    noise = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3), np.uint8)
    assert 4 * len(renderer.encoded(noise, 1, 0.0)) < 64 * 2**20  # a batch of four


def test_requests_at_once_get_the_bytes_of_requests_one_by_one(client):
    requests = []
    for number, view in enumerate(timed_views()):
        request = request_for(view, image_format=1 + number % 2)
        if number % 3 == 0:
            place(request, "car", at(9.0, 0.1 * number, 1.0))
        requests.append(theirs(request))
    alone = [client.render_rgb(request).image_bytes for request in requests]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda request: client.render_rgb(request).image_bytes, requests))
    assert together == alone


def test_what_the_server_says_of_itself_and_its_scene(client):
    version = client.get_version()
    assert version.version_id.startswith("sparsestreet ")
    assert version.grpc_api_version.minor == 55
    assert list(client.get_available_scenes().scene_ids) == ["street"]
    client.render_rgb(theirs(request_for(timed_views()[0], "*")))  # the only one
    assert [scene.scene_id for scene in client.get_loaded_scenes().scenes] == ["street"]
    assert len(client.get_available_ego_masks().ego_mask_metadata) == 0
    poses = client.get_available_trajectories(pb2.AvailableTrajectoriesRequest(scene_id="street"))
    poses = poses.available_trajectories[0].trajectory.poses
    assert [pose.timestamp_us for pose in poses] == [START_US + STEP_US * frame for frame in range(5)]
    # 1.5 m behind the front camera, which is at (2, 0.2) then and looks 6 degrees to the left.
    place = np.array([2 - 1.5 * np.cos(np.radians(6)), 0.2 - 1.5 * np.sin(np.radians(6)), -0.1])
    assert np.allclose([poses[2].pose.vec.x, poses[2].pose.vec.y, poses[2].pose.vec.z], place, atol=1e-5)


def test_a_camera_on_the_recorded_vehicle_sees_what_was_recorded(client):
    """As a simulator asks: pose of the vehicle times ``rig_to_camera``, lens and name as the server says them."""
    from scipy.spatial.transform import Rotation

    def matrix(pose):
        made = np.eye(4)
        made[:3, :3] = Rotation.from_quat([pose.quat.x, pose.quat.y, pose.quat.z, pose.quat.w]).as_matrix()
        made[:3, 3] = pose.vec.x, pose.vec.y, pose.vec.z
        return made

    poses = client.get_available_trajectories(pb2.AvailableTrajectoriesRequest(scene_id="street"))
    rig = matrix(poses.available_trajectories[0].trajectory.poses[3].pose)
    cameras = client.get_available_cameras(pb2.AvailableCamerasRequest(scene_id="street")).available_cameras
    assert [camera.logical_id for camera in cameras] == ["0", "1", "2", "3"]
    for camera, view in zip(cameras, timed_views()[12:16], strict=True):
        request = theirs(request_for(view))
        request.camera_intrinsics.CopyFrom(camera.intrinsics)
        pose = rig @ matrix(camera.rig_to_camera)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        for end in (request.sensor_pose.start_pose, request.sensor_pose.end_pose):
            end.CopyFrom(
                common_pb2.Pose(
                    vec=common_pb2.Vec3(x=pose[0, 3], y=pose[1, 3], z=pose[2, 3]),
                    quat=common_pb2.Quat(w=w, x=x, y=y, z=z),
                )
            )
        seen = decoded(client.render_rgb(request).image_bytes).astype(int)
        # Two float32 poses one after the other.
        assert np.abs(seen - rendered(view)).max() <= 2


NAN = float("nan")
STATUSES = {
    "another scene": ({"scene_id": "elsewhere"}, grpc.StatusCode.NOT_FOUND, "no scene 'elsewhere': this server has"),
    "no scene": ({"scene_id": ""}, grpc.StatusCode.INVALID_ARGUMENT, "scene_id is empty"),
    "huge": ({"resolution_h": 10**6, "resolution_w": 10**6}, grpc.StatusCode.INVALID_ARGUMENT, "8192 pixels a side"),
    "video": ({"image_format": 5}, grpc.StatusCode.UNIMPLEMENTED, "AVC"),
    "quality": ({"image_quality": NAN}, grpc.StatusCode.INVALID_ARGUMENT, "image_quality"),
}


@pytest.mark.parametrize(("changes", "code", "said"), STATUSES.values(), ids=STATUSES)
def test_errors_are_statuses_and_the_server_goes_on(client, changes, code, said):
    view = timed_views()[0]
    with pytest.raises(grpc.RpcError) as caught:
        picture(client, view, **changes)
    assert caught.value.code() == code
    assert said in there(caught.value.details())
    assert picture(client, view)


def test_the_log_says_which_objects_float_or_are_not_there(client, caplog):
    request = request_for(timed_views()[8])
    place(request, "tram", at(9.0, 0.0, 5.5))
    client.render_rgb(theirs(request))
    place(request, "trams", at(9.0, 0.0, 1.0))
    with pytest.raises(grpc.RpcError, match="no object 'trams'"):
        client.render_rgb(theirs(request))
    floats, refused = caplog.messages
    assert re.match(r"street: tram is [45]\.\d m above the ground", floats)
    assert refused == "street: requests that name trams are refused: there is no such object"


def test_an_error_that_repeats_a_long_name_is_still_its_status(client):
    request = request_for(timed_views()[0])
    place(request, "x" * 100_000, at(0.0, 0.0, 0.0))
    with pytest.raises(grpc.RpcError) as caught:
        client.render_rgb(theirs(request))
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert "no object 'xxx" in there(caught.value.details())


def test_what_is_not_there_yet_is_unimplemented(client):
    with pytest.raises(grpc.RpcError) as caught:
        client.render_aggregated(pb2.AggregatedRenderRequest())
    assert caught.value.code() == grpc.StatusCode.UNIMPLEMENTED
    assert "lidar" in there(caught.value.details())


def test_bytes_that_are_no_message_get_a_status(client, caplog):
    call = client.channel.unary_unary("/nre.grpc.protos.sensorsim.SensorsimService/render_rgb")
    with pytest.raises(grpc.RpcError, match="make messages of `serve --proto`") as caught:
        call(b"\xff" * 100, timeout=60)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert caplog.text == ""
    assert picture(client, timed_views()[0])


def test_a_call_that_never_ends_its_message_gives_its_place_back(tmp_path, monkeypatch):
    """Four take all workers and all places; one that is closed without a message is told so."""
    monkeypatch.setattr("sparsestreet.serving.standard.WHOLE_MESSAGE", 0.5)
    monkeypatch.setattr("sparsestreet.serving.server.MAX_WAITING", 4)
    runs = named_runs([write_run(tmp_path / "street")])
    server, port = start(Scenes(runs, load_scene, memory=10**9), "127.0.0.1", 0, workers=4)
    client, end = Client(port), threading.Event()
    call = client.channel.stream_unary("/nre.grpc.protos.sensorsim.SensorsimService/get_version")
    held = [call.future((b"" for _ in range(1) if end.wait(60) and False), timeout=60) for _ in range(4)]
    assert {one.code() for one in held} == {grpc.StatusCode.CANCELLED}
    assert client.get_version()
    with pytest.raises(grpc.RpcError, match="the call has no message: send one"):
        call(iter(()), timeout=60)
    end.set()
    client.channel.close()
    server.stop(None).wait()


def test_a_request_whose_deadline_passes_while_it_waits_is_not_rendered(client, monkeypatch):
    held, let_go, pictures = threading.Event(), threading.Event(), []

    def slow(served, view, edits):
        pictures.append(view.time)
        held.set()
        let_go.wait(30)
        return renderer.picture(served, view, edits)

    monkeypatch.setattr("sparsestreet.serving.server.picture", slow)
    call = client.calls["render_rgb"]
    first = call.future(theirs(request_for(timed_views()[0])), timeout=60)
    assert held.wait(30)
    late = call.future(theirs(request_for(timed_views()[4])), timeout=0.2)
    dropped = call.future(theirs(request_for(timed_views()[8])), timeout=60)
    assert late.code() == grpc.StatusCode.DEADLINE_EXCEEDED
    dropped.cancel()
    last = call.future(theirs(request_for(timed_views()[16])), timeout=60)
    time.sleep(0.1)  # until the server has heard of it
    let_go.set()
    assert first.result().image_bytes
    assert last.result().image_bytes
    assert pictures == [0.0, 1.0]


def test_health_and_what_a_picture_took(client):
    check = client.channel.unary_unary(
        "/grpc.health.v1.Health/Check",
        request_serializer=lambda message: message.SerializeToString(),
        response_deserializer=wire.kind("grpc.health.v1.HealthCheckResponse").FromString,
    )
    ask = wire.kind("grpc.health.v1.HealthCheckRequest")
    assert check(ask(service="nre.grpc.protos.sensorsim.SensorsimService"), timeout=60).status == 1
    with pytest.raises(grpc.RpcError) as caught:
        check(ask(service="other"), timeout=60)
    assert caught.value.code() == grpc.StatusCode.NOT_FOUND
    _, call = client.calls["render_rgb"].with_call(theirs(request_for(timed_views()[0])), timeout=60)
    spent = {key: float(value) for key, value in call.trailing_metadata() if key.endswith("-ms")}
    assert spent.keys() == {"wait-ms", "render-ms", "encode-ms"}
    assert spent["render-ms"] > 0


def test_a_client_finds_a_server_that_was_started_again(tmp_path):
    scenes = Scenes(named_runs([write_run(tmp_path / "street")]), load_scene, memory=10**9)
    server, port = start(scenes, "127.0.0.1", 0, workers=1)
    client = Client(port)
    first = picture(client, timed_views()[0])
    server.stop(None).wait()
    server, _ = start(scenes, "127.0.0.1", port, workers=1)
    assert picture(client, timed_views()[0]) == first
    client.channel.close()
    server.stop(None).wait()


def test_a_port_has_one_server(client):
    port = int(client.channel._channel.target().decode().rpartition(":")[2])
    with pytest.raises(OSError, match=f"nobody can listen on 127.0.0.1:{port}"):
        start(Scenes({}, load_scene, memory=1), "127.0.0.1", port, workers=1)
