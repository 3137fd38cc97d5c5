"""The way from a call of the op to its launches, as on a device: Triton's own, with a driver that runs nothing."""

from collections import Counter
from types import SimpleNamespace

import pytest
import torch
from triton import knobs
from triton.compiler import CompiledKernel
from triton.runtime.jit import KernelInterface

from sparsestreet.ops.triton import launch
from tests.ops.triton.launch_alike import KINDS
from tests.ops.triton.recording import run_compiler

FORWARD = [
    "project_rows", "list_visible", "list_pairs", "bound_tiles", "order_tiles", "blend_tiles",
    "blend_tiles", "compose_pixels",
]  # fmt: skip
BACKWARD = ["decompose_pixels", "blend_tiles_backward", "sum_slots", "project_rows_backward"]
CALLS, LAUNCHES, PYTHON = 25, 8, 240
"""Most calls of torch in a forward pass with a background, allocations and views too, most launches, and most calls of
Python's functions."""
CASE = {"terms": 1, "pairs": 100_003, "background": True}
DAILY = CASE | {"width": 1920, "height": 1280}
SLOW = [
    CASE | {"width": 1600, "height": 900, "terms": 16},
    CASE | {"width": 16, "height": 16, "pairs": 1},
    CASE | {"width": 1, "height": 1, "terms": 4, "background": False},
    # More tiles than 16 bits count.
    CASE | {"width": 5001, "height": 3003, "pairs": 1 << 20},
]


