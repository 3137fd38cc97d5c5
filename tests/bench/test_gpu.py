"""Device timings and gsplat beside them end to end, with a fake gsplat: no device needed."""

import time
from typing import Any

import pytest
import torch
import torch._dynamo  # the first optimizer imports it, in seconds that are no test's

from sparsestreet.bench import gpu, gpu_step, gsplat_peer
from sparsestreet.bench.device_profile import DeviceProfile
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.gpu_record import GpuRecord
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import BenchScene, Size
from sparsestreet.bench.timing import TimeSpread, TimingBudget
from sparsestreet.ops import splat
from sparsestreet.ops.triton.tuning import Tuning, tuning
from sparsestreet.phases import WallClock
from sparsestreet.types import Gaussians
from tests.bench.fake_gsplat import fake_gsplat
from tests.bench.test_records import PROVENANCE

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)
CPU = torch.device("cpu")


def test_both_renderers_get_a_record(tmp_path, monkeypatch):
    module = fake_gsplat()
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: module)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, said.append)
    records = read_records(file.path)
    assert [record["renderer"] for record in records] == [
        "sparsestreet cpu",
        "gsplat 1.5.3 packed",
        "gsplat 1.5.3 unpacked",
    ]
    for record in records:
        assert record["failed"] is None
        assert record["forward"]["median"] > 0
        assert record["inference"]["repeats"] == 1
        assert record["stages"] is None  # no device, no kernels
    assert [record["agrees"] for record in records] == [True] * 3
    assert [record["pairs"] for record in records[1:]] == [7, 7]
    assert [record["samples"] is None for record in records] == [False, True, True]
    # 2, 1, 0, 1, 3 and 0 pairs.
    said_of_theirs = {"mean": 1.16667, "median": 1.0, "longest": 3, "split": 0, "parts": 0, "longest_part": 0}
    assert [record["tiles"] for record in records] == [None, said_of_theirs, said_of_theirs]
    assert records[0]["samples"] > records[0]["pairs"] >= 60
    assert any("agrees: equal" in line for line in said)


@pytest.mark.lengthy
@pytest.mark.parametrize("slower", ["packed", "unpacked"])
def test_gsplats_faster_mode_is_used_after_the_first_size(tmp_path, monkeypatch, slower):
    module = fake_gsplat()

    def slow_in_one_mode(**given):
        if given["packed"] == (slower == "packed"):
            time.sleep(0.2)  # the image takes a few milliseconds
        return fake_gsplat().rasterization(**given)

    vars(module).update(rasterization=slow_in_one_mode)
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: module)
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)
    gpu.run_gpu([Size(48, 32, 60), Size(32, 32, 20), Size(32, 32, 30)], CPU, ONCE, file, lambda text: None)
    theirs = [record["renderer"] for record in read_records(file.path) if record["renderer"].startswith("gsplat")]
    faster = "unpacked" if slower == "packed" else "packed"
    assert theirs == [f"gsplat 1.5.3 {mode}" for mode in ("packed", "unpacked", faster, faster)]


def test_a_record_is_on_disk_before_the_next_is_measured(tmp_path, monkeypatch):
    module = fake_gsplat()
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)

    def cut_off(**given):
        raise KeyboardInterrupt

    vars(module).update(rasterization=cut_off)
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: module)
    with pytest.raises(KeyboardInterrupt):
        gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, lambda text: None)
    assert [record["renderer"] for record in read_records(file.path)] == ["sparsestreet cpu"]


def test_many_splats_are_not_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: fake_gsplat(brightness=0.5))
    monkeypatch.setattr(gpu, "TRUTH_ROWS", 59)
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, lambda text: None)
    assert [(record["parity"], record["agrees"]) for record in read_records(file.path)] == [(None, None)] * 3


def test_the_headline_comes_first():
    assert (gpu.IMAGES[0], gpu.ROWS[0]) == ((1920, 1280), 1_500_000)
    assert gpu.ROWS[0] <= gpu.TRUTH_ROWS


def test_a_peer_that_fails_is_on_record_and_ends_nothing(tmp_path, monkeypatch):
    module = fake_gsplat()

    def broken(**given):
        raise RuntimeError("no kernel image is available\nmore")

    vars(module).update(rasterization=broken)
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: module)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert not gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, said.append)
    ours, *theirs = read_records(file.path)
    assert ours["failed"] is None
    assert [record["failed"] for record in theirs] == ["RuntimeError: no kernel image is available"] * 2
    assert any("FAILED: RuntimeError" in line for line in said)


def test_a_peer_that_disagrees_is_a_failure(tmp_path, monkeypatch):
    module = fake_gsplat(brightness=0.9)
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: module)
    said: list[str] = []
    assert not gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, RecordFile(tmp_path / "g.jsonl", PROVENANCE), said.append)
    assert any("DISAGREES" in line for line in said)


