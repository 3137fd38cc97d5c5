"""Every method with every sparsification, from one file each."""

import csv
import itertools
from typing import Any

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate

from sparsestreet.cli.config.compose import option_tree, options_of, resolved
from sparsestreet.cli.config.validate import config_problem, override_problem
from sparsestreet.cli.runs.run import recipe_of
from sparsestreet.pruning import ImportanceRule, LeaveOneOutRule, OpacityRule, RandomRule
from sparsestreet.records.configuration import flat_config
from sparsestreet.scene.body import SmplFile
from sparsestreet.scene.initialize.sources import ImagePoints
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import SampledMaskSettings
from sparsestreet.scene.nodes import BackgroundSettings, SmplSettings
from sparsestreet.training.callbacks import DensityControl, MaskTraining, PhaseTimes, Pruning, RowLedger
from sparsestreet.training.losses import MaskSparsity
from sparsestreet.training.parallel import DataParallel
from tests.cli.configurations import composed
from tests.typed import as_a, there

METHODS, SPARSIFY = options_of("method"), options_of("sparsify")
PAIRS = list(itertools.product(METHODS, SPARSIFY))
WITH_EACH = ("removal",)
COMPOSED = [pair for pair in PAIRS if pair[0] == "streetgs" or pair[1] in WITH_EACH]
"""The pairs that a daily run composes: each option once; each method with masks and pruning."""
DAILY = [("3dgs", "removal"), ("omnire", "removal"), ("pvg", "masks"), ("deformgs", "none")]
"""The pairs that a daily run trains: every method, every stage. The run of conftest.py is StreetGS. The rule of the
paper takes part in test_toy_node.py."""
EXPERIMENTS = options_of("experiment")


@pytest.mark.parametrize(
    ("method", "sparsify"),
    [pair if pair in COMPOSED else pytest.param(*pair, marks=pytest.mark.slow) for pair in PAIRS],
)
def test_every_pair_composes_and_its_parts_agree(method: str, sparsify: str):
    """Masks, their loss and their callback come together; what a method has stays with every sparsification."""
    cfg = composed(f"method={method}", f"sparsify={sparsify}")
    recipe = recipe_of(cfg)
    masked = cfg.sparsify.masks
    assert all((settings.mask_settings is not None) == masked for settings in recipe.nodes.values())
    assert list(recipe.losses) == [
        *recipe_of(composed(f"method={method}")).losses,
        *(["mask_sparsity"] if masked else []),
    ]
    # Which rule and which masks a sparsification has is the paper's matter, and that of its name.
    rules = dict.fromkeys(("importance", "paper", "paper_short"), ImportanceRule)
    rules |= {"removal": LeaveOneOutRule, "random": RandomRule, "opacity": OpacityRule}
    assert masked or sparsify not in ("masks", "paper", "paper_short", "removal", "maskgaussian")
    sampled = [type(settings.mask_settings) is SampledMaskSettings for settings in recipe.nodes.values()]
    assert sampled == [sparsify == "maskgaussian"] * len(sampled)
    added = ([MaskTraining] if masked else []) + ([Pruning] if sparsify in rules else [])
    assert [type(callback) for callback in recipe.callbacks.values()] == [DensityControl, RowLedger, PhaseTimes, *added]
    if sparsify in rules:
        pruning = as_a(Pruning, recipe.callbacks["pruning"])
        assert type(pruning.rule) is rules[sparsify]
        # The paper prunes once, at 28,000 of 30,000 steps, whatever the schedule.
        assert (pruning.at == (0.93334,)) == (rules[sparsify] is ImportanceRule)
        # And the background alone.
        touched = [name for name, settings in recipe.nodes.items() if pruning.rule.touches(name, settings)]
        assert touched == (["background"] if rules[sparsify] is ImportanceRule else list(recipe.nodes))
    assert cfg.name == method + ("" if sparsify == "none" else f"+{sparsify}")


@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("method", [METHODS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in METHODS[1:])])
def test_every_experiment_composes(experiment: str, method: str):
    recipe_of(composed(f"experiment={experiment}", f"method={method}"))


def papers_numbers(capacity: str, schedule: str) -> dict[str, Any]:
    """What sparsify=paper says of masks and pruning, with every node that the paper has."""
    cfg = composed("method=omnire", "sparsify=paper", f"schedule={schedule}", f"capacity={capacity}")
    recipe = recipe_of(cfg)
    removal = as_a(MaskTraining, recipe.callbacks["mask_training"]).remove_in
    pruning = as_a(Pruning, recipe.callbacks["pruning"])
    rule = as_a(ImportanceRule, pruning.rule)
    masks = {name: cfg.node[name].mask for name in recipe.nodes}
    rates = {name: recipe.nodes[name].learning_rates for name in recipe.nodes}
    return {
        "lambda_m": as_a(MaskSparsity, recipe.losses["mask_sparsity"]).weight,
        "masks end": removal.stop,
        "pruned at": pruning.at,
        "rule": (rule.gate, rule.remove, list(rule.nodes or ())),
        "lambda_n": {name: mask.sparsity_weight for name, mask in masks.items()},
        "epsilon": {mask.threshold for mask in masks.values()},
        "only where visible": {mask.visible_only for mask in masks.values()},
        "the image closes": {masks[name].image_closes for name in ("smpl", "deformable")},
        "rate": {LearningRate.of(each["mask_logits"]).initial for each in rates.values()},
        "K_min": {name: settings.min_gaussians for name, settings in recipe.nodes.items()},
    }


