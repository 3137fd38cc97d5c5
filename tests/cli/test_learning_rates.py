"""The rates of the paper's length against those of DriveStudio, in what a step moves."""

import pytest

from sparsestreet.cli.config.assemble import recipe_of
from sparsestreet.scene.learning_rate import LearningRate, matching_rate
from tests.cli.configurations import composed

RADIUS = 90.0
"""Meters, as of a drive of Waymo."""

GAUSSIANS = {
    "means": (1.6e-4 * RADIUS, 1.6e-6 * RADIUS),
    "log_scales": (5e-3, 5e-3),
    "quaternions": (1e-3, 1e-3),
    "opacity_logits": (5e-2, 5e-2),
    "sh_dc": (2.5e-3, 2.5e-3),
    "sh_rest": (1.25e-4, 1.25e-4),
}
BOXES = {"rotation_deltas": (1e-5, 5e-6), "translation_deltas": (5e-4, 1e-4)}

# First and last rate of each parameter. DriveStudio at e59bda4: general_cfg, replaced as a whole by a node's own entry
# of that name, times its scale_factor.
UPSTREAM = {
    "omnire": {
        "background": GAUSSIANS,
        "rigid": GAUSSIANS | BOXES,
        "deformable": GAUSSIANS
        | BOXES
        | {
            "means": (2 * 1.6e-4, 2 * 1.6e-6),
            "embeddings": (1e-3, 1e-4),
            "network": (5 * 1.6e-3, 5 * 1.6e-4),
        },
        "smpl": GAUSSIANS
        | BOXES
        | {
            "means": (3 * 1.6e-4, 3 * 1.6e-6),
            "quaternions": (5e-3, 5e-3),
            "sh_dc": (5e-3, 5e-3),
            "sh_rest": (2.5e-4, 2.5e-4),
            # ins_rotation turns the root (BOXES), smpl_rotation the other 23 joints.
            "joint_deltas": (5e-5, 1e-5),
        },
    },
    "deformgs": {
        # Its network decays over 40,000 steps; the run ends after 30,000.
        "background": GAUSSIANS | {"network": (5 * 1.6e-4, 5 * 1.6e-4 * 0.01 ** (30 / 40))}
    },
    "pvg": {
        "background": GAUSSIANS
        | {
            "opacity_logits": (5e-3, 5e-3),
            "velocities": (1e-3 * RADIUS, 1e-3 * RADIUS),
            "log_life_spans": (2e-3, 2e-3),
            "life_peaks": (8e-4, 8e-6),
        }
    },
}


def ends(rate: LearningRate) -> tuple[float, float]:
    """What the optimizer takes at the start and at the end of a run; for means meters a step."""
    initial = rate.initial * (RADIUS if rate.scale_by_scene_radius else 1.0)
    return initial * rate.factor(0.0), initial * rate.factor(1.0)


@pytest.mark.parametrize("method", UPSTREAM)
def test_rates_of_the_papers_length_are_upstreams(method):
    nodes = recipe_of(composed(f"method={method}", "schedule=paper", "capacity=paper")).nodes
    assert set(nodes) == set(UPSTREAM[method])
    for name, wanted in UPSTREAM[method].items():
        found = {key: ends(matching_rate(key, nodes[name].learning_rates, where=name)) for key in wanted}
        for key, rates in wanted.items():
            # 1e-3: a final rate may be given in three digits.
            assert found[key] == pytest.approx(rates, rel=1e-3), f"{name}.{key}"


def test_means_in_a_box_do_not_learn_with_the_size_of_the_scene():
    """A short run has twice the rates, and the same rule."""
    nodes = recipe_of(composed("method=omnire")).nodes
    means = {name: LearningRate.of(node.learning_rates["means"]) for name, node in nodes.items()}
    scaled = {name: rate.scale_by_scene_radius for name, rate in means.items()}
    assert scaled == {"background": True, "rigid": True, "deformable": False, "smpl": False}
