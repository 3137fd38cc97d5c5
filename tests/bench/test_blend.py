"""The stages beside vectorized torch, at a size of milliseconds."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from sparsestreet.bench import blend
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import Size, frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import OpTimes, TimeSpread, TimingBudget
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.reference import on_screen, visible_rows
from tests.bench.test_records import PROVENANCE
from tests.ops.scenes import camera, cast, cotangents, random_gaussians, relative_error

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)


def test_main_size_has_a_peer_and_a_floor(tmp_path, monkeypatch):
    monkeypatch.setattr(blend, "measured_peak", lambda: 1e11)
    file, said = RecordFile(tmp_path / "blend.jsonl", PROVENANCE), []
    blend.run_blend(Size(64, 48, 300), [Size(48, 32, 200)], ONCE, ONCE, file, said.append)
    main, training = read_records(file.path)
    assert set(main["peer"]) == {"forward", "both"}
    samples = main["times"]["samples"]
    assert main["floor_ms"] == pytest.approx({"blend": 36e3 * samples / 1e11, "blend_backward": 65e3 * samples / 1e11})
    assert main["difference"]["pixels"] == 64 * 48
    assert main["difference"]["largest_without_ties"] <= 1e-5
    assert training["peer"] is None
    text = "\n".join(said)
    assert "torch over C++" in text
    assert "x its floor" in text


def test_what_is_timed_is_done(monkeypatch):
    """On a clock that the peer's blend moves by 3 ms, and its gradients by 7 ms; a warm-up and one that counts."""
    now, done = [0.0], []
    monkeypatch.setattr(blend.time, "perf_counter", lambda: now[0])

    def peer(name, seconds):
        def work(splats, width, height, settings, *cotangent):
            now[0] += seconds
            done.append((name, width, height, settings, torch.is_grad_enabled(), [one.shape for one in cotangent]))

        monkeypatch.setattr(blend, name, work)

    peer("blend_torch", 0.003)
    peer("blend_gradients", 0.007)
    gaussians, camera = blend._scene(Size(48, 32, 50))
    times = blend.time_torch(gaussians, camera, TimingBudget(repeats=3, seconds=100.0))
    found = {name: (one.median, one.minimum, one.repeats) for name, one in times.items()}
    assert found == {"forward": pytest.approx((3.0, 3.0, 3)), "both": pytest.approx((7.0, 7.0, 3))}
    forward = ("blend_torch", 48, 32, blend.SETTINGS, False, [])
    both = ("blend_gradients", 48, 32, blend.SETTINGS, True, [(32, 48, 3)])
    assert done == [forward] * 5 + [both] * 5


def test_ties_are_counted_apart(monkeypatch):
    """Of 6 pixels one differs by 0.25 and one by 1e-6: the first is a tie at the cut-off."""
    ours, theirs = torch.zeros(2, 3, 3), torch.zeros(2, 3, 3)
    theirs[0, 1, 2], theirs[1, 2, 0] = 0.25, 1e-6
    gaussians, camera = blend._scene(Size(3, 2, 5))
    asked = []
    monkeypatch.setattr(
        blend, "splat", lambda *given, **how: asked.append((given, how)) or SimpleNamespace(rgb=ours)
    )  # fmt: skip
    monkeypatch.setattr(blend, "blend_torch", lambda *given: asked.append(given[1:]) or (theirs, None))
    found = blend.image_difference(gaussians, camera)
    assert (found.pixels, found.ties, found.largest) == (6, 1, 0.25)
    assert found.largest_without_ties == pytest.approx(1e-6)
    assert asked == [((gaussians, camera), {"backend": "cpu"}), (3, 2, blend.SETTINGS)]
    theirs.fill_(1.0)
    assert blend.image_difference(gaussians, camera) == blend.Difference(6, 6, 1.0, 0.0)


