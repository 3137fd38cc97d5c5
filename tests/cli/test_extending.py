"""What docs/extending.md shows, run: each kind of part from outside, and one training with all of them."""

import ast
import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.errors import InstantiationException
from PIL import Image

from sparsestreet import load_scene
from sparsestreet.cli.commands.data import data
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.render import render
from sparsestreet.cli.commands.report import report
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.validate import override_problem
from sparsestreet.cli.runs.run import data_of, recipe_of
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.pruning import RenderContext
from sparsestreet.records.costs import COSTS
from sparsestreet.records.curves import LOGGED
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.initialize.training_data import Coverage
from sparsestreet.scene.masks import MaskScope, StaticMask
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.rendering import render as rendered
from sparsestreet.scene.views import read_views
from sparsestreet.training.callbacks import Pruning
from tests.cli import configurations
from tests.cli.toy.bobbing import Bobbing
from tests.cli.toy.density import GrowthDensity
from tests.cli.toy.gain import Gain
from tests.cli.toy.loss import MeanColor
from tests.cli.toy.mask import ProbitMask, ProbitMaskSettings
from tests.cli.toy.metric import largest_errors
from tests.cli.toy.rule import SizeRule
from tests.cli.toy.source import DrivenPoints
from tests.scene.density.scenes import make_rows as rows_at_random
from tests.scene.density.scenes import with_statistics
from tests.scene.street import street_log, training_data
from tests.training.stubs import background, frame_at, make_rows, set_rows
from tests.typed import as_a

ROOT = Path(__file__).parents[2]
OUTSIDE = f"hydra.searchpath=[file://{Path(__file__).parent / 'toy' / 'conf'}]"
PROBIT = "node.background.mask._target_=tests.cli.toy.mask.ProbitMaskSettings"
STEPS = 20


@pytest.fixture(scope="module")
def run(tiny_street, tmp_path_factory) -> Path:
    """A short run with everything that is our own; its events come every fifth step, the rule at the twelfth."""
    out = tmp_path_factory.mktemp("extending") / "run"
    parts = ["node=[background,bobbing]", "effects=[sky,gain]", "loss=[photometric,sky,depth,mean_color]"]
    masks = ["sparsify=size", "schedule.mask_learning_rate=1.0", "schedule.lambda_m=3.0", "image_points=none"]
    rule = ["callback.pruning.rule.meters=0.1", "callback.phase_times.every=3"]
    every = ["schedule.refine_in.every=5", "schedule.mask_in.every=5", "trainer.log_every_n_steps=1"]
    short = [f"schedule.max_steps={STEPS}", f"trainer.val_check_interval={STEPS}"]
    street = [word for word in tiny_street if not word.startswith(("image_points.", "schedule.", "trainer."))]
    assert train([*street, OUTSIDE, *parts, PROBIT, *masks, *rule, *every, *short, f"out={out}"]) == 0
    return out


def composed(*overrides: str):
    assert override_problem([OUTSIDE, *overrides]) is None
    return configurations.composed(OUTSIDE, *overrides)


def test_the_page_shows_the_parts_of_this_folder():
    """As they are: the site takes each class or function from its file."""
    page = (ROOT / "docs" / "extending.md").read_text()
    shown = re.findall(r"^```\{literalinclude\} \.\./(\S+)\n:(?:pyobject: (\w+)|language: yaml)$", page, flags=re.M)
    assert len(shown) == page.count("{literalinclude}")
    parts = ("bobbing", "density", "gain", "loss", "mask", "metric", "reader", "rule", "source")
    assert {f"tests/cli/toy/{name}.py" for name in parts} <= {name for name, _ in shown}
    for name, part in shown:
        text = (ROOT / name).read_text()
        named = {getattr(node, "name", "") for node in ast.parse(text).body} if part else {""}
        assert part in named, f"{name} has no {part}"


@pytest.mark.parametrize(
    "words",
    [
        ["loss=[photometric,sky,depth,mean_color]"],
        ["++loss.mean_color._target_=tests.cli.toy.loss.MeanColor", "++loss.mean_color.weight=0.1"],
    ],
    ids=["a file", "no file"],
)
def test_a_loss(words):
    loss = recipe_of(composed(*words)).losses["mean_color"]
    assert loss == MeanColor(weight=0.1)
    frame = frame_at()
    frame = replace(frame, image=torch.tensor([51, 102, 153], dtype=torch.uint8).expand(frame.image.shape))
    scene = SceneGraph({"background": background()})
    rendering = replace(rendered(scene, frame), rgb=torch.tensor([0.5, 0.6, 0.7]).expand(frame.image.shape))
    assert loss.applies(frame)
    # The colors lie 0.3, 0.2 and 0.1 apart.
    torch.testing.assert_close(loss(rendering, frame, scene), torch.tensor(0.1 * 0.2))


