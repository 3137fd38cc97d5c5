"""The panel of objects: choose one, hide it, move it by sliders or by dragging it in the picture."""

from typing import Any

from sparsestreet.viewing.edit_state import Offset, own_frame
from sparsestreet.viewing.poses import matrix, wxyz_of
from sparsestreet.viewing.stage import Stage

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
