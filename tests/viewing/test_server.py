"""The viewer in a browser: flown, played, edited, saved."""

import http.client
import http.server
import io
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from sparsestreet.viewing.edit_state import EditState
from sparsestreet.viewing.server import REST, Canvas, Pace, Shot, Viewer
from sparsestreet.viewing.stage import Eye, Stage
from tests.browser import browser
from tests.export.street import stored_street, street_views

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'sparsestreet[viewer]'")


@pytest.fixture
def viewer(tmp_path) -> Iterator[Viewer]:
    stored, views = stored_street(), street_views()
    stage = Stage(stored, views, EditState(stored.scene.eval(), {}, 0.4, lambda path: (stored, 1.0)))
    made = Viewer(
        stage, views[0], title="t", host="127.0.0.1", port=0, frames_per_second=20.0,
        save=tmp_path / "edits.yaml", known_as=("Street.Lab",),
    )  # fmt: skip
    thread = threading.Thread(target=made.run)
    thread.start()
    yield made
    made.stop()
    thread.join(20)
    assert not thread.is_alive()


def test_the_panel_edits_and_saves(viewer):
    """As if somebody clicked: what widgets are set to, with the events that viser makes of it."""
    panel, client = viewer.objects, object()
    event = type("Event", (), {"client": client})()
    panel.choice.value = "tram"
    assert panel.about.content == "recorded from 0.0 to 0.2 s"
    panel.hidden.value = True
    panel._hide(event)
    panel.choice.value = "car"
    assert not panel.hidden.value
    panel.sliders["right"].value = 2.0
    panel._slide(event)
    assert yaml.safe_load(viewer.stage.edits.text()) == {"remove": ["tram"], "move": {"car": {"right": 2.0}}}
    # The handle stands at the object; dragged 1 m up, it says so.
    panel.drags.value = True
    assert panel.handle.visible
    expected = viewer.stage.edits.frame("car", 0.0)[:3, 3] - np.array([0, 2.0, 0])
    np.testing.assert_allclose(panel.handle.position, expected, atol=1e-6)
    panel.handle.position = expected + np.array([0, 0, 1.0])
    panel._drag(event)
    assert viewer.stage.edits.said()["move"] == {"car": {"right": 2.0, "up": 1.0}}
    assert panel.sliders["up"].value == 1.0
    before = panel.handle.position.copy()
    viewer.stage.seek(0.2)
    panel.follow()
    np.testing.assert_allclose(panel.handle.position - before, [2.0, -1.0, 0.0], atol=1e-5)  # the car drove
    viewer.write_edits()
    assert yaml.safe_load(viewer.save.read_text()) == viewer.stage.edits.said()
    panel._reset()
    assert "move" not in viewer.stage.edits.said()
    assert panel.sliders["right"].value == 0


