"""Length, numbers of Gaussians and refinements follow the images that training sees."""

import pytest

from sparsestreet.cli.config.assemble import recipe_of, with_images
from sparsestreet.training.callbacks import DensityControl
from tests.cli.configurations import composed
from tests.typed import as_a

DRIVE = ("data=drivestudio", "data.root=/no/drive")


@pytest.mark.parametrize(
    ("words", "images", "expected"),
    [
        ((), None, (2000, 40_000, 130_000, 8000)),
        ((), 108, (2000, 40_000, 130_000, 8000)),  # of the default street
        ((), 27, (2000, 40_000, 130_000, 8000)),
        ((), 432, (8000, 160_000, 520_000, 32_000)),  # of 160 frames of it
        (DRIVE, 54, (3000, 40_000, 130_000, 8000)),
        (DRIVE, 108, (6000, 80_000, 260_000, 16_000)),
        ((*DRIVE, "data.images_per_capacity=27"), 108, (6000, 160_000, 520_000, 32_000)),
        (("node.background.max_gaussians=7000",), 432, (8000, 160_000, 7000, 32_000)),
        (("sparsify=uncapped",), 432, (8000, 160_000, None, None)),
        (("schedule=paper", "capacity=paper"), 432, (30_000, 1_000_000, None, None)),
    ],
)
def test_steps_and_gaussians_follow_the_training_images(words, images, expected):
    cfg = with_images(composed(*words), images)
    background, rigid = cfg.node.background, cfg.node.rigid
    found = (cfg.schedule.max_steps, background.num_points, background.max_gaussians, rigid.max_gaussians)
    assert found == expected


@pytest.mark.parametrize(
    ("words", "images", "every"),
    [((), None, 100), ((), 108, 100), ((), 40, 100), ((), 432, 400), ((), 560, 600), (("schedule=paper",), 432, 100)],
)
def test_a_refinement_has_heard_all_training_images(words, images, every):
    cfg = composed(*words)
    recipe_of(cfg)  # as train has it before it reads the log
    control = as_a(DensityControl, recipe_of(with_images(cfg, images)).callbacks["density_control"])
    assert control.refine_in.every == every


@pytest.mark.parametrize(
    ("words", "largest"), [((), 40.0), (("schedule=paper",), None), (("preset=drivestudio",), None)]
)
def test_a_short_run_counts_no_more_of_the_radius_than_a_street_has(words, largest):
    cfg = composed(*words)
    assert recipe_of(cfg).optimizer.largest_radius == largest
    assert {node.density.steady_means for node in cfg.node.values()} == {"preset=drivestudio" not in words}


@pytest.mark.parametrize(
    ("words", "images", "length"),
    [
        ((), None, 1.0),
        ((), 108, 1.0),
        ((), 27, 1.0),
        ((), 432, 4.0),
        (DRIVE, 108, 2.0),
        ((*DRIVE, "data.images_per_capacity=108"), 108, 1.0),
        ((*DRIVE, "schedule.max_steps=2000"), 108, 1.0),  # a third of its steps: rates as they are
        (("schedule.max_steps=4000",), 432, 2.0),
        (("schedule.max_steps=40000",), 432, 4.0),
        (("budget.minutes=5",), 432, 1.0),
        (("schedule=paper",), 432, 1.0),
        (("preset=drivestudio",), 432, 1.0),
    ],
)
def test_rates_are_lower_where_a_longer_log_is_trained_longer(words, images, length):
    cfg = composed(*words)
    recipe_of(cfg)
    assert recipe_of(with_images(cfg, images)).optimizer.relative_length == length


@pytest.mark.parametrize("method", ["pvg", "deformgs", "omnire"])
def test_gaussians_of_every_method_follow_the_training_images(method):
    few, many = (with_images(composed(f"method={method}"), images).node for images in (108, 216))
    limits = {name: node.max_gaussians for name, node in few.items() if node.max_gaussians is not None}
    assert limits
    assert {name: many[name].max_gaussians for name in limits} == {name: 2 * most for name, most in limits.items()}
    assert many.background.num_points == 2 * few.background.num_points


@pytest.mark.parametrize(
    ("words", "images", "removal", "weight"),
    [((), None, 6.0, 12.0), (("schedule.max_steps=1200",), None, 6.0, 12.0), (DRIVE, 108, 2.0, 4.0),
     (("schedule.max_steps=10000",), 108, 1.2, 2.4), (("schedule=paper",), 108, 1.0, 1.0)],
)  # fmt: skip
def test_masks_press_in_a_long_run_as_much_in_all_as_in_2000_steps(words, images, removal, weight):
    schedule = with_images(composed(*words), images).schedule
    assert (schedule.removal_lambda_m, schedule.lambda_m) == pytest.approx((removal, weight))
