"""The symmetries that every backend is tested with, in two scenes that the interpreter bears instead of drawn ones."""

import inspect

import pytest
import torch

from tests.ops import test_properties

PROPERTIES = (
    (test_properties.test_moving_the_world_and_the_camera_together, {}),
    (test_properties.test_another_unit_of_length, {"unit": 3.7}),
    (test_properties.test_order_of_the_rows, {}),
    (test_properties.test_a_crop_is_the_image_of_a_shifted_principal_point, {"numbers": (0.3, 0.2, 0.4, 0.1)}),
    (test_properties.test_crops_together_make_the_image, {"cut": (0.4, 0.7)}),
    (test_properties.test_where_the_tiles_fall_does_not_matter, {"padding": (7, 11, 3, 0), "lens": False}),
    (test_properties.test_where_the_tiles_fall_does_not_matter, {"padding": (2, 5, 0, 13), "lens": True}),
    (test_properties.test_a_masked_duplicate_changes_no_bit, {}),
    (test_properties.test_the_image_is_linear_in_the_background, {}),
    (test_properties.test_float32_is_close_to_float64, {}),
)


@pytest.mark.parametrize(("property_", "numbers"), PROPERTIES)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow_if_interpreted)])
def test_property(property_, numbers, seed):
    scene = test_properties.make_scene(seed, width=18, height=11, focal=16.0, rows=10, terms=(1, 4)[seed])
    given = {"backend": "triton", "scene": scene} | numbers
    if "dtype" in inspect.signature(property_).parameters:
        given["dtype"] = torch.float32
    property_.hypothesis.inner_test(**given)


def test_no_property_is_missing():
    named = {name for name in vars(test_properties) if name.startswith("test_")}
    assert {property_.__name__ for property_, _ in PROPERTIES} == named
