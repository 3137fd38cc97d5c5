"""Device timings and gsplat beside them end to end, with a fake gsplat: no device needed."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch._dynamo  # the first optimizer imports it, in seconds that are no test's
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import DeviceType

from benchmarks import gpu, gsplat_baseline
from benchmarks.gpu import DeviceProfile, GpuRecord, numbered, short_name, stage_of
from sparsestreet.bench.accuracy import Errors, ImageError
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import BenchScene, Size, frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import TimeSpread, TimingBudget
from sparsestreet.ops import splat
from sparsestreet.phases import WallClock
from sparsestreet.types import Gaussians
from tests.bench.fake_gsplat import fake_gsplat
from tests.bench.test_records import PROVENANCE

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)
CPU = torch.device("cpu")
SETTINGS = gsplat_baseline.settings_beside(None)


def test_both_renderers_get_a_record(tmp_path, monkeypatch):
    module = fake_gsplat()
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: module)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, said.append)
    records = read_records(file.path)
    renderers = ["sparsestreet cpu", "gsplat 1.5.3 packed", "gsplat 1.5.3 unpacked"]
    assert [record["renderer"] for record in records] == renderers
    for record in records:
        assert record["failed"] is None
        assert record["forward"]["median"] > 0
        assert record["inference"]["repeats"] == 1
        assert record["stages"] is None  # no device, no kernels
    assert [record["agrees"] for record in records] == [True] * 3
    assert [record["pairs"] for record in records[1:]] == [7, 7]
    assert [record["samples"] is None for record in records] == [False, True, True]
    assert records[0]["samples"] > records[0]["pairs"] >= 60
    assert any("agrees: equal" in line for line in said)


@pytest.mark.lengthy
@pytest.mark.parametrize(("slower", "first"), [("packed", "ours"), ("unpacked", "ours"), ("unpacked", "gsplat")])
def test_gsplats_faster_mode_is_used_after_the_first_size(tmp_path, monkeypatch, slower, first):
    module = fake_gsplat()

    def slow_in_one_mode(**given):
        if given["packed"] == (slower == "packed"):
            time.sleep(0.2)  # the image takes a few milliseconds
        return fake_gsplat().rasterization(**given)

    vars(module).update(rasterization=slow_in_one_mode)
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: module)
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)
    sizes = [Size(48, 32, 60), Size(32, 32, 20), Size(32, 32, 30)]
    gpu.run_gpu(sizes, CPU, ONCE, file, lambda text: None, first=first)
    measured = [record["renderer"] for record in read_records(file.path)]
    assert measured.index("sparsestreet cpu") == (0 if first == "ours" else 2)
    theirs = [renderer for renderer in measured if renderer.startswith("gsplat")]
    faster = "unpacked" if slower == "packed" else "packed"
    assert theirs == [f"gsplat 1.5.3 {mode}" for mode in ("packed", "unpacked", faster, faster)]


def test_a_record_is_on_disk_before_the_next_is_measured(tmp_path, monkeypatch):
    module = fake_gsplat()
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)

    def cut_off(**given):
        raise KeyboardInterrupt

    vars(module).update(rasterization=cut_off)
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: module)
    with pytest.raises(KeyboardInterrupt):
        gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, lambda text: None)
    assert [record["renderer"] for record in read_records(file.path)] == ["sparsestreet cpu"]


def test_many_splats_are_not_compared(tmp_path, monkeypatch):
    assert gpu.ROWS[0] <= gpu.TRUTH_ROWS  # the headline is
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: fake_gsplat(brightness=0.5))
    monkeypatch.setattr(gpu, "TRUTH_ROWS", 59)
    file = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE)
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, lambda text: None)
    assert [(record["parity"], record["agrees"]) for record in read_records(file.path)] == [(None, None)] * 3
    monkeypatch.setattr(gpu, "TRUTH_ROWS", 60)
    assert gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, compares=False)
    assert not gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file)


def test_a_peer_that_fails_is_on_record_and_ends_nothing(tmp_path, monkeypatch):
    module = fake_gsplat()

    def broken(**given):
        raise RuntimeError("no kernel image is available\nmore")

    vars(module).update(rasterization=broken)
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: module)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert not gpu.run_gpu([Size(48, 32, 60)], CPU, ONCE, file, said.append)
    ours, *theirs = read_records(file.path)
    assert ours["failed"] is None
    assert [record["failed"] for record in theirs] == ["RuntimeError: no kernel image is available"] * 2
    assert any("FAILED: RuntimeError" in line for line in said)


def test_a_peer_that_disagrees_is_a_failure(tmp_path, monkeypatch):
    module = fake_gsplat(brightness=0.9)
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: module)
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
    step = gpu.TrainingStep(rows, camera, gpu.our_render(camera, SETTINGS, "cpu"))
    before = [parameter.detach().clone() for parameter in step.parameters]
    step()
    assert all(bool((old != new).any()) for old, new in zip(before, step.parameters, strict=True))
    assert bool((step.statistics.gradient_sum > 0).any())
    assert all(parameter.grad is None for parameter in step.parameters)


def test_a_record_is_of_its_workload(tmp_path, monkeypatch):
    """A street and two sizes behind it, each with its own scene, rows and image; wider than high, and higher."""
    monkeypatch.setattr(gsplat_baseline, "find_gsplat", lambda device: "none")
    camera = frustum_camera(40, 56)
    street = BenchScene("a street", "of a run", frustum_gaussians(30, camera, sigma_pixels=2.0, terms=4), camera)
    file, said = RecordFile(tmp_path / "gpu.jsonl", PROVENANCE), []
    assert gpu.run_gpu([Size(48, 32, 60), Size(32, 48, 20)], CPU, ONCE, file, said.append, [street])
    records = read_records(file.path)
    assert [(one["kind"], one["scene"], one["rows"], one["width"], one["height"]) for one in records] == [
        ("gpu", "of a run", 30, 40, 56),
        ("gpu", "random frustum", 60, 48, 32),
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
        rendering = splat(given, camera, settings=SETTINGS)
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


def test_every_number_of_a_record_is_in_its_line():
    values = [TimeSpread(float(place), 0.5, None, 3) for place in range(1, 5)]
    record = GpuRecord("sparsestreet triton", "a device", "a street", 1234, 640, 480)
    assert gpu.line(dataclasses.replace(record, failed="RuntimeError: no")).split() == [
        *("sparsestreet", "triton", "a", "street", "1234", "640x480", "FAILED:", "RuntimeError:", "no"),
    ]
    inference, forward, backward, step = values
    record = dataclasses.replace(record, inference=inference, forward=forward, backward=backward)
    start = "sparsestreet triton     a street             1234 640x480    forward 2.000  backward 3.000"
    assert gpu.line(record) == f"{start}  no grad 1.000 ms"
    assert gpu.line(dataclasses.replace(record, inference=None)) == f"{start}  no grad - ms"
    assert gpu.line(dataclasses.replace(record, backward=None, failed="why")).endswith("FAILED: why")
    image = ImageError(0.1, 0.2, 61.25)
    whole = dataclasses.replace(
        record, step=step, pairs=2_500_000, samples=70_000_000, memory_before=10.0, memory_peak=345.0,
        parity=Errors(image, {}), agrees=True, failed="late",
    )  # fmt: skip
    assert gpu.line(whole) == (
        f"{start}  no grad 1.000 ms  step 4.000  2.50 M pairs, 70 M samples  peak     345 MB  agrees: 61.2 dB"
        "  FAILED: late"
    )
    busy = dataclasses.replace(
        whole, launches=31, waits=1, stages={"sort": TimeSpread(1.25, 1.0, 0.125, 20), "x": step}
    )
    said = "  peak     345 MB  31 launches, 1 waits  [sort 1.250 (1.000), x 4.000]"
    assert gpu.line(busy) == gpu.line(whole).replace("  peak     345 MB", said)
    without = dataclasses.replace(whole, samples=None)
    assert gpu.line(without) == gpu.line(whole).replace(", 70 M samples", "")
    assert " M " not in gpu.line(dataclasses.replace(without, pairs=None))


@pytest.mark.parametrize(
    ("failed", "agrees", "ok"), [(None, None, True), (None, True, True), (None, False, False), ("why", True, False)]
)
def test_a_failure_or_a_disagreement_is_not_ok(failed, agrees, ok):
    assert GpuRecord("r", "d", "s", 1, 2, 3, failed=failed, agrees=agrees).ok is ok


@pytest.mark.parametrize(
    ("kernel", "stage"),
    [
        ("project_rows", "project"),
        ("project_rows_backward", "project_backward"),
        ("sum_slots", "project_backward"),
        ("blend_tiles", "blend"),
        ("blend_tiles_backward", "blend_backward"),
        ("list_pairs", "bin"),
        ("void at_cuda_detail::cub::DeviceRadixSortOnesweepKernel<...>", "sort"),
        ("void at::native::(anonymous namespace)::searchsorted_cuda_kernel<long, int>(...)", "bin"),
        ("thin_parts", "blend"),
        ("compose_pixels", "blend"),
        ("decompose_pixels", "other"),
        ("Memset (Device)", "other"),
        # gsplat 1.5.3
        ("void gsplat::projection_ewa_3dgs_fused_fwd_kernel<float>(...)", "project"),
        ("void gsplat::projection_ewa_3dgs_packed_bwd_kernel<float>(...)", "project_backward"),
        ("void gsplat::spherical_harmonics_fwd_kernel<float>(...)", "project"),
        ("void gsplat::spherical_harmonics_bwd_kernel<float>(...)", "project_backward"),
        ("void gsplat::quat_scale_to_covar_preci_bwd_kernel<float>(...)", "project_backward"),
        ("void gsplat::intersect_tile_kernel<float>(...)", "bin"),
        ("void gsplat::intersect_offset_kernel(...)", "bin"),
        ("void gsplat::rasterize_to_pixels_3dgs_fwd_kernel<3u, float>(...)", "blend"),
        ("void gsplat::rasterize_to_pixels_3dgs_bwd_kernel<3u, float>(...)", "blend_backward"),
    ],
)
def test_kernels_belong_to_stages(kernel, stage):
    assert stage_of(kernel) == stage


def event(name: str, start: float, microseconds: float, device: DeviceType = DeviceType.CUDA) -> FunctionEvent:
    return FunctionEvent(0, name, 0, start, start + microseconds, device_type=device)


@pytest.fixture
def profiles(monkeypatch):
    """A profiler: the events of each run, and how many there were."""
    runs: list[int] = []

    def install(events_of: Callable[[int], list[FunctionEvent]]) -> list[int]:
        class Profiler:
            def __init__(self, activities: list) -> None: ...

            def __enter__(self) -> "Profiler":
                return self

            def __exit__(self, *error: object) -> None: ...

            def events(self) -> list[FunctionEvent]:
                return events_of(len(runs) - 1)

        monkeypatch.setattr(gpu, "profile", Profiler)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
        return runs

    return install


def test_device_time_of_the_stages_and_its_spread(profiles):
    def events(run: int) -> list[FunctionEvent]:
        """The first run takes a second, then 2, 4, 3 and 9 ms, of which 1 ms is another kernel's."""
        milliseconds = [1000.0, 2.0, 4.0, 3.0, 9.0][run]
        return [
            event("blend_tiles", 0, 1000.0 * (milliseconds - 1)),
            event("raster_more", 1, 1000.0),
            *([event("project_rows", 2, 500.0)] if run > 1 else []),
            event("blend_tiles", 3, 9000.0, DeviceType.CPU),  # the launch: not a time of the device
        ]

    runs = profiles(events)
    found = gpu.profiled(lambda: runs.append(1), repeats=4)
    assert len(runs) == 5  # the first does not count: kernels are compiled
    assert list(found.stages) == ["blend", "project"]
    # Quartiles of 2, 3, 4, 9, linear between samples: 2.75 and 5.25.
    blend = found.stages["blend"]
    assert (blend.median, blend.minimum, blend.iqr) == pytest.approx((3.5, 2.0, 2.5))
    # A run without the kernel counts as zero: 0, 0.5, 0.5, 0.5.
    project = found.stages["project"]
    assert (project.median, project.minimum, project.repeats) == (pytest.approx(0.5), 0.0, 4)
    assert list(found.kernels) == ["blend_tiles", "raster_more", "project_rows"]
    assert found.kernels["blend_tiles"].median == pytest.approx(2.5)  # of 1, 3, 2, 8


