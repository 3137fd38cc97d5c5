"""Streets whose cameras record brighter and darker, and in tints of their own."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose
from hydra.utils import instantiate
from PIL import Image

from sparsestreet.cli.config.compose import configuration
from sparsestreet.data.synthetic import LidarSensor, StreetReader, StreetSettings, make_street
from sparsestreet.data.synthetic.capture import Sight, to_srgb
from sparsestreet.data.synthetic.render import (
    StreetSweep,
    at_night,
    behind_dirt,
    dirt_opacity,
    exposure_walk,
    hood_coverage,
    recorded_gains,
    render_frame,
    sweep,
)
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.street import street_name
from sparsestreet.data.synthetic.textures import Plain
from sparsestreet.data.synthetic.tracer import Part, Scene, at
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.typed import there

CLEAN = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, supersampling=1, num_parked_cars=2, num_moving_cars=1,
    num_pedestrians=0, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
)  # fmt: skip


@pytest.mark.parametrize("effects", [{"exposure_walk": 0.3}, {"exposure_walk": 0.2, "white_balance": 0.05}])
def test_images_are_stored_values_times_gains(effects):
    """A stored value v became g v: one rounding before and one behind the gain, and white is white."""
    settings = replace(CLEAN, **effects)
    world = build_world(CLEAN)
    with unchecked():
        clean, frame = (render_frame(one, world, 1) for one in (CLEAN, settings))
    factors = []
    for before, behind in zip(clean.images, frame.images, strict=True):
        old, new = before.rgb.astype(float).reshape(-1, 3), behind.rgb.astype(float).reshape(-1, 3)
        unclipped = (old > 40) & (new < 255)
        assert unclipped.sum(0).min() > 100
        gain = np.array([np.median((new / old.clip(1))[unclipped[:, c], c]) for c in range(3)])
        assert (np.abs(np.minimum(old * gain, 255) - new) <= 0.5 * gain + 1.5).all()
        np.testing.assert_array_equal(before.depth, behind.depth)
        factors.append(gain)
    logs = np.log2(np.array(factors))
    # Two frames walk by one standard deviation around 0, each camera on its own way.
    np.testing.assert_allclose(np.abs(logs.mean(1)), effects["exposure_walk"], atol=0.02)
    tints = np.log(2) * (logs - logs.mean(1, keepdims=True))
    np.testing.assert_allclose(tints.std(), effects.get("white_balance", 0.0), atol=0.01)


def test_white_stays_white():
    linear = np.full((3, 1, 1), 9.0, np.float32)  # far beyond what an image stores
    assert to_srgb(linear, np.array([0.4, 1.0, 2.0], np.float32)).tolist() == [[[102, 255, 255]]]


def test_a_walk_is_smooth_and_each_cameras_own():
    settings = replace(CLEAN, num_frames=40, num_cameras=3, exposure_walk=0.2)
    walks = np.array([exposure_walk(settings, camera) for camera in range(3)])
    np.testing.assert_allclose(walks.mean(1), 0, atol=1e-12)
    np.testing.assert_allclose(walks.std(1), 0.2, rtol=1e-12)
    # A frame later exposure is nearly the same: neighbors tell that of a held-out image.
    assert np.diff(walks).std() < 0.3 * walks.std()
    assert np.abs(np.diff(walks, 2)).max() < 0.1
    assert np.abs(np.corrcoef(walks) - np.eye(3)).max() < 0.95


def test_tints_cancel_over_cameras_and_do_not_brighten():
    settings = replace(CLEAN, num_cameras=3, white_balance=0.04)
    gains = np.log([there(recorded_gains(settings, 0, camera)) for camera in range(3)])
    np.testing.assert_allclose(gains.sum(0), 0, atol=1e-6)
    np.testing.assert_allclose(gains.sum(1), 0, atol=1e-6)
    np.testing.assert_allclose(gains.std(), 0.04, rtol=1e-5)
    np.testing.assert_array_equal(gains, np.log([there(recorded_gains(settings, 1, camera)) for camera in range(3)]))
    assert recorded_gains(CLEAN, 0, 0) is None
    np.testing.assert_array_equal(recorded_gains(replace(CLEAN, num_frames=1, exposure_walk=0.2), 0, 0), 1)


@pytest.mark.lengthy
def test_the_truth_has_neither(tmp_path):
    """Its images are those of the clean street; what was recorded is not."""
    settings = replace(CLEAN, exposure_walk=0.4, white_balance=0.1)
    with unchecked():
        clean = StreetReader(CLEAN, tmp_path / "clean").read()
        log = StreetReader(settings, tmp_path / "walk").read()
        truth, same = (one.truth(log.views[2]) for one in (log, clean))
    assert torch.equal(truth.image, same.image)
    off = (truth.image.float() - log.frames[2].image.float()).mean((0, 1)).abs().max()
    assert off > 10
    assert (truth.image.float() - clean.frames[2].image.float()).mean((0, 1)).abs().max() < 1


WIDTH, HEIGHT = 240, 144


def street(*, seed: int = 0, dirt: float = 0.0, night: float = 0.0) -> StreetSettings:
    return StreetSettings(width=WIDTH, height=HEIGHT, seed=seed, dirt=dirt, night=night)


def gray(level: float) -> Sight:
    return Sight(
        np.full((3, HEIGHT, WIDTH), level, np.float32),
        np.full((HEIGHT, WIDTH), 7, np.float32),
        np.zeros((HEIGHT, WIDTH), np.int16),
        np.zeros((HEIGHT, WIDTH), bool),
    )


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_three_spots_cover_their_share_of_the_front_camera(share: float):
    settings = street(dirt=share)
    assert dirt_opacity(settings, 1) is None
    opacity = there(dirt_opacity(settings, 0))
    assert (opacity > 0.475).mean() == pytest.approx(share, rel=0.05)  # circles of pixels
    seen = behind_dirt(gray(0.5), opacity).linear
    assert seen.min() < 0.07
    assert seen.max() == 0.5
    assert (there(dirt_opacity(street(dirt=share, seed=1), 0)) != opacity).any()


def test_night_takes_light_and_leaves_the_noise_of_each_image():
    settings = street(night=3.0)
    first, again, other = (at_night(settings, gray(0.4), frame, 0).linear for frame in (2, 2, 3))
    assert first.mean() == pytest.approx(0.05, rel=0.01)
    assert first.std() == pytest.approx((0.002**2 + 0.01**2 * 0.05) ** 0.5, rel=0.02)
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02


def test_a_clean_street_by_day_keeps_its_name():
    sight = gray(0.4)
    assert at_night(street(), sight, 0, 0) is sight
    assert dirt_opacity(street(), 0) is None
    assert street_name(street()) == street_name(street(dirt=0.0, night=0.0)) != street_name(street(dirt=0.01))


HOODED = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=1.0, supersampling=1, num_parked_cars=3,
    num_moving_cars=1, num_pedestrians=0, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
    hood=0.2, hood_known=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    with unchecked():
        return make_street(HOODED, tmp_path_factory.mktemp("streets") / "hooded")


@pytest.mark.lengthy
def test_it_covers_the_bottom_of_the_front_camera_alone():
    world = build_world(HOODED)
    with unchecked():
        clean, hooded = (render_frame(one, world, 1).images for one in (replace(HOODED, hood=0.0), HOODED))
    np.testing.assert_array_equal(clean[1].rgb, hooded[1].rgb)
    covered = (clean[0].rgb != hooded[0].rgb).any(-1)
    # Whole rows at the bottom, none above the edge's middle: 1.1 times 0.2 of 30 rows.
    assert covered[-4:].all()
    assert not covered[: 30 - 7].any()
    assert hooded[0].rgb[-3:].mean() < 100
    assert not hooded[0].depth[-4:].any()
    assert (hooded[0].object_indices[-4:] == -1).all()
    np.testing.assert_array_equal(clean[0].depth[:23], hooded[0].depth[:23])


@pytest.mark.lengthy
def test_it_stands_still_while_the_street_passes(root):
    """A second apart: what is mirrored in it moves by the little that the car turns."""
    first, last = (np.array(Image.open(root / f"images/00{frame}_0.jpg"), float) for frame in range(2))
    moved = np.abs(first - last).mean(-1)
    assert moved[-4:].mean() < 4
    assert moved[:23].mean() > 12


@pytest.mark.lengthy
def test_its_masks_are_written_where_they_are_asked_for(root):
    """By the reader they are ``Frame.ego``; the truth beside the path has no hood."""
    log = StreetReader(HOODED, root).read()
    front, left = log.frames[0], log.frames[1]
    assert left.ego is None
    ego = there(front.ego).numpy()
    np.testing.assert_array_equal(ego, there(hood_coverage(HOODED, 0)) > 0)
    with unchecked():
        truth = there(there(log.truth)(log.views[0])).image.numpy().astype(float)
    off = np.abs(truth - front.image.numpy()).mean(-1)
    assert off[ego].mean() > 30
    assert off[:22].mean() < 3
    assert not list(root.glob("ego_masks/1.png"))


@pytest.mark.lengthy
def test_files_are_silent_on_it_unless_asked(tmp_path):
    with unchecked():
        silent = make_street(replace(HOODED, num_frames=1, hood_known=False), tmp_path / "silent")
    assert not (silent / "ego_masks").exists()


@pytest.mark.parametrize(("width", "hood"), [(48, 0.2), (160, 0.1), (33, 0.05)])
def test_its_share_of_the_image_is_the_settings(width, hood):
    settings = replace(HOODED, width=width, hood=hood, hood_cameras="all")
    for camera in range(2):
        assert there(hood_coverage(settings, camera)).mean() == pytest.approx(hood, rel=1e-3)
    assert hood_coverage(replace(settings, hood=0.0), 0) is None


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
