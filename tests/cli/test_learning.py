"""Whether what is trained learns: every method, nodes that move, and useless Gaussians that are planted."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jaxtyping import Bool
from torch import Tensor

from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import load_run_config
from sparsestreet.cli.runs.run import data_of
from sparsestreet.data.datamodule import StreetData
from sparsestreet.pruning import LeaveOneOutRule, RenderContext
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.nodes import Background
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene
from tests.cli.test_methods import METHODS
from tests.conftest import unchecked
from tests.pruning.planted import Views, activated, judge, plant


def column(path, name: str) -> list[float]:
    """The numbers of a curve, in the order of the steps."""
    with path.open() as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


@pytest.mark.slow
@pytest.mark.parametrize("sparsify", ["none", "removal"])
@pytest.mark.parametrize("method", METHODS)
def test_training_and_held_out_views_improve(method: str, sparsify: str, run_train, tmp_path):
    out = run_train(
        tmp_path,
        f"method={method}",
        f"sparsify={sparsify}",
        "schedule.max_steps=300",
        "trainer.val_check_interval=30",
        "trainer.log_every_n_steps=5",
    )
    curves = out / "curves" / "metrics.csv"
    errors, held_out = column(curves, "train/photometric"), column(curves, "val/psnr")
    assert len(errors) >= 50
    assert len(held_out) == 10
    # Means over a sixth of the run: single steps see single images.
    assert sum(errors[-10:]) < 0.7 * sum(errors[:10])
    assert held_out[-1] > held_out[0] + 1


@pytest.fixture(scope="module")
def planted_street(tiny_street, tmp_path_factory):
    return planted_in(
        tiny_street, tmp_path_factory.mktemp("planted"), max_steps=100, max_gaussians=1200, few=100, hidden=24
    )


@unchecked()
def planted_in(tiny_street: list[str], out: Path, max_steps: int, max_gaussians: int, few: int, hidden: int):
    """A trained background, what was planted into it, and which of its own rows a view would miss: of ``few`` of them,
    since each costs about one rendering of a few views."""
    size = [f"schedule.max_steps={max_steps}", f"node.background.max_gaussians={max_gaussians}"]
    assert train([*tiny_street, f"out={out}", "node=[background]", *size]) == 0
    data, stored = data_of(load_run_config(out)), load_scene(out)
    views = data.split.train.views
    cameras = [view.camera for view in views]
    generator = torch.Generator().manual_seed(0)
    sky = [stored.scene.effects["sky"].background(view).detach() for view in views]
    table = stored.scene.nodes["background"].rows
    rows, planted = plant(table, cameras, generator, hidden=hidden, copies=hidden // 4, backend="cpu", sky_images=sky)
    sample = torch.randperm(int((~planted).sum()), generator=generator)[:few]
    visible = Views(activated(rows), cameras, "cpu", sky).visible(sample)
    return out, data, rows, planted, visible


@pytest.mark.slow
def test_removal_finds_what_was_planted_and_spares_what_is_visible(planted_street):
    """One pass without a budget: rows that nobody sees. The judge renders every view without the row."""
    out, data, rows, planted, visible = planted_street
    keep = _prune_by_removal(load_scene(out), data, rows, allowed_db=0.0)
    verdict = judge(keep, planted, visible)
    assert verdict.recall >= 0.95
    assert verdict.visible_lost <= 0.02
    # No test if hardly anything went, or hardly anything is visible.
    assert verdict.num_visible > 50
    assert int((~keep & ~planted).sum()) > 100


def _prune_by_removal(stored: StoredScene, data: StreetData, rows: Rows, *, allowed_db: float) -> Bool[Tensor, " n"]:
    scene = stored.scene
    settings = replace(scene.nodes["background"].settings, min_gaussians=0)
    scene.nodes["background"] = Background(settings, rows)
    look = RenderContext(options=RenderOptions(stored.options.settings, "cpu"))
    return LeaveOneOutRule(allowed_db).select(scene, data.split.train, look)["background"].keep
