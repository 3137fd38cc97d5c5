"""How many recorded images showed what a picture shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.export.layers import layer_picture, layer_values
from sparsestreet.export.seen import count_images, images_seen
from sparsestreet.scene.edits import REMOVED, Added, Change, Edits, Moved, edited
from tests.export.street import CAR_ROWS, ROAD_ROWS, stored_street, street_views

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


def test_more_than_255_images_are_255_and_few_are_dark():
    stored = hidden_road()
    count_images(stored, FRONT)
    stored.scene.nodes["rigid"].rows.images_seen[:] = 1000
    values = layer_values(stored, FRONT[0], ["seen"])["seen"]
    assert (values.dtype, values[16, 24]) == (np.uint8, 255)
    none, few, many, more = layer_picture("seen", np.array([[0, 2, 32, 255]], np.uint8), [])[0].astype(int).sum(-1)
    assert none < few < many == more


def test_counts_are_asked_for_before_edits():
    stored = hidden_road()
    with pytest.raises(ValueError, match="call count_images before it is edited"):
        layer_values(stored, FRONT[0], ["seen"])
