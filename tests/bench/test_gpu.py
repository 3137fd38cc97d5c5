"""The plumbing of device timings and of gsplat beside them, with a fake gsplat: no device needed."""

import dataclasses
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import DeviceType

from sparsestreet.bench import device_profile, gpu, gpu_record, gpu_step, gsplat_peer
from sparsestreet.bench.accuracy import Errors, GradientError, ImageError
from sparsestreet.bench.device_profile import DeviceProfile, numbered, short_name, stage_of
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.gpu_record import GpuRecord
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import BenchScene, Size
from sparsestreet.bench.tile_loads import TileLoads
from sparsestreet.bench.timing import TimeSpread, TimingBudget, leaves
from sparsestreet.ops import splat
from sparsestreet.ops.triton.tuning import Tuning, tuning
from sparsestreet.phases import WallClock
from sparsestreet.types import Camera, Gaussians
from tests.bench.test_records import PROVENANCE

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)
CPU = torch.device("cpu")
# What gsplat 1.5.3's rasterization takes, of which we use these.
TAKES = {
    *("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "near_plane"),
    *("eps2d", "sh_degree", "packed", "absgrad", "rasterize_mode"),
}


def fake_gsplat(brightness: float = 1.0) -> ModuleType:
    """A module with gsplat's signature that renders with our op."""

    def rasterization(**given):
        assert set(given) == TAKES
        assert given["viewmats"].shape == (1, 4, 4)
        assert given["Ks"].shape == (1, 3, 3)
        assert given["colors"].shape[1] == (given["sh_degree"] + 1) ** 2
        fields = ("means", "quats", "scales", "opacities", "colors")
        camera = Camera(given["viewmats"][0], given["Ks"][0], given["width"], given["height"])
        rendering = splat(Gaussians(*(given[name] for name in fields)), camera, settings=gsplat_peer.SETTINGS)

        class Means:
            absgrad = property(lambda self: rendering.screen_offsets.grad[None])

        radii = rendering.radii[None, :, None].expand(-1, -1, 2)
        # Six tiles of 16x16, of which the third and the last are empty.
        offsets = torch.tensor([[[0, 2, 3], [3, 4, 7]]], dtype=torch.int32)
        meta = {"flatten_ids": torch.zeros(7, dtype=torch.int32), "means2d": Means(), "radii": radii}
        meta |= {"isect_offsets": offsets}
        return brightness * rendering.rgb[None], rendering.alpha[None, ..., None], meta

    module = ModuleType("gsplat")
    vars(module).update(__version__="1.5.3", rasterization=rasterization)
    return module


@pytest.fixture
def rows() -> Gaussians:
    return leaves(frustum_gaussians(60, frustum_camera(48, 32), sigma_pixels=2.0, terms=9), torch.float32)


def test_the_same_image_agrees(rows):
    found = gsplat_peer.parity(fake_gsplat(), rows, frustum_camera(48, 32), "cpu")
    assert found.image.psnr is None
    assert gsplat_peer.agrees(found)
    assert rows.means.grad is None
    assert gsplat_peer.draw(fake_gsplat(), rows, frustum_camera(48, 32), packed=True)[2] == 7


def test_another_image_or_another_gradient_disagrees(rows):
    found = gsplat_peer.parity(fake_gsplat(brightness=1.02), rows, frustum_camera(48, 32), "cpu")
    assert not gsplat_peer.agrees(found)
    assert found.gradients["sh"].relative_l2 == pytest.approx(0.02, rel=1e-3)
    # A thousandth of the colors is within the limits.
    slight = gsplat_peer.parity(fake_gsplat(brightness=1.001), rows, frustum_camera(48, 32), "cpu")
    assert gsplat_peer.agrees(slight)


def test_a_gradient_alone_can_disagree():
    image = ImageError(0.0, 0.0, None)
    good, bad = GradientError(1e-3, 1e-3), GradientError(6e-3, 1e-3)
    assert gsplat_peer.agrees(Errors(image, {"means": good, "sh": good}))
    assert not gsplat_peer.agrees(Errors(image, {"means": good, "sh": bad}))
    assert not gsplat_peer.agrees(Errors(image, {"means": GradientError(None, None)}))


def test_settings_are_those_of_gsplat():
    assert (gsplat_peer.SETTINGS.stop, gsplat_peer.SETTINGS.alpha_max, gsplat_peer.SETTINGS.near_plane) == (
        "exclusive",
        0.999,
        0.01,
    )


def test_gsplat_is_looked_for_on_a_cuda_device_only(monkeypatch):
    assert "CUDA" in str(gsplat_peer.find_gsplat(CPU))
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)  # makes the import fail
    assert "cannot be imported" in str(gsplat_peer.find_gsplat(torch.device("cuda")))
    module = fake_gsplat()
    monkeypatch.setitem(__import__("sys").modules, "gsplat", module)
    assert gsplat_peer.find_gsplat(torch.device("cuda")) is module


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

        monkeypatch.setattr(device_profile, "profile", Profiler)
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
    found = device_profile.profiled(lambda: runs.append(1), repeats=4)
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
    found = device_profile.profiled(lambda: None, repeats=2)
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


