"""The lidar in a room whose walls and floor are planes: what it measures is known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hydra import compose
from hydra.utils import instantiate

from sparsestreet.cli.config.compose import configuration
from sparsestreet.data.synthetic import LidarSensor, StreetReader, StreetSettings
from sparsestreet.data.synthetic.render import StreetSweep, sweep
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.textures import Plain
from sparsestreet.data.synthetic.tracer import Part, Scene, at

GRAY = Plain((0.5, 0.5, 0.5))
HALF = 20.0
"""The walls stand so far from the origin, meters, and are higher than any beam goes."""
ROOM = Scene.of(
    [
        Part(box(100.0, 100.0, 2.0), GRAY, at(0.0, 0.0, -1.0)),
        *(Part(box(2.0, 100.0, 100.0), GRAY, at(side * (HALF + 1), 0.0, 0.0)) for side in (-1.0, 1.0)),
        *(Part(box(100.0, 2.0, 100.0), GRAY, at(0.0, side * (HALF + 1), 0.0)) for side in (-1.0, 1.0)),
    ]
)
EXACT = LidarSensor(
    name="exact", elevations=[-30.0, 20.0], beams=11, azimuth_steps=720, max_range=75.0, noise=0.0, dropout=0.0,
    height=1.7,
)  # fmt: skip
RAYS = 11 * 720


def turn(seed: int = 0, frame: int = 0, **changes) -> StreetSweep:
    """One turn of EXACT, with some values changed, on an ego car at the origin."""
    return sweep(StreetSettings(seed=seed, lidar=replace(EXACT, **changes)), ROOM, np.eye(4), frame)


def ranges(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, :3].astype(np.float64), axis=1)


def test_beams_are_evenly_spread_over_the_vertical_field():
    points = turn(noise=0.02, dropout=0.3).points.astype(np.float64)
    elevations = np.degrees(np.arcsin(points[:, 2] / ranges(points)))
    # Noise moves a point along its beam only; float32 leaves 1e-5 degrees.
    np.testing.assert_allclose(np.unique(elevations.round(3)), np.linspace(-30, 20, 11), atol=2e-3)
    assert np.abs(elevations - elevations.round()).max() < 1e-4


def test_rays_of_a_beam_are_evenly_spread_over_the_turn():
    points = turn(beams=1, elevations=[-5.0, -5.0]).points
    azimuths = np.sort(np.degrees(np.arctan2(points[:, 1], points[:, 0])))
    np.testing.assert_allclose(azimuths, np.arange(720) * 0.5 - 179.75, atol=1e-3)


def test_every_return_lies_on_the_floor_or_a_wall():
    seen = turn()
    assert len(seen.points) == RAYS
    np.testing.assert_array_equal(seen.world_from_lidar[:3, 3], [0.9, 0.0, 1.7])
    world = seen.points[:, :3] + seen.world_from_lidar[:3, 3]
    surfaces = np.abs(np.stack((world[:, 2], np.abs(world[:, 0]) - HALF, np.abs(world[:, 1]) - HALF)))
    # Float32 at 30 m has a spacing of 2e-6 m.
    assert surfaces.min(0).max() < 1e-4
    assert (surfaces < 1e-4).any(1).all()


def test_only_what_is_farther_than_the_range_gives_no_return():
    everything = turn().points
    seen = turn(max_range=15.0).points
    np.testing.assert_array_equal(seen, everything[ranges(everything) < 15])
    assert 0 < len(seen) < RAYS


def test_noise_has_its_standard_deviation_and_no_bias():
    errors = ranges(turn(noise=0.05).points) - ranges(turn().points)
    # Five standard errors of a mean and of a standard deviation of so many.
    assert abs(errors.mean()) < 5 * 0.05 / math.sqrt(RAYS)
    assert abs(errors.std() - 0.05) < 5 * 0.05 / math.sqrt(2 * RAYS)


@pytest.mark.parametrize("dropout", [0.05, 0.6])
def test_dropout_loses_its_share_of_the_returns(dropout):
    kept = turn(dropout=dropout).points
    lost = RAYS - len(kept)
    assert abs(lost - dropout * RAYS) < 5 * math.sqrt(RAYS * dropout * (1 - dropout))
    assert set(map(bytes, kept)) < set(map(bytes, turn().points))
    # It strikes everywhere: each of the beams loses some and keeps some.
    beams = np.unique(np.degrees(np.arcsin(kept[:, 2] / ranges(kept))).round(), return_counts=True)[1]
    assert len(beams) == 11
    assert beams.max() < 720


def test_a_seed_and_a_frame_have_a_sweep_of_their_own():
    changes = {"noise": 0.02, "dropout": 0.2}
    assert turn(3, 4, **changes).points.tobytes() == turn(3, 4, **changes).points.tobytes()
    sweeps = {turn(seed, frame, **changes).points.tobytes() for seed, frame in ((3, 4), (3, 5), (4, 4))}
    assert len(sweeps) == 3


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("beams", 0),
        ("azimuth_steps", -3),
        ("max_range", 0.0),
        ("height", -1.0),
        ("noise", -0.1),
        ("noise", math.nan),
        ("dropout", 1.0),
        ("dropout", -0.1),
        ("elevations", [3.0, 2.0]),
        ("elevations", [-90.0, 2.0]),
        ("elevations", [-9.0, 90.0]),
        ("elevations", [1.0]),
        ("elevations", [1.0, 2.0, 3.0]),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(field, value):
    with pytest.raises(ValueError, match=rf"LidarSensor\.{field} ") as caught:
        replace(EXACT, **{field: value})
    assert str(value) in str(caught.value)


def test_equal_sensors_are_equal_however_they_were_written():
    assert replace(EXACT, elevations=(-30.0, 20.0)) == EXACT
    assert len({EXACT, replace(EXACT, elevations=(-30.0, 20.0))}) == 1


def reader(*overrides: str) -> StreetReader:
    with configuration():
        return instantiate(compose("train", list(overrides)).data.log, _convert_="all")


def test_the_usual_street_and_sensor_are_those_of_conf():
    assert reader().settings == StreetSettings()


@pytest.mark.lengthy
@pytest.mark.parametrize("name", ["hdl32", "hdl64", "ideal", "waymo_top"])
def test_a_sensor_is_chosen_and_changed_from_the_command_line(name):
    plain, lossy = reader(f"data/lidar={name}"), reader(f"data/lidar={name}", "data.lidar.dropout=0.25")
    assert plain.settings.lidar.name == name
    assert lossy.settings.lidar == replace(plain.settings.lidar, dropout=0.25)
    assert lossy.folder != plain.folder
