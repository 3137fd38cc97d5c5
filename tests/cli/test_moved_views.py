"""Which trainings look beside the path, and how hard."""

from sparsestreet.cli.config.assemble import recipe_of
from sparsestreet.cli.config.compose import resolved
from sparsestreet.records.configuration import flat_config
from sparsestreet.training.moved_views import MovedViews
from tests.cli.configurations import composed


def test_a_simulators_preset_differs_in_its_moved_views_alone():
    usual, simulation = (flat_config(resolved(composed(*words))) for words in ((), ("preset=simulation",)))
    apart = {key for key in usual if usual[key] != simulation.get(key)}
    assert {key for key in apart if not key.startswith(("moved_views.", "preset."))} == {"name", "out"}
    assert usual.keys() == simulation.keys()
    settings = recipe_of(composed("preset=simulation")).moved_views
    assert settings == MovedViews(every=2, depth_weight=8.0, color_weight=8.0)


def test_they_can_be_left_out():
    assert recipe_of(composed("moved_views=none")).moved_views is None
