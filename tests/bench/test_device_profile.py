"""Times of kernels and stages from events of a profiler."""

from collections.abc import Callable

import pytest
import torch
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import DeviceType

from sparsestreet.bench import device_profile
from sparsestreet.bench.device_profile import numbered, short_name, stage_of


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


def test_peaks_are_megabytes_of_the_device(monkeypatch):
    log = []
    for name in ("synchronize", "empty_cache", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda name=name: log.append(name))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda: log.append("before") or 2_500_000)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: log.append("peak") or 7_000_000)
    assert device_profile.peak_megabytes(lambda: log.append("run")) == pytest.approx((2.5, 7.0))
    assert log == ["synchronize", "empty_cache", "reset_peak_memory_stats", "before", "run", "synchronize", "peak"]
