import logging
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.ops.spherical_harmonics import FIRST
from sparsestreet.scene.initialize.sources import LidarPoints, NearPoints
from sparsestreet.scene.nodes import Background, BackgroundSettings, RigidSettings
from sparsestreet.triangulation import StreetPoints
from tests.scene.street import (
    NUM_FRAMES,
    ROAD_COLOR,
    SOURCES,
    background_settings,
    rigid_settings,
    street_log,
    training_data,
    triangulated,
)

LIDAR_ONLY = background_settings(lidar=10_000)
MOVERS = rigid_settings(classes=("Car", "Cyclist"))


def build(
    settings: BackgroundSettings,
    held_out: frozenset[int] = frozenset(),
    seed: int = 0,
    log=None,
    movers: RigidSettings = MOVERS,
) -> Background:
    return settings.build(training_data(log, held_out, movers), torch.Generator().manual_seed(seed))


def colors(node: Background) -> torch.Tensor:
    return 0.5 + FIRST * node.rows.sh_dc[:, 0]


def test_lidar_outside_moving_boxes_keeps_its_color():
    node = build(LIDAR_ONLY)
    torch.testing.assert_close(colors(node), torch.tensor(ROAD_COLOR).expand(len(node.rows), 3))
    driving = street_log().tracks[1]
    for sweep in street_log().sweeps:
        world_points = sweep.points
        in_box = transform_points(inverse(driving.world_from_object[sweep.index]), world_points.double())
        inside = (in_box.abs() < driving.size / 2).all(1)
        assert inside.any()
        assert not set(map(tuple, world_points[inside].tolist())) & set(map(tuple, node.rows.means.tolist()))


def test_the_number_of_points_of_each_kind():
    node = build(background_settings(lidar=40, near=30, far=20, sh_degree=1))
    log = street_log()
    assert len(node.rows) == 90
    assert node.rows.sh_rest.shape == (90, 3, 3)
    distance = (node.rows.means - log.center).norm(dim=1)
    assert (distance[40:70] <= log.radius * 1.0001).all()
    assert (distance[70:] >= log.radius * 0.9999).all()
    cameras = torch.stack([frame.camera.position for frame in log.frames])
    from_camera = (node.rows.means[40:, None] - cameras).norm(dim=2).min(1).values
    assert (node.rows.log_scales.exp()[40:, 0] <= 0.02 * from_camera * 1.0001).all()


def street_half_covered():
    """16 of 21 rows are no sky. The lidar covers 8 of them; 33 points, one a column, on three."""
    log = street_log()
    depth = torch.zeros_like(log.frames[0].sky, dtype=torch.float32)
    depth[14:] = 5.0  # and the row above is near
    frames = as_frames([replace(frame, depth=depth) for frame in log.frames])
    seen = [(point, view, point + 0.5, 8.5) for point in range(33) for view in range(NUM_FRAMES)]
    across = torch.stack((torch.full((33,), 20.0), torch.linspace(-9, 9, 33), torch.full((33,), 3.0)), 1)
    points = StreetPoints(triangulated(across.tolist(), seen, pixel_size=0.01), {})
    return training_data(replace(log, frames=frames), points=points)


def started(data, sources=SOURCES, seed: int = 0, **changes) -> Background:
    settings = background_settings(num_points=160, sources=sources, **changes)
    return settings.build(data, torch.Generator().manual_seed(seed))


def test_each_source_gives_its_share_and_the_log_says_so(caplog):
    with caplog.at_level(logging.INFO):
        node = started(street_half_covered())
    assert len(node.rows) == 160
    assert (
        "the lidar covers 50 % of the pixels that are not sky, images 19 % more; "
        "points from lidar: 80, images: 30, near: 25, far: 25" in caplog.text
    )


def test_a_source_with_a_number_takes_no_share(caplog, monkeypatch):
    """Then the images need not be measured; a source of a share still has its own."""
    numbers = {"lidar": 7, "images": 3, "near": 9, "far": 2}
    numbered = {name: replace(SOURCES[name], number=number) for name, number in numbers.items()}
    with caplog.at_level(logging.INFO):
        node = started(street_half_covered(), {**numbered, "far": SOURCES["far"]})
    assert "points from lidar: 7, images: 3, near: 9, far: 25" in caplog.text
    monkeypatch.setattr("sparsestreet.scene.nodes.background.coverage", lambda _: pytest.fail("images were measured"))
    assert len(started(street_half_covered(), numbered).rows) == 7 + 3 + 9 + 2
    assert len(node.rows) == 7 + 3 + 9 + 25


