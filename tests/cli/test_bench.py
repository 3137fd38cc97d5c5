"""``sparsestreet bench``: modes, help, and the street of a run."""

import json
from pathlib import Path

import pytest
import torch

from sparsestreet.bench import blend, data, figures, gpu, knobs, masks, scaling, scenes, step, sweep
from sparsestreet.bench.refine import enlarged
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import TimingBudget
from sparsestreet.cli.commands import bench as cli_bench
from sparsestreet.cli.commands.bench import bench, trained_street
from sparsestreet.cli.runs import run as cli_step
from sparsestreet.geometry.cameras import project
from sparsestreet.ops import splat
from sparsestreet.ops.triton.tuning import Tuning
from sparsestreet.records.provenance import this_machine, this_source
from sparsestreet.scene.storage import load_scene, save_scene
from sparsestreet.scene.views import read_views, write_views
from tests.export.street import stored_street, street_views


def test_help_teaches_by_example(capsys):
    with pytest.raises(SystemExit) as ended:
        bench(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(
        f"sparsestreet bench {mode}" in text for mode in ("knobs", "blend", "step", "data", "masks", "scaling", "gpu")
    )


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
    monkeypatch.setattr(gpu, "run_gpu", lambda *arguments, **named: False)
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


@pytest.fixture
def handed(monkeypatch):
    """What each mode hands to its measurement, which is replaced: positional and named arguments."""
    given = {}

    def replaced(module, name, answer):
        monkeypatch.setattr(module, name, lambda *args, **named: given.update({name: (args, named)}) or answer)

    for module, name in (
        (sweep, "run_sweep"),
        (blend, "run_blend"),
        (masks, "run_masks"),
        (data, "run_data"),
        (scaling, "run_scaling"),
    ):
        replaced(module, name, None)
    replaced(gpu, "run_gpu", True)
    replaced(step, "run_step", None)
    monkeypatch.setattr(
        figures, "draw_pareto", lambda records, folder: given.update(drawn=(records, folder)) or ["a.svg"]
    )
    monkeypatch.setattr(cli_bench, "trained_street", lambda run: given.update(street=run) or "the street")
    monkeypatch.setattr(scenes, "bench_scenes", lambda *given: ("scenes", *given))
    return given


TRIAL = TimingBudget(repeats=2, least=1)


@pytest.mark.parametrize(
    ("words", "name", "expected"),
    [
        (["knobs"], "run_sweep", (("scenes", sweep.FULL, None), ("scenes", sweep.SMALL), knobs.points(), sweep.BUDGET)),
        (["--quick", "--street", "RUN"], "run_sweep",
         (("scenes", sweep.QUICK, "the street"), ("scenes", sweep.SMALL), knobs.points(), sweep.QUICK_BUDGET)),
        (["blend"], "run_blend", (blend.MAIN, blend.TRAINING, TimingBudget(20, 10.0, 3), TimingBudget(3, 10.0, 3))),
        (["blend", "--quick"], "run_blend", (Size(64, 48, 300), [Size(48, 32, 200)], TRIAL, TRIAL)),
        (["masks"], "run_masks", ((5_000, 50_000), 150, TimingBudget(100, 10.0, 3))),
        (["masks", "--quick"], "run_masks", ((100,), 150, TRIAL)),
        (["scaling"], "run_scaling", (scaling.ROWS, scaling.LARGE, TimingBudget(seconds=15.0, least=5))),
        (["scaling", "--quick"], "run_scaling", ((200, 400, 800), None, TRIAL)),
        (["gpu"], "run_gpu",
         ([Size(w, h, rows) for w, h in gpu.IMAGES for rows in gpu.ROWS], torch.device("cuda"), gpu.BUDGET)),
        (["gpu", "--quick"], "run_gpu", ([Size(64, 48, 500)], torch.device("cuda"), TRIAL)),
        (["step", "seed=3"], "run_step", ("train seed=3", "trains", step.FULL)),
        (["step", "seed=3", "--quick"], "run_step", ("train seed=3", "trains", step.QUICK)),
    ],
)  # fmt: skip
def test_a_mode_hands_on_what_it_is_told(handed, monkeypatch, tmp_path, words, name, expected):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    trained = []
    monkeypatch.setattr(
        cli_step, "train_with", lambda overrides, folder: trained.append((overrides, folder)) or "trains"
    )
    assert bench([*words, "--out", str(tmp_path / "o")]) == 0
    args, named = handed[name]
    assert args[: len(expected)] == expected
    mode = words[0] if not words[0].startswith("-") else "knobs"
    file, *folder = args[len(expected) :]
    assert file.path == tmp_path / "o" / f"{mode}.jsonl"
    assert folder == ([tmp_path / "o"] if mode in ("scaling", "step") else [])
    assert named == ({"streets": [], "tunings": gpu.DEFAULT} if words[0] == "gpu" else {})
    if mode == "knobs":
        assert handed["drawn"] == ([], tmp_path / "o")
        assert handed.get("street") == (Path("RUN") if "--street" in words else None)
    if mode == "step":
        ((overrides, _),) = trained
        assert overrides == ["seed=3"]


def test_a_street_is_beside_the_sizes_of_a_gpu(handed, monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cli_bench, "front_streets", lambda *given: [given])
    for words, refine, enlarge in (([], 1, 1), (["--quick", "--refine", "3"], 3, 1), (["--enlarge", "2"], 1, 2)):
        assert bench(["gpu", "--street", "RUN", *words, "--out", str(tmp_path)]) == 0
        (sizes, *_), named = handed["run_gpu"]
        assert named["streets"] == [(Path("RUN"), refine, enlarge)]
        assert bool(sizes) == (enlarge == 1)  # larger images are of the street alone


def test_other_choices_of_the_kernels_are_beside_todays(handed, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    words = ["--tuning", "most_parts=1,two_launches=false", "--tuning", "shortest_part=64"]
    assert bench(["gpu", *words, "--out", str(tmp_path)]) == 0
    today, whole, short = handed["run_gpu"][1]["tunings"].items()
    assert today == ("", Tuning())
    assert whole == (words[1], Tuning(most_parts=1, two_launches=False))
    assert short == (words[3], Tuning(shortest_part=64))
    with pytest.raises(SystemExit, match="bench gpu: no choice 'most_part' of the kernels: name one of most_parts, "):
        bench(["gpu", "--tuning", "most_part=1"])
    for wrong, said in (("most_parts=many", "most_parts is a number, got 'many'"), ("most_parts=0", "at least 1 part"),
                        ("two_launches=1", "two_launches is true or false, got '1'")):  # fmt: skip
        with pytest.raises(SystemExit, match=said):
            bench(["gpu", "--tuning", wrong])
    with pytest.raises(SystemExit) as ended:
        bench(["knobs", "--tuning", "most_parts=1"])
    assert ended.value.code == 2


@pytest.mark.parametrize("flag", ["--refine", "--enlarge"])
@pytest.mark.parametrize("words", [["gpu"], ["knobs", "--street", "RUN"], ["gpu", "--street", "RUN", "0"]])
def test_only_the_street_of_a_gpu_is_refined(words, flag, capsys):
    *words, number = [*words] if words[-1] == "0" else [*words, "3"]
    with pytest.raises(SystemExit) as ended:
        bench([*words, flag, number])
    assert ended.value.code == 2
    assert f"{flag} N, at least 1" in capsys.readouterr().err


def made_street(folder: Path) -> Path:
    """A run of 37 splats, four cameras, five frames, of which the front camera's third is held out."""
    save_scene(folder / "scene.safetensors", stored_street())
    views = street_views()
    write_views(folder / "views.json", [*views[:8], *views[9:]], [views[8]])
    return folder


def test_the_front_camera_sees_the_first_frame_and_the_middle_one(tmp_path):
    run = made_street(tmp_path / "run")
    streets, stored = cli_bench.front_streets(run, 3), load_scene(run)
    views = [view for view in read_views(run / "views.json").all if view.camera_index == 0]
    for street, view in zip(streets, (views[0], views[2]), strict=True):
        assert street.source == f"trained: run on hand-made, frame {view.frame_index}, refined 3x3"
        assert len(street.gaussians) == 9 * len(stored.scene.gaussians_at(view).gaussians)
        assert (street.camera.width, street.camera.height) == (3 * view.camera.width, 3 * view.camera.height)
        assert torch.equal(street.camera.camera_from_world, view.camera.camera_from_world)
    assert [street.source.split(", ")[1] for street in streets] == ["frame 0", "frame 2"]


def test_a_street_comes_once_more_in_larger_images(tmp_path):
    first, middle, *larger = cli_bench.front_streets(made_street(tmp_path / "run"), 1, 2)
    for street, wide in zip((first, middle), larger, strict=True):
        assert wide.gaussians is street.gaussians
        assert (wide.camera.width, wide.camera.height) == (2 * street.camera.width, 2 * street.camera.height)
        pixels, depths, _ = project(street.camera, street.gaussians.means)
        seen = depths > 0
        torch.testing.assert_close(project(wide.camera, street.gaussians.means)[0][seen], 2 * pixels[seen])
    with pytest.raises(ValueError, match="factor of at least 1, got 0"):
        enlarged(first, 0)


@pytest.mark.lengthy
def test_a_dry_run_of_a_refined_street(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    run = made_street(tmp_path / "run")
    words = ["gpu", "--quick", "--street", str(run), "--refine", "3", "--out", str(tmp_path)]
    assert bench(words) == 0
    records = [json.loads(line) for line in (tmp_path / "gpu.jsonl").read_text().splitlines()]
    assert [record["scene"].split(", ")[-1] for record in records] == ["random frustum", "refined 3x3", "refined 3x3"]
    # The tram has left at frame 3, not at 0 and 2.
    assert [(record["rows"], record["width"], record["height"]) for record in records[1:]] == [(333, 144, 96)] * 2
    for record in records:
        assert record["failed"] is None
        assert record["pairs"] > 0
        assert [record[name] for name in ("kernels", "launches", "waits", "tiles")] == [None] * 4  # of a device


def test_a_drive_is_made_up_beside_the_records(handed, tmp_path):
    for words, drive in (([], data.FULL), (["--quick"], data.QUICK)):
        assert bench(["data", *words, "--out", str(tmp_path)]) == 0
        (given, folder, file), _ = handed["run_data"]
        assert (given, folder, file.path) == (drive, tmp_path, tmp_path / "data.jsonl")
    assert (data.FULL.images, data.FULL.width, data.FULL.height, data.STEP_MS) == (200, 1920, 1280, 5.0)


def test_threads_and_words_stand_in_the_record(handed, monkeypatch, tmp_path):
    before = torch.get_num_threads()
    numbers = []
    monkeypatch.setattr(torch, "set_num_threads", numbers.append)
    bench(["masks", "--threads", str(before + 1), "--out", str(tmp_path / "a b")])
    assert numbers == [before + 1]
    provenance = handed["run_masks"][0][3]._provenance
    assert provenance.command == f"sparsestreet bench masks --threads {before + 1} --out '{tmp_path / 'a b'}'"
    assert (provenance.threads, provenance.machine, provenance.source) == (before, this_machine(), this_source())
    numbers.clear()
    bench(["masks", "--out", str(tmp_path)])
    assert numbers == []


def test_the_street_of_a_run_is_the_view_in_its_middle(tmp_path):
    """Of five frames and four cameras, 20 views, in their order: the eleventh."""
    save_scene(tmp_path / "run" / "scene.safetensors", stored_street())
    views = street_views()
    write_views(tmp_path / "run" / "views.json", views[:15], views[15:])
    street, stored = trained_street(tmp_path / "run"), load_scene(tmp_path / "run")
    middle = read_views(tmp_path / "run" / "views.json").all[10]
    assert (street.name, street.source) == (
        "trained street", f"trained: run on {stored.name}, frame {middle.frame_index}",
    )  # fmt: skip
    assert torch.equal(street.camera.camera_from_world, middle.camera.camera_from_world)
    assert torch.equal(street.gaussians.means, stored.scene.gaussians_at(middle).gaussians.means)
    assert not street.gaussians.means.requires_grad
