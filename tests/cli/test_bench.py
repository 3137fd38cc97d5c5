"""``sparsestreet bench``: modes, help, and the street of a run."""

import json

import pytest
import torch

from sparsestreet.bench import gpu, scaling
from sparsestreet.cli.bench import bench, trained_street
from sparsestreet.ops import splat
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.views import read_views


def test_help_teaches_by_example(capsys):
    with pytest.raises(SystemExit) as ended:
        bench(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(f"sparsestreet bench {mode}" in text for mode in ("knobs", "blend", "step", "masks", "scaling", "gpu"))


def test_unknown_mode_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        bench(["knob"])
    assert ended.value.code == 2
    assert "invalid choice" in capsys.readouterr().err


def test_records_name_command_and_threads(tmp_path, capsys):
    assert bench(["scaling", "--quick", "--out", str(tmp_path), "--threads", str(torch.get_num_threads())]) == 0
    first = json.loads((tmp_path / "scaling.jsonl").read_text().splitlines()[0])
    assert first["provenance"]["command"].startswith("sparsestreet bench scaling --quick")
    assert first["provenance"]["threads"] == torch.get_num_threads()
    assert first["rows"] < min(scaling.ROWS)


def test_a_masks_network_is_timed_beside_its_bits(tmp_path, capsys):
    assert bench(["masks", "--quick", "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "masks.jsonl").read_text())
    assert record["rows"] == 100
    assert record["bytes_of_bits"] == 100 * -(-record["frames"] // 8)
    assert 0 < record["bits"]["minimum"] <= record["bits"]["median"]
    assert 0 < record["network"]["minimum"] <= record["network"]["median"]
    assert "ms saved a frame" in capsys.readouterr().out


@pytest.mark.slow
def test_step_times_and_counts_the_phases_of_a_training(tmp_path, tiny_street, capsys):
    assert (
        bench(
            ["step", "--quick", "--out", str(tmp_path), *tiny_street, "sparsify=masks", "callback.phase_times.every=1"]
        )
        == 0
    )
    record = json.loads((tmp_path / "step.jsonl").read_text())
    phases = {phase["name"]: phase for phase in record["phases"]}
    every_step = {"data", "scene", "splat", "sky", "loss photometric", "loss mask_sparsity", "splat backward",
                  "scene backward", "backward", "optimizer", "density statistics", "loop"}  # fmt: skip
    assert every_step <= phases.keys()
    assert sum(phase["time"]["median"] for phase in phases.values()) == pytest.approx(
        record["step"]["median"], rel=0.5
    )  # medians of parts beside the median of the whole
    assert sum(phase["operations"] for phase in phases.values()) == pytest.approx(record["operations"])
    assert phases["splat"]["floor_ms"] > 0
    assert record["gaussians"].keys() == {"background", "rigid"}
    assert (tmp_path / "step.png").stat().st_size > 10_000
    assert "times its op" in capsys.readouterr().out


def test_step_refuses_what_train_refuses(tmp_path):
    with pytest.raises(SystemExit, match=r"bench step: no key 'schedule\.max_stps'"):
        bench(["step", "--quick", "--out", str(tmp_path), "schedule.max_stps=3"])
    with pytest.raises(SystemExit) as ended:
        bench(["blend", "--quick", "--out", str(tmp_path), "seed=1"])
    assert ended.value.code == 2


def test_gpu_without_a_device_is_an_error_and_quick_is_not(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="no CUDA device"):
        bench(["gpu", "--out", str(tmp_path)])
    assert bench(["gpu", "--quick", "--out", str(tmp_path)]) == 0
    assert "no GPU timings" in capsys.readouterr().out
    monkeypatch.setattr(gpu, "run_gpu", lambda *arguments: False)
    assert bench(["gpu", "--quick", "--out", str(tmp_path)]) == 1


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no scene at"):
        trained_street(tmp_path)


@pytest.mark.slow
def test_the_street_of_a_run_is_what_the_run_renders(run_train, tmp_path):
    run = run_train(tmp_path / "run", "schedule.max_steps=20")
    street = trained_street(run)
    assert street.source.startswith("trained: run on ")
    assert not street.gaussians.means.requires_grad
    views = read_views(run / "views.json").all
    view = views[len(views) // 2]
    assert street.source.endswith(f"frame {view.frame_index}")
    with torch.no_grad():
        again = splat(street.gaussians, street.camera)
    assert torch.equal(again.rgb, load_scene(run).render(view).splats.rgb)  # without the sky
    assert float(again.alpha.mean()) > 0.2
