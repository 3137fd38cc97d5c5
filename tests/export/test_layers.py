"""Layers of a picture: their values, and which object a pixel shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.export.layers import (
    FARTHEST,
    LAYERS,
    instance_table,
    layer_picture,
    layer_pictures,
    layer_values,
    tables,
)
from sparsestreet.export.path import recorded
from sparsestreet.scene.edits import REMOVED, Added, Change, Edits, Moved, edited
from tests.export.street import stored_street, street_views

VIEW = street_views(cameras=(0,))[1]


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


def test_what_is_farther_than_65_meters_says_so():
    stored = with_faint("rigid")
    with torch.no_grad():
        stored.scene.nodes["background"].rows.means[:] = torch.tensor([100.0, 0.0, 1.5])
        stored.scene.nodes["background"].rows.log_scales[:] = 2.0
    depth = layer_values(stored, VIEW, ["depth"])["depth"]
    assert set(np.unique(depth)) <= {0, FARTHEST}
    assert (depth == FARTHEST).any()


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
    scene = edited(stored_street().scene.eval(), Edits(added={"second": Added("car")}))
    stored = replace(stored_street(), scene=scene)
    assert [(one.id, one.name, one.node) for one in instance_table(stored)] == [
        (1, "car", "rigid"), (2, "tram", "rigid"), (3, "second", "second"),
    ]  # fmt: skip
    found = tables(stored, LAYERS)
    assert found["nodes"] == {"1": "background", "2": "rigid", "3": "second"}
    assert found["instances"]["3"] == {"name": "second", "class": "", "node": "second"}
    assert tables(stored, ["rgb"]) == {}


def test_a_new_object_has_the_id_of_its_line():
    stored = with_faint("background")
    gone = {"car": REMOVED, "tram": REMOVED}
    scene = edited(stored.scene.eval(), Edits(gone, {"second": Added("car")}))
    ids = layer_values(replace(stored, scene=scene), VIEW, ["instances"])["instances"]
    assert set(np.unique(ids)) == {0, 3}


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