def test_times_by_the_names_of_kernels_launches_and_waits(profiles):
    sort = "void cub::DeviceRadixSortOnesweepKernel<P, int>(int)"
    host = DeviceType.CPU
    given = [
        event("blend_tiles", 40.0, 300.0),  # the second launch, of parts
        event("blend_tiles", 10.0, 100.0),
        event("thin_parts", 30.0, 200.0),
        event(sort, 3.0, 7.0),
        event(sort, 4.0, 8.0),
        event("Memcpy DtoH (Device -> Pageable)", 5.0, 2.0),
        *(event(name, 0.0, 50.0, host) for name in ("cudaStreamSynchronize", "cudaLaunchKernel", "aten::item")),
        event("cudaDeviceSynchronize", 99.0, 50.0, host),  # of the measurement
    ]
    profiles(lambda run: given)
    found = gpu.profiled(lambda: None, repeats=2)
    assert {name: round(1e3 * times.median, 6) for name, times in found.kernels.items()} == {
        "cub::DeviceRadixSortOnesweepKernel": 15.0,
        "Memcpy DtoH": 2.0,
        "blend_tiles": 100.0,
        "thin_parts": 200.0,
        "blend_tiles 2": 300.0,
    }
    assert {name: round(1e3 * times.median, 6) for name, times in found.stages.items()} == {
        "sort": 15.0, "other": 2.0, "blend": 600.0,
    }  # fmt: skip
    assert (found.launches, found.waits) == (6, 1)


