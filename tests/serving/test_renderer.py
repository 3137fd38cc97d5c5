"""Requests as pictures, without a network."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.scene.edits import Edits, edited
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene
from sparsestreet.serving import wire
from sparsestreet.serving.artifact import box_center
from sparsestreet.serving.cameras import NotServedError, pose_message
from sparsestreet.serving.renderer import ServedScene, edits_of, encoded, picture, view_of
from tests.export.street import stored_street
from tests.scene.people import smpl, walker
from tests.serving.street import START_US, as_sent, at, place, request_for, served, timed_views, world_from_camera


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return served(tmp_path_factory.mktemp("runs") / "street")


def shown(street, request) -> np.ndarray:
    return picture(street, view_of(request, street.rig), edits_of(request, street))


def rendered(view, stored=None) -> np.ndarray:
    return ((stored or stored_street()).render(view).rgb.clamp(0, 1) * 255).round().byte().numpy()


@pytest.mark.parametrize("number", [0, 6, 19])
def test_a_request_for_a_recorded_pose_is_what_render_shows_of_it(street, number):
    view = timed_views()[number]
    assert np.array_equal(shown(street, request_for(view)), rendered(as_sent(view)))


def test_other_pixels_than_those_of_the_calibration_show_the_same(street):
    view = timed_views()[5]
    request = request_for(view, resolution_h=16, resolution_w=96)
    intrinsics = view.camera.intrinsics * torch.tensor([[2.0], [0.5], [1.0]])
    expected = as_sent(replace(view, camera=replace(view.camera, intrinsics=intrinsics, width=96, height=16)))
    assert np.array_equal(shown(street, request), rendered(expected))


def test_an_object_that_is_not_named_stays_as_logged_and_one_far_below_is_gone(street):
    view = timed_views()[8]  # the car is at (10, 0, 1), the tram at (9, -3, 1)
    as_logged = shown(street, request_for(view))
    request = request_for(view)
    place(request, "car", at(10.0, 0.0, 1.0))
    # float32 poses: a value on the verge of two.
    assert np.abs(shown(street, request).astype(int) - as_logged).max() <= 1
    below = request_for(view)
    place(below, "car", at(10.0, 0.0, -99.0))
    without = stored_street()
    node = without.scene.nodes["rigid"]
    with torch.no_grad():
        node.rows.opacity_logits[node.rows.instances == 0] = -100
    assert np.array_equal(shown(street, below), rendered(as_sent(view), without))
    assert not np.array_equal(shown(street, below), as_logged)


def test_a_moved_object_stands_where_it_was_put_also_after_its_recorded_life(street):
    view = timed_views()[16]  # time 1: the tram has left
    request = request_for(view)
    place(request, "tram", at(9.0, 0.5, 1.0, yaw=0.7))
    there = stored_street()
    node = there.scene.nodes["rigid"]
    assert isinstance(node, Rigid)
    with torch.no_grad():
        node.spans[1] = torch.tensor([0.0, 1.0])
        node.keyframe_times[1] = torch.tensor([0.0, 1.0])
        node.keyframe_translations[1] = torch.tensor([9.0, 0.5, 1.0])
        node.keyframe_quaternions[1] = torch.tensor([np.cos(0.35), 0.0, 0.0, np.sin(0.35)])
    expected = rendered(as_sent(view), there)
    assert np.abs(shown(street, request).astype(int) - expected).max() <= 1
    assert np.abs(shown(street, request_for(view)).astype(int) - expected).max() > 20


def test_a_global_shutter_sees_the_street_of_the_start_of_its_frame(street):
    """Also where the frame lasts: its camera stands where it is at the start."""
    request = request_for(timed_views()[4])
    request.frame_end_us = request.frame_start_us + 100_000
    assert view_of(request, street.rig).time == street.rig.clock.time(request.frame_start_us)


def test_rows_of_a_turning_car_are_what_each_of_them_saw(street):
    """Against 32 pictures, one a row, of a camera and a car that move straight and turn evenly meanwhile."""
    view = timed_views()[4]
    # From 30 m behind, with a longer lens: a splat keeps its shape while it is read out, unless it is near.
    zoomed = view.camera.intrinsics * torch.tensor([[5.0, 1.0, 1.0], [1.0, 5.0, 1.0], [1.0, 1.0, 1.0]])
    view = replace(view, camera=replace(view.camera, intrinsics=zoomed))
    start = world_from_camera(view.camera)
    start[:3, 3] -= 30 * start[:3, 2]
    # 8 m/s and a turn of 0.5 rad/s, over 30 ms; the car passes from left to right at 10 m/s.
    turn = Rotation.from_euler("y", 0.5 * 0.03)
    end = start.copy()
    end[:3, :3] = start[:3, :3] @ turn.as_matrix()
    end[:3, 3] += 0.24 * start[:3, 2]
    request = request_for(view, frame_end_us=START_US + 250_000 + 30_000)
    request.camera_intrinsics.shutter_type = wire.number("ShutterType", "ROLLING_TOP_TO_BOTTOM")
    request.sensor_pose.start_pose.CopyFrom(pose_message(start))
    request.sensor_pose.end_pose.CopyFrom(pose_message(end))
    place(request, "car", at(9.0, 0.5, 1.0), at(9.0, 0.2, 1.0))
    rows = []
    for row in range(32):
        share = row / 31
        pose = start.copy()
        pose[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix()
        pose[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
        one = request_for(view, frame_start_us=START_US + 250_000 + round(30_000 * share))
        one.frame_end_us = one.frame_start_us
        one.sensor_pose.start_pose.CopyFrom(pose_message(pose))
        one.sensor_pose.end_pose.CopyFrom(pose_message(pose))
        place(one, "car", at(9.0, 0.5 - 0.3 * share, 1.0))
        rows.append(shown(street, one)[row])
    expected = np.stack(rows).astype(int)
    difference = np.abs(shown(street, request).astype(int) - expected)
    still = request_for(view)
    still.sensor_pose.start_pose.CopyFrom(pose_message(start))
    still.sensor_pose.end_pose.CopyFrom(pose_message(start))
    place(still, "car", at(9.0, 0.5, 1.0))
    frozen = np.abs(shown(street, still).astype(int) - expected)
    # Motion on the screen is taken as even: 2 of 255, and rounding. A picture of the first row alone is off by 85, and
    # more than ten times as much.
    assert difference.mean() < 0.1 * frozen.mean()
    assert difference.max() <= 3


def test_bytes_are_a_png_or_a_jpeg(street):
    image = shown(street, request_for(timed_views()[0]))
    png = cv2.imdecode(np.frombuffer(encoded(image, 1, 0.0), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(png[..., ::-1], image)
    jpeg = cv2.imdecode(np.frombuffer(encoded(image, 2, 95.0), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(float)
    # Noise of a quality of 95, and half as many colors as pixels on this small and colorful image.
    assert 10 * np.log10(255**2 / ((jpeg - image) ** 2).mean()) > 30
    assert len(encoded(image, 2, 20.0)) < len(encoded(image, 2, 95.0))


NAN = float("nan")


def put(path: str, *values: float) -> Callable[[Any], None]:
    """Set an entry of a request, or several that end alike: ``resolution_w,resolution_h``, ``radial_coeffs.4``."""
    *parents, last = path.split(".")

    def change(request: Any) -> None:
        for name in parents:
            request = getattr(request, name)
        for name, value in zip(last.split(","), values, strict=True):
            request.__setitem__(int(name), value) if name.isdigit() else setattr(request, name, value)

    return change


LENS, POSE = "camera_intrinsics.opencv_pinhole_param", "sensor_pose.start_pose"
BAD = {
    "nan pose": (put(f"{POSE}.vec.x", NAN), "start_pose must be finite"),
    "no rotation": (lambda request: request.sensor_pose.start_pose.quat.Clear(), "length 1"),
    "backward": (put("frame_end_us", START_US - 1), "ends at most 1 s after"),
    "another clock": (put("frame_start_us,frame_end_us", 5, 5), "the log lasts from 1532402927600000"),
    "a million pixels": (put("resolution_w", 10**6), "1 to 8192 pixels a side, got 1000000"),
    "too many pixels": (put("resolution_w,resolution_h", 8000, 8000), "at most 36,000,000 pixels"),
    "no lens": (lambda request: request.camera_intrinsics.ClearField("opencv_pinhole_param"), "has no lens"),
    "flat": (put(f"{LENS}.focal_length_x", 1e-30), "focal lengths of camera 0"),
    "folded": (put(f"{LENS}.tangential_coeffs.0", 5.0), "must have an inverse"),
    "twice": (lambda request: [place(request, "car", at(0, 0, 0)) for _ in range(2)], "'car' twice"),
    "stranger": (lambda request: place(request, "caar", at(0, 0, 0)), "no object 'caar'"),
    "nan actor": (lambda request: place(request, "car", at(NAN, 0, 0)), "start_pose of car must be finite"),
    "far": (put(f"{POSE}.vec.x", 1e9), "1e\\+09 m from the origin"),
    "format": (put("image_format", 0), "image_format is not said"),
    "quality": (put("image_quality", NAN), "image_quality lies in"),
    "mask": (put("insert_ego_mask", True), "no masks of the vehicle"),
    "shutter": (put("camera_intrinsics.shutter_type", 77), "must be one of .* got 77"),
}


@pytest.mark.parametrize(("change", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_is_refused_in_a_sentence(street, change, said):
    request = request_for(timed_views()[0])
    change(request)
    with pytest.raises(ValueError, match=said) as caught:
        shown(street, request)
    assert not isinstance(caught.value, NotServedError)


LACKING = {
    "f-theta": (lambda r: r.camera_intrinsics.ftheta_param.SetInParent(), "ftheta.*send opencv_pinhole_param"),
    "fisheye": (lambda r: r.camera_intrinsics.opencv_fisheye_param.SetInParent(), "opencv_fisheye"),
    "windshield": (lambda r: r.camera_intrinsics.bivariate_windshield_model_param.SetInParent(), "windshield"),
    "rational": (put(f"{LENS}.radial_coeffs.4", 0.1), "k4 to k6"),
    "prism": (put(f"{LENS}.thin_prism_coeffs.1", 0.1), "thin prism"),
    "video": (put("image_format", 5), "got image_format AVC"),
}


@pytest.mark.parametrize(("change", "said"), LACKING.values(), ids=LACKING)
def test_what_there_is_not_is_said_to_be_so(street, change, said):
    request = request_for(timed_views()[0])
    change(request)
    with pytest.raises(NotServedError, match=said):
        shown(street, request)


def test_a_camera_of_the_log_is_known_by_its_name(street):
    """Its exposure and its color are then those of this camera."""
    request = request_for(timed_views()[6])
    assert view_of(request, street.rig).camera_index == 2
    request.camera_intrinsics.logical_id = "a camera of theirs"
    assert view_of(request, street.rig).camera_index is None


def test_no_edits_render_the_scene_itself(street):
    assert edits_of(request_for(timed_views()[0]), street) == Edits()


def test_instants_beside_the_log_show_its_ends(street):
    late = request_for(timed_views()[16], frame_start_us=START_US + 5_000_000, frame_end_us=START_US + 5_000_000)
    assert view_of(late, street.rig).time == 1.0


def test_a_person_stands_on_the_ground_of_its_box(street):
    """Messages place boxes by their centers, and a person's own frame is at the pelvis."""
    node = smpl(walker("anna", spread=0.0), walker("berta", y=2.0, seed=1))
    scene = SceneGraph({"people": node}).eval()
    people = ServedScene("people", StoredScene(scene, RenderOptions(), "people", 5), street.rig)
    view = timed_views()[8]
    anna = node.rows.instances == 0

    @torch.no_grad()
    def means(request):
        return edited(scene, edits_of(request, people)).gaussians_at(view).gaussians.means

    request = request_for(view)
    logged = means(request)
    place(request, "anna", box_center(node, 0, view.time))
    assert torch.allclose(means(request), logged, atol=1e-5)  # float32 of the message
    request = request_for(view)
    place(request, "anna", at(3.0, 0.0, 5.0 + float(node.sizes[0, 2]) / 2))
    stands = means(request)
    assert torch.equal(stands[~anna], logged[~anna])
    # The soles of a body at rest, but for the 0.5 % of Gaussians that may have left it.
    assert float(stands[anna][:, 2].quantile(0.01)) == pytest.approx(5.0, abs=0.02)