def test_a_rule():
    cfg = composed("sparsify=size")
    pruning = as_a(Pruning, recipe_of(cfg).callbacks["pruning"])
    assert (pruning.at, pruning.rule, cfg.name) == ((0.6,), SizeRule(meters=1.0), "streetgs+size")
    node = background(20, min_gaussians=19)
    set_rows(node, "log_scales", {3: 1.0, 5: 2.0})
    selection = pruning.rule.select(SceneGraph({"background": node}), [frame_at()], RenderContext())["background"]
    assert (~selection.keep).nonzero().tolist() == [[5]]
    assert selection.floor_hit


def test_a_density_strategy():
    nodes = recipe_of(composed("density@node.background.density=growth", "node.background.density.growth=0.5")).nodes
    density = nodes["background"].density
    assert density == GrowthDensity(growth=0.5)  # the rest as the class has it, like conf/density/gradient.yaml
    assert nodes["rigid"].density == GradientDensity(cull_scale=0.1)
    rows = rows_at_random(10, torch.Generator().manual_seed(0))
    wanted = with_statistics([1.0] * 10)
    for most, after in ((None, 15), (12, 12)):
        plan = as_a(GrowthDensity, density).densify(
            rows, wanted, radius=1e6, progress=0.5, max_gaussians=most, generator=torch.Generator().manual_seed(0)
        )
        assert len(plan.source) == after  # radius 1e6: every row is small, so that each wanted one is cloned


def test_a_method_with_a_sparsification():
    recipe = recipe_of(composed("method=no_lidar", "sparsify=masks"))
    assert set(recipe.nodes) == {"background", "rigid"}
    assert set(recipe.losses) == {"photometric", "sky", "mask_sparsity"}


def test_a_mask():
    settings = recipe_of(composed("sparsify=masks", PROBIT)).nodes["background"]
    scope = MaskScope.whole([0.0, 1.0], torch.zeros(3), radius=1.0)
    mask = as_a(ProbitMaskSettings, settings.mask_settings).build(settings.min_gaussians, scope)
    assert isinstance(mask, ProbitMask)
    assert mask.settings == ProbitMaskSettings(sparsity_weight=2.5e-3)
    rows = make_rows(3, columns={"mask_logits": torch.tensor([-2.5, -2.0, 1.0])})
    # The normal distribution passes 0.01 at -2.33, the sigmoid at -4.6.
    probit, sigmoid = ProbitMask(mask.settings), StaticMask(mask.settings)
    assert probit.multipliers(rows, 0.0).tolist() == [0, 1, 1] == probit.keep(rows).keep.tolist()
    assert sigmoid.multipliers(rows, 0.0).tolist() == [1, 1, 1]


def test_a_source():
    chosen = "source@node.background.sources=[lidar,images,near,far,driven]"
    nodes = recipe_of(composed(chosen, "node.background.sources.near.part=0.233")).nodes
    background = as_a(BackgroundSettings, nodes["background"])
    assert list(background.sources) == ["lidar", "images", "near", "far", "driven"]
    source = background.sources["driven"]
    assert source == DrivenPoints(initial_opacity=0.3, part=0.1, height=1.5)
    assert source.share(Coverage(lidar=0.5, images=0.25)) == pytest.approx(0.025)
    log = street_log()
    seeds = source.draw(40, training_data(log), torch.Generator().manual_seed(0))
    # The cameras drive along x, half a meter an instant, 1.5 m above the ground.
    assert {tuple(point) for point in seeds.points.positions.tolist()} == {(0.5 * step, 0.0, 0.0) for step in range(5)}
    assert seeds.opacities.tolist() == pytest.approx([0.3] * 40)
    with pytest.raises(InstantiationException, match=r"add up to 1 at most, got 1\.1: lower the part of one"):
        recipe_of(composed(chosen))


