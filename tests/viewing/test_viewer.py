"""The viewer in a browser: flown, played, edited, saved."""

import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from sparsestreet.cli.view import USAGE, ViewRequest, view
from sparsestreet.viewing.edit_state import EditState
from sparsestreet.viewing.server import Viewer
from sparsestreet.viewing.stage import Stage
from tests.browser import browser
from tests.export.street import stored_street, street_views

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'sparsestreet[viewer]'")


@pytest.fixture
def viewer(tmp_path) -> Iterator[Viewer]:
    stored, views = stored_street(), street_views()
    stage = Stage(stored, views, EditState(stored.scene.eval(), {}, 0.4, lambda path: (stored, 1.0)))
    made = Viewer(
        stage, views[0], title="t", host="127.0.0.1", port=0, frames_per_second=20.0, save=tmp_path / "edits.yaml"
    )
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


def test_the_help_names_every_option_and_slips_are_one_line(capsys, tmp_path):
    for field in ViewRequest.__dataclass_fields__:
        assert f"\n  {field} " in USAGE
    for words, said in (
        (["fps=0"], "fps lies in 1 to 60, got 0"),
        (["port=99999"], "a port lies in 0 to 65535"),
        (["hots=a"], "did you mean 'host'?"),
    ):
        assert view([str(tmp_path), *words]) == 2
        assert said in capsys.readouterr().err
    assert view([str(tmp_path / "nowhere")]) == 1
    assert "there is no scene at" in capsys.readouterr().err


def picture(chromium) -> np.ndarray:
    image = Image.open(io.BytesIO(chromium.picture())).convert("RGB")
    return np.asarray(image.crop((0, 200, 500, 600)), np.float64)  # beside the panel


@pytest.mark.slow
def test_a_browser_flies_and_sees_edits(viewer, tmp_path: Path):
    with browser() as chromium:
        chromium.open(f"http://127.0.0.1:{viewer.port}", 900, 600)
        chromium.wait("document.body.innerText.includes('900 x 600 in')")
        time.sleep(1)
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