def expected(kernel: str, width: int, height: int) -> dict[str, str]:
    """What is known of the sizes that a kernel gets; of all other numbers, which change from view to view, nothing."""
    if kernel in ("blend_tiles", "blend_tiles_backward"):
        return {}
    sizes = {"width": width, "height": height, "tiles_x": -(-width // 16)}
    return {name: "1" if size == 1 else "16" if size % 16 == 0 else "" for name, size in sizes.items()}


def check(case: dict, found: dict) -> None:
    split = case["pairs"] > 1
    names = [*FORWARD, *BACKWARD] if split else [n for n in [*FORWARD, *BACKWARD] if "parts" not in n]
    assert {kernel["name"] for kernel in found["compiled"]} <= set(names)
    for kernel in found["compiled"]:
        sizes = expected(kernel["name"], case["width"], case["height"])
        # As in test_machine_code.py: the forward blend spills outside of its loop.
        assert kernel["spilled"] <= 8 * (kernel["name"] == "blend_tiles"), kernel
        assert kernel["tensor_core"] == kernel["atomics"] == 0, kernel
        assert kernel["shared"] <= 48 << 10, kernel
        # One number for each row, which fits 32 bits.
        assert kernel["types"].get("places", "*i32") == "*i32"
        for name, known in kernel["known"].items():
            kind = kernel["types"][name]
            wanted = "16" if kind.startswith("*") else "" if kind.startswith("fp") else sizes.get(name, "")
            assert known == wanted, (kernel["name"], name)


@pytest.mark.slow
def test_every_kernel_compiles_as_it_is_launched():
    (found,) = run_compiler("launch_offline", [DAILY])
    check(DAILY, found)
    assert found["forward"] == FORWARD
    assert [kernel["name"] for kernel in found["compiled"]] == [*FORWARD, *BACKWARD]
    assert len(found["calls"]) <= CALLS, Counter(found["calls"])
    assert len(found["forward"]) <= LAUNCHES
    assert found["python"] <= PYTHON
    # What torch starts on the device, but for views and bare allocations.
    assert Counter(found["dispatches"]) == Counter(["sort"] * 2 + ["cumsum"] * 2 + ["index_select", "new_full"])
    assert found["after_wait"] == []


@pytest.mark.slow
def test_every_kernel_compiles_for_other_sizes():
    for case, found in zip(SLOW, run_compiler("launch_offline", SLOW), strict=True):
        check(case, found)
        assert len(found["dispatches"]) <= 6


@pytest.fixture(scope="module")
def launched() -> dict[str, list[dict]]:
    """By version of Triton: what each launch got."""
    # An unknown one first: what a known one has bound is not bound again.
    return run_compiler("launch_alike", {"3.12.0": ["plain", "plain"], "": [*KINDS] * 3})


@pytest.fixture(scope="module")
def alike(launched) -> dict[str, list[dict]]:
    """By kind: what each of its three launches got. Each of them is found in another way."""
    return {name: launched[""][i :: len(KINDS)] for i, name in enumerate(KINDS)}


KNOWN = {"to": "16", "values": "16", "factor": "", "count": ""}
TYPES = ["*fp32", "*fp32", "i32", "i32"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "known", "types"),
    [
        ("plain", {}, {}),
        ("another plain", {}, {}),
        ("unaligned target", {"to": ""}, {}),
        ("unaligned source", {"values": ""}, {}),
        ("doubles", {}, {1: "*fp64"}),
        ("one", {"factor": "1"}, {2: "constexpr"}),
        ("sixteens", {"factor": "16"}, {}),
        ("zero", {"factor": "16"}, {}),
        ("long", {}, {2: "i64"}),
        ("least int", {"factor": "16"}, {}),
        ("long sixteens", {"factor": "16"}, {2: "i64"}),
        ("float", {}, {2: "fp32"}),
        ("count of one", {}, {}),
    ],
)
def test_a_launch_gets_the_kernel_of_its_arguments(alike, name, known, types):
    wanted = [types.get(i, kind) for i, kind in enumerate(TYPES)]
    for found in alike[name]:
        assert found["known"] == KNOWN | known
        assert found["types"] == [kind for kind in wanted if kind != "constexpr"]


@pytest.mark.slow
def test_only_the_first_of_launches_alike_is_bound(alike):
    assert alike["plain"][0]["bound"]
    assert not alike["another plain"][0]["bound"]
    assert not any(later["bound"] for _, *others in alike.values() for later in others)


@pytest.mark.slow
def test_what_is_no_argument_is_part_of_the_kernel_too(alike):
    codes = {
        alike[name][i]["code"] for name in ("plain", "other constant", "other block", "other options") for i in range(3)
    }
    assert len(codes) == 4
    # A count is not specialized, so what it is compiles nothing.
    assert alike["count of one"][0]["code"] == alike["plain"][0]["code"]


@pytest.mark.slow
def test_an_unknown_triton_binds_every_launch(launched):
    assert [found["bound"] for found in launched["3.12.0"]] == [True, True]


def test_an_unknown_triton_is_named():
    with pytest.warns(UserWarning, match=r"Triton 3\.70\.0 is not among .*3\.6\.x, 3\.7\.x"):
        assert not launch._is_known("3.70.0")
    assert launch._is_known("3.6.0")
    assert launch._is_known("3.7.1")


def test_other_arguments_are_refused():
    with pytest.raises(TypeError, match="must be tensors, ints or floats, got None"):
        launch._kind(None)
    with pytest.raises(TypeError, match="got True"):
        launch._kind(True)


@pytest.mark.parametrize(("current", "entered"), [(1, []), (0, [1])])
def test_a_kernel_runs_on_the_device_of_its_tensors(monkeypatch, current, entered):
    devices, started = [], []

    class Kernel(KernelInterface):
        fn = object()

        def __getitem__(self, grid):
            return lambda *arguments, **options: started.append((grid, arguments, options))

    class Entered:
        def __init__(self, device):
            devices.append(device)

        def __enter__(self):
            assert not started

        def __exit__(self, *_):
            assert started

    monkeypatch.setattr(launch.torch.cuda, "device", Entered)
    monkeypatch.setattr(launch.torch.cuda, "current_device", lambda: current)
    tensor = torch.zeros(2)
    monkeypatch.setattr(torch.Tensor, "get_device", lambda tensor: 1)
    launch.launch(Kernel(), 33, 16, tensor, 5, options={"num_warps": 1}, DEPTH=True)
    assert devices == entered
    assert started == [((3, 1, 1), (tensor, 5), {"DEPTH": True, "BLOCK": 16, "num_warps": 1})]


@pytest.mark.parametrize(
    ("hooked", "called"), [(None, "run"), ("launch_enter_hook", "item"), ("launch_exit_hook", "item")]
)
def test_a_launch_that_a_hook_waits_for_is_tritons_own(monkeypatch, hooked, called):
    # A profiler may set either of the two hooks alone.
    started = []

    class Compiled(CompiledKernel):
        function = packed_metadata = None

        def __init__(self):
            pass

        def __getitem__(self, grid):
            return lambda *arguments: started.append(("item", grid, arguments))

        def run(self, *arguments):
            started.append(("run", arguments[:3], arguments[9:]))

    if hooked:
        monkeypatch.setattr(getattr(knobs.runtime, hooked), "calls", [print])
    monkeypatch.setattr(launch, "driver", SimpleNamespace(active=SimpleNamespace(get_current_stream=lambda device: 7)))
    launch._start(Compiled(), 0, (3, 1, 1), (5, 6))
    assert started == [(called, (3, 1, 1), (5, 6))]
