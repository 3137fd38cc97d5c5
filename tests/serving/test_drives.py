"""The examples run: a car that we steer, and one that another package drives."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparsestreet.scene.storage import load_scene
from sparsestreet.serving.renderer import Scenes, named_runs
from sparsestreet.serving.server import start
from tests.conftest import unchecked
from tests.serving.street import write_run

pytest.importorskip("carla_driver_interface", reason="pip install carla-driver-interface==2.3.1")
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def examples(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield
    for name in ("drive", "closed_loop"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "street")


def test_a_car_is_steered_beside_the_recorded_path(run, tmp_path, examples):
    import drive  # pyright: ignore[reportMissingImports]

    drive.main(run, tmp_path / "out")
    pictures = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "out").iterdir())]
    assert len(pictures) == 11  # a second, ten steps
    assert {picture.shape for picture in pictures} == {(32, 4 * 48, 3)}
    assert not np.array_equal(pictures[0], pictures[-1])


def test_a_step_of_the_car_is_a_piece_of_a_circle(examples):
    import drive  # pyright: ignore[reportMissingImports]

    car, places = np.eye(4), []
    for _ in range(50):
        places.append(car[:2, 3])
        car = drive.step(car, 5.0, 0.3)
    # Wheels turned by an angle lead around a circle of wheelbase / tan(angle), here to the left.
    radius = 2.8 / np.tan(0.3)
    distances = np.linalg.norm(np.array(places) - [0.0, radius], axis=1)
    assert np.abs(distances - radius).max() < 0.01  # a step is a chord: 0.5^2 / (24 radius) m shorter
    assert drive.steer(np.eye(4), np.array([radius, radius, 0.0])) == pytest.approx(0.3)


@pytest.mark.slow
def test_another_packages_driver_stays_on_the_recorded_path(run, examples):
    """100 steps, in a street whose log ends long before; it stands still from there on."""
    import closed_loop  # pyright: ignore[reportMissingImports]

    server, port = start(Scenes(named_runs([run]), load_scene, memory=10**9), "127.0.0.1", 0, workers=2)
    with unchecked():
        driven = closed_loop.drive(port, steps=100)
    server.stop(None).wait()
    assert len(driven.pictures) == 400
    straight = driven.places[-1] - driven.recorded[0]
    assert np.linalg.norm(straight) > 20
    recorded = [place for place in driven.places if np.linalg.norm(place - driven.recorded[0]) < 4]
    beside = driven.beside[: len(recorded)]
    assert beside[0] == pytest.approx(0.4, abs=0.01)
    assert beside.max() < 0.5
    assert beside[-1] < 0.2
