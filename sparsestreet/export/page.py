"""A street as one page that opens in any browser, without a network: viser's recording of its clouds."""

import contextlib
import io
import math
import threading
from collections.abc import Sequence
from functools import partial
from http import HTTPStatus
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from sparsestreet.atomic import atomic_file
from sparsestreet.export.recording import Cloud, Part
from sparsestreet.geometry.cameras import inverse
from sparsestreet.listening import Callers
from sparsestreet.types import View

SKY_PART = "sky"
_SORTS_FROM_A_FILE = (
    "<script>if(location.protocol==='file:'){const Any=Worker;window.Worker=class extends Any{constructor(url,options){"
    "if(String(url).startsWith('blob:')&&options?.type==='module')throw Error('no module of a blob in a file');"
    "super(url,options)}}}</script>"
)
"""Chromium starts no module worker out of a blob in a page that is a file, and says so only later. viser 1.1 sorts its
clouds in one: they would be drawn unsorted. Where the blob is refused at once, its code takes a data URL instead."""
_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
    "script-src 'unsafe-inline' 'unsafe-eval' data: blob:; worker-src data: blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; base-uri 'none'; form-action 'none'\">"
)
"""No network at all. viser unpacks its program into the page, compiles some, and starts workers at data: addresses."""
_LOOK = 10.0
"""Meters to the point around which a viewer's camera turns."""


def write_page(
    path: Path | str, parts: Sequence[Part], seconds: Sequence[float], start: View, *, dome: Cloud | None, title: str
) -> None:
    """Write the page, the whole file or nothing.

    Args:
        path: the file.
        parts: what moves as one, at the instants of ``seconds``.
        seconds: since the first instant, ascending.
        start: the view that the page opens with.
        dome: the sky around the camera's start; None: black.
        title: of the page.

    Raises ImportError without viser, OSError if nothing can be written.
    """
    # viser records what a server would show; it says where that server is, which nobody needs to know.
    with contextlib.redirect_stdout(io.StringIO()):
        server = private_server(None, host="127.0.0.1", port=0)
        try:
            page = _recorded(server, parts, seconds, start, dome)
        finally:
            server.stop()
    page = page.replace("<title>Viser</title>", f"<title>{_text(title)}</title>{_SORTS_FROM_A_FILE}", 1)
    page = page.replace("<head>", f"<head>{_POLICY}", 1)
    with atomic_file(Path(path)) as temporary:
        temporary.write_text(page, encoding="utf-8")


def viser_module() -> ModuleType:
    """Return viser. Raises ImportError, saying how to get it, where it is not installed."""
    try:
        import viser
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "a page and the viewer need viser, which is not installed: pip install 'sparsestreet[viewer]'"
        ) from error
    return viser


def private_server(callers: Callers | None, **options: Any) -> Any:
    """Start viser's server, for pages of its own alone, and without its public tunnel: viser has options for neither.

    Args:
        callers: who is answered; None: nobody, where a scene is only recorded.
        options: host, port and others of ``viser.ViserServer``.

    Raises ImportError without viser, or for a version of it that starts its server another way.
    """
    viser, ready, guarded = viser_module(), threading.Event(), []
    from websockets.asyncio import server as sockets

    plain = sockets.serve

    def serve(*arguments: Any, process_request: Any, **more: Any) -> Any:
        guarded.append(process_request)
        allowed = partial(_answer, callers, ready, process_request)
        return plain(*arguments, process_request=allowed, **more)

    sockets.serve = serve
    try:
        server = viser.ViserServer(verbose=False, **options)
    finally:
        sockets.serve = plain
    try:
        server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)
    except (AttributeError, AssertionError):
        guarded.clear()
    if not guarded:
        server.stop()
        raise ImportError(f"viser {viser.__version__} cannot be closed to foreign pages: pip install 'viser<1.2'")
    ready.set()
    return server


def _answer(callers: Callers | None, ready: threading.Event, answer: Any, connection: Any, request: Any) -> Any:
    """What viser answers to a request, unless it is refused: then nothing is opened."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    refusal = "this server answers nobody"
    if callers is not None and ready.is_set():
        refusal = callers.refusal(hosts, origins, connection.local_address[0])
    if refusal is not None:
        return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
    response = answer(connection, request)
    if response is not None:
        response.headers["X-Frame-Options"] = "DENY"  # no foreign page may lay its own over it
    return response


def _recorded(server: Any, parts: Sequence[Part], seconds: Sequence[float], start: View, dome: Cloud | None) -> str:
    # From an empty scene on: a page that starts anew repeats every message, also that something is visible.
    serializer = server.get_scene_serializer()
    center = start.camera.position.numpy()
    look_from(server, start, far=4 * (1.0 if dome is None else float(np.abs(dome.centers).max())))
    if dome is not None:
        _add(server, f"/{SKY_PART}", dome, position=center)
    players = [_Player(server, part) for part in parts]
    for index, second in enumerate(seconds):
        for player in players:
            player.show(index)
        after = seconds[index + 1] if index + 1 < len(seconds) else second + _last_step(seconds)
        serializer.insert_sleep(after - second)
    return serializer.as_html(dark_mode=True)


class _Player:
    """A part in viser's scene: a frame with a cloud for each shape."""

    def __init__(self, server: Any, part: Part) -> None:
        self.part = part
        first = part.shown[0]
        self.frame = server.scene.add_frame(
            f"/{part.name}", show_axes=False, position=part.positions[0], wxyz=part.wxyz[0]
        )
        self.clouds = [
            _add(server, f"/{part.name}/{number}", shape, visible=number == first)
            for number, shape in enumerate(part.shapes)
        ]

    def show(self, index: int) -> None:
        shape = self.part.shown[index]
        if shape is not None:
            self.frame.position, self.frame.wxyz = self.part.positions[index], self.part.wxyz[index]
        for number, cloud in enumerate(self.clouds):
            cloud.visible = number == shape


def _add(server: Any, name: str, cloud: Cloud, **place: Any) -> Any:
    return server.scene.add_gaussian_splats(
        name, cloud.centers, cloud.covariances, cloud.colors, cloud.opacities[:, None], **place
    )


def look_from(server: Any, view: View, far: float) -> None:
    world_from_camera = inverse(view.camera.camera_from_world.double()).numpy()
    position, ahead = world_from_camera[:3, 3], world_from_camera[:3, 2]
    server.scene.set_up_direction("+z")
    server.initial_camera.position = position
    server.initial_camera.look_at = position + _LOOK * ahead
    server.initial_camera.fov = 2 * math.atan(view.camera.height / 2 / float(view.camera.intrinsics[1, 1]))
    server.initial_camera.far = max(far, 1000.0)


def _last_step(seconds: Sequence[float]) -> float:
    return seconds[-1] - seconds[-2] if len(seconds) > 1 else 0.0


def _text(title: str) -> str:
    return title.replace("&", "&amp;").replace("<", "&lt;")
