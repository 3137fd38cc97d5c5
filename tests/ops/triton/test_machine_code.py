"""Every kernel compiles for sm_80, sm_90 and sm_120 without a GPU, and the pixel loops stay within their budgets.

Budgets are what was measured with Triton 3.7.1; 3.6.0 makes pixel kernels of the same registers and instructions. The
instructions of a (splat, pixel) sample are those of a splat that touches all four quadrants of its tile: the
costliest. Of one that touches two it is a third less for the pair, where a kernel that took the tile as a whole had 154
forward and 487 backward whatever it touched.
"""

import dataclasses
import itertools
import json

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, splat
from sparsestreet.ops.settings import StopRule
from sparsestreet.ops.triton import rasterizer
from sparsestreet.types import Harmonics, Shutter
from tests.ops.scenes import camera, cast, device_of, random_gaussians
from tests.ops.triton.recording import Launch, compile_launches, record_launches
from tests.ops.triton.splitting import Rule, split_by

DEVICE = device_of("triton")

STILL = camera(5, 4)
LENS = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])
SHUTTER = Shutter(torch.ones(3), torch.zeros(3))
VIEWS = {
    "plain": STILL,
    "lens": dataclasses.replace(STILL, distortion=LENS),
    "shutter": dataclasses.replace(STILL, shutter=SHUTTER),
    "columns": dataclasses.replace(STILL, shutter=dataclasses.replace(SHUTTER, direction="left")),
    "both": dataclasses.replace(STILL, distortion=LENS, shutter=SHUTTER),
}
# Terms of harmonics, view, whether rows move, settings, what is differentiated: what trains, each switch on and off,
# the largest case of the row kernels, and the kernels that stand beside gsplat's.
CASES = [
    (16, "plain", False, SplatSettings(), "rgb"),
    (1, "plain", False, SplatSettings(), "depth"),
    (16, "plain", False, SplatSettings.preset("gsplat15"), "rgb"),
    (1, "plain", False, SplatSettings(stop="exclusive", antialias=True), "depth"),
    (9, "plain", False, SplatSettings(half_colors=True), "rgb"),
    (16, "plain", False, SplatSettings.preset("drivestudio"), "rgb"),
    (4, "plain", False, SplatSettings(plain_gradients=True), "rgb"),
    (1, "lens", False, SplatSettings(), "depth"),
    (4, "shutter", True, SplatSettings.preset("exact"), "depth"),
    (4, "columns", True, SplatSettings(), "rgb"),
    (16, "both", True, SplatSettings(antialias=True), "rgb"),
]


# Views, terms in use and stored behind the first, and whether these rest, of tables as nodes keep them.
TABLES = [("plain", 16, 15, False), ("plain", 16, 15, True), ("plain", 4, 15, False), ("both", 16, 15, False)]

_FORWARD = ("unscented", "within_fold", "roll", "velocity")
_BACKWARD = ("unscented", "unscented_backward", "roll", "roll_backward", "velocity", "velocity_backward")
EFFECTS = {"project_rows": _FORWARD, "project_rows_backward": _BACKWARD}


def launches_of(monkeypatch: pytest.MonkeyPatch) -> list[Launch]:
    """What the cases launch, and all that is counted, with both rules of where a pixel stops and with split tiles."""
    stops: tuple[StopRule, ...] = ("inclusive", "exclusive")
    launches = record_launches(monkeypatch)
    for terms, name, moves, settings, output in CASES:
        scene = cast(random_gaussians(3, STILL, terms=terms), torch.float32, requires_grad=True, device=DEVICE)
        displacements = torch.ones(3, 3, device=DEVICE) if moves else None
        scene = dataclasses.replace(scene, displacements=displacements)
        getattr(splat(scene, VIEWS[name], backend="triton", settings=settings), output).sum().backward()
    for name, terms, stored, rests in TABLES:
        rows = cast(random_gaussians(3, STILL, terms=1 + stored), torch.float32, requires_grad=True, device=DEVICE)
        first, rest = (table.detach().requires_grad_() for table in (rows.dense_sh()[:, :1], rows.dense_sh()[:, 1:]))
        tables = Harmonics((first,), (rest.detach() if rests else rest,), terms)
        splat(dataclasses.replace(rows, sh=tables), VIEWS[name], backend="triton").rgb.sum().backward()
    scene = cast(random_gaussians(3, STILL, terms=1), torch.float32, requires_grad=True, device=DEVICE)
    with torch.no_grad():
        splat(scene, STILL, backend="triton")
    image = torch.ones(4, 5, 3, device=DEVICE)
    for background, weights in ((None, None), (image, image[..., 0])):
        rasterizer.leave_one_out(scene, background, weights, STILL, SplatSettings())
    for stop in stops:
        contribution(scene, STILL, settings=SplatSettings(stop=stop), backend="triton")
    for gates, stop in itertools.product((None, torch.ones(3, device=DEVICE)), stops):
        with split_by(Rule(min_part_pairs=1, min_parts=2)):
            splat(scene, STILL, backend="triton", settings=SplatSettings(stop=stop), gates=gates).depth.sum().backward()
    unique = {json.dumps(dataclasses.asdict(launch), sort_keys=True): launch for launch in launches}
    return list(unique.values())


