"""A request for a picture as a view and edits of a scene, and the picture as bytes. Nothing here knows of a network."""

from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from sparsestreet.scene.edits import Change, Edits, Given, edited, objects_of
from sparsestreet.scene.edits.edits import found
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.rendering import render
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import NotServedError, Pose, lens_of, matrix, posed
from sparsestreet.serving.rig import Rig
from sparsestreet.serving.scenes import ServedScene
from sparsestreet.types import View

Picture = UInt8[np.ndarray, "h w 3"]

LONGEST_READOUT = 1.0
"""Seconds between the first and the last row."""
DEFAULT_QUALITY = 95
"""Of a JPEG whose request says none, 1 to 100."""
_FORMATS = ("PNG", "JPEG")
_FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
"""A third of the time of the usual compression, for files that are a tenth larger."""


def view_of(request: Any, rig: Rig) -> View:
    """What the camera of a request sees, and when. Raises ValueError, NotServedError for a lens that there is not."""
    if request.insert_ego_mask:
        raise ValueError(
            "this server has no masks of the vehicle (get_available_ego_masks): send insert_ego_mask=false"
        )
    _wanted(request.image_format, request.image_quality)  # before anything is rendered
    spec, clock = request.camera_intrinsics, rig.clock
    start_us, end_us = request.frame_start_us, request.frame_end_us
    if not 0 <= end_us - start_us <= 1e6 * LONGEST_READOUT:
        raise ValueError(f"a frame ends at most {LONGEST_READOUT:g} s after it starts, got {start_us} to {end_us} us")
    start = matrix(request.sensor_pose.start_pose, "sensor_pose.start_pose")
    shutter = wire.word("ShutterType", spec.shutter_type)
    rolls = shutter not in ("GLOBAL", "UNKNOWN")
    # A camera whose rows are read at once may leave out where it ends.
    ends = rolls or request.sensor_pose.HasField("end_pose")
    end = matrix(request.sensor_pose.end_pose, "sensor_pose.end_pose") if ends else start
    times = clock.time(start_us), clock.time(end_us)
    lens = lens_of(spec, request.resolution_h or spec.resolution_h, request.resolution_w or spec.resolution_w)
    camera = posed(lens, start, end, shutter, (end_us - start_us) / 1e6, times[1] - times[0])
    index = next((one.index for one in rig.cameras if one.name == spec.logical_id), None)
    return View(camera, (times[0] + times[1]) / 2 if rolls else times[0], None, index)


def edits_of(request: Any, served: ServedScene) -> Edits:
    """The objects that a request places; all others stay as logged.

    Raises ValueError for an object that the scene has not, or a pose that is none.
    """
    clock = served.rig.clock
    times = clock.time(request.frame_start_us), clock.time(request.frame_end_us)
    objects = objects_of(served.stored.scene)
    changes: dict[str, Change] = {}
    for one in request.dynamic_objects:
        name = one.track_id
        if name in changes:
            raise ValueError(f"dynamic_objects has {name!r} twice: send each object once")
        _, node, instance = found(objects, name)
        start = matrix(one.pose_pair.start_pose, f"the start_pose of {name}")
        end = matrix(one.pose_pair.end_pose, f"the end_pose of {name}")
        lift = frame_from_box(node, instance)
        changes[name] = Change(Given(start @ lift, end @ lift, times))
    return Edits(changes)


def frame_from_box(node: Tracked, instance: int) -> Pose:
    """From the center of an object's box, which messages place, to its own frame: a person's is at the pelvis."""
    lift = np.eye(4)
    lift[2, 3] = node.frame_height(instance) - float(node.sizes[instance, 2]) / 2
    return lift


@torch.no_grad()
def picture(served: ServedScene, view: View, edits: Edits) -> Picture:
    """The image, as ``sparsestreet render`` writes it; on the device of the scene, which takes one at a time."""
    stored = served.stored
    scene = edited(stored.scene, edits) if edits.changes else stored.scene
    rgb = render(scene, view, options=stored.options).rgb
    return (rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()


def encoded(image: Picture, image_format: int, quality: float) -> bytes:
    """A PNG or a JPEG; OpenCV lets other threads work meanwhile. Raises NotServedError or ValueError."""
    word, quality = _wanted(image_format, quality)
    turned = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if word == "PNG":
        done, data = cv2.imencode(".png", turned, _FASTEST)
    else:
        done, data = cv2.imencode(".jpg", turned, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError(f"OpenCV cannot write a {word} of {image.shape[1]} x {image.shape[0]} pixels")
    return data.tobytes()


def _wanted(image_format: int, quality: float) -> tuple[str, int]:
    word = wire.word("ImageFormat", image_format)
    if word == "UNDEFINED":
        raise ValueError(f"image_format is not said: send {' or '.join(_FORMATS)}")
    if word not in _FORMATS:
        raise NotServedError(f"pictures are {' or '.join(_FORMATS)}, got image_format {word}")
    if not 0 <= quality <= 100:
        raise ValueError(f"image_quality lies in 1 to 100, or is 0 for {DEFAULT_QUALITY}, got {quality:g}")
    return word, max(round(quality), 1) if quality else DEFAULT_QUALITY
