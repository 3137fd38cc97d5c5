"""Rules at one schedule differ in their rule alone; what stands beside them differs from plain in one thing each."""

from typing import Any

import pytest

from sparsestreet.cli.config.assemble import recipe_of
from sparsestreet.cli.config.compose import resolved
from sparsestreet.cli.config.option_files import options_of
from sparsestreet.pruning import ImportanceRule, LeaveOneOutRule, LightGaussianRule, MiniSplattingRule
from sparsestreet.records.configuration import flat_config
from sparsestreet.scene.density import GradientDensity, McmcDensity
from sparsestreet.training.callbacks import Pruning
from tests.cli.configurations import composed
from tests.typed import as_a

RULES = options_of("experiment/rule")
NAMES = ("name", "out", "sparsify.")
MOMENTS = ["[0.93334]", "[0.6]", "[0.4,0.5,0.6]"]


def without(parts: tuple[str, ...], *overrides: str) -> dict[str, Any]:
    config = flat_config(resolved(composed(*overrides)))
    return {key: value for key, value in config.items() if not key.startswith(parts)}


@pytest.mark.lengthy
@pytest.mark.parametrize("moments", MOMENTS)
def test_rules_differ_in_their_rule_alone(moments: str):
    chosen = [(f"experiment=rule/{rule}", f"schedule.removal_at={moments}") for rule in RULES]
    said = [without((*NAMES, "callback.pruning.rule."), *overrides) for overrides in chosen]
    assert all(one == said[0] for one in said)
    assert len({composed(*overrides).name for overrides in chosen}) == len(RULES) == 6


def test_every_rule_takes_from_all_nodes_and_leaves_the_same_number():
    cfgs = {name: composed(f"experiment=rule/{name}", f"schedule.removal_at={MOMENTS[0]}") for name in RULES}
    rules: dict[str, Any] = {
        name: as_a(Pruning, recipe_of(cfg).callbacks["pruning"]).rule for name, cfg in cfgs.items()
    }
    assert {(rule.nodes, rule.keep) for rule in rules.values()} == {(None, 0.5)}
    kinds = {"importance": ImportanceRule, "removal": LeaveOneOutRule}
    kinds |= {"mini_splatting": MiniSplattingRule, "lightgaussian": LightGaussianRule}
    assert kinds == {name: type(rules[name]) for name in kinds}


def test_a_moment_is_in_the_name():
    assert composed("experiment=rule/opacity", "schedule.removal_at=[0.4,0.6]").name == "streetgs+masks+opacity@0.4-0.6"


@pytest.mark.parametrize("method", ["omnire", "pvg", "deformgs"])
def test_uncapped_is_plain_without_limits(method: str):
    nodes = recipe_of(composed(f"method={method}", "sparsify=uncapped")).nodes
    assert {settings.max_gaussians for settings in nodes.values()} == {None}
    apart = (*NAMES, "capacity.", *(f"node.{name}.max_gaussians" for name in nodes))
    assert without(apart, f"method={method}", "sparsify=uncapped") == without(apart, f"method={method}")


def test_mcmc_is_capped_with_another_density_control():
    capped, mcmc = (recipe_of(composed(f"sparsify={one}")).nodes for one in ("capped", "mcmc"))
    assert without((*NAMES, "node.background.den"), "sparsify=capped") == without(
        (*NAMES, "node.background.den"), "sparsify=mcmc"
    )
    assert type(capped["background"].density) is GradientDensity
    assert as_a(McmcDensity, mcmc["background"].density).cull_opacity == 0.005