def bare(launch: Launch, registers: int, **constants: bool) -> Launch:
    """A pixel kernel for RGB alone."""
    constants = launch.constants | {"DEPTH": False} | constants
    return dataclasses.replace(launch, constants=constants, options=launch.options | {"maxnreg": registers})


@pytest.fixture(scope="module", params=[80, 90, 120], ids=["sm_80", "sm_90", "sm_120"])
def compiled(request) -> list[tuple[Launch, dict]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = launches_of(monkeypatch)
    first = {launch.name: launch for launch in reversed(launches) if launch.name.startswith("blend")}
    backward = first["blend_tiles_backward"]
    launches.append(bare(backward, 96, ABSOLUTE=False))
    launches.append(bare(backward, 104, ABSOLUTE=False, DEPTH=True))
    plain = [launch for launch in launches if launch.name in EFFECTS and _is_plain(launch)]
    launches += [dataclasses.replace(launch, without=EFFECTS[launch.name]) for launch in plain]
    return compile_launches(launches, request.param)


@pytest.mark.slow
def test_every_kernel_is_compiled(compiled):
    assert {launch.name for launch, _ in compiled} == {
        "project_rows", "list_visible", "list_pairs", "bound_tiles", "order_tiles", "blend_tiles",
        "count_tiles_pixels", "blend_tiles_backward", "sum_slots", "project_rows_backward", "remove_from_tiles",
        "compose_pixels", "decompose_pixels",
    }  # fmt: skip


@pytest.mark.slow
def test_nothing_spills(compiled, request):
    """But 8 bytes outside of loops, of the forward blend and of rows; on sm_120, whose registers were not tuned,
    once in the blend's."""
    newest = "sm_120" in request.node.name
    for launch, found in compiled:
        is_forward = launch.name == "blend_tiles"
        assert found["spilled"] <= 8 * (is_forward or launch.name == "project_rows") or newest, launch
        assert sum(loop["spilled"] for loop in found["loops"]) <= (newest and is_forward), launch


@pytest.mark.slow
def test_no_tensor_cores_and_no_atomics(compiled):
    """Nothing is rounded to tf32, and no sum depends on who comes first."""
    assert [launch for launch, found in compiled if found["tensor_core"] or found["atomics"]] == []


# Switches that are on: registers, instructions per sample.
FORWARD = {
    "DEPTH": (96, 22.0),
    "DEPTH LASTS": (96, 23.5),
    "DEPTH LASTS TOGETHER": (96, 24.0),
    "DEPTH LASTS REST": (96, 23.5),
    "DEPTH EXCLUSIVE LASTS": (96, 26.0),
    "DEPTH EXCLUSIVE LASTS TOGETHER": (96, 26.0),
    "DEPTH EXCLUSIVE LASTS REST": (96, 26.0),
    "DEPTH GATED LASTS TOGETHER": (104, 25.5),
    "DEPTH GATED LASTS REST": (104, 25.0),
    "DEPTH EXCLUSIVE GATED LASTS TOGETHER": (104, 27.0),
    "DEPTH EXCLUSIVE GATED LASTS REST": (104, 27.0),
}
BACKWARD = {
    "": (96, 53.0),
    "DEPTH": (104, 56.0),
    "ABSOLUTE": (96, 58.5),
    "ABSOLUTE DEPTH": (104, 61.0),
    "ABSOLUTE DEPTH TOGETHER": (104, 61.0),
    "ABSOLUTE DEPTH GATED TOGETHER": (112, 66.5),
}
BUDGETS = {"blend_tiles": FORWARD, "blend_tiles_backward": BACKWARD}


@pytest.mark.slow
def test_budget_of_the_pixel_loops(compiled):
    loops = [(launch, _switches(launch.constants), found) for launch, found in compiled if launch.name in BUDGETS]
    assert {(launch.name, switches) for launch, switches, _ in loops} == {
        (name, switches) for name, budgets in BUDGETS.items() for switches in budgets
    }
    for launch, switches, found in loops:
        registers, instructions = BUDGETS[launch.name][switches]
        assert found["registers"] <= registers, (launch.name, switches)
        assert found["sample"] <= instructions, (launch.name, switches)
        if launch.name == "blend_tiles":
            # Only the next pair's row and quadrants are loaded, and eleven numbers change lanes, or a gate too.
            loop = found["loops"][-1]
            assert (loop["loads"], loop["exchanges"]) == (1, 11 + launch.constants["GATED"])
        # What a part lets through is a second, shorter loop.
        assert len(found["loops"]) == (2 if launch.name == "blend_tiles" and launch.constants["TOGETHER"] else 1)


def _switches(constants: dict) -> str:
    return " ".join(sorted(name for name, value in constants.items() if value is True))


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_effects_that_are_off_are_not_in_the_row_kernels(compiled, name):
    """They are the same machine code where the functions of the effects do not exist."""
    whole, without = (
        [
            found["code"]
            for launch, found in compiled
            if launch.name == name and bool(launch.without) == missing and _is_plain(launch)
        ]
        for missing in (False, True)
    )
    assert without
    assert without == whole


# Loads, stores and registers of a lane's row: 16 warps of a multiprocessor then run at once.
ROW_BUDGETS = {"project_rows": (54, 7, 128), "project_rows_backward": (50, 22, 128)}
# Rows of 45 numbers do not begin at multiples of 16 bytes: each number is loaded and stored alone, and addresses take
# registers: in backward 8 warps run at once.
TABLE_BUDGETS = {"project_rows": (91, 7, 128), "project_rows_backward": (86, 58, 192)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ROW_BUDGETS)
def test_budget_of_the_row_kernels(compiled, name):
    found = [(launch, found) for launch, found in compiled if launch.name == name and _is_still(launch, terms=16)]
    for tables in (False, True):
        budget = (TABLE_BUDGETS if tables else ROW_BUDGETS)[name]
        own = [found for launch, found in found if (launch.constants["STORED"] >= 0) == tables]
        assert own
        for each in own:
            assert each["loads"] <= budget[0]
            assert each["stores"] <= budget[1]
            assert each["registers"] <= budget[2]


def _is_still(launch: Launch, terms: int | None = None) -> bool:
    constants = launch.constants
    return not (constants["DISTORTED"] or constants["ROLLING"]) and terms in (None, constants["TERMS"])


def _is_plain(launch: Launch) -> bool:
    return launch.constants["TERMS"] == 1 and not (launch.constants["DISTORTED"] or launch.constants["ROLLING"])


@pytest.mark.lengthy
def test_effects_do_not_touch_the_pixel_kernels(monkeypatch):
    launches = record_launches(monkeypatch)
    view, pixel_kernels = camera(5, 4), []
    leaves = cast(random_gaussians(3, view), torch.float32, requires_grad=True, device=DEVICE)
    shutter = Shutter(torch.ones(3), torch.zeros(3))
    for seen in (view, dataclasses.replace(view, distortion=torch.zeros(5), shutter=shutter)):
        launches.clear()
        splat(leaves, seen, backend="triton").rgb.sum().backward()
        pixel_kernels.append([launch for launch in launches if launch.name.startswith("blend")])
    assert len(pixel_kernels[0]) == 2
    assert pixel_kernels[0] == pixel_kernels[1]
