"""An effect from outside the package: it is called for, trained, stored, opened, timed, reported and left out."""

import csv
import shutil
from pathlib import Path

import pytest
import torch

from sparsestreet import load_scene
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.render import render
from sparsestreet.cli.commands.report import report
from sparsestreet.cli.commands.train import train
from sparsestreet.records.costs import COSTS
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.views import read_views
from tests.cli.conftest import TINY_RIGID
from tests.cli.toy.gain import Gain

CONF = Path(__file__).parent / "toy" / "conf"


@pytest.fixture(scope="module")
def toy_run(tiny_street, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("toy_effect") / "run"
    toy = [f"hydra.searchpath=[file://{CONF}]", "effects=[sky,gain]"]
    # Few steps: the leave-one-out rule comes at the 6th, and that the gain has moved is enough.
    short = ["sparsify=removal", "schedule.max_steps=8", "image_points=none", "callback.phase_times.every=3"]
    every_step = ["trainer.log_every_n_steps=1"]
    street = [word for word in tiny_street if not word.startswith(("image_points.", "schedule.max_steps"))]
    assert train([*street, *TINY_RIGID, *toy, *short, *every_step, f"out={out}"]) == 0
    return out


def test_it_is_trained_with_its_regularizer(toy_run):
    gain = load_scene(toy_run).scene.effects["gain"]
    assert isinstance(gain, Gain)
    # Two cameras, and steps of about the learning rate.
    assert gain.log_gains.shape == (2,)
    assert 0.005 < gain.log_gains.abs().max() < 0.1
    with (toy_run / "curves" / "metrics.csv").open() as file:
        terms = [float(row["train/gain/evenness"]) for row in csv.DictReader(file) if row.get("train/gain/evenness")]
    assert max(terms) > 0


def test_the_scene_opens_with_it_and_shows_what_the_run_showed(toy_run):
    stored = load_scene(toy_run)
    view = read_views(toy_run / "views.json").held_out[0]
    image = (stored.render(view).rgb.clamp(0, 1) * 255).round().byte()
    from PIL import Image

    shown = torch.tensor(bytearray(Image.open(toy_run / "pictures" / "005_0_render.png").tobytes()))
    assert torch.equal(image.flatten(), shown)
    without = stored.scene.without("gain")
    assert list(without.effects) == ["sky"]
    assert without.effects["sky"] is stored.scene.effects["sky"]


def test_it_is_timed_counted_and_reported(toy_run, capsys):
    costs, summary = COSTS.read(toy_run), SUMMARY.read(toy_run)
    assert set(costs.effects) == {"sky", "gain"}
    assert {"sky", "gain"} <= set(costs.frame_ms) & set(costs.step_ms)
    assert summary.bytes_by_part["gain"] == 2 * 4
    assert RUN.read(toy_run).config["effects.gain.evenness"] == 0.1
    assert report([str(toy_run)]) == 0
    assert "streetgs+removal" in capsys.readouterr().out


@pytest.mark.slow
def test_commands_open_it_where_its_module_is_trusted(toy_run, tmp_path, capsys):
    """A run may come from anybody; the user's own command says whose code may run."""
    run = shutil.copytree(toy_run, tmp_path / "run")
    commands = [
        (evaluate, [str(run)], 1),
        (render, [str(run), str(tmp_path / "still"), "frames=0:1", "device=cpu"], 1),
        (train, [f"resume={run}", f"hydra.searchpath=[file://{CONF}]"], 2),
    ]
    for command, words, status in commands:
        assert command(words) == status
        said = "effects.gain._target_ names 'tests.cli.toy.gain.GainSettings', which conf/ does not: say parts=[tests"
        assert said in capsys.readouterr().err
    for command, words, _ in commands:
        assert command([*words, "parts=[tests.cli.toy]"]) == 0