def test_no_point_starts_where_a_moving_object_passes(caplog):
    """The car's own returns, and what it drives over at other instants, of every source."""
    sources = {"lidar": LidarPoints(box_enlargement=None, number=10_000), "near": NearPoints(part=0.0, number=5000)}
    data = training_data(movers=MOVERS)
    kept = {}
    for cleared in (False, True):
        settings = background_settings(sources=sources, num_points=0, clear_swept_boxes=cleared)
        with caplog.at_level(logging.INFO):
            kept[cleared] = settings.seeds(data, torch.Generator().manual_seed(0))
    outside = torch.ones(len(kept[False]), dtype=torch.bool)
    for track in data.moving:
        for pose in track.world_from_object:
            in_box = transform_points(inverse(pose), kept[False].points.positions.double())
            outside &= ~(2 * in_box.abs() <= track.size).all(1)
    # Five sweeps of 60 returns of the car, and guesses.
    assert int((~outside).sum()) > 300
    for name in ("positions", "colors"):
        assert torch.equal(getattr(kept[True].points, name), getattr(kept[False].points, name)[outside])
    for name in ("smallest", "largest", "opacities"):
        assert torch.equal(getattr(kept[True], name), getattr(kept[False], name)[outside])
    assert f"{int((~outside).sum())} of them lie where a moving object passes, and go" in caplog.text


def test_a_source_says_how_opaque_and_how_large_its_gaussians_start():
    opacities = dict(zip(SOURCES, (0.2, 0.3, 0.4, 0.5), strict=True))
    sources = {name: replace(source, initial_opacity=opacities[name]) for name, source in SOURCES.items()}
    rows = started(street_half_covered(), sources).rows
    expected = torch.tensor([0.2] * 80 + [0.3] * 30 + [0.4] * 25 + [0.5] * 25)
    torch.testing.assert_close(torch.sigmoid(rows.opacity_logits), expected)
    # The neighbors of points from images are decimeters away; 8 pixels of 1 cm are the limit.
    torch.testing.assert_close(rows.log_scales[80:110].exp(), torch.full((30, 3), 0.08))


def test_a_source_draws_what_it_draws_without_the_others():
    data = street_half_covered()
    means = started(data).rows.means
    without = started(data, {name: source for name, source in SOURCES.items() if name != "images"}).rows.means
    assert torch.equal(torch.cat((means[:80], means[110:])), without)
    assert not torch.equal(means[110:135], started(data, seed=1).rows.means[110:135])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"num_points": -1}, "num_points must be >= 0, got -1"),
        ({"sources": {**SOURCES, "near": None}}, "got near=None: leave one out with ~node.background.sources.near"),
        ({"sources": {**SOURCES, "near": NearPoints(part=0.7)}}, "add up to 1 at most, got 1.2: lower the part of one"),
        ({"sources": {"one": LidarPoints(), "two": LidarPoints()}}, "sources one, two may add up to 1 at most, got 2"),
    ],
)
def test_sources_that_cannot_be(changes: dict, said: str):
    with pytest.raises(ValueError, match=said):
        background_settings(**changes)


def test_a_log_without_lidar_starts_from_images_and_guesses(caplog):
    points = triangulated([[20.0, 0.0, 1.0]] * 50, [(point, 0, 16.5, 8.5) for point in range(50)])
    data = training_data(replace(street_log(), sweeps=Sweeps.of(())), points=StreetPoints(points, {}))
    with caplog.at_level(logging.INFO):
        node = started(data)
    # 9 of the 16 x 33 pixels of one of five views are near a point: 0.5 of 160 points, the rest is guessed.
    assert "points from lidar: 0, images: 1, near: 80, far: 80" in caplog.text
    assert len(node.rows) == 161


def test_a_log_of_pictures_alone_starts_from_guesses():
    assert len(started(training_data(replace(street_log(), sweeps=Sweeps.of(())))).rows) == 160


def test_nothing_to_start_from_is_an_error():
    with pytest.raises(ValueError, match="background of 'hand-made' has nothing to start from"):
        build(LIDAR_ONLY, held_out=frozenset(range(NUM_FRAMES)))
    with pytest.raises(ValueError, match="num_points=0 came from its sources, which are none; raise num_points"):
        build(background_settings())