@pytest.mark.parametrize(("capacity", "schedule"), [("paper", "paper"), ("small", "short")])
def test_the_papers_method_has_its_numbers_at_any_length(schedule: str, capacity: str):
    """Those of its text: steps 24,000 and 28,000 of 30,000 as fractions, lambda_n, K_min. lambda_m, epsilon and the
    rate, which it leaves open, as stated in conf."""
    assert papers_numbers(capacity, schedule) == {
        "lambda_m": 1.0,
        "masks end": 24_000 / 30_000,
        "pruned at": (pytest.approx(28_000 / 30_000, abs=1e-5),),
        "rule": (True, None, ["background"]),
        "lambda_n": {"background": 2.5e-3, "rigid": 1e-4, "smpl": 1e-5, "deformable": 1e-5},
        "epsilon": {0.01},
        "only where visible": {False},
        "the image closes": {True},
        "rate": {0.01},
        "K_min": {"background": 40_000, "rigid": 10_000, "smpl": 50_000, "deformable": 5_000},
    }


def test_the_short_variant_is_the_schedules():
    """And what it was called before stays what it was: with the paper's schedule and capacity both are one."""
    cfg = composed("method=omnire", "sparsify=paper_short")
    assert cfg.loss.mask_sparsity.weight == cfg.schedule.lambda_m == 12.0
    assert (cfg.schedule.mask_in.stop, cfg.schedule.mask_learning_rate) == (0.9, 0.03)
    assert (cfg.node.rigid.mask.visible_only, cfg.node.smpl.mask.image_closes) == (True, False)
    assert cfg.node.deformable.min_gaussians == 5000
    at_length = ("method=omnire", "schedule=paper", "capacity=paper")
    short, exact = (resolved(composed(*at_length, f"sparsify={one}")) for one in ("paper_short", "paper"))
    for one in (short, exact):
        for key in ("sparsify", "name", "out"):
            one.pop(key, None)
    assert short == exact


def test_sources_are_chosen_left_out_and_refused():
    chosen = recipe_of(composed("source@node.background.sources=[lidar,far]")).nodes["background"]
    assert list(as_a(BackgroundSettings, chosen).sources) == ["lidar", "far"]
    left = recipe_of(composed("~node.background.sources.near", "node.background.sources.images.order=random"))
    sources = as_a(BackgroundSettings, left.nodes["background"]).sources
    assert list(sources) == ["lidar", "images", "far"]
    assert as_a(ImagePoints, sources["images"]).order == "random"
    with pytest.raises(InstantiationException, match=r"leave one out with ~node\.background\.sources\.far"):
        recipe_of(composed("node.background.sources.far=null"))


@pytest.mark.parametrize(
    ("overrides", "asked"),
    [
        ([], {"rigid": (1.0, 0.0), "deformable": (0.5, 0.0), "smpl": (None, 0.0)}),
        (["preset=drivestudio"], {"rigid": (None, 1.0), "deformable": (None, 0.5), "smpl": (None, 0.5)}),
        (["moving.rigid.min_displacement=2.0"], {"rigid": (2.0, 0.0), "deformable": (0.5, 0.0), "smpl": (None, 0.0)}),
    ],
)
def test_what_moves_is_one_choice_and_upstreams_presets_make_it(overrides, asked):
    nodes = recipe_of(composed("method=omnire", *overrides)).nodes
    assert {name: (nodes[name].min_displacement, nodes[name].min_path_length) for name in asked} == asked


def test_settings_of_the_op_are_those_of_a_preset_unless_given():
    from sparsestreet.ops import SplatSettings

    assert recipe_of(composed()).options.settings == SplatSettings(antialias=True)
    changed = recipe_of(composed("render.preset=fine", "render.settings.alpha_min=0.1")).options
    assert (changed.settings, changed.backend) == (SplatSettings(max_sigma=4.0, alpha_min=0.1, antialias=True), "auto")
    # Other renderers do not antialias.
    assert recipe_of(composed("render.preset=inria")).options.settings == SplatSettings.preset("inria")
    # A record holds the values, whatever a preset means later.
    assert flat_config(resolved(composed("render.preset=fast")))["render.settings.alpha_min"] == pytest.approx(1 / 128)
    assert "no settings preset 'quick': choose one of ['default'" in there(
        config_problem(composed("render.preset=quick"))
    )


