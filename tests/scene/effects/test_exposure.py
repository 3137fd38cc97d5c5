"""Gains of images: where they are called for, what they start from, and which a view has."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.effects import Exposure, ExposureSettings, Finding, linearized
from sparsestreet.scene.effects import exposure as exposure_module
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.state import FINISHED
from sparsestreet.types import Sweep, Track, View
from tests.evidence import wall
from tests.scene.effects.test_effects import CAMERA, picture, scene_of, sky
from tests.scene.street import training_data

TIMES = {0: [0.0, 0.25, 1.0], 2: [0.1, 0.6]}
SETTINGS = ExposureSettings(when="on")
FOUND = Finding(called_for=True, reason="")


def exposure(**said) -> Exposure:
    """Gains with different values in every entry."""
    made = Exposure(replace(SETTINGS, **said), TIMES)
    with torch.no_grad():
        made.log_gains.copy_(torch.randn(5, 3, generator=torch.Generator().manual_seed(0)) / 3)
    return made


def view(time: float, camera: int | None) -> View:
    return View(CAMERA, time, None, camera)


@pytest.mark.parametrize(
    ("time", "camera", "wanted"),
    [
        (0.25, 0, [0.0, 1.0, 0.0, 0.0, 0.0]),  # a training image
        (0.1, 2, [0.0, 0.0, 0.0, 1.0, 0.0]),
        (0.4, 0, [0.0, 0.8, 0.2, 0.0, 0.0]),  # between two of its camera, whatever others recorded
        (0.35, 2, [0.0, 0.0, 0.0, 0.5, 0.5]),
        (0.0, 2, [0.0, 0.0, 0.0, 1.0, 0.0]),  # before the first
        (0.9, 2, [0.0, 0.0, 0.0, 0.0, 1.0]),  # behind the last
        (0.25, None, [0.0] * 5),  # no camera of the rig
        (0.25, 1, [0.0] * 5),  # one that is held out
    ],
)
def test_a_view_has_the_gain_of_its_image_or_of_the_line_between_neighbors(time, camera, wanted):
    made = exposure()
    expected = torch.tensor(wanted) @ made.log_gains
    torch.testing.assert_close(made.log_gain(view(time, camera)), expected)
    plain, seen = (
        picture(scene, camera_index=camera, time=time) for scene in (scene_of(sky=sky()), scene_of(sky=sky(), g=made))
    )
    torch.testing.assert_close(seen, plain * expected.exp().detach())


def test_a_change_of_the_splats_is_followed_to_the_image():
    """Exactly where the gains are gray: a splat that is brighter, over a sky."""
    made, seen = exposure(), view(0.4, 0)
    with torch.no_grad():
        made.log_gains.copy_(made.log_gains[:, :1].expand(5, 3))
        rendering = render(scene_of(), seen, options=RenderOptions(backend="reference"))
        rgb = rendering.splats.rgb
        before, behind = (made.image(one, rendering.splats, seen, RenderOptions()) for one in (rgb, rgb + 0.1))
        both = linearized([sky(), made], seen)
    assert both.slope is not None
    assert both.background is not None
    torch.testing.assert_close(behind - before, (0.1 * both.slope)[..., None].expand_as(rgb))
    torch.testing.assert_close(both.background, sky().background(seen))


def test_the_slope_of_colored_gains_is_that_of_a_change_of_any_color_on_average():
    made, seen = exposure(), view(0.0, 0)
    changes = torch.nn.functional.normalize(torch.randn(40_000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    factor, slope = made.log_gains[0].detach().exp(), made.slope(seen).detach()
    # 40,000 directions: half a percent.
    assert float(slope[0, 0]) == pytest.approx(float((changes * factor).square().sum(1).mean().sqrt()), rel=0.01)


def test_regularizers_draw_gains_to_their_neighbors_line_and_their_mean_to_zero():
    made = exposure(smooth=2.0, level=3.0)
    terms = made.regularizers(view(0.25, 0), FINISHED)
    off = made.log_gains[1] - (0.75 * made.log_gains[0] + 0.25 * made.log_gains[2])
    torch.testing.assert_close(terms["smooth"], 2 * off.square().sum())
    torch.testing.assert_close(terms["level"], 3 * made.log_gains.mean(0).square().sum())
    # The first has one neighbor, a held-out view no gain of its own.
    for seen in (view(0.0, 0), view(0.2, 0), view(0.25, None)):
        assert made.regularizers(seen, FINISHED).keys() == {"level"}
    assert exposure(smooth=0.0, level=0.0).regularizers(view(0.25, 0), FINISHED) == {}
    assert scene_of(exposure=made).bytes_by_part()["exposure"] == 5 * 3 * 4


def log_of(planted: torch.Tensor, lidar: bool = True) -> DrivingLog:
    """A wall of which every image has gains of its own."""
    frames = wall.frames(lambda instant, number: planted[instant, number].exp())
    sweeps = wall.sweeps() if lidar else Sweeps.of(())
    count = wall.INSTANTS
    return DrivingLog("wall", as_frames(frames), sweeps, (), count, 2, torch.eye(4, dtype=torch.float64))


def tinted(size: float) -> torch.Tensor:
    """Cameras of other colors: each channel ``size`` off the mean, to one side or the other."""
    signs = torch.tensor([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]])
    return (size * signs).expand(wall.INSTANTS, 2, 3)


def test_cameras_of_other_colors_call_for_gains():
    """Half of the points' images are those of the other camera, so half of the difference is the error."""
    wanted = 0.1 / math.log(2)
    for size, on in ((0.02, False), (0.1, True)):
        found = SETTINGS.detect(training_data(log_of(tinted(size))))
        assert found.called_for is on
        assert found.value is not None
        assert (found.unit, found.threshold, found.declared, found.missing) == ("EV", 0.05, False, None)
    # 8 images of neighbors have the camera's own gain and 9 that of the other, but for the drive's ends.
    assert found.value == pytest.approx(wanted, rel=0.15)
    assert found.noise is not None
    assert found.noise < 0.02
    assert "between channels" in found.reason
    # The levels' mean square, with waves of 40 / sqrt(4) around 100; neighbors of one camera leave nothing.
    levels = (100**2 + 40**2 / 4) / 255**2
    lost = (math.log(2) * found.value) ** 2 * levels
    assert found.gain == pytest.approx(10 * math.log10(1 + lost / 10**-2.8), rel=0.03)


