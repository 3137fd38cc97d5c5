"""``sparsestreet bench``: modes, help, and the street of a run."""

import shlex
from pathlib import Path

import pytest
import torch

from sparsestreet.bench import figures, scenes, settings_sweep, step
from sparsestreet.bench.records import read_records
from sparsestreet.cli.commands import bench as cli_bench
from sparsestreet.cli.commands.bench import bench, trained_street
from sparsestreet.cli.runs import run as cli_step
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.views import read_views
from tests.export.street import write_street


@pytest.fixture
def handed(monkeypatch):
    """What each mode hands to its measurement, which is replaced: positional and named arguments."""
    given = {}

    def replaced(module, name):
        monkeypatch.setattr(module, name, lambda *args, **named: given.update({name: (args, named)}))

    replaced(settings_sweep, "run_sweep")
    replaced(step, "run_step")
    monkeypatch.setattr(
        figures, "draw_pareto", lambda records, folder: given.update(drawn=(records, folder)) or ["a.svg"]
    )
    monkeypatch.setattr(cli_bench, "trained_street", lambda run: given.update(street=run) or "the street")
    monkeypatch.setattr(scenes, "bench_scenes", lambda *given: ("scenes", *given))
    return given


SMALL = ("scenes", settings_sweep.SMALL)


@pytest.mark.parametrize(
    ("words", "name", "expected"),
    [
        (["settings"], "run_sweep",
         (("scenes", settings_sweep.FULL, None), SMALL, settings_sweep.points(), settings_sweep.BUDGET)),
        (["quick=true", "street=RUN"], "run_sweep",
         (("scenes", settings_sweep.QUICK, "the street"), SMALL, settings_sweep.points(), settings_sweep.QUICK_BUDGET)),
        (["step", "seed=3"], "run_step", ("train seed=3", "trains", step.FULL)),
        (["step", "seed=3", "quick=true"], "run_step", ("train seed=3", "trains", step.QUICK)),
    ],
)  # fmt: skip
def test_a_mode_hands_on_what_it_is_told(handed, monkeypatch, tmp_path, words, name, expected):
    trained = []
    monkeypatch.setattr(
        cli_step, "train_with", lambda overrides, folder: trained.append((overrides, folder)) or "trains"
    )
    assert bench([*words, f"out={tmp_path / 'o'}"]) == 0
    args, named = handed[name]
    assert args[: len(expected)] == expected
    mode = words[0] if "=" not in words[0] else "settings"
    file, *folder = args[len(expected) :]
    assert file.path == tmp_path / "o" / f"{mode}.jsonl"
    file.write("anything", step.Floor(1.0))
    (record,) = read_records(file.path)
    assert record["provenance"]["command"] == shlex.join(["sparsestreet", "bench", *words, f"out={tmp_path / 'o'}"])
    assert record["provenance"]["threads"] == torch.get_num_threads()
    assert folder == ([tmp_path / "o"] if mode == "step" else [])
    assert named == {}
    if mode == "settings":
        assert handed["drawn"] == ([], tmp_path / "o")
        assert handed.get("street") == (Path("RUN") if "street=RUN" in words else None)
    if mode == "step":
        ((overrides, _),) = trained
        assert overrides == ["seed=3"]


def test_the_street_of_a_run_is_the_view_in_its_middle(tmp_path):
    """Of five frames and four cameras, 20 views, in their order: the eleventh."""
    write_street(tmp_path / "run")
    street, stored = trained_street(tmp_path / "run"), load_scene(tmp_path / "run")
    middle = read_views(tmp_path / "run" / "views.json").all[10]
    assert (street.name, street.source) == (
        "trained street", f"trained: run on {stored.name}, frame {middle.frame_index}",
    )  # fmt: skip
    assert torch.equal(street.camera.camera_from_world, middle.camera.camera_from_world)
    assert torch.equal(street.gaussians.means, stored.scene.gaussians_at(middle).gaussians.means)
    assert not street.gaussians.means.requires_grad
