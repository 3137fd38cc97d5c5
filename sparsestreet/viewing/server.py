"""The viewer: viser's window and panel in a browser, pictures rendered here."""

import contextlib
import io
import math
import threading
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sparsestreet.atomic import atomic_file
from sparsestreet.export.page import look_from, private_server
from sparsestreet.listening import Callers, bare, check_address
from sparsestreet.types import View
from sparsestreet.viewing.object_panel import ObjectPanel, eye_of, show_from
from sparsestreet.viewing.stage import Eye, Stage

_MIN_PIXELS, _MAX_PIXELS = 40_000.0, 1920.0 * 1080
"""Pixels of a picture while the camera moves. Below, a frame is no faster: all Gaussians are placed in any case."""
_QUICKEST = 2.0
"""Largest factor of a change between two frames; the square root of it is taken, since one frame is a noisy measure."""


class Pace:
    """Pixels of a frame, followed from how long frames take.

    >>> pace = Pace(frames_per_second=10.0)
    >>> for _ in range(30):
    ...     pace.note(seconds=pace.pixels / 5e6)  # a machine of 5 million pixels a second
    >>> round(pace.pixels / 1e5)
    5
    """

    def __init__(self, frames_per_second: float) -> None:
        self.budget = 1 / frames_per_second
        self.pixels = 200_000.0

    def note(self, seconds: float) -> None:
        """A frame of ``pixels`` took so long."""
        factor = min(max(self.budget / max(seconds, 1e-6), 1 / _QUICKEST), _QUICKEST)
        self.pixels = min(max(self.pixels * math.sqrt(factor), _MIN_PIXELS), _MAX_PIXELS)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of a frame of a window, in its proportions and no larger.

        >>> Pace(frames_per_second=10.0).size(1600, 800)
        (632, 316)
        """
        return fitted(width, height, self.pixels)


def fitted(width: int, height: int, pixels: float) -> tuple[int, int]:
    """Return a size in the same proportions with at most so many pixels.

    >>> fitted(200, 100, 1e6), fitted(200, 100, 5000.0)
    ((200, 100), (100, 50))
    """
    scale = min(1.0, math.sqrt(pixels / (width * height)))
    return max(int(width * scale), 1), max(int(height * scale), 1)


REST = 0.2
"""Seconds without a change after which nothing moves."""
MAX_STILL = 1920.0 * 1200
"""Pixels of a picture at rest."""
_SHORTEST = 1 / 30
"""Seconds from one picture to the next: browsers show no more."""


@dataclass(frozen=True)
class Shot:
    """A picture that is due."""

    eye: Eye
    width: int
    height: int
    whole: bool
    """Of full size: nothing moves."""


class Canvas:
    """One window. All times are seconds of one clock."""

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.eye: Eye | None = None
        self._version = -1
        self._changed = self._drawn = float("-inf")
        self._stale, self._whole = False, False

    def look(self, eye: Eye, now: float) -> None:
        """The window's camera or size has changed."""
        self.eye, self._changed, self._stale = eye, now, True

    def due(self, version: int, now: float) -> Shot | None:
        """What to draw now, if anything; ``version`` is that of the stage."""
        if self.eye is None:
            return None
        if version != self._version:
            self._version, self._changed, self._stale = version, now, True
        width, height = self.eye.width, self.eye.height
        if self._stale and now - self._drawn >= _SHORTEST:
            return Shot(self.eye, *self.pace.size(width, height), whole=False)
        if not self._stale and not self._whole and now - self._changed >= REST:
            return Shot(self.eye, *fitted(width, height, MAX_STILL), whole=True)
        return None

    def drawn(self, shot: Shot, seconds: float, now: float) -> None:
        """The picture was drawn in so many seconds."""
        if not shot.whole:
            self.pace.note(seconds)
        # The camera may have moved meanwhile.
        self._drawn, self._stale, self._whole = now, self.eye is not shot.eye, shot.whole


_QUALITY = {False: 50, True: 85}
"""Of a JPEG while something moves, and at rest."""
_IDLE = 0.005
"""Seconds to wait where nothing is due."""


