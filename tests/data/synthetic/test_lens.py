"""A street behind a lens: every pixel shows what a pinhole sees in the direction that the lens bends there."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic import StreetReader, StreetSettings, capture, make_street
from sparsestreet.data.synthetic.capture import StreetCamera, street_camera
from sparsestreet.data.synthetic.render import Instant, render_image
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.tracer import _bounding_planes
from sparsestreet.data.synthetic.world import build_world

LENS = (-0.3, 0.1, 0.004, -0.006, 0.02)
SETTINGS = StreetSettings(
    seed=3, num_frames=1, width=97, height=61, num_cameras=1, supersampling=1, lens=LENS,
    lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
)  # fmt: skip


def imaged(x: np.ndarray, y: np.ndarray, lens: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Brown-Conrady as OpenCV's manual states it."""
    k1, k2, p1, p2, k3 = lens
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return bent_x, bent_y


def seen(x: np.ndarray, y: np.ndarray, lens: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Its inverse as a fixed point: what the lens adds is taken off until nothing changes."""
    guess = x, y
    for _ in range(200):
        bent = imaged(*guess, lens)
        guess = guess[0] + x - bent[0], guess[1] + y - bent[1]
    bent = imaged(*guess, lens)
    assert max(np.abs(bent[0] - x).max(), np.abs(bent[1] - y).max()) < 1e-12
    return guess


@pytest.mark.lengthy
def test_a_pixel_shows_what_a_pinhole_of_one_pixel_sees_there():
    world = build_world(SETTINGS)
    instant = Instant.at(world, 0.0)
    camera = street_camera(SETTINGS, 0, world.ego.pose(0.0))
    image = render_image(SETTINGS, instant, camera)
    focal = camera.intrinsics[0, 0]
    columns, rows = np.random.default_rng(0).integers((97, 61), size=(20, 2)).T
    columns[:4], rows[:4] = (0, 96, 0, 96), (0, 0, 60, 60)
    x, y = seen((columns + 0.5 - 48.5) / focal, (rows + 0.5 - 30.5) / focal, LENS)
    moved = np.hypot(x * focal + 48.5 - columns - 0.5, y * focal + 30.5 - rows - 0.5)
    assert moved[:4].min() > 5
    same = []
    for column, row, right, down in zip(columns, rows, x, y, strict=True):
        intrinsics = np.array([[focal, 0, 0.5 - focal * right], [0, focal, 0.5 - focal * down], [0, 0, 1]])
        found = render_image(SETTINGS, instant, StreetCamera(camera.world_from_camera, intrinsics, 1, 1))
        same.append(
            np.abs(found.rgb[0, 0].astype(int) - image.rgb[row, column]).max() <= 1
            and np.isclose(found.depth[0, 0], image.depth[row, column], rtol=1e-4)
            and found.object_indices[0, 0] == image.object_indices[row, column]
            and found.sky[0, 0] == image.sky[row, column]
        )
    # Rays agree to float32's last digits: one of 20 may meet an edge in another way.
    assert sum(same) >= 19


@pytest.mark.lengthy
def test_files_of_a_street_say_its_lens_and_show_it(tmp_path):
    """Unprojected by what the files say, the road is flat."""
    root = make_street(SETTINGS, tmp_path)
    fx, fy, cx, cy, *lens = np.loadtxt(root / "intrinsics/0.txt")
    assert tuple(lens) == LENS
    with np.load(root / "depth/000_0.npz") as stored:
        depth, ids = stored["depth"], stored["instance"]
    v, u = np.meshgrid(np.arange(61) + 0.5, np.arange(97) + 0.5, indexing="ij")
    x, y = seen((u - cx) / fx, (v - cy) / fy, LENS)
    pose = np.loadtxt(root / "extrinsics/000_0.txt")
    points = np.stack((x, y, np.ones_like(x)), -1) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
    road = points[(depth > 0) & (ids < 0) & (np.abs(points[..., 1]) < 1.5) & (points[..., 0] < 50)]
    assert len(road) > 300
    # Float32 depth is good to 1e-7 of 50 m.
    np.testing.assert_allclose(road[:, 2], 0, atol=1e-4)
    read = StreetReader(SETTINGS, root).read().views[0].camera
    np.testing.assert_array_equal(read.distortion, np.array(LENS, np.float32))


def test_frames_share_the_rays_of_a_lens(monkeypatch):
    first = street_camera(SETTINGS, 0, np.eye(4))
    ahead = first.rays(1)
    monkeypatch.setattr(capture, "undistort", None)
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turned = street_camera(SETTINGS, 0, turn).rays(1)
    np.testing.assert_allclose(
        turned.directions, np.einsum("ij,jhw->ihw", turn[:3, :3], ahead.directions), rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_tiles_with_bent_sides_are_bounded_on_all_of_them(k1):
    """Culling by four planes is what makes a street fast to trace: none is lost, none cuts off a ray."""
    tile = street_camera(replace(SETTINGS, lens=(k1, 0.0, 0.0, 0.0, 0.0)), 0, np.eye(4)).rays(1).directions
    heights = np.einsum("kj,jhw->khw", _bounding_planes(tile), tile)
    assert len(heights) == 4
    assert heights.min() >= -1e-6
    # Each touches the tile.
    assert heights.min((1, 2)).max() < 1e-6


@pytest.mark.parametrize(("beyond", "planes"), [(0.0, 4), (0.5e-6, 4), (1.5e-6, 3)])
def test_a_plane_of_a_wide_tile_goes_if_it_cuts_off_more_than_rounding(beyond, planes):
    """Columns at -80 and 80 degrees, most of them at 80: from the middle a ray points back, and no plane is turned."""
    x, y, z = np.cos(np.radians(80)), np.sin(np.radians(80)), 0.3
    outwards = np.array([-z, 0, x]) / np.hypot(x, z)
    top = np.array([x, 0, z]) + beyond * outwards
    rows = [[(x, -y, z), tuple(top), *[(x, y, z)] * 3], [(x, -y, -z), (1, 0, 0), *[(x, y, -z)] * 3]]
    assert len(_bounding_planes(np.array(rows, np.float32).transpose(2, 0, 1))) == planes


@pytest.mark.parametrize(
    "lens",
    [
        (-0.3, 0.1, 0.0, 0.0),
        (float("nan"), 0.1, 0.0, 0.0, 0.0),
        (-0.3, 0.1, 0.0, float("inf"), 0.0),
        # Folds at r = 0.75, which it images at 0.50: the image's corner lies at 0.69.
        (-0.6, 0.0, 0.0, 0.0, 0.0),
        # Images nothing left of x = -1 / 6.
        (0.0, 0.0, 0.0, 0.5, 0.0),
    ],
)
def test_a_lens_that_does_not_reach_the_corners_is_refused(lens):
    with pytest.raises(ValueError, match=r"five coefficients k1, k2, p1, p2, k3 .* in the whole image but is \["):
        replace(SETTINGS, lens=lens)


def test_a_lens_is_refused_for_the_image_it_has():
    assert replace(SETTINGS, lens=(-0.6, 0.0, 0.0, 0.0, 0.0), field_of_view=30.0).lens[0] == -0.6


@pytest.mark.parametrize(("excess", "reaches"), [(-2e-8, True), (2e-8, False)])
def test_the_largest_lens_is_found_in_float64(excess, reaches):
    """r (1 + k r^2) is largest, 2/3 r, at r^2 = -1 / 3k: the corner c of an image is reached up to k = -4 / 27 c^2.

    Coefficients rounded to float32 are off by up to 6e-8 of their size.
    """
    corner_squared = np.tan(np.radians(30)) ** 2 * (1 + 0.75**2)
    lens = (-4 / 27 / corner_squared * (1 + excess), 0.0, 0.0, 0.0, 0.0)
    with nullcontext() if reaches else pytest.raises(ValueError, match="in the whole image"):
        replace(SETTINGS, width=80, height=60, field_of_view=60.0, lens=lens)


def test_equal_lenses_are_equal_settings():
    """As a file gives them, and as code does."""
    assert replace(SETTINGS, lens=list(LENS)) == SETTINGS
    assert hash(replace(SETTINGS, lens=list(LENS))) == hash(SETTINGS)
    assert replace(SETTINGS, lens=[]) == replace(SETTINGS, lens=())
