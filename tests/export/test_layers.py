"""Layers of a picture: their values, and which object a pixel shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.export.layers import (
    MAX_MILLIMETERS,
    LidarReturns,
    count_images,
    enlarged,
    images_seen,
    layer_picture,
    layer_pictures,
    layer_values,
    tables,
)
from sparsestreet.export.path import recorded
from sparsestreet.scene.edits import REMOVED, Added, Change, Edits, Moved, edited
from sparsestreet.types import Sweep
from tests.export.street import CAR_ROWS, ROAD_ROWS, stored_street, street_views

VIEW = street_views(cameras=(0,))[1]
LAYERS = ("rgb", "depth", "alpha", "nodes", "instances")


def with_faint(*nodes: str):
    """The street with nodes whose Gaussians are not drawn."""
    stored = stored_street()
    with torch.no_grad():
        for name in nodes:
            stored.scene.nodes[name].rows.opacity_logits[:] = -20.0
    return stored


def test_the_values_are_those_of_the_rendering():
    stored = stored_street()
    found, rendering = layer_values(stored, VIEW, LAYERS), stored.render(VIEW)
    assert np.array_equal(found["rgb"], (rendering.rgb.clamp(0, 1) * 255).round().byte().numpy())
    assert np.array_equal(found["alpha"], (rendering.alpha.clamp(0, 1) * 255).round().byte().numpy())
    assert found["depth"].dtype == np.uint16
    solid = rendering.alpha.numpy() >= 0.5
    assert 0 < solid.mean() < 1
    assert (found["depth"][~solid] == 0).all()
    # Rounded to a millimeter.
    np.testing.assert_allclose(found["depth"][solid] / 1000, rendering.depth.numpy()[solid], atol=0.00051)
    # What is farther than 65 meters says so.
    far = with_faint("rigid")
    with torch.no_grad():
        far.scene.nodes["background"].rows.means[:] = torch.tensor([100.0, 0.0, 1.5])
        far.scene.nodes["background"].rows.log_scales[:] = 2.0
    depth = layer_values(far, VIEW, ["depth"])["depth"]
    assert set(np.unique(depth)) == {0, MAX_MILLIMETERS}
    with pytest.raises(ValueError, match="made of a log's returns"):
        layer_values(stored, VIEW, ["lidar"])
    with pytest.raises(ValueError, match="call count_images before it is edited"):
        layer_values(stored, VIEW, ["seen"])


def test_a_lone_object_is_where_it_covers_more_than_half():
    stored = with_faint("background")
    alone = replace(VIEW, time=1.0, frame_index=None)  # the tram is gone
    found = layer_values(stored, alone, ["nodes", "instances"])
    alpha = stored.render(alone).alpha.numpy()
    covered = alpha > 0.5
    clear = np.abs(alpha - 0.5) > 1e-5
    assert 0 < covered.mean() < 1
    assert np.array_equal(found["instances"][clear], np.where(covered, 1, 0)[clear])
    # The second node: no background is in the way.
    assert np.array_equal(found["nodes"][clear], np.where(covered, 2, 0)[clear])


def test_the_nearest_of_opaque_objects_is_shown():
    stored = with_faint("background")
    with torch.no_grad():
        stored.scene.nodes["rigid"].rows.opacity_logits[:] = 10.0
        stored.scene.nodes["rigid"].rows.log_scales[:] = 1.5
    # Both fill the image; the car is 8 m ahead at first and the tram 9 m, then the other way round.
    ids = layer_values(stored, VIEW, ["instances"])["instances"]
    assert ids[16, 24] == 1
    moved = edited(stored.scene.eval(), Edits({"car": Change(Moved(forward=20.0))}))
    ids = layer_values(replace(stored, scene=moved), VIEW, ["instances"])["instances"]
    assert ids[16, 24] == 2


def test_every_object_has_a_line_in_the_table_also_new_ones():
    """By its id, also where those before it are gone."""
    faint, gone = with_faint("background"), {"car": REMOVED, "tram": REMOVED}
    scene = edited(faint.scene.eval(), Edits(gone, {"second": Added("car")}))
    ids = layer_values(replace(faint, scene=scene), VIEW, ["instances"])["instances"]
    assert set(np.unique(ids)) == {0, 3}
    scene = edited(stored_street().scene.eval(), Edits(added={"second": Added("car")}))
    stored = replace(stored_street(), scene=scene)
    found = tables(stored, LAYERS)
    assert found["nodes"] == {"1": "background", "2": "rigid", "3": "second"}
    lines = (("1", "car", "rigid"), ("2", "tram", "rigid"), ("3", "second", "second"))
    assert found["instances"] == {number: {"name": name, "class": "", "node": node} for number, name, node in lines}
    assert tables(stored, ["rgb"]) == {}


def test_pictures_stand_below_each_other():
    stored, path = stored_street(), recorded(street_views(cameras=(0, 1)))[:1]
    (picture,) = layer_pictures(stored, path, LAYERS)
    assert picture.shape == (5 * 32, 2 * 48, 3)
    first = layer_values(stored, path[0][0], ["rgb"])["rgb"]
    assert np.array_equal(picture[:32, :48], first)


@pytest.mark.parametrize(("depth", "color"), [(0, [0, 0, 0]), (1000, [252, 255, 164]), (60_000, None)])
def test_near_is_light(depth, color):
    (shown,) = layer_picture("depth", np.array([[depth]], np.uint16), [])[0].tolist()
    if color is not None:
        assert shown == color
    else:
        assert sum(shown) < 150


FRONT = street_views(cameras=(0,))


def hidden_road():
    """The car as a wall before the front camera, and the road a smaller wall behind it, at all times."""
    stored = stored_street()
    road, objects = (stored.scene.nodes[name].rows for name in ("background", "rigid"))
    with torch.no_grad():
        for rows in (road, objects):
            rows.opacity_logits[:] = 12.0
        objects.opacity_logits[CAR_ROWS:] = -20.0  # no tram
        objects.means[:CAR_ROWS], objects.log_scales[:CAR_ROWS] = 0.0, 1.0
        road.means[:], road.log_scales[:] = torch.tensor([20.0, 0.0, 1.5]), 0.0
    return stored


def test_what_an_object_hides_in_all_images_is_a_guess_once_it_is_removed():
    stored = hidden_road()
    count_images(stored, FRONT)
    before = layer_values(stored, FRONT[1], ["seen"])["seen"]
    assert before[16, 24] == len(FRONT)  # the car, in all of them
    bare = replace(stored, scene=edited(stored.scene.eval(), Edits({"car": REMOVED})))
    found = layer_values(bare, FRONT[1], ["seen", "alpha"])
    road = found["alpha"] > 250
    assert road.any()
    assert (found["seen"][road] == 0).all()


def test_only_views_that_show_it_count():
    stored = hidden_road()
    with torch.no_grad():
        stored.scene.nodes["rigid"].rows.opacity_logits[:] = -20.0
    count_images(stored, [*FRONT, *street_views(cameras=(3,))])  # and five that look back
    spans = stored.render(FRONT[0]).spans
    counts = images_seen(stored.scene, spans)
    # Of equal Gaussians in one place the first has the largest part of all pixels.
    assert counts[spans["background"]].tolist() == [len(FRONT)] + [0] * (ROAD_ROWS - 1)
    assert (counts[spans["rigid"]] == 0).all()


def test_counts_go_where_objects_go_and_those_of_another_scene_have_none():
    stored, other = hidden_road(), stored_street()
    count_images(stored, FRONT)
    edits = Edits(
        {"car": Change(Moved(right=1.0))},
        {"twin": Added("car"), "guest": Added("car", instead_of="car", scene=other.scene)},
    )
    scene = edited(stored.scene.eval(), edits)
    spans = replace(stored, scene=scene).render(FRONT[0]).spans
    counts = images_seen(scene, spans)
    car = counts[spans["rigid"]][:CAR_ROWS]
    assert car.max() == len(FRONT)
    assert torch.equal(counts[spans["twin"]], car)
    assert counts[spans["guest"]].tolist() == [0.0] * CAR_ROWS


def test_a_pixel_has_the_mean_of_its_gaussians_by_their_weights():
    stored = hidden_road()
    with torch.no_grad():
        stored.scene.nodes["rigid"].rows.opacity_logits[1:CAR_ROWS] = -20.0
        stored.scene.nodes["rigid"].rows.opacity_logits[0] = 0.0  # half of the light comes through the car
    count_images(stored, FRONT)
    for node, number in (("background", 200), ("rigid", 10)):
        stored.scene.nodes[node].rows.images_seen[:] = number
    value = layer_values(stored, FRONT[0], ["seen"])["seen"][16, 24]
    whole = float(stored.render(FRONT[0]).alpha[16, 24])
    with torch.no_grad():
        stored.scene.nodes["background"].rows.opacity_logits[:] = -20.0
    car = float(stored.render(FRONT[0]).alpha[16, 24])  # it is the nearer one
    assert 0.3 < car < 0.6
    assert value == pytest.approx((10 * car + 200 * (whole - car)) / whole, abs=0.51)  # rounded


def test_a_pixel_half_covered_has_the_whole_count():
    """One Gaussian that 40 images saw covers 0.6 of a pixel, and nothing is behind it: 40, not 24."""
    stored = hidden_road()
    with torch.no_grad():
        for rows in (stored.scene.nodes[name].rows for name in ("background", "rigid")):
            rows.opacity_logits[:] = -20.0
        stored.scene.nodes["rigid"].rows.opacity_logits[0] = 0.5
    count_images(stored, FRONT)
    stored.scene.nodes["rigid"].rows.images_seen[0] = 40
    assert 0.55 < float(stored.render(FRONT[0]).alpha[16, 24]) < 0.65
    assert layer_values(stored, FRONT[0], ["seen"])["seen"][16, 24] == 40


def test_more_than_255_images_are_255_and_few_are_dark():
    stored = hidden_road()
    count_images(stored, FRONT)
    stored.scene.nodes["rigid"].rows.images_seen[:] = 1000
    values = layer_values(stored, FRONT[0], ["seen"])["seen"]
    assert (values.dtype, values[16, 24]) == (np.uint8, 255)
    none, few, many, more = layer_picture("seen", np.array([[0, 2, 32, 255]], np.uint8), [])[0].astype(int).sum(-1)
    assert none < few < many == more


def seen_at(column: float, line: float, depth: float) -> list[float]:
    """The world's point that the view's pinhole has there."""
    camera = VIEW.camera
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.double().tolist()
    point = np.array([(column - cx) / fx * depth, (line - cy) / fy * depth, depth, 1.0])
    return (np.linalg.inv(camera.camera_from_world.double().numpy()) @ point)[:3].tolist()


def returns(points: dict[int, list[list[float]]]) -> LidarReturns:
    """Sweeps of frames 0 to 4, which are at times 0 to 1."""
    read = []

    def load(frame: int) -> Sweep:
        read.append(frame)
        places = torch.tensor(points[frame]).reshape(-1, 3)
        return Sweep(frame, frame / 4, places, torch.zeros_like(places), torch.zeros(len(places), dtype=torch.bool))

    made = LidarReturns(Sweeps(points, load), {frame: frame / 4 for frame in points})
    made.__dict__["read"] = read
    return made


def test_the_nearest_return_of_a_pixel_in_millimeters():
    places = [seen_at(10.5, 7.5, 12.345), seen_at(10.4, 7.6, 20.0), seen_at(40.5, 30.5, 80.0), seen_at(20.5, 9.5, -3.0)]
    values = layer_values(stored_street(), VIEW, ["lidar"], returns({1: places}))["lidar"]
    assert values.dtype == np.uint16
    assert values[7, 10] == 12345
    assert values[30, 40] == MAX_MILLIMETERS
    assert np.count_nonzero(values) == 2


def test_the_sweep_that_is_nearest_in_time_is_read_once_for_all_cameras():
    log = returns({frame: [seen_at(frame + 0.5, 0.5, 5.0)] for frame in (0, 1, 4)})
    for time, frame in ((0.0, 0), (0.2, 1), (0.3, 1), (0.6, 1), (0.7, 4)):
        assert np.flatnonzero(log.millimeters(VIEW.camera, time)).tolist() == [frame]
    assert log.__dict__["read"] == [0, 1, 4]


def test_dots_lie_on_the_picture():
    log = returns({1: [seen_at(10.5, 7.5, 5.0)]})
    path = recorded([VIEW])
    (picture,) = layer_pictures(stored_street(), path, ["rgb", "lidar"], log)
    rgb, dots = picture[:32], picture[32:]
    changed = np.argwhere((rgb // 2 != dots).any(-1))
    assert changed.tolist() == [[7, 10]]
    (alone,) = layer_pictures(stored_street(), path, ["lidar"], log)
    assert np.array_equal(alone, dots)
    near, far = (layer_picture("lidar", np.array([[mm]], np.uint16), []).sum() for mm in (2000, 60_000))
    assert near > far > 0


def test_dots_grow_with_the_picture_and_the_nearer_one_wins():
    values = np.zeros((3, 4), np.uint16)
    values[0, 0], values[1, 1] = 9, 5
    assert enlarged(values, 1).tolist() == values.tolist()
    assert enlarged(values, 2).tolist() == [[9, 9, 0, 0], [9, 5, 5, 0], [0, 5, 5, 0]]
    wide = np.zeros((2, 640), np.uint16)
    wide[0, 0] = 1000
    assert np.count_nonzero(layer_picture("lidar", wide, []).any(-1)) == 4
