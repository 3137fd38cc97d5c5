"""The panel for the object that is chosen, and poses as viser has them."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sparsestreet.viewing.edit_state import Offset, own_frame
from sparsestreet.viewing.stage import Eye, Stage

_MAX_CANVAS = 16_384
"""Pixels of a side of a window."""


def eye_of(camera: Any) -> Eye | None:
    """Where a window of viser looks from; its axes are OpenCV's, its field of view vertical.

    None where it has no size, as in a tab that nobody sees, or says what no camera is: anybody may write to a server.
    """
    numbers = np.array([*camera.wxyz, *camera.position, camera.fov], np.float64)
    width, height = int(camera.image_width), int(camera.image_height)
    if not np.isfinite(numbers).all() or not np.linalg.norm(numbers[:4]) > 0:
        return None
    if not (0 < numbers[7] < math.pi and 0 < width <= _MAX_CANVAS and 0 < height <= _MAX_CANVAS):
        return None
    return Eye(matrix(numbers[:4], numbers[4:7]), float(numbers[7]), width, height)


def show_from(client: Any, eye: Eye) -> None:
    """Let a window of viser look from there."""
    with client.atomic():
        client.camera.position = eye.world_from_camera[:3, 3]
        client.camera.wxyz = wxyz_of(eye.world_from_camera)
        client.camera.fov = eye.fov


def matrix(wxyz: Any, position: Any) -> Float64[np.ndarray, "4 4"]:
    """A pose of a unit quaternion and a position, meters.

    >>> matrix((1.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(wxyz, np.float64), scalar_first=True).as_matrix()
    pose[:3, 3] = position
    return pose


def wxyz_of(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4"]:
    """The rotation of a pose as a unit quaternion."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)


_METERS, _HEIGHT, _DEGREES = 15.0, 3.0, 180.0
"""As far as the sliders go."""
_HANDLE = 100.0
"""Pixels of an arrow."""
_NONE = "(none)"


class ObjectPanel:
    """Widgets of viser on top of the edits of a stage."""

    def __init__(self, server: Any, stage: Stage) -> None:
        self.stage, self.server = stage, server
        self._names = {self._label(name): name for name in stage.edits.names}
        gui = server.gui
        with gui.add_folder("Objects"):
            self.choice = gui.add_dropdown("object", (_NONE, *self._names), initial_value=_NONE)
            self.about = gui.add_markdown("")
            self.hidden = gui.add_checkbox("hidden", False)
            self.sliders = {
                name: gui.add_slider(f"{name}, {unit}", -reach, reach, step, 0.0)
                for name, unit, reach, step in (
                    ("forward", "m", _METERS, 0.05),
                    ("right", "m", _METERS, 0.05),
                    ("up", "m", _HEIGHT, 0.01),
                    ("turn", "°", _DEGREES, 1.0),
                )
            }
            self.drags = gui.add_checkbox("drag it in the picture", False)
            reset = gui.add_button("As recorded")
        self.handle = server.scene.add_transform_controls(
            "/chosen", scale=_HANDLE, fixed=True, disable_rotations=True, visible=False, depth_test=False
        )
        self.choice.on_update(lambda event: self._show())
        self.drags.on_update(lambda event: self._place_handle())
        self.hidden.on_update(self._hide)
        for slider in self.sliders.values():
            slider.on_update(self._slide)
        reset.on_click(lambda event: self._reset())
        self.handle.on_update(self._drag)
        self._show()

    @property
    def chosen(self) -> str | None:
        """The name of the object that is chosen."""
        return self._names.get(self.choice.value)

    def follow(self) -> None:
        """Let the handle go along where the object is at another time."""
        if self.handle.visible and self.stage.time != self._placed_at:
            self._place_handle()

    def _label(self, name: str) -> str:
        kind = self.stage.edits.class_name(name)
        return f"{name} ({kind})" if kind else name

    def _show(self) -> None:
        """Let the widgets say what the edits say."""
        name, edits = self.chosen, self.stage.edits
        fixed = name is None or edits.goes_its_own_way(name)
        self.hidden.disabled = name is None
        for widget in (*self.sliders.values(), self.drags):
            widget.disabled = fixed
        if name is None:
            self.about.content = ""
        else:
            start, end = edits.life(name)
            own = "; held or on a path by the file of edits" if fixed else ""
            self.about.content = f"recorded from {start:.1f} to {end:.1f} s{own}"
            self.hidden.value = edits.is_hidden(name)
            offset = edits.offset(name)
            for key, slider in self.sliders.items():
                slider.value = min(max(getattr(offset, key), slider.min), slider.max)
        self._place_handle()

    def _hide(self, event: Any) -> None:
        if event.client is not None and self.chosen is not None:
            self.stage.edits.hide(self.chosen, self.hidden.value)
            self.stage.changed()

    def _slide(self, event: Any) -> None:
        if event.client is not None:
            self._move(Offset(**{key: float(slider.value) for key, slider in self.sliders.items()}))
            self._place_handle()

    def _drag(self, event: Any) -> None:
        if event.client is not None and self.chosen is not None:
            recorded = self.stage.edits.frame(self.chosen, self.stage.time)
            offset = Offset.of(own_frame(recorded, matrix(self.handle.wxyz, self.handle.position)))
            for key, slider in self.sliders.items():
                slider.value = min(max(getattr(offset, key), slider.min), slider.max)
            self._move(offset)

    def _reset(self) -> None:
        if self.chosen is not None and not self.stage.edits.goes_its_own_way(self.chosen):
            self.stage.edits.hide(self.chosen, False)
            self._move(Offset())
            self._show()

    def _move(self, offset: Offset) -> None:
        if self.chosen is not None:
            self.stage.edits.move(self.chosen, offset)
            self.stage.changed()

    def _place_handle(self) -> None:
        name, edits, self._placed_at = self.chosen, self.stage.edits, self.stage.time
        self.handle.visible = name is not None and self.drags.value and not edits.goes_its_own_way(name)
        if name is not None and self.handle.visible:
            frame = edits.frame(name, self._placed_at) @ edits.offset(name).frame
            self.handle.position, self.handle.wxyz = frame[:3, 3], wxyz_of(frame)
