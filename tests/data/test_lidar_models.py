"""Angles of lidars by hand, and files of them: good ones, slips, and what nobody means."""

import json
import math

import pytest
import torch

from sparsestreet.data.lidar_models import NAMES, LidarModel, lidar_model

SAID = {
    "spinning_direction": "cw",
    "spinning_frequency_hz": 20.0,
    "n_rows": 2,
    "n_columns": 3,
    "row_elevations_rad": [0.1, -0.2],
    "column_azimuths_rad": [-3.0, 3.0, 2.0],
    "row_azimuth_offsets_rad": [0.0, 0.05],
    "reach_m": 50,
}

_LARGE = {name: [-1e-3 * one for one in range(1001)] for name in ("row_elevations_rad", "row_azimuth_offsets_rad")}
_LARGE["column_azimuths_rad"] = [-1e-3 * one for one in range(2000)]


def written(folder, **changes):
    path = folder / "mine.json"
    path.write_text(json.dumps({name: one for name, one in (SAID | changes).items() if one is not None}))
    return str(path)


def test_rays_are_fired_column_by_column_from_the_first(tmp_path):
    """The table crosses the seam behind the lidar, from -3 to 3 rad, which is 0.28 rad clockwise."""
    model = lidar_model(written(tmp_path))
    assert (model.name, model.seconds, model.reach, model.is_clockwise) == ("mine", 0.05, 50.0, True)
    assert model.shares().tolist() == pytest.approx([0, 0, 1 / 3, 1 / 3, 2 / 3, 2 / 3])
    rays = [(-3.0, 0.1), (-2.95, -0.2), (3.0, 0.1), (3.05, -0.2), (2.0, 0.1), (2.05, -0.2)]
    by_hand = [(math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)) for a, e in rays]
    torch.testing.assert_close(model.directions(), torch.tensor(by_hand, dtype=torch.float64))
    turned = written(tmp_path, spinning_direction="ccw", column_azimuths_rad=[2.0, 3.0, -3.0], reach_m=None)
    assert not lidar_model(turned).is_clockwise
    assert lidar_model(turned).reach == math.inf


@pytest.mark.parametrize(
    ("name", "rows", "columns", "top", "bottom", "first", "hertz"),
    [
        ("waymo_top", 64, 2650, 2.2053, -17.7191, 31.96163, 10),
        ("hdl64", 64, 2083, 2.0, -24.33, 180.0, 10),
        ("hdl32", 32, 1085, 10.67, -30.6633, 180.0, 20),
        ("pandar64", 64, 1800, 14.87, -24.909, 179.95, 10),
        ("at128", 128, 1200, 12.93, -12.47, 60.0, 10),
    ],
)
def test_lidars_of_a_name_turn_clockwise_and_see_what_their_makers_say(name, rows, columns, top, bottom, first, hertz):
    model = lidar_model(name)
    assert (len(model.row_elevations), len(model.column_azimuths)) == (rows, columns)
    assert math.degrees(model.row_elevations.max()) == pytest.approx(top, abs=1e-3)
    assert math.degrees(model.row_elevations.min()) == pytest.approx(bottom, abs=0.01)
    assert math.degrees(model.column_azimuths[0]) == pytest.approx(first)
    assert model.is_clockwise
    around = 120 if name == "at128" else 360 - 360 / columns
    assert math.degrees(model.column_azimuths[0] - model.column_azimuths[-1]) == pytest.approx(around)
    assert 1 / model.seconds == pytest.approx(hertz)
    assert model.source


def test_every_name_of_a_lidar_is_its_own():
    assert [lidar_model(name).name for name in NAMES] == list(NAMES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"row_elevation_rad": [0.1]}, "has 'row_elevation_rad', which nothing reads"),
        ({"column_azimuths_rad": None}, "has no 'column_azimuths_rad'"),
        ({"row_elevations_rad": [0.1, "0.2"]}, r"row_elevations_rad\[1\] is '0.2', not a number"),
        ({"row_elevations_rad": [10.0, -25.0]}, "elevations lie within pi/2, got 25: write radians"),
        ({"row_elevations_rad": [0.1, float("nan")]}, r"row_elevations_rad\[1\] must be finite"),
        ({"row_azimuth_offsets_rad": [0.0]}, "row_azimuth_offsets_rad has 1 numbers, not 2"),
        ({"n_rows": 64}, "n_rows must be a whole number from 2 to 2"),
        ({"row_elevations_rad": [], "row_azimuth_offsets_rad": [], "n_rows": 0}, "got 0 rows"),
        ({"column_azimuths_rad": [0.0, -0.1, 0.1]}, "rise or fall all the way"),
        ({"column_azimuths_rad": [0.0, -2.5, -5.0, -6.9], "n_columns": 4}, "at most once around"),
        ({"spinning_direction": "ccw"}, "is 'ccw', against the order of column_azimuths_rad"),
        ({"spinning_frequency_hz": 0}, "spinning_frequency_hz must be positive"),
        ({"spinning_frequency_hz": 1e-9}, "a turn takes more than 0 and at most 10 s"),
        ({"reach_m": -1}, "reach_m must be positive"),
        ({**_LARGE, "n_rows": None, "n_columns": None}, "1 to 2,000,000 rays, got 1001 rows and 2000 columns"),
    ],
)
def test_a_file_that_is_no_lidar_is_refused_by_its_field(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        lidar_model(written(tmp_path, **changes))
    assert "mine.json" in str(caught.value)


def test_a_name_or_file_that_is_not_there_is_said(tmp_path):
    with pytest.raises(ValueError, match="there is no lidar 'hdl46': name waymo_top, hdl64, hdl32"):
        lidar_model("hdl46")
    with pytest.raises(ValueError, match="the file is missing"):
        lidar_model(str(tmp_path / "none.json"))
    (tmp_path / "cut.json").write_text('{"n_rows": 2,')
    with pytest.raises(ValueError, match="no JSON"):
        lidar_model(str(tmp_path / "cut.json"))


def test_a_lidar_of_one_ray_is_a_lidar():
    zero = torch.zeros(1, dtype=torch.float64)
    model = LidarModel("one", zero, zero, zero, 0.1, math.inf, "by hand")
    assert model.directions().tolist() == [[1.0, 0.0, 0.0]]