class Viewer:
    """A stage on the web. ``run`` serves it until ``stop``; all windows show one time and the same edits."""

    def __init__(
        self,
        stage: Stage,
        start: View,
        *,
        title: str,
        host: str,
        port: int,
        frames_per_second: float,
        save: Path,
        known_as: Sequence[str] = (),
    ) -> None:
        """``known_as``: further names by which browsers reach it. Raises OSError where nobody can listen there."""
        self.stage, self.save, self.frames_per_second = stage, save, frames_per_second
        check_address(host, 0)  # viser would try one port after the other
        # viser says where it is in a box of its own.
        with contextlib.redirect_stdout(io.StringIO()):
            self.server = private_server(Callers.of(host, known_as), host=bare(host), port=port, label=title)
        look_from(self.server, start, far=1000.0)
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._windows: dict[int, tuple[Any, Canvas]] = {}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._clock_panel()
        self._camera_panel()
        self.objects = ObjectPanel(self.server, stage)
        self._save_panel()
        self.server.on_client_connect(self._joined)
        self.server.on_client_disconnect(self._left)

    @property
    def port(self) -> int:
        """Where it listens: the one that was asked for, or the next that is free."""
        return self.server.get_port()

    def run(self) -> None:
        """Render what is due until ``stop``, then end the server."""
        try:
            while not self._ended.is_set():
                if not self.step():
                    self._ended.wait(_IDLE)
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def stop(self) -> None:
        self._ended.set()

    def write_edits(self) -> None:
        """Write what was done as a file of edits, whole or not at all."""
        with atomic_file(self.save) as temporary:
            temporary.write_text(self.stage.edits.text(), encoding="utf-8")

    def step(self) -> bool:
        """Draw what is due in all windows; whether anything was."""
        self.stage.tick(time.perf_counter())
        with self._lock:
            windows = list(self._windows.values())
        drew = False
        for client, canvas in windows:
            if self._rides.value and canvas.eye is not None:
                self._ride(client, canvas)
            shot = canvas.due(self.stage.version, time.perf_counter())
            if shot is not None:
                self._draw(client, canvas, shot)
                drew = True
        if drew and self.stage.playing:
            self._slider.value = round(self.stage.seconds, 2)
        if drew:
            self.objects.follow()
        return drew

    def _draw(self, client: Any, canvas: Canvas, shot: Shot) -> None:
        started = time.perf_counter()
        image = self.stage.picture(shot.eye, shot.width, shot.height)
        with self._lock:
            if client.client_id not in self._windows:  # closed meanwhile
                return
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # it closed just now
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=_QUALITY[shot.whole])
        ended = time.perf_counter()
        canvas.drawn(shot, ended - started, ended)
        refining = "" if shot.whole else "refining: "
        self._said.content = f"{refining}{shot.width} x {shot.height} in {1000 * (ended - started):.0f} ms"

    def _joined(self, client: Any) -> None:
        canvas = Canvas(Pace(self.frames_per_second))
        with self._lock:
            self._windows[client.client_id] = client, canvas

        looking = threading.Lock()  # viser calls from many threads: the last to look has to be the last to read

        def seen(camera: Any) -> None:
            # Who rides along is where the log was: the window only answers.
            with looking:
                eye = eye_of(camera)
                if eye is not None and (not self._rides.value or canvas.eye is None):
                    canvas.look(eye, time.perf_counter())

        client.camera.on_update(seen)
        seen(client.camera)  # what it said when it joined: it need not say more

    def _left(self, client: Any) -> None:
        with self._lock:
            self._windows.pop(client.client_id, None)

    def _clock_panel(self) -> None:
        gui, stage = self.server.gui, self.stage
        with gui.add_folder("Time"):
            self._slider = gui.add_slider("seconds", 0.0, max(stage.duration, 0.01), 0.01, 0.0)
            self._plays = gui.add_checkbox("play", False)
            self._said = gui.add_markdown("loading")

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # not where the clock moves it
                stage.seek(self._slider.value)

        @self._plays.on_update
        def _(event: Any) -> None:
            stage.play(self._plays.value)

    def _camera_panel(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Cameras of the log"):
            self._jump = gui.add_button_group("jump to", [str(index) for index in self.stage.cameras])
            self._rides = gui.add_checkbox("ride along", False, hint="stay on that camera while the log plays")
        self._ridden = next(iter(self.stage.cameras))

        @self._jump.on_click
        def _(event: Any) -> None:
            self._ridden = int(self._jump.value)
            if event.client is not None:
                show_from(event.client, self._rider(1, 1))

    def _ride(self, client: Any, canvas: Canvas) -> None:
        seen = eye_of(client.camera)
        if seen is None:
            return
        eye = self._rider(seen.width, seen.height)
        if canvas.eye is None or not eye.same(canvas.eye):
            show_from(client, eye)
            canvas.look(eye, time.perf_counter())

    def _rider(self, width: int, height: int) -> Eye:
        camera = self.stage.cameras[self._ridden]
        return Eye(camera.at(self.stage.time), camera.fov, width, height)

    def _save_panel(self) -> None:
        button = self.server.gui.add_button("Save edits", hint=f"writes {self.save}")
        said = self.server.gui.add_markdown("")

        @button.on_click
        def _(event: Any) -> None:
            try:
                self.write_edits()
            except OSError as error:
                said.content = f"not saved: {error}"
                return
            said.content = f"saved as `{self.save}`; `sparsestreet render ... edits={self.save}` uses it"