@pytest.mark.parametrize(
    "overrides",
    [
        [
            "node.background.mask.threshold=0.1",
            "node.background.mask.sparsity_weight=1e-3",
            "node.rigid.density.grad_threshold=1e-4",
            "node.background.learning_rates.means.initial=1e-4",
            "node.rigid.learning_rates.mask_logits.initial=0.1",
            "node.background.sources.lidar.initial_opacity=0.2",
            "node.background.sources.images.order=random",
            "node.rigid.initial_opacity=0.2",
            "image_points.min_views=4",
            "render.settings.alpha_min=0.01",
            "effects.sky.learning_rates.texels.initial=0.02",
            "loss.depth.nearest=1.0",
            "optimizer.visible_only=true",
        ],
        [
            "image_points=none",
            "~node.background.sources.near",
            "render.preset=fast",
            "pruning@callback.pruning.rule=removal",
            "density@node.background.density=gradient",
            "effects.sky.when=off",
            "logger=none",
        ],
        ["source@node.background.sources=[lidar,far]", "effects=[]"],
    ],
    ids=["values", "choices", "some of several"],
)
def test_every_option_can_be_set_without_plus_signs(overrides: list[str]):
    """What does not fit names its key."""
    assert override_problem(["sparsify=paper", *overrides]) is None
    recipe_of(composed("sparsify=paper", *overrides))


@pytest.mark.parametrize(
    ("method", "sparsify"),
    [pair if pair in DAILY else pytest.param(*pair, marks=pytest.mark.slow) for pair in PAIRS],
)
def test_every_pair_trains_and_each_of_its_events_fires(method: str, sparsify: str, run_train, tmp_path):
    """20 steps in which densification, masking and pruning each come once.

    Quick masks, so that some rows do go, and a small budget of removal, so that it leaves some to the masks. One method
    starts with points from images, the other without.
    """
    masked = option_tree("sparsify", sparsify)["sparsify"].get("masks", False)
    masks = ["schedule.mask_learning_rate=1.0", "schedule.lambda_m=10.0"]
    out = run_train(
        tmp_path,
        f"method={method}",
        f"sparsify={sparsify}",
        "trainer.fast_dev_run=20",
        "schedule.refine_in.every=5",
        "schedule.mask_in.every=5",
        "schedule.removal_db=0.01",
        *(["node.background.density.grad_threshold=1e-6"] if sparsify != "mcmc" else []),
        *(masks if masked else []),
        *(["image_points=none"] if method == "3dgs" else []),
        *(BASELINE_TERMS if method == "omnire" else []),
    )
    with (out / "records" / "counts.csv").open() as file:
        reasons = {row["reason"] for row in csv.DictReader(file)}
    assert {"start", "densify"} <= reasons
    assert ("mask" in reasons) == masked
    assert ("pruning" in reasons) == (sparsify not in ("none", "masks", "maskgaussian", "capped", "uncapped", "mcmc"))
    assert torch.load(out / "checkpoints" / "last.ckpt", weights_only=False)["global_step"] == 20


BASELINE_TERMS = [
    "loss=[photometric,sky,depth,opacity_entropy,inverse_depth_smoothness,dynamic_region]",
    "loss.depth.inverse=false",
    "loss.depth.weight=0.01",
    "node.background.sharp_shape=0.1",
    "node.rigid.sharp_shape=0.1",
    "node.rigid.temporal_smooth=0.01",
]


def test_the_terms_of_the_baselines_are_options():
    losses: dict[str, Any] = dict(recipe_of(composed(*BASELINE_TERMS)).losses)
    dynamic = losses.pop("dynamic_region")
    assert (dynamic.weight, dynamic.threshold, dynamic.from_progress) == (1.0, 0.2, 0.6666)
    assert {name: loss.weight for name, loss in losses.items()} == {
        "photometric": 1.0,
        "sky": 0.05,
        "depth": 0.01,
        "opacity_entropy": 0.05,
        "inverse_depth_smoothness": 0.001,
    }
    assert not losses["depth"].inverse


def test_several_processes_are_an_option():
    cfg = composed("trainer=ddp", "trainer.devices=2")
    assert type(instantiate(cfg.trainer.strategy)) is DataParallel
    assert (cfg.trainer.devices, cfg.trainer.accelerator, cfg.optimizer.batch_rule) == (2, "auto", "sqrt")


def test_people_with_a_body_of_the_users_need_its_file():
    """It could not be given: what the built-in body has was merged into it, and a path was no key."""
    chosen = ("method=omnire", "preset=drivestudio", "body@node.smpl.body=smpl_file")
    assert config_problem(composed(*chosen)) == "node.smpl.body.path has no value: give node.smpl.body.path=..."
    people = recipe_of(composed(*chosen, "node.smpl.body.path=SMPL.npz")).nodes["smpl"]
    assert as_a(SmplSettings, people).body == SmplFile("SMPL.npz")