def test_a_device_without_a_fast_backend_is_not_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "resolve_backend", lambda name, device: "reference")
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a device")
    file, said = RecordFile(tmp_path / "g.jsonl", PROVENANCE), []
    assert not gpu.run_gpu([Size(48, 32, 60)], torch.device("cuda"), ONCE, file, said.append)
    assert read_records(file.path) == []
    assert any("install triton" in line for line in said)


def test_a_step_trains_all_fields_and_counts_the_view(rows):
    camera = frustum_camera(48, 32)
    step = gpu_step.TrainingStep(rows, camera, gpu_step.our_render(camera, "cpu"))
    before = [parameter.detach().clone() for parameter in step.parameters]
    step()
    assert all(bool((old != new).any()) for old, new in zip(before, step.parameters, strict=True))
    assert bool((step.statistics.gradient_sum > 0).any())
    assert all(parameter.grad is None for parameter in step.parameters)


def test_every_choice_of_the_kernels_is_measured_as_it_says(tmp_path, monkeypatch):
    """Forward, backward, step and counts see it; gsplat is measured once."""
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: fake_gsplat())
    held = []
    counted = gpu.work_of

    def counts(*given: Any) -> tuple[int | None, int | None]:
        held.append(tuning())
        return counted(*given)

    monkeypatch.setattr(gpu, "work_of", counts)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    other = Tuning(most_parts=1)
    tunings = {"": Tuning(), "most_parts=1": other}
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, said.append, tunings=tunings)
    ours, changed, *theirs = read_records(file.path)
    assert (ours["renderer"], changed["renderer"]) == ("sparsestreet cpu", "sparsestreet cpu most_parts=1")
    assert (ours["tuning"], changed["tuning"]) == (vars(Tuning()), vars(other))
    assert [record["tuning"] for record in theirs] == [None, None]
    assert held == [Tuning(), other]
    assert tuning() == Tuning()


def test_a_record_is_of_its_workload(tmp_path, monkeypatch):
    """Two sizes and a street between them, each with its own scene, rows and image; wider than high, and higher."""
    monkeypatch.setattr(gsplat_peer, "find_gsplat", lambda device: "none")
    camera = frustum_camera(40, 56)
    street = BenchScene("a street", "of a run", frustum_gaussians(30, camera, sigma_pixels=2.0, terms=4), camera)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert gpu.run_gpu([Size(48, 32, 60), Size(32, 48, 20)], CPU, ONCE, file, said.append, [street])
    records = read_records(file.path)
    assert [(one["kind"], one["scene"], one["rows"], one["width"], one["height"]) for one in records] == [
        ("gpu", "random frustum", 60, 48, 32),
        ("gpu", "of a run", 30, 40, 56),
        ("gpu", "random frustum", 20, 32, 48),
    ]
    assert {one["device"] for one in records} == {"cpu: these are no GPU timings"}
    assert said[0] == "cpu: these are no GPU timings; backend cpu; none"
    assert said[-1] == "3 of 3 measured and in agreement"
    assert all(one["step"]["median"] > 0 and one["memory_peak"] is None for one in records)


def test_memory_and_stages_are_of_a_whole_step(rows, monkeypatch):
    """On a device: before and peak, in this order, and kernels of forward and backward."""
    camera = frustum_camera(48, 32)
    workload = gpu.Workload("a scene", rows, camera)
    monkeypatch.setattr(gpu.Workload, "device", torch.device("cuda"))
    monkeypatch.setattr(gpu, "clock_of", lambda device: WallClock())
    drawn = []

    def draw(given: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
        drawn.append(torch.is_grad_enabled())
        rendering = splat(given, camera, settings=gsplat_peer.SETTINGS)
        return rendering.rgb, rendering.alpha

    def run_once(step, answer):
        before = len(drawn)
        step()
        assert drawn[before:] == [True]
        assert rows.means.grad is None
        return answer

    time = TimeSpread(1.0, 1.0, None, 1)
    profile = DeviceProfile({"blend": time}, {"blend_tiles": time}, 7, 1)
    monkeypatch.setattr(gpu, "peak_megabytes", lambda step: run_once(step, (10.0, 30.0)))
    monkeypatch.setattr(gpu, "profiled", lambda step: run_once(step, profile))
    record = gpu.measure(GpuRecord("r", "d", "s", 60, 48, 32), draw, workload, ONCE)
    assert (record.memory_before, record.memory_peak) == (10.0, 30.0)
    assert (record.stages, record.kernels) == ({"blend": time}, {"blend_tiles": time})
    assert (record.launches, record.waits) == (7, 1)
    assert (record.forward.repeats, record.backward.repeats, record.inference.repeats) == (1, 1, 1)
    assert drawn.count(False) == 2  # without gradients: a warm-up and one that counts
    assert record.ok
