"""A request for a picture as a view and edits of a scene, and the picture as bytes. Nothing here knows of a network."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from sparsestreet.records.run import RUN
from sparsestreet.scene.edits import Change, Edits, Given, edited, objects_of
from sparsestreet.scene.edits.edits import found
from sparsestreet.scene.edits.ground import Ground
from sparsestreet.scene.effects.optics import GlobalShutter, Pinhole
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.rendering import render
from sparsestreet.scene.standing import StandingScene
from sparsestreet.scene.storage import SCENE_FILE as SCENE_FILE
from sparsestreet.scene.storage import STREET_FILE, StoredScene, rig_record, scene_path, views_of
from sparsestreet.scene.views import VIEWS_FILE as VIEWS_FILE
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import NotServedError, lens_of, matrix, posed
from sparsestreet.serving.rig import Pose, Rig, rig_of
from sparsestreet.types import View

Open = Callable[[Path], StoredScene]


class UnknownSceneError(ValueError):
    """A name that no scene has."""


@dataclass(frozen=True)
class ServedScene:
    """A scene that is open, and the vehicle that recorded its log."""

    name: str
    stored: StoredScene
    rig: Rig

    @cached_property
    def ground(self) -> Ground:
        """Its ground, read when somebody asks for the first time."""
        return Ground(self.stored.scene)


@dataclass(frozen=True)
class RigOptions:
    """What a user says of the vehicle (``rig_of``)."""

    mount: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None
    frame_rate: float | None = None


def open_run(run: Path, name: str, open_scene: Open, options: RigOptions) -> ServedScene:
    """The scene of a run's folder. Raises FileNotFoundError or ValueError for one that cannot be served.

    Its own lens or shutter that was left out in training is no longer left out: requests say which camera they mean.
    """
    stored = open_scene(run)
    effects = {key: one for key, one in stored.scene.effects.items() if not isinstance(one, Pinhole | GlobalShutter)}
    scene = StandingScene(dict(stored.scene.nodes.items()), effects).eval()
    return ServedScene(name, replace(stored, scene=scene), run_rig(run, options))


def run_rig(run: Path, options: RigOptions) -> Rig:
    """The vehicle of a run, from what training left in its folder."""
    return rig_of(
        views_of(run),
        rig_record(run),
        mount=options.mount,
        names=options.names,
        frame_rate=options.frame_rate,
    )


def named_runs(runs: Sequence[Path]) -> dict[str, Path]:
    """Name for runs: that of the log, or of the folder where several runs are of one log.

    Raises FileNotFoundError for a folder without a scene, ValueError for two runs of one name.
    """
    logs = []
    for run in runs:
        if not run.is_file() and not ((run / SCENE_FILE).is_file() and (run / VIEWS_FILE).is_file()):
            _check_small(run)
        description = RUN.find(run)
        logs.append(_called(run) if description is None else description.scene)
    names = [log if logs.count(log) == 1 else _called(run) for log, run in zip(logs, runs, strict=True)]
    if len(set(names)) < len(names):
        raise ValueError(f"each scene needs a name of its own, got {', '.join(names)}: rename a folder")
    return dict(zip(names, runs, strict=True))


def _check_small(run: Path) -> None:
    if (run / SCENE_FILE).is_file() or not (run / STREET_FILE).is_file():
        missing = run / (VIEWS_FILE if (run / SCENE_FILE).is_file() else SCENE_FILE)
        raise FileNotFoundError(f"there is no {missing}: give the folder of a finished run, or a .street")


def _called(run: Path) -> str:
    return run.stem if run.is_file() else run.resolve().name


class Scenes:
    """Opens scenes when they are asked for; those asked for longest ago are closed where memory ends."""

    def __init__(
        self, runs: dict[str, Path], open_scene: Open, *, memory: int, options: RigOptions | None = None
    ) -> None:
        """
        Args:
            runs: the folder of each scene.
            open_scene: reads a scene of a folder onto its device.
            memory: bytes of scene files that are open at the same time; one scene is open in any case.
            options: what is said of the vehicles.
        """
        self.runs, self.memory = runs, memory
        self._open_scene, self._options = open_scene, options or RigOptions()
        self._sizes = {name: scene_path(run).stat().st_size for name, run in runs.items()}
        self._opened: OrderedDict[str, ServedScene] = OrderedDict()
        self._rigs: dict[str, Rig] = {}
        self._reading, self._changing = threading.Lock(), threading.Lock()

    @property
    def names(self) -> list[str]:
        return list(self.runs)

    @property
    def opened(self) -> list[str]:
        """Name of the scenes in memory, the one asked for longest ago first."""
        with self._changing:
            return list(self._opened)

    def rig(self, name: str) -> Rig:
        """The vehicle of a scene, which need not be open. Raises UnknownSceneError."""
        name = self.known(name)
        if name not in self._rigs:
            self._rigs[name] = run_rig(self.runs[name], self._options)
        return self._rigs[name]

    def get(self, name: str) -> ServedScene:
        """The scene, opened if need be; safe from many threads. Raises UnknownSceneError, ValueError, OSError."""
        name = self.known(name)
        found = self._recent(name)
        if found is not None:
            return found
        with self._reading:
            found = self._recent(name)
            if found is None:
                self._make_room(self._sizes[name])
                found = open_run(self.runs[name], name, self._open_scene, self._options)
                with self._changing:
                    self._opened[name] = found
        return found

    def known(self, name: str) -> str:
        """The name itself; of "*" that of the only scene. Raises UnknownSceneError, ValueError for no name at all."""
        if not name:
            raise ValueError(f"scene_id is empty: name one of {self._said}")
        if name == "*" and len(self.runs) == 1:
            return next(iter(self.runs))
        if name not in self.runs:
            raise UnknownSceneError(f"there is no scene {name[:100]!r}: this server has {self._said}")
        return name

    @property
    def _said(self) -> str:
        return ", ".join(list(self.runs)[:10]) + (" and others" if len(self.runs) > 10 else "")

    def _recent(self, name: str) -> ServedScene | None:
        with self._changing:
            if name in self._opened:
                self._opened.move_to_end(name)
            return self._opened.get(name)

    def _make_room(self, size: int) -> None:
        with self._changing:
            while self._opened and size + sum(self._sizes[name] for name in self._opened) > self.memory:
                self._opened.popitem(last=False)


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


def with_objects(scene: SceneGraph, edits: Edits) -> SceneGraph:
    """Return the scene with its objects where they are placed; the scene itself where none is."""
    return edited(scene, edits) if edits.changes else scene


@torch.no_grad()
def picture(served: ServedScene, view: View, edits: Edits) -> Picture:
    """The image, as ``sparsestreet render`` writes it; on the device of the scene, which takes one at a time."""
    stored = served.stored
    rgb = render(with_objects(stored.scene, edits), view, options=stored.options).rgb
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