def status(port: int, headers: Sequence[tuple[str, str]], socket: bool) -> int:
    """What a request gets: 200 for the page, 101 for a socket that is open."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest("GET", "/", skip_host=True)
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade["Sec-WebSocket-Key"] = "MDEyMzQ1Njc4OWFiY2RlZg=="
    for header in [*headers, *(upgrade.items() if socket else ())]:
        connection.putheader(*header)
    connection.endheaders()
    answer = connection.getresponse()
    assert answer.status != 200 or answer.headers["X-Frame-Options"] == "DENY"
    connection.close()
    return answer.status


OWN = "127.0.0.1:PORT"
TUNNEL = "localhost:9000"
ANSWERED = {
    "a program": [("Host", OWN)],
    "the page itself": [("Host", OWN), ("Origin", f"http://{OWN}")],
    "by name": [("Host", "localhost:PORT"), ("Origin", "http://localhost:PORT")],
    "its page by name, its socket by address": [("Host", OWN), ("Origin", "http://localhost:PORT")],
    "upper case": [("Host", "LOCALHOST:PORT"), ("Origin", "HTTP://LocalHost:PORT")],
    "IPv6": [("Host", "[0:0::1]:PORT"), ("Origin", "http://[::1]:PORT")],
    "a tunnel": [("Host", TUNNEL), ("Origin", f"http://{TUNNEL}")],
    "known": [("Host", "street.lab"), ("Origin", "http://street.lab:80")],
    "a proxy that ends TLS": [("Host", "street.lab"), ("Origin", "https://street.lab")],
}
FOREIGN = {
    "a site": [("Host", OWN), ("Origin", "https://evil.example")],
    "no site": [("Host", OWN), ("Origin", "null")],
    "an empty one": [("Host", OWN), ("Origin", "")],
    "another port": [("Host", OWN), ("Origin", "http://127.0.0.1:1")],
    "another port by name": [("Host", "localhost:PORT"), ("Origin", "http://localhost")],
    "our port beside a tunnel": [("Host", TUNNEL), ("Origin", "http://localhost:PORT")],
    "another address of a loopback": [("Host", OWN), ("Origin", "http://[::1]:PORT")],
    "TLS of another server": [("Host", OWN), ("Origin", f"https://{OWN}")],
    "TLS at our number": [("Host", "street.lab:443"), ("Origin", "http://street.lab:80")],
    "begins like ours": [("Host", OWN), ("Origin", "http://127.0.0.1.evil.example:PORT")],
    "a user": [("Host", OWN), ("Origin", f"http://{OWN}@evil.example")],
    "a path": [("Host", OWN), ("Origin", f"http://{OWN}/")],
    "twice": [("Host", OWN), ("Origin", f"http://{OWN}"), ("Origin", "https://evil.example")],
    "a list": [("Host", OWN), ("Origin", f"http://{OWN}, https://evil.example")],
    "rebound": [("Host", "evil.example:PORT"), ("Origin", "http://evil.example:PORT")],
    "rebound, unsaid": [("Host", "evil.example:PORT")],
    "a dot at the end": [("Host", "localhost.:PORT"), ("Origin", "http://localhost.:PORT")],
    "a user in the host": [("Host", f"{OWN}@evil.example")],
    "two hosts": [("Host", OWN), ("Host", "evil.example")],
    "no host": [],
}


@pytest.mark.parametrize(("cases", "wanted"), [(ANSWERED, (101, 200)), (FOREIGN, (403, 403))], ids=["own", "foreign"])
def test_pages_of_others_get_neither_the_socket_nor_the_page(viewer, cases, wanted):
    got = {
        name: tuple(
            status(viewer.port, [(key, value.replace("PORT", str(viewer.port))) for key, value in headers], socket)
            for socket in (True, False)
        )
        for name, headers in cases.items()
    }
    assert got == dict.fromkeys(cases, wanted)


def window(port: int) -> Any:
    """A socket as viser's page opens it."""
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    return connect(
        f"ws://127.0.0.1:{port}",
        origin=Origin(f"http://127.0.0.1:{port}"),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        compression=None,
    )


def told(socket: Any, until: Callable[[str], bool], seconds: float) -> list[str]:
    """Kinds of the messages that come, up to one that is waited for or the end of the time."""
    import msgspec
    import zstandard

    kinds: list[str] = []
    end = time.monotonic() + seconds
    while not any(map(until, kinds)) and time.monotonic() < end:
        try:
            raw = socket.recv(timeout=max(end - time.monotonic(), 0.01))
        except TimeoutError:
            break
        packed = raw[16 : 16 + int.from_bytes(raw[8:16], "little")]
        inner = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))
        kinds += [message["type"] for message in inner["messages"]]
    return kinds


def test_a_window_that_says_once_where_it_is_gets_a_picture_and_nobody_a_tunnel(viewer, monkeypatch):
    import msgspec

    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *words: asked.append(words))
    camera = {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 0], "fov": 1.0, "near": 0.01,
        "far": 1000.0, "image_height": 40, "image_width": 64, "look_at": [1.0, 0, 0], "up_direction": [0.0, 0, 1.0],
    }  # fmt: skip
    for _ in range(6):  # by chance, viser may call back for the first message too
        with window(viewer.port) as socket:
            socket.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
            told(socket, lambda kind: False, 0.1)
            socket.send(msgspec.msgpack.encode(camera))
            kinds = told(socket, lambda kind: kind == "BackgroundImageMessage", 15)
        assert "BackgroundImageMessage" in kinds
        assert not any("Share" in kind for kind in kinds)
    assert asked == []


def test_a_viser_that_cannot_be_closed_is_refused(monkeypatch):
    """As a later version that starts its server another way."""
    import viser
    from websockets.asyncio import server as sockets

    from sparsestreet.export.page import private_server

    plain = sockets.serve

    def open_server(**options: Any) -> Any:
        monkeypatch.setattr(sockets, "serve", plain)
        return viser_server(**options)

    viser_server = viser.ViserServer
    monkeypatch.setattr(viser, "ViserServer", open_server)
    with pytest.raises(ImportError, match=r"cannot be closed to foreign pages: pip install 'viser<1\.2'"):
        private_server(None, host="127.0.0.1", port=0)


def picture(chromium) -> np.ndarray:
    image = Image.open(io.BytesIO(chromium.picture())).convert("RGB")
    return np.asarray(image.crop((0, 200, 500, 600)), np.float64)  # beside the panel


