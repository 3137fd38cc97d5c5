"""The page of a street: one file that asks no network for anything, with the clouds and their poses over time."""

import base64
import io
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparsestreet.cli.commands.export import export
from sparsestreet.export.path import recorded
from sparsestreet.export.recording import recorded_parts
from sparsestreet.scene.views import write_views
from tests.browser import browser
from tests.export.street import CAR_ROWS, ROAD_ROWS, TRAM_ROWS, stored_street, street_views, write_street

pytest.importorskip("viser", reason="pages need viser: pip install 'sparsestreet[viewer]'")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return write_street(tmp_path_factory.mktemp("run"), street_views(cameras=(0, 1)), frame_rate=10.0)


def messages(file: Path) -> list[tuple[float, dict[str, Any]]]:
    """What the page plays: seconds, message."""
    import msgspec
    import zstandard

    (found,) = re.findall(r'__VISER_EMBED_DATA__="([^"]+)"', file.read_text())
    data = base64.b64decode(found)
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = int.from_bytes(inner[:8], "little")
    said = msgspec.msgpack.decode(inner[8 : 8 + length])
    return [(seconds, message) for seconds, message in said["messages"]]


def test_the_page_plays_what_moves_at_the_logs_speed(run, tmp_path, capsys):
    out = tmp_path / "street.html"
    assert export([str(run), str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{ROAD_ROWS + CAR_ROWS + TRAM_ROWS} Gaussians, 2 objects, 0.4 s" in said
    assert "viser" not in said
    played = messages(out)
    kinds = [message["type"] for _, message in played]
    assert kinds.count("GaussianSplatsMessage") == 4  # road, car, tram, sky
    parts = {part.name: part for part in recorded_parts(stored_street(), recorded(street_views(cameras=(0, 1))), 1)}
    moves = [(at, message) for at, message in played if message["type"] == "SetPositionMessage"]
    car = [(at, message["position"]) for at, message in moves if message["name"] == "/rigid/car"]
    times = [at for at, _ in car][-4:]
    np.testing.assert_allclose(times, [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    np.testing.assert_allclose([place for _, place in car][-4:], parts["rigid/car"].positions[1:], atol=1e-6)
    gone = [
        (at, message["visible"])
        for at, message in played
        if message["type"] == "SetSceneNodeVisibilityMessage" and message["name"].startswith("/rigid/tram/")
    ]
    assert gone[-1][1] is False
    assert gone[-1][0] == pytest.approx(0.3)


def test_the_page_is_named_and_needs_no_network(run, tmp_path):
    out = tmp_path / "street.html"
    assert export([str(run), str(out)]) == 0
    text = out.read_text()
    assert "<title>hand-made</title>" in text
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=[\"']?https?:", text)
    # Before anything that it could forbid, and no address of a network is allowed.
    said = re.search(r'<head><meta http-equiv="Content-Security-Policy" content="default-src \'none\'; ([^"]+)">', text)
    assert said is not None
    assert set(re.findall(r"[a-z]+:|\*|'self'", said[1])) == {"data:", "blob:"}


def test_edits_are_honored(run, tmp_path, capsys):
    (tmp_path / "edits.yaml").write_text("remove: [tram]\n")
    assert export([str(run), str(tmp_path / "a.html"), f"edits={tmp_path / 'edits.yaml'}"]) == 0
    names = {message.get("name", "") for _, message in messages(tmp_path / "a.html")}
    assert "/rigid/car/0" in names
    assert not any("tram" in name for name in names)
    assert f"{ROAD_ROWS + CAR_ROWS} Gaussians, 1 objects" in capsys.readouterr().out


def test_without_viser_the_sentence_says_how_to_get_it(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert export([str(run), str(tmp_path / "a.html")]) == 1
    assert "pip install 'sparsestreet[viewer]'" in capsys.readouterr().err
    assert not (tmp_path / "a.html").exists()


@pytest.mark.slow
def test_a_browser_draws_it_from_a_file_as_it_is_rendered(run, tmp_path):
    """One instant, since a page of several plays."""
    views, out = street_views(480, 320, cameras=(0,))[:1], tmp_path / "street.html"
    write_views(tmp_path / "views.json", views, [])
    assert export([str(run), str(out), f"views={tmp_path / 'views.json'}"]) == 0
    with browser() as chromium:
        # The sorter of the clouds must answer: Chromium starts no module worker out of a blob in a page of a file.
        chromium.call(
            "Page.addScriptToEvaluateOnNewDocument",
            source="window.forbidden=[];document.addEventListener('securitypolicyviolation',e=>"
            "window.forbidden.push(e.violatedDirective+' '+e.blockedURI));window.sorted=0;"
            "const W=Worker;window.Worker=class extends W{constructor(...a){super(...a);"
            "this.addEventListener('message',e=>{if(e.data.sortedIndices)window.sorted++})}}",
        )
        chromium.open(out.as_uri(), 480, 320)
        chromium.wait("window.sorted > 0 && !!document.querySelector('canvas')", 150)
        time.sleep(3)  # the clouds fade in
        assert chromium.run("window.forbidden.join()") == ""
        chromium.run("fetch('http://127.0.0.1:9/').catch(() => 0)")
        chromium.wait("window.forbidden.join() === 'connect-src http://127.0.0.1:9/'")
        shown = Image.open(io.BytesIO(chromium.picture())).convert("RGB")
        outside = [one for one in chromium.requests if not one.startswith(("file:", "data:", "blob:"))]
    assert outside in ([], ["http://127.0.0.1:9/"])  # the one that the page forbade
    rendered = stored_street().render(views[0]).rgb.clamp(0, 1).numpy()
    # Below the note that says that no GPU draws.
    error = np.asarray(shown, np.float64)[200:] / 255 - rendered[200:]
    assert -10 * np.log10(np.square(error).mean()) > 20
