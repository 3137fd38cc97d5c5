"""A node type from outside the package: it trains, densifies, is masked, pruned, saved, opened and reported."""

import csv
import json
from pathlib import Path

import pytest
import torch

from sparsestreet import load_scene
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.report import report
from sparsestreet.cli.commands.train import train
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.views import read_views
from tests.cli.toy.bobbing import Bobbing

CONF = Path(__file__).parent / "toy" / "conf"


@pytest.fixture(scope="module")
def toy_run(tiny_street, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("toy") / "run"
    status = train(
        [
            *tiny_street,
            f"hydra.searchpath=[file://{CONF}]",
            "node=[background,bobbing]",
            "sparsify=paper",
            # The paper's rule takes from the background alone.
            "callback.pruning.rule.nodes=null",
            "schedule.mask_learning_rate=0.25",
            "schedule.lambda_m=30.0",
            f"out={out}",
        ]
    )
    assert status == 0
    return out


def test_its_gaussians_come_and_go_for_every_reason(toy_run):
    with (toy_run / "records" / "counts.csv").open() as file:
        reasons = {row["reason"] for row in csv.DictReader(file) if row["node"] == "bobbing"}
    assert {"start", "densify", "mask", "pruning"} <= reasons
    # Its learned parts have moved, its network too, which rested for the first quarter.
    node = load_scene(toy_run).scene.nodes["bobbing"]
    assert isinstance(node, Bobbing)
    assert node.lift[0].get_parameter("weight").abs().sum() > 0
    assert len(node.rows) >= node.settings.min_gaussians


def test_its_regularizer_is_among_the_terms_of_the_loss(toy_run):
    with (toy_run / "curves" / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row.get("train/bobbing/stillness")]
    assert float(rows[0]["train/bobbing/stillness"]) > 0


def test_it_is_opened_with_the_names_of_its_tracks_and_shows_what_the_run_showed(toy_run):
    stored = load_scene(toy_run)
    instances = stored.scene.nodes["bobbing"].instances()
    assert len(instances.names) > 0
    assert len(instances.ids) == len(stored.scene.nodes["bobbing"].rows)
    view = read_views(toy_run / "views.json").held_out[0]
    image = (stored.render(view).rgb.clamp(0, 1) * 255).round().byte()
    from PIL import Image

    expected = torch.tensor(bytearray(Image.open(toy_run / "pictures" / "005_0_render.png").tobytes()))
    assert torch.equal(image.flatten(), expected)


def test_it_is_evaluated_and_reported(toy_run, capsys):
    before = SUMMARY.read(toy_run)
    assert evaluate([f"run={toy_run}", "parts=[tests.cli.toy]"]) == 0
    after = SUMMARY.read(toy_run)
    assert after.quality == before.quality
    assert after.gaussians["bobbing"] > 0
    assert json.loads((toy_run / "run.json").read_text())["config"]["node.bobbing.stillness"] == 0.1
    assert report([str(toy_run)]) == 0
    assert "bobbing" in capsys.readouterr().out