@pytest.mark.parametrize(
    ("kernel", "name"),
    [
        ("blend_tiles", "blend_tiles"),
        ("void at::native::(anonymous namespace)::search_kernel<long, int>(long*, int)", "native::search_kernel"),
        ("void gsplat::raster_fwd_kernel<3u, float>(f<g<int> >(*)(int))", "gsplat::raster_fwd_kernel"),
        ("Memset (Device)", "Memset"),
        ("()", "()"),
    ],
)  # fmt: skip
def test_names_of_kernels_are_short(kernel, name):
    assert short_name(kernel) == name
    assert numbered([event(kernel, 0, 1)] * 2)[1] == (f"{name} 2" if kernel == "blend_tiles" else name)


def test_peaks_are_megabytes_of_the_device(monkeypatch):
    log = []
    for name in ("synchronize", "empty_cache", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda name=name: log.append(name))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda: log.append("before") or 2_500_000)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: log.append("peak") or 7_000_000)
    assert gpu.peak_megabytes(lambda: log.append("run")) == pytest.approx((2.5, 7.0))
    assert log == ["synchronize", "empty_cache", "reset_peak_memory_stats", "before", "run", "synchronize", "peak"]


def test_without_a_device_quick_runs_and_the_rest_is_an_error(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu.main([f"out={tmp_path}"]) == 1
    assert "no CUDA device is available: quick=true" in capsys.readouterr().err
    assert gpu.main(["enlarge=2"]) == 2
    assert gpu.main(["quick=true", f"out={tmp_path}"]) == 0
    assert "no GPU timings" in capsys.readouterr().out
    monkeypatch.setattr(gpu, "run_gpu", lambda *arguments, **named: False)
    assert gpu.main(["quick=true", f"out={tmp_path}"]) == 1


def test_a_street_comes_first_as_large_as_asked_and_sizes_are_those_named(tmp_path, monkeypatch):
    given = {}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    def run_gpu(sizes, device, budget, file, *, streets, first, compares):
        given.update(sizes=len(sizes), streets=streets, how=(first, compares))
        return True

    monkeypatch.setattr(gpu, "run_gpu", run_gpu)
    monkeypatch.setattr(gpu, "front_streets", lambda *words: [words])
    for words, sizes, factors, how in (
        ([], 10, (1, 1), ("ours", True)),
        (["enlarge=2", "refine=3", "rows=7", "first=gsplat", "compares=false"], 2, (2, 3), ("gsplat", False)),
    ):
        assert gpu.main(["street=RUN", *words, f"out={tmp_path}"]) == 0
        assert given == {"sizes": sizes, "streets": [(Path("RUN"), *factors)], "how": how}