def test_random_gains_do_not_because_neighbors_do_not_foretell_them():
    found = SETTINGS.detect(training_data(log_of(wall.random_gains(0.2))))
    assert not found.called_for
    assert "neighbors in time foretell too little" in found.reason
    assert found.gain is not None
    assert found.gain < 0.1


def test_without_lidar_nothing_is_called_for_and_on_starts_from_none():
    log = log_of(tinted(0.1), lidar=False)
    found = SETTINGS.detect(training_data(log))
    assert not found.called_for
    assert "not measured" in found.reason
    made = SETTINGS.build(training_data(log), found, torch.Generator())
    assert torch.equal(made.log_gains, torch.zeros(2 * wall.INSTANTS, 3))


def test_what_lies_in_the_boxes_of_the_log_says_nothing():
    """All of the wall is the side of a tram."""
    poses = torch.eye(4, dtype=torch.float64).repeat(wall.INSTANTS, 1, 1)
    poses[:, 2, 3] = wall.DEPTH
    tram = Track("tram", "Tram", torch.arange(wall.INSTANTS), poses, torch.tensor([60.0, 20.0, 1.0]))
    log = replace(log_of(tinted(0.1)), tracks=(tram,))
    assert "not measured" in SETTINGS.detect(training_data(log)).reason


def test_boxes_of_held_out_frames_say_nothing():
    """A tram before instant 4 and behind it; on the line between the two it would hide the wall at instant 4."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([-1000.0, 1000.0 + 2 * wall.DEPTH])
    times = torch.tensor([3.5, 4.5], dtype=torch.float64) / (wall.INSTANTS - 1)
    tram = Track("tram", "Tram", torch.tensor([4, 5]), poses, torch.tensor([60.0, 20.0, 1.0]), times=times)
    log = log_of(wall.random_gains(0.1))
    with_tram, without = (
        SETTINGS.build(training_data(replace(log, tracks=tracks), frozenset({5})), FOUND, torch.Generator()).log_gains
        for tracks in ((tram,), ())
    )
    assert torch.equal(with_tram, without)


def test_it_starts_from_the_measured_gains_of_training_images_alone():
    planted = wall.random_gains(0.1)
    planted = planted - planted.mean(1, keepdim=True)  # what both cameras share may be drift
    held_out = frozenset({3, 8})
    data = training_data(log_of(planted), held_out)
    made = SETTINGS.build(data, SETTINGS.detect(data), torch.Generator())
    trained = torch.tensor([instant for instant in range(wall.INSTANTS) if instant not in held_out])
    wanted = planted[trained].transpose(0, 1).reshape(-1, 3)
    torch.testing.assert_close(made.log_gains.detach(), wanted - wanted.mean(0), rtol=0, atol=0.005)
    assert SETTINGS.cost(data).numbers == made.log_gains.numel()
    # A held-out image has the line between its neighbors.
    seen = View(CAMERA, 3 / (wall.INSTANTS - 1), 3, 1)
    wanted = (made.log_gain(replace(seen, time=2 / 11)) + made.log_gain(replace(seen, time=4 / 11))) / 2
    torch.testing.assert_close(made.log_gain(seen), wanted)


def test_held_out_images_are_not_looked_at():
    class Unread(dict):
        def __missing__(self, index):
            raise AssertionError(f"image {index} is held out")

    log = log_of(tinted(0.1))
    pixels = Unread({frame.indices: frame for frame in log.frames if frame.frame_index != 5})
    views = [View(f.camera, f.time, f.frame_index, f.camera_index) for f in log.frames]
    lazy = Frames(views, lambda seen: pixels[seen.indices])

    def sweep(index: int) -> Sweep:
        assert index != 5
        return wall.sweep(index)

    sweeps = Sweeps(range(wall.INSTANTS), sweep)
    data = training_data(replace(log, frames=lazy, sweeps=sweeps), frozenset({5}))
    SETTINGS.build(data, SETTINGS.detect(data), torch.Generator())


def test_times_increase_whatever_the_order_of_the_views():
    seen = [View(CAMERA, time, frame, camera) for camera in (2, 0) for frame, time in ((0, 0.5), (1, 0.1), (2, 0.3))]
    assert exposure_module._times(seen) == {0: [0.1, 0.3, 0.5], 2: [0.1, 0.3, 0.5]}