def test_a_reader(tmp_path, capsys):
    words = [OUTSIDE, "data=pictures", "data.log.focal=20", f"data.root={tmp_path}", "split.stride=0"]
    assert data(["check", *words]) == 1
    assert "there is no picture" in capsys.readouterr().out
    for index in range(3):
        Image.fromarray(np.full((20, 32, 3), 40 * index, np.uint8)).save(tmp_path / f"{index:03d}.png")
    assert data(["check", *words]) == 0
    assert "3 x 1" in capsys.readouterr().out
    assert data(["check", *("data=auto" if word == "data=pictures" else word for word in words)]) == 0
    assert capsys.readouterr().out.startswith("data=pictures, as ")
    street = data_of(composed(*words[1:], "split.stride=2", "split.offset=1", "seed=7"))
    split = street.split
    assert street.seed == 7  # of the order of its frames
    assert [int(frame.image[0, 0, 0]) for frame in split.train] == [0, 80]
    (view,) = split.held_out.views
    assert (view.time, view.frame_index, view.camera.position.tolist()) == (0.5, 1, [0.0, 0.0, 1.0])
    (tmp_path / "001.png").write_bytes(b"torn")
    assert data(["check", *words]) == 1
    assert "cannot be decoded" in capsys.readouterr().out


def test_its_gaussians_come_and_go_for_every_reason(run):
    with (run / "records" / "counts.csv").open() as file:
        reasons = {row["reason"] for row in csv.DictReader(file) if row["node"] == "bobbing"}
    assert {"start", "densify", "mask", "pruning"} <= reasons
    # Its learned parts have moved, its network too, which rested for the first quarter.
    node = load_scene(run).scene.nodes["bobbing"]
    assert isinstance(node, Bobbing)
    assert node.lift[0].get_parameter("weight").abs().sum() > 0
    assert len(node.rows) >= node.settings.min_gaussians


def test_the_scene_opens_and_shows_what_the_run_showed(run):
    stored = load_scene(run)
    node = stored.scene.nodes["bobbing"]
    assert len(node.instances().names) > 0
    assert len(node.instances().ids) == len(node.rows)
    view = read_views(run / "views.json").held_out[0]
    image = (stored.render(view).rgb.clamp(0, 1) * 255).round().byte()
    assert np.array_equal(image.numpy(), np.asarray(Image.open(run / "pictures" / "005_0_render.png")))
    without = stored.scene.without("gain")
    assert list(without.effects) == ["sky"]
    assert without.effects["sky"] is stored.scene.effects["sky"]


def test_regularizers_are_among_the_terms_of_the_loss(run):
    gain = load_scene(run).scene.effects["gain"]
    assert isinstance(gain, Gain)
    # Two cameras, and steps of about the learning rate.
    assert gain.log_gains.shape == (2,)
    assert 0.005 < gain.log_gains.abs().max() < 0.01 * STEPS
    rows = LOGGED.rows(run)
    for term in ("train/bobbing/stillness", "train/gain/evenness"):
        assert max(float(row[term]) for row in rows if row[term]) > 0


def test_it_is_timed_counted_and_reported(run, capsys):
    costs, summary = COSTS.read(run), SUMMARY.read(run)
    assert set(costs.effects) == {"sky", "gain"}
    assert {"sky", "gain"} <= set(costs.frame_ms) & set(costs.step_ms)
    assert summary.bytes_by_part["gain"] == 2 * 4
    description = RUN.read(run)
    assert (description.label, description.steps) == ("streetgs+size", STEPS)
    assert description.config["loss.mean_color.weight"] == 0.1
    assert report([str(run)]) == 0
    said = capsys.readouterr().out
    assert "streetgs+size" in said
    assert "bobbing" in said


@pytest.mark.slow
def test_commands_open_it_where_its_module_is_trusted(run, tmp_path, capsys):
    """A run may come from anybody; the user's own command says whose code may run."""
    run = shutil.copytree(run, tmp_path / "run")
    commands = [
        (evaluate, [str(run)], 1),
        (render, [str(run), str(tmp_path / "still"), "frames=0:1", "device=cpu"], 1),
        (train, [f"resume={run}", f"hydra.searchpath=[file://{ROOT}/tests/cli/toy/conf]"], 2),
    ]
    for command, words, status in commands:
        assert command(words) == status
        said = "effects.gain._target_ names 'tests.cli.toy.gain.GainSettings', which conf/ does not: say parts=[tests"
        assert said in capsys.readouterr().err
    for command, words, _ in commands:
        assert command([*words, "parts=[tests.cli.toy]"]) == 0


def test_a_number_of_a_finished_run(run, tiny_street):
    root = next(word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    errors = largest_errors(run, DriveStudioReader(root).read())
    held_out = read_views(run / "views.json").held_out
    assert set(errors) == {(view.frame_index, view.camera_index) for view in held_out}
    # A short run is far off somewhere, and nothing can be off by more than 1.
    assert all(0.2 < error <= 1 for error in errors.values())