@pytest.mark.slow
def test_a_browser_flies_and_sees_edits(viewer, tmp_path: Path):
    with browser() as chromium:
        end = time.monotonic() + 150
        chromium.open(f"http://127.0.0.1:{viewer.port}", 900, 600)
        chromium.wait("document.body.innerText.includes('900 x 600 in')", 150)
        first = picture(chromium)
        while first.std() <= 20 and time.monotonic() < end:  # viser fades it in
            first = picture(chromium)
        viewer.stage.edits.hide("car", True)
        viewer.stage.changed()
        time.sleep(2)
        without = picture(chromium)
        chromium.drag((300, 400), (420, 400), steps=20)
        time.sleep(2)
        turned = picture(chromium)
        outside = [
            one for one in chromium.requests if "127.0.0.1" not in one and not one.startswith(("data:", "blob:"))
        ]
    assert first.std() > 20
    assert np.abs(without - first).max() > 30
    assert np.abs(turned - without).mean() > 2
    assert outside == []


@pytest.mark.slow
def test_a_page_of_another_port_of_this_machine_gets_no_socket(viewer, tmp_path: Path):
    import viser

    (tmp_path / "evil.html").write_text(
        f"<script>const s=new WebSocket('ws://127.0.0.1:{viewer.port}','viser-v{viser.__version__}');"
        "window.got='';s.onopen=()=>{window.got='open'};s.onerror=()=>{window.got='refused'}</script>"
        f"<iframe src='http://127.0.0.1:{viewer.port}'></iframe>"
    )
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as other, browser() as chromium:
        threading.Thread(target=other.serve_forever).start()
        try:
            chromium.open(f"http://127.0.0.1:{other.server_port}/evil.html", 400, 300)
            chromium.wait("window.got !== '' && document.readyState === 'complete'")
            got = chromium.run("window.got")
            time.sleep(2)
        finally:
            other.shutdown()
    assert got == "refused"
    assert viewer.server.get_clients() == {}  # nor one in a frame, under what the page lays over it


def eye(width: int = 1200, height: int = 600) -> Eye:
    return Eye(np.eye(4), 1.0, width, height)


def there(shot: Shot | None) -> Shot:
    assert shot is not None
    return shot


def test_a_moving_camera_gets_small_pictures_and_then_a_whole_one():
    canvas = Canvas(Pace(10.0))
    assert canvas.due(0, 0.0) is None
    canvas.look(eye(), 1.0)
    small = there(canvas.due(0, 1.0))
    assert (small.whole, small.width / small.height) == (False, pytest.approx(2, rel=0.01))
    assert small.width < 1200
    canvas.drawn(small, 0.05, 1.05)
    assert canvas.due(0, 1.1) is None
    whole = there(canvas.due(0, 1.01 + REST))
    assert whole == Shot(small.eye, 1200, 600, whole=True)
    canvas.drawn(whole, 0.3, 1.5)
    assert canvas.due(0, 9.0) is None


def test_a_change_of_the_scene_is_drawn_like_a_move():
    canvas = Canvas(Pace(10.0))
    canvas.look(eye(), 0.0)
    canvas.drawn(there(canvas.due(0, 0.0)), 0.01, 0.01)
    canvas.drawn(there(canvas.due(0, 1.0)), 0.01, 1.0)
    changed = there(canvas.due(1, 2.0))
    assert not changed.whole
    canvas.drawn(changed, 0.01, 2.01)
    assert canvas.due(1, 2.1) is None
    assert there(canvas.due(1, 2.01 + REST)).whole


def test_a_move_while_a_picture_is_drawn_is_not_forgotten():
    canvas = Canvas(Pace(10.0))
    canvas.look(eye(), 0.0)
    first = there(canvas.due(0, 0.0))
    canvas.look(eye(), 0.05)
    canvas.drawn(first, 0.1, 0.1)
    assert canvas.due(0, 0.101) is None  # no more pictures than a browser shows
    assert not there(canvas.due(0, 0.2)).whole


@pytest.mark.parametrize(("overhead", "rate"), [(0.0, 2e6), (0.02, 4e6), (0.05, 1e7)])
def test_the_pace_settles_at_the_frame_rate(overhead, rate):
    pace = Pace(10.0)
    for _ in range(40):
        pace.note(overhead + pace.pixels / rate)
    assert overhead + pace.pixels / rate == pytest.approx(0.1, rel=0.02)
    # A small window is not enlarged, and a machine that is too slow gets the smallest picture.
    assert pace.size(100, 60) == (100, 60)
    for _ in range(50):
        pace.note(5.0)
    assert pace.size(1000, 500) == (282, 141)