def test_a_line_has_medians_and_spreads():
    value, single = TimeSpread(1.25, 1.0, 0.125, 20), TimeSpread(3.0, 3.0, None, 1)
    record = GpuRecord("sparsestreet triton", "a device", "random frustum", 7, 8, 9, forward=value, backward=single)
    record = dataclasses.replace(record, inference=value, stages={"sort": value, "other": single})
    text = gpu_record.line(record)
    assert "forward 1.250 (iqr 0.125)  backward 3.000  no grad 1.250 (iqr 0.125) ms" in text
    assert "[sort 1.250 (iqr 0.125), other 3.000]" in text


def test_a_device_without_a_fast_backend_is_not_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "resolve_backend", lambda name, device: "reference")
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a device")
    file, said = RecordFile(tmp_path / "g.jsonl", PROVENANCE), []
    assert not gpu.run_gpu([Size(48, 32, 60)], torch.device("cuda"), ONCE, file, said.append)
    assert read_records(file.path) == []
    assert any("install triton" in line for line in said)


@pytest.mark.parametrize("mode", gsplat_peer.MODES)
def test_what_gsplat_saw_is_of_all_rows(mode):
    """Packed answers are of the rows in view, here 3 and 1."""
    gradients, radii = torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([[5, 6], [8, 7]], dtype=torch.int32)
    if mode == "packed":
        meta = {"means2d": SimpleNamespace(absgrad=gradients), "radii": radii, "gaussian_ids": torch.tensor([3, 1])}
        wanted = torch.tensor([[0.0, 0.0], [3.0, 4.0], [0.0, 0.0], [1.0, 2.0]]), torch.tensor([0.0, 8.0, 0.0, 6.0])
    else:
        meta = {"means2d": SimpleNamespace(absgrad=gradients[None]), "radii": radii[None]}
        wanted = gradients, torch.tensor([6.0, 8.0])
    found = gsplat_peer.seen(meta, 4 if mode == "packed" else 2)
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))


def test_a_step_trains_all_fields_and_counts_the_view(rows):
    camera = frustum_camera(48, 32)
    step = gpu_step.TrainingStep(rows, camera, gpu_step.our_render(camera, "cpu"))
    before = [parameter.detach().clone() for parameter in step.parameters]
    step()
    assert all(bool((old != new).any()) for old, new in zip(before, step.parameters, strict=True))
    assert bool((step.statistics.gradient_sum > 0).any())
    assert all(parameter.grad is None for parameter in step.parameters)


def test_every_number_of_a_record_is_in_its_line():
    values = [TimeSpread(float(place), 0.5, None, 3) for place in range(1, 5)]
    record = GpuRecord("sparsestreet triton", "a device", "a street", 1234, 640, 480)
    assert gpu_record.line(dataclasses.replace(record, failed="RuntimeError: no")).split() == [
        *("sparsestreet", "triton", "a", "street", "1234", "640x480", "FAILED:", "RuntimeError:", "no"),
    ]
    inference, forward, backward, step = values
    record = dataclasses.replace(record, inference=inference, forward=forward, backward=backward)
    start = "sparsestreet triton     a street             1234 640x480    forward 2.000  backward 3.000"
    assert gpu_record.line(record) == f"{start}  no grad 1.000 ms"
    assert gpu_record.line(dataclasses.replace(record, inference=None)) == f"{start}  no grad - ms"
    assert gpu_record.line(dataclasses.replace(record, backward=None, failed="why")).endswith("FAILED: why")
    image = ImageError(0.1, 0.2, 61.25)
    whole = dataclasses.replace(
        record, step=step, pairs=2_500_000, samples=70_000_000, memory_before=10.0, memory_peak=345.0,
        parity=Errors(image, {}), agrees=True, failed="late",
    )  # fmt: skip
    assert gpu_record.line(whole) == (
        f"{start}  no grad 1.000 ms  step 4.000  2.50 M pairs, 70 M samples  peak     345 MB  agrees: 61.2 dB"
        "  FAILED: late"
    )
    busy = dataclasses.replace(whole, launches=31, waits=1, tiles=TileLoads(804.4, 421.5, 7925, 700, 2500, 1300))
    said = "  tiles 804 pairs, longest 7925, 700 split in 2500 parts"
    assert gpu_record.line(busy) == gpu_record.line(whole).replace(
        "  peak     345 MB", f"{said}  peak     345 MB  31 launches, 1 waits"
    )
    without = dataclasses.replace(whole, samples=None)
    assert gpu_record.line(without) == gpu_record.line(whole).replace(", 70 M samples", "")
    assert " M " not in gpu_record.line(dataclasses.replace(without, pairs=None))


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


def test_peaks_are_megabytes_of_the_device(monkeypatch):
    log = []
    for name in ("synchronize", "empty_cache", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda name=name: log.append(name))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda: log.append("before") or 2_500_000)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: log.append("peak") or 7_000_000)
    assert device_profile.peak_megabytes(lambda: log.append("run")) == pytest.approx((2.5, 7.0))
    assert log == ["synchronize", "empty_cache", "reset_peak_memory_stats", "before", "run", "synchronize", "peak"]


@pytest.mark.parametrize(
    ("failed", "agrees", "ok"), [(None, None, True), (None, True, True), (None, False, False), ("why", True, False)]
)
def test_a_failure_or_a_disagreement_is_not_ok(failed, agrees, ok):
    assert GpuRecord("r", "d", "s", 1, 2, 3, failed=failed, agrees=agrees).ok is ok