def test_a_peak_is_the_best_of_several(monkeypatch):
    monkeypatch.setattr(blend, "_repeat", lambda call, budget: [0.5, 0.25, 1.0] if budget.repeats == 5 else [])
    assert blend.measured_peak(size=4) == 2 * 64 / 0.25


def test_a_record_as_lines():
    def times(median: float) -> TimeSpread:
        return TimeSpread(median, median / 2, None, 1)

    stages = {"forward": times(8.0), "bin": times(1.0), "blend": times(2.0), "blend_backward": times(3.0)}
    alone = blend.BlendRecord(300, 64, 48, OpTimes(stages, 777, 2_500_000), None, None, None, None)
    first, *rest = blend.lines(alone)
    assert first == "\n300 splats, 64x48: 777 (splat, tile) pairs, 2.5 M samples"
    assert rest == [f"  {name:<24}{one}" for name, one in stages.items()]
    whole = replace(
        alone, peer={"forward": times(50.0), "both": times(120.0)}, peak_gflops=34.4,
        floor_ms={"blend": 0.5, "blend_backward": 2.0}, difference=blend.Difference(3072, 3, 0.25, 1e-6),
    )  # fmt: skip
    _, _, _, drawn, back, *rest = blend.lines(whole)
    assert drawn == f"  {'blend':<24}{stages['blend']}, 4.0 x its floor"
    assert back == f"  {'blend_backward':<24}{stages['blend_backward']}, 1.5 x its floor"
    assert rest == [
        f"  torch tiles, forward    {times(50.0)}",
        f"  torch tiles, both       {times(120.0)}",
        "  peak 34 GFLOP/s (float32 matrix product)",
        "  blend forward + backward, torch over C++: 20 times",
        "  image difference 1.0e-06, except 3 of 3072 pixels at the cut-off (up to 2.5e-01)",
    ]


pytestmark = pytest.mark.lengthy
SETTINGS = SplatSettings()


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        SplatSettings(stop="exclusive", transmittance_min=0.1),
        SplatSettings(max_sigma=1.5),
        SplatSettings(half_colors=True, depth_bits=12),
    ],
)
def test_image_and_gradients(settings):
    view = camera(37, 29)
    gaussians = random_gaussians(200, view)
    splats = on_screen(gaussians, visible_rows(gaussians, view, settings), view, settings)
    colors, transmittance = blend.blend_torch(splats, 37, 29, settings)
    leaves = cast(gaussians, torch.float64, requires_grad=True)
    truth = splat(leaves, view, settings=settings, backend="reference")
    assert (colors - truth.rgb).abs().max() < 1e-12
    assert (1 - transmittance - truth.alpha).abs().max() < 1e-12
    # Through the projection of the reference, with the gradients of the tiles put in at the screen.
    cotangent = cotangents(view)[0]
    truth.rgb.backward(cotangent)
    other = cast(gaussians, torch.float64, requires_grad=True)
    graph = on_screen(other, visible_rows(other, view, settings), view, settings)
    gradients = blend.blend_gradients(splats, 37, 29, settings, cotangent)
    torch.autograd.backward([getattr(graph, name) for name in gradients], list(gradients.values()))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert relative_error(getattr(other, name).grad, getattr(leaves, name).grad) < 1e-10, name


def test_cpu_agrees_on_a_large_scene():
    view = frustum_camera(160, 96)
    gaussians = frustum_gaussians(6000, view, sigma_pixels=2.0, terms=1)
    splats = on_screen(gaussians, visible_rows(gaussians, view, SETTINGS), view, SETTINGS)
    image = splat(gaussians, view, backend="cpu").rgb
    difference = (image - blend.blend_torch(splats, 160, 96, SETTINGS)[0]).abs().amax(-1)
    # A splat within rounding of the cut-off is blended by one and not by the other: at most one pixel in thousands.
    assert (difference > 1e-5).sum() <= 3
    assert difference.max() < 1 / 255
