"""The cases that every backend is tested with, as far as they are small enough for the interpreter, in float32."""

import inspect
import itertools
from collections.abc import Callable, Iterator

import pytest
import torch

from tests.ops import (
    test_effects_knobs,
    test_effects_lens,
    test_effects_shutter,
    test_hard_blending,
    test_hard_geometry,
    test_hard_lists,
    test_hard_values,
)
from tests.ops.scenes import device_of

RENDERED = (
    test_hard_blending.test_10_one_opaque_splat_is_drawn,
    test_hard_blending.test_10_a_clamped_alpha_has_no_gradient,
    test_hard_blending.test_11_12_opacity_at_the_cut_off,
    test_hard_blending.test_11_12_opacity_at_and_just_above_the_cut_off,
    test_hard_blending.test_24_expected_depth_of_a_faint_splat,
    test_hard_blending.test_26_deep_stacks,
    test_hard_blending.test_26_light_that_vanishes_in_float32,
    test_hard_blending.test_27_exponents_that_underflow,
    test_hard_blending.test_28_bright_pixels_are_not_clamped,
    test_hard_geometry.test_03_determinant_of_needles,
    test_hard_geometry.test_03_04_needles_in_float32,
    test_hard_geometry.test_06_through_the_near_plane,
    test_hard_geometry.test_06_camera_inside_a_splat,
    test_hard_geometry.test_07_gradients_on_both_sides_of_the_jacobian_limit,
    test_hard_geometry.test_07_the_limit_acts_and_is_continuous,
    test_hard_geometry.test_19_a_splat_far_from_the_origin,
    test_hard_geometry.test_19_a_scene_far_from_the_origin,
    test_hard_geometry.test_21_brightness_of_a_sub_pixel_splat,
    test_hard_geometry.test_23_tiles_of_a_few_ellipses,
    test_hard_lists.test_15_nothing_to_draw,
    test_hard_lists.test_16_numbers_of_every_row_are_written,
    test_hard_lists.test_17_depth_ties_keep_the_row_order,
    test_hard_lists.test_17_neighboring_depths_are_told_apart,
    test_hard_values.test_01_extreme_scenes_are_right,
    test_hard_values.test_02_an_overflowing_row_is_culled,
    test_hard_values.test_05_zero_quaternion_is_the_identity,
    test_hard_values.test_05_length_of_quaternions_does_not_matter,
    test_hard_values.test_05_only_zero_has_no_direction,
    test_hard_values.test_14_zero_scales,
    test_hard_values.test_14_a_masked_row_leaves_no_trace,
    test_hard_values.test_22_every_parameter_alone,
    test_hard_values.test_25_negative_colors_are_black_without_gradient,
    test_effects_knobs.test_box_by_hand,
    test_effects_knobs.test_depth_bits,
    test_effects_knobs.test_half_colors_by_hand,
    test_effects_lens.test_what_the_lens_does_not_see_is_culled,
    test_effects_shutter.test_cameras_and_displacements_get_no_gradient,
    test_effects_shutter.test_rows_that_outrun_the_readout_are_culled,
)
# These hand their own tensors, on the CPU, to the op.
CALLED = (
    test_hard_geometry.test_13_antialias_of_tiny_splats,
    test_hard_geometry.test_13_antialias_above_its_floor,
)


def _cases(functions: tuple[Callable, ...]) -> Iterator:
    """Each function with each combination of its own parameters besides backend and dtype."""
    for function in functions:
        axes = []
        for mark in function.pytestmark:
            names = (mark.args[0],) if isinstance(mark.args[0], str) else mark.args[0]
            if "backend" not in names:
                rows = [values if len(names) > 1 else (values,) for values in mark.args[1]]
                axes.append([dict(zip(names, values, strict=True)) for values in rows])
        given = {"backend": "triton"}
        if "dtype" in inspect.signature(function).parameters:
            given["dtype"] = torch.float32
        for number, chosen in enumerate(itertools.product(*axes)):
            arguments = given | {name: value for values in chosen for name, value in values.items()}
            yield pytest.param(function, arguments, id=f"{function.__name__[5:]}-{number}")


@pytest.mark.parametrize(("case", "arguments"), [*_cases(RENDERED)])
def test_case(case, arguments):
    case(**arguments)


@pytest.mark.skipif(device_of("triton").type != "cpu", reason="the case's tensors are on the CPU")
@pytest.mark.parametrize(("case", "arguments"), [*_cases(CALLED)])
def test_case_on_the_cpu(case, arguments):
    case(**arguments)
