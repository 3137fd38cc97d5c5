"""Training end to end on a tiny street, through the command line."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from PIL import Image

from sparsestreet.cli.commands import evaluate as evaluate_module
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.runs.locks import sole_writer
from sparsestreet.metrics.definitions import PROTOCOLS
from sparsestreet.records.costs import COSTS
from sparsestreet.records.run import FAILURE, RUN, CodeVersion, FailedRun
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.views import read_views
from tests.cli.recompute import recompute
from tests.conftest import checked
from tests.typed import as_a, there


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


@pytest.fixture(scope="module")
def evaluated_again(finished, tmp_path_factory) -> Path:
    """A copy, evaluated by a process of another number of threads than trained it."""
    out = tmp_path_factory.mktemp("again") / "run"
    shutil.copytree(finished, out)
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)  # evaluate goes back to the number that trained
    with checked():
        assert evaluate([f"run={out}"]) == 0
    torch.set_num_threads(before)
    return out


@pytest.fixture
def sweep(finished, tmp_path) -> Path:
    """Two finished runs, one that failed later, and one that has just begun."""
    for name in ("a", "b", "failed"):
        shutil.copytree(finished, tmp_path / name)
    FAILURE.write(tmp_path / "failed", FailedRun(label="l", seed=0, command="c", error="e", trace="t"))
    (tmp_path / "begun").mkdir()
    return tmp_path


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_frames_of_a_sweep_are_timed_one_run_after_the_other(sweep, capsys, monkeypatch):
    """What is timed stays after Ctrl-C, and is not timed again unless it is asked for; the log is not read."""
    monkeypatch.setattr(evaluate_module, "data_of", lambda *given: pytest.fail("reads the log"))
    before, true, timed = bytes_of(sweep), evaluate_module.time_again, []

    def time_again(run, *given, **how):
        timed.append(run.name)
        if timed == ["a", "b"]:
            raise KeyboardInterrupt
        return true(run, *given, **how)

    monkeypatch.setattr(evaluate_module, "time_again", time_again)
    with pytest.raises(SystemExit) as ended:
        evaluate([str(sweep), "only=speed"])
    out, err = capsys.readouterr()
    assert (ended.value.code, out.count("ms a frame")) == (130, 1)
    assert "timed runs stay: give the same command to go on" in err
    assert evaluate([str(sweep), "only=speed"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0].endswith(" ms a frame, timed before"), timed) == (True, ["a", "b", "b"])
    assert re.match(r"2 of 2, b: [\d.]+ ms a frame \([\d.]+ before\)", lines[1])
    after = bytes_of(sweep)
    files = ("cost.json", "latency.csv", "summary.json")
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed == {f"{run}/records/{file}" for run in "ab" for file in files}
    command = there(SUMMARY.read(sweep / "b").timed).command
    assert command == f"sparsestreet evaluate run={sweep / 'b'} only=speed"
    assert evaluate([str(sweep / "b"), "only=speed", "again=true"]) == 0
    assert timed == ["a", "b", "b", "b"]


def test_runs_that_were_timed_by_other_code_or_threads_are_timed_again(sweep, monkeypatch):
    run = sweep / "a"
    assert evaluate([str(run), "only=speed"]) == 0
    summary, asked = SUMMARY.read(run), []
    monkeypatch.setattr(evaluate_module, "time_again", lambda *given, **how: asked.append(given) or summary)
    assert evaluate([str(run), "only=speed"]) == 0
    assert asked == []
    here = there(summary.timed)
    others = (
        {"source": CodeVersion("abc", False)}, {"machine": replace(here.machine, cores=99)}, {"threads": 99},
        {"device": "cuda: another"},
    )  # fmt: skip
    for other in others:
        SUMMARY.write(run, replace(summary, timed=replace(here, **other)))
        assert evaluate([str(run), "only=speed"]) == 0
    assert len(asked) == len(others)
    views = read_views(run / "views.json")
    assert [view.indices for view in asked[0][2]] == [view.indices for view in views.held_out]
    with sole_writer(run):
        assert evaluate([str(run), "only=speed", "again=true"]) == 1


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        ("only=speed novel=1 training_lpips=true", 2, "leave out novel=1 training_lpips=true"),
        ("again=true", 2, "again=true is for only=speed"),
        ("only=quality", 2, "only"),
        ("only=speed", 1, "holds no run that was measured"),
    ],
)
def test_timing_that_cannot_be_is_refused(tmp_path, capsys, words, status, said):
    assert evaluate([str(tmp_path), *words.split()]) == status
    assert said in capsys.readouterr().err


def flat_psnr(root: Path) -> float:
    """Of held-out images against their mean color."""
    images = [np.asarray(Image.open(path)) / 255 for path in sorted((root / "images").glob("005_*.jpg"))]
    return float(np.mean([-10 * np.log10(((image - image.mean((0, 1))) ** 2).mean()) for image in images]))


def test_training_improves_and_leaves_records(finished, tiny_street):
    summary = json.loads((finished / "records" / "summary.json").read_text())
    with (finished / "curves" / "metrics.csv").open() as file:
        psnr = [float(row["psnr"]) for row in csv.DictReader(file) if row["psnr"]]
    (root,) = (Path(word.partition("=")[2]) for word in tiny_street if word.startswith("data.log.root="))
    # 60 steps from gray, with a reset: 1.7 dB were measured; noise between runs is zero on the CPU.
    flat = flat_psnr(root)
    assert summary["quality"]["held_out"]["psnr_full"]["mean"] > flat + 1.5
    assert summary["quality"]["training"]["psnr_full"]["mean"] > flat + 1.5
    assert psnr
    assert summary["gaussians_total"] == sum(summary["gaussians"].values())
    assert summary["guards"]["alarms"] == {}
    assert summary["guards"]["rows"]["drawn"] > 0
    for picture in ("pictures/sheet.png", "curves/counts.png", "curves/psnr.png"):
        assert (finished / picture).is_file()


def test_training_ends_with_its_result(finished):
    """What the record says, in lines that follow each other; later runs of this process may have written behind."""
    summary = SUMMARY.read(finished)
    lines = (finished / "train.log").read_text().splitlines()
    first = next(index for index, line in enumerate(lines) if "held-out views: PSNR" in line)
    quality, _, ranges, size, places = lines[first : first + 5]
    assert f"held-out views: PSNR {summary.mean('psnr_full'):.2f} dB, vehicles " in quality
    seen = there(summary.geometry).groups["seen"]
    assert "ranges along the rays of " in ranges
    assert f"held-out sweeps: median error in images {seen.median:.3f} m ({100 * there(seen.within):.0f} % w" in ranges
    assert f"{summary.gaussians_total:,} Gaussians, {summary.bytes_total / 1e6:.2f} MB, " in size
    assert places.endswith(
        f"pictures: {finished}/pictures/sheet.png; curves: {finished}/curves; numbers: {finished}/records"
    )


def test_costs_of_a_run(finished):
    costs, summary = COSTS.read(finished), SUMMARY.read(finished)
    stages = {"start", "data", "points", "initialize", "train", "validate", "prune", "intensities", "save"}
    stages |= {"effects", "evaluate", "latency", "costs", "geometry", "gains", "pictures", "other"}
    assert set(costs.phases) == stages
    assert all(seconds > 0 for seconds in costs.phases.values())
    assert list(costs.passes) == [f"LeaveOneOutRule at step {step}" for step in (24, 30, 36)]
    assert sum(costs.passes.values()) == pytest.approx(costs.phases["prune"], rel=1e-4)  # six digits each
    parts = {"scene", "splat", "sky", "losses", "regularizers", "backward", "optimizer", "density", "loop"}
    assert set(costs.step_ms) == parts | {"data"}
    assert 50 < there(costs.peak_host_mb) < 20_000  # of this process, megabytes and neither KiB nor bytes
    assert costs.peak_device_mb is None
    assert {name: node.gaussians for name, node in costs.nodes.items()} == summary.gaussians
    assert sum(node.megabytes for node in costs.nodes.values()) == pytest.approx(
        1e-6 * (summary.bytes_total - summary.bytes_by_part["sky"]), rel=1e-4
    )
    assert set(costs.effects) == {"sky"}


def test_held_out_psnr_over_seconds(finished):
    with (finished / "curves" / "held_out.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["step"] == "60"
    assert float(row["seconds"]) == pytest.approx(RUN.read(finished).training_seconds, abs=0.2)
    mean = SUMMARY.read(finished).quality["held_out"]["psnr_full"].mean
    # All held-out views are within val_frames; harmonics have the degree of the end here and there.
    assert float(row["psnr_full"]) == pytest.approx(mean, abs=0.05)
    assert row["psnr_vehicle"]
    assert (finished / "curves" / "held_out.png").is_file()


def test_the_ledger_is_a_chain_that_ends_in_the_record(finished):
    summary = SUMMARY.read(finished)
    with (finished / "records" / "counts.csv").open() as file:
        changes = list(csv.DictReader(file))
    for node, rows in summary.gaussians.items():
        own = [change for change in changes if change["node"] == node]
        assert [int(change["before"]) for change in own[1:]] == [int(change["after"]) for change in own[:-1]]
        assert int(own[-1]["after"]) == rows


def test_run_json_says_what_the_run_is(finished, tiny_street):
    run = RUN.read(finished)
    assert (run.method, run.sparsify, run.label) == ("streetgs", "removal", "streetgs+removal")
    assert (run.steps, run.max_steps, run.seed) == (60, 60, 0)
    assert run.split == "every 10th frame from 5"
    assert run.config["schedule.removal_db"] == 0.0
    assert run.config["node.background.min_gaussians"] == 200
    assert run.device.startswith("cpu: ")
    assert run.threads == torch.get_num_threads()
    assert run.training_seconds > 0
    assert run.noise.before > 0
    assert run.data_hash.startswith("64x40x12_")  # the street's name
    assert "sparsify=removal" in run.command
    assert run == SUMMARY.read(finished).run


def test_held_out_views_are_those_of_the_split(finished):
    views = read_views(finished / "views.json")
    assert {view.frame_index for view in views.held_out} == {5}
    assert views.frame_rate == 10.0
    assert {(view.seconds, view.stamp) for view in views.held_out} == {(0.5, 500_000_000)}
    assert {view.frame_index for view in views.training} == set(range(12)) - {5}


def test_evaluation_agrees_with_training_and_leaves_what_training_said(finished, evaluated_again):
    first, costs = SUMMARY.read(finished), COSTS.read(finished)
    second, again = SUMMARY.read(evaluated_again), COSTS.read(evaluated_again)
    made_anew = ("frame_ms", "nodes", "effects", "noise")
    assert replace(again, **{name: getattr(costs, name) for name in made_anew}) == costs
    assert again.nodes != costs.nodes  # other milliseconds
    assert second.evaluated.threads == min(first.run.threads, second.evaluated.machine.cores)
    assert (second.quality, second.by_camera) == (first.quality, first.by_camera)
    assert list(second.by_camera["held_out"]) == ["0", "1"]
    assert second.gaussians == first.gaussians
    assert second.run == first.run
    assert second.evaluated.command == f"sparsestreet evaluate run={evaluated_again}"
    assert first.evaluated.command == first.run.command


def test_the_tables_numbers_follow_from_predictions_and_images(finished, evaluated_again, tiny_street):
    """Six numbers in each of two protocols, by a program that shares no code with the metrics; so after evaluate."""
    (root,) = (Path(word.partition("=")[2]) for word in tiny_street if word.startswith("data.log.root="))
    for run in (finished, evaluated_again):
        summary, expected = SUMMARY.read(run), recompute(run, root)
        names = [name for protocol in PROTOCOLS.values() for name in protocol.metrics if not name.startswith("lpips")]
        assert len(names) == len(set(names)) == 12
        for name in names:
            # The record keeps 6 digits; the metrics take images in float32, which is 6e-8 of 1.
            assert summary.mean(name) == pytest.approx(expected[name], rel=2e-5)
    stored = [path.name for path in (evaluated_again / "predictions/held_out").iterdir()]
    assert len(stored) == SUMMARY.read(evaluated_again).images["held_out"]


def test_a_run_of_an_earlier_version_is_refused_in_one_line(finished, tmp_path, capsys):
    shutil.copytree(finished, tmp_path / "old")
    path = tmp_path / "old/.hydra/config.yaml"
    cfg = as_a(DictConfig, OmegaConf.load(path))
    del cfg.evaluation
    OmegaConf.save(cfg, path)
    assert evaluate([f"run={tmp_path / 'old'}"]) == 1
    assert "is of an earlier version, its configuration lacks 'evaluation': train it again" in capsys.readouterr().err


@pytest.mark.slow
def test_the_floor_holds_while_masks_are_trained(run_train, tmp_path):
    """A crushing lambda closes every mask; K_min Gaussians stay open, are kept, and the firing is logged."""
    out = run_train(
        tmp_path,
        "sparsify=masks",
        "loss.mask_sparsity.weight=1e6",
        "schedule.mask_learning_rate=1.0",
        "node.rigid.mask.visible_only=false",
        "schedule.densify_until=0.1",
        "schedule.refine_in.stop=0.1",
    )
    summary = SUMMARY.read(out)
    assert summary.gaussians == {"background": 200, "rigid": 60}
    said = (out / "train.log").read_text()
    assert "(K_min) of node 'background' held" in said
    assert "take nothing: background (200 Gaussians, K_min 200), rigid (60 Gaussians, K_min 60)" in said
