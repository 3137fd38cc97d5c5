"""Gains of images from lidar points, against gains that are planted."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.evidence import exposure
from sparsestreet.evidence.exposure import (
    EV,
    GainErrors,
    ImageGains,
    Links,
    PartGains,
    gain_errors,
    image_gains,
    solved,
    without_drift,
)
from sparsestreet.types import Camera, Track, View
from tests.evidence import wall

# Levels are rounded to 1 of 100, in medians of hundreds of points and over dozens of links.
TOLERANCE = 0.004
PLANTED = wall.random_gains(0.1)


def gains_of(made, sweeps=None, boxes=()) -> ImageGains:
    found = image_gains(wall.lazy(made), wall.sweeps() if sweeps is None else sweeps, boxes)
    assert found is not None
    return found


def assert_planted(found: ImageGains, planted: torch.Tensor = PLANTED, tolerance: float = TOLERANCE) -> None:
    wanted = torch.stack([planted[view.frame_index, view.camera_index] for view in found.views]).double()
    torch.testing.assert_close(found.log_gains, wanted, rtol=0, atol=tolerance)


def gain(instant: int, number: int) -> torch.Tensor:
    return PLANTED[instant, number].exp()


@pytest.fixture(scope="module")
def frames():
    return wall.frames(gain)


def test_planted_gains_of_images_and_channels_are_measured(frames):
    found = gains_of(frames)
    assert_planted(found)
    assert found.points > 5000
    # The wall has levels around 100.
    assert found.mean_square == pytest.approx((100 / 255) ** 2, rel=0.2)
    assert bool(found.inner.all())


def test_without_lidar_nothing_is_measured(frames):
    assert image_gains(wall.lazy(frames), Sweeps.of(()), ()) is None


def test_images_without_a_sweep_of_their_own_are_measured_too(frames):
    odd = Sweeps.of(tuple(wall.sweep(instant) for instant in range(1, wall.INSTANTS, 2)))
    assert_planted(gains_of(frames, odd))


def flickering(frames, **changes):
    """Pictures whose left 70 % flicker by another factor, and what the frames have beside that."""
    edge = int(0.7 * wall.WIDTH)
    made = []
    for place, frame in enumerate(frames):
        image = frame.image.float()
        image[:, :edge] *= (0.7, 1.0, 1.4)[place % 3]
        made.append(replace(frame, image=image.round().clamp(0, 255).to(torch.uint8), **changes))
    return made


def left(share: float = 0.7) -> torch.Tensor:
    mask = torch.zeros(wall.HEIGHT, wall.WIDTH, dtype=torch.bool)
    mask[:, : int(share * wall.WIDTH)] = True
    return mask


@pytest.mark.parametrize("mask", ["ego", "vehicle", "human", "sky"])
def test_masked_pixels_are_left_out(frames, mask: str):
    # The rest nears the camera: what rounding makes of shine (0.005) adds up along the drive.
    assert_planted(gains_of(flickering(frames, **{mask: left()})), tolerance=4 * TOLERANCE)


def test_flicker_without_a_mask_would_be_taken_for_a_gain(frames):
    found = gains_of(flickering(frames))
    with pytest.raises(AssertionError):
        assert_planted(found, tolerance=0.1)


def test_what_hides_behind_something_near_is_not_looked_up(frames):
    """A plate at 3 m goes with the car; returns from it and from the wall behind it lie in the same pixels."""

    def with_plate(sweep):
        side = torch.cartesian_prod(torch.linspace(-3.4, 1.5, 90), torch.linspace(-1.3, 1.3, 50))
        plate = torch.cat((side + torch.tensor([wall.STEP * sweep.index, 0.0]), torch.full((len(side), 1), 3.0)), 1)
        # No camera colored it: it hides, and is not looked up.
        return replace(
            sweep,
            points=torch.cat((sweep.points, plate)),
            colors=torch.full((len(sweep.points) + len(plate), 3), 0.5),
            colored=torch.cat((sweep.colored, torch.zeros(len(plate), dtype=torch.bool))),
        )

    hiding = Sweeps.of(tuple(with_plate(sweep) for sweep in wall.sweeps()))
    # Each camera sees the plate over its pixels -16.7 + 40 ... to 51 of 80 or farther to the right.
    made = []
    for place, frame in enumerate(frames):
        image = frame.image.clone()
        right = {0: 78, 1: 51}[frame.camera_index]
        image[:, :right] = (50, 100, 200)[place % 3]
        made.append(replace(frame, image=image))
    found = image_gains(wall.lazy(made), hiding, ())
    assert found is not None
    own = [place for place, view in enumerate(found.views) if view.camera_index == 1]
    planted = PLANTED[:, 1].double()
    measured = found.log_gains[own]
    torch.testing.assert_close(measured - measured.mean(0), planted - planted.mean(0), rtol=0, atol=2 * TOLERANCE)


def test_what_lies_in_a_box_is_left_out(frames):
    """The wall's part from x = -9 to 3 is the side of a tram, whose levels flicker."""
    track = Track(
        "tram",
        "Tram",
        torch.arange(wall.INSTANTS),
        torch.eye(4, dtype=torch.float64).repeat(wall.INSTANTS, 1, 1),
        torch.tensor([12.0, 9.0, 1.0]),
    )
    track.world_from_object[:, :3, 3] = torch.tensor([-3.0, 0.0, wall.DEPTH], dtype=torch.float64)
    made = []
    for place, frame in enumerate(frames):
        x = frame.camera.position[0] + wall.DEPTH * (torch.arange(wall.WIDTH) + 0.5 - wall.WIDTH / 2) / wall.FOCAL
        image = frame.image.float()
        image[:, x < 3] *= (0.7, 1.0, 1.4)[place % 3]
        made.append(replace(frame, image=image.round().clamp(0, 255).to(torch.uint8)))
    assert_planted(gains_of(made, boxes=[track]))


def test_low_points_and_the_others_are_told_apart(frames):
    """What lies more than 0.8 m below the cameras shines now and then."""

    def shining(place, frame):
        image = frame.image.float()
        y = wall.DEPTH * (torch.arange(wall.HEIGHT) + 0.5 - wall.HEIGHT / 2) / wall.FOCAL
        image[y > 0.8] *= (0.8, 1.0, 1.2)[place % 3]
        return replace(frame, image=image.round().clamp(0, 255).to(torch.uint8))

    found = gains_of([shining(place, frame) for place, frame in enumerate(frames)])
    low, others = (replace(found, log_gains=part.log_gains) for part in found.parts)
    assert_planted(others)
    shine = torch.tensor([0.8, 1.0, 1.2]).log()[torch.arange(len(frames)) % 3].view(wall.INSTANTS, 2, 1)
    # The lowest row of blocks holds a little of both.
    assert_planted(low, PLANTED + shine - shine.mean(), tolerance=2 * TOLERANCE)


def test_white_and_dark_levels_say_nothing():
    """Two thirds of the wall are three times as bright: in the brighter images they are white."""

    def lit(frame):
        bright = torch.where((torch.arange(wall.HEIGHT) % 30 < 20)[:, None, None], 3.0, 1.0)
        instant, number = frame.indices
        clean = wall.frame(instant, number, torch.ones(3)).image
        return replace(frame, image=(clean * bright * gain(instant, number)).round().clamp(0, 255).to(torch.uint8))

    assert_planted(gains_of([lit(frame) for frame in wall.frames(gain)]), tolerance=2 * TOLERANCE)


def test_large_images_are_looked_at_coarsely(frames):
    def enlarged(frame):
        camera = frame.camera
        intrinsics = camera.intrinsics * torch.tensor([[6.0], [6.0], [1.0]])
        camera = replace(camera, intrinsics=intrinsics, width=6 * camera.width, height=6 * camera.height)
        image = frame.image.repeat_interleave(6, 0).repeat_interleave(6, 1)
        return replace(frame, camera=camera, image=image)

    assert_planted(gains_of([enlarged(frame) for frame in frames]))


def test_of_many_images_runs_of_neighbors_are_looked_at():
    made = [replace(wall.frame(0, 0, torch.ones(3)), frame_index=index, time=index / 99) for index in range(100)]
    sweeps = Sweeps.of(tuple(replace(wall.sweep(0, 200), index=index) for index in range(100)))
    found = image_gains(wall.lazy(made), sweeps, (), most=48)
    assert found is not None
    indices = [view.frame_index for view in found.views]
    assert indices == [*range(24), *range(76, 100)]
    # Instants around the others were not looked at, but nothing was recorded before the first or behind the last.
    assert [index for index, inner in zip(indices, found.inner, strict=True) if inner] == [*range(16), *range(84, 100)]


def test_levels_that_change_with_the_distance_are_no_gain(frames):
    """Every point gets darker by the square root of its distance: for the nearest ones a third over the drive."""

    def shining(frame):
        x, y = ((torch.arange(size) + 0.5 - size / 2) / wall.FOCAL for size in (wall.WIDTH, wall.HEIGHT))
        distances = (1 + x[None] ** 2 + y[:, None] ** 2).sqrt()
        image = frame.image.float() * distances[..., None] ** 0.5
        return replace(frame, image=image.round().clamp(0, 255).to(torch.uint8))

    # What is left of the image nears the camera; without a look at shine the gains are 0.05 off.
    right = [replace(shining(frame), ego=left(0.4)) for frame in frames]
    assert_planted(gains_of(right), tolerance=4 * TOLERANCE)


def test_a_drift_that_all_cameras_share_is_left_out():
    """Not what jumps, nor what one camera has for itself: two cameras of other colors, a ramp, and jumps in time."""
    count, generator = 200, torch.Generator().manual_seed(3)
    tints = torch.tensor([[0.1, 0.0, -0.1], [-0.1, 0.0, 0.1]], dtype=torch.float64)
    jumps = 0.1 * (-1.0) ** torch.arange(count, dtype=torch.float64)[:, None, None]
    ramp = torch.linspace(-0.6, 0.6, count, dtype=torch.float64)[:, None, None]
    measured = gains((ramp + jumps + tints) / EV)
    order = torch.randperm(2 * count, generator=generator)
    mixed = replace(measured, views=tuple(measured.views[i] for i in order), log_gains=measured.log_gains[order])
    found = torch.empty_like(measured.log_gains)
    found[order] = without_drift(mixed)
    found = found.view(count, 2, 3)
    inner = slice(80, -80)  # at its ends the drive has neighbors on one side only
    # Of a jump that alternates 1 / (1 + 4 x 196) is taken for drift, and at 80 instants from the ends 0.003 of a slope.
    torch.testing.assert_close(found[inner], (jumps + tints)[inner].expand(-1, 2, 3), rtol=0, atol=0.004)
    assert float(found[:, 0].sub(tints[0]).abs().max()) < 0.3  # of 0.7


def test_a_wrong_link_moves_no_gain():
    pairs = torch.combinations(torch.arange(8))
    truth = torch.linspace(-0.3, 0.3, 8, dtype=torch.float64)[:, None].expand(8, 3)
    ratios = truth[pairs[:, 1]] - truth[pairs[:, 0]]
    noise = 1e-3 * torch.randn(ratios.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ratios = ratios + noise
    ratios[3] += 1.0
    links = Links(pairs, ratios, torch.full_like(ratios, 1e-3), torch.full((len(pairs),), 100))
    # 28 links of 0.001; least squares without weights would be 0.1 off.
    torch.testing.assert_close(solved(links, 8), truth, rtol=0, atol=3e-3)


def test_groups_that_share_nothing_have_mean_zero_each():
    pairs = torch.tensor([[0, 1], [2, 3]])
    ratios = torch.tensor([[0.2] * 3, [-0.4] * 3], dtype=torch.float64)
    links = Links(pairs, ratios, torch.full_like(ratios, 1e-3), torch.tensor([100, 100]))
    found = solved(links, 5)[:, 0].tolist()
    assert found == pytest.approx([-0.1, 0.1, 0.2, -0.2, 0.0], abs=1e-6)


@pytest.mark.parametrize(("rate", "reach"), [(None, 8), (10.0, 8), (5.0, 4), (2.0, 2), (0.1, 2)])
def test_points_are_looked_up_as_long_before_and_after_at_every_rate(rate: float | None, reach: int):
    """0.8 s, at least two instants; one that is held out in the middle changes nothing."""
    moments = [i for i in range(9) if i != 4]
    camera = Camera(torch.eye(4), torch.eye(3), 4, 4)
    views = [View(camera, i / 8, i, c, seconds=None if rate is None else i / rate) for i in moments for c in (0, 1)]
    assert exposure._reach(views) == reach


COUNT, REACH = 200, 3
CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)


def gains(log_gains: torch.Tensor) -> ImageGains:
    """Of ``COUNT`` instants of some cameras [i c 3], EV; those of instants up to 3 apart share as many points."""
    instants, cameras, _ = log_gains.shape
    views = tuple(View(CAMERA, i / (instants - 1), i, c) for i in range(instants) for c in range(cameras))
    pairs = torch.combinations(torch.arange(len(views)))
    pairs = pairs[(pairs[:, 1] // cameras - pairs[:, 0] // cameras) <= REACH]
    flat = EV * log_gains.reshape(-1, 3).double()
    ratios = flat[pairs[:, 1]] - flat[pairs[:, 0]]
    links = Links(pairs, ratios, torch.full_like(ratios, 1e-3), torch.full((len(pairs),), 100))
    part = PartGains(flat - flat.mean(0), links)
    return ImageGains(views, part.log_gains, (part, part), torch.ones(len(views), dtype=torch.bool), 0.2, 1000)


def errors(log_gains: torch.Tensor) -> GainErrors:
    found = gain_errors(gains(log_gains))
    assert found is not None
    return found


def gray(values: torch.Tensor, cameras: int = 1) -> torch.Tensor:
    return values[:, None, None].expand(-1, cameras, 3)


def test_a_drift_over_the_whole_drive_is_no_error():
    """All images that show a point have one gain but for the slope: 2 EV over the drive, 0.01 an instant."""
    found = errors(gray(torch.linspace(0, 2, COUNT)))
    # Only the three images at either end have all others on one side, two steps away on average.
    assert found.without < 2 * 0.01 * (6 / COUNT) ** 0.5
    # linspace is in float32.
    assert found.foretold == pytest.approx(0, abs=1e-6)
    assert found.removed < 0.005


def test_cameras_with_gains_of_their_own_are_all_foretold():
    tints = torch.tensor([[0.1, 0.0, -0.1], [-0.1, 0.0, 0.1]])
    found = errors(tints.expand(COUNT, 2, 3))
    # Inside, six other images have the camera's own gain and seven that of the other: 7/13 of the difference.
    wanted = 7 / 13 * 0.2 * (2 / 3) ** 0.5
    assert found.without == pytest.approx(wanted, rel=0.01)
    assert found.removed == pytest.approx(found.without, rel=1e-6)
    assert found.color == pytest.approx(found.without, rel=1e-6)
    assert found.cameras[0] == pytest.approx((0.1, 0.0, -0.1), abs=1e-6)
    assert found.images == 2 * (COUNT - 2)


def test_random_jumps_are_not_foretold():
    found = errors(gray(torch.randn(COUNT, generator=torch.Generator().manual_seed(0))))
    # Against the mean of six others: 1 + 1/6; against the mean of two: 1 + 1/2. 200 draws: 5 %.
    assert found.without == pytest.approx((7 / 6) ** 0.5, rel=0.15)
    assert found.foretold == pytest.approx(1.5**0.5, rel=0.15)
    assert found.removed == 0
    assert found.color == pytest.approx(0, abs=1e-9)


def test_a_wave_is_removed_but_for_its_bend():
    """Of period 20: neighbors leave 1 - cos(2 pi / 20), others 1 - (cos w + cos 2w + cos 3w) / 3."""
    w = 2 * torch.pi / 20
    found = errors(gray(torch.sin(w * torch.arange(COUNT))))
    cosines = torch.cos(w * torch.arange(1, 4))
    # The ends are no waves.
    assert found.without == pytest.approx(float(1 - cosines.mean()) / 2**0.5, rel=0.05)
    assert found.foretold == pytest.approx(float(1 - cosines[0]) / 2**0.5, rel=0.02)
    assert found.removed == pytest.approx((found.without**2 - found.foretold**2) ** 0.5)


def test_the_standard_error_is_that_of_the_drives_parts():
    """Waves whose size differs from part to part: what 20 drives scatter, one drive says of itself."""
    values, said = [], []
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        size = torch.rand(8, generator=generator).repeat_interleave(COUNT // 8)
        found = errors(gray(0.1 * size * torch.sin(torch.arange(COUNT) * 2 * torch.pi / 20)))
        values.append(found.removed)
        assert found.noise is not None
        said.append(found.noise)
    scatter = float(torch.tensor(values).std())
    # A jackknife of eight parts is a quarter off itself, its mean over 20 drives less.
    assert float(torch.tensor(said).mean()) == pytest.approx(scatter, rel=0.4)


def test_only_images_whose_neighbors_were_all_looked_at_count():
    """The gain of the last half of the drive jumps by chance."""
    values = torch.zeros(COUNT)
    values[COUNT // 2 :] = torch.randn(COUNT // 2, generator=torch.Generator().manual_seed(0))
    measured = gains(gray(values))
    inner = torch.arange(COUNT) < COUNT // 2 - REACH
    found = gain_errors(replace(measured, inner=inner))
    assert found is not None
    assert found.without == pytest.approx(0, abs=1e-9)
    assert gain_errors(replace(measured, inner=torch.zeros(COUNT, dtype=torch.bool))) is None


@pytest.mark.parametrize(("instants", "enough"), [(7, False), (8, True)])
def test_few_instants_say_nothing(instants: int, enough: bool):
    inner = torch.arange(COUNT) < instants + 1  # the first image has no neighbor before it
    found = gain_errors(replace(gains(gray(torch.zeros(COUNT))), inner=inner))
    assert (found is not None) is enough


def test_only_what_both_kinds_of_points_show_is_an_error_of_gains():
    """A wave that all points show, and on the road one more, of another period."""
    instants = torch.arange(COUNT)
    common, shine = 0.1 * torch.sin(instants * torch.pi / 10), 0.2 * torch.sin(instants * torch.pi / 7)
    road, rest, alone = (gains(gray(wave)).parts[0] for wave in (common + shine, common, shine))
    both = replace(gains(gray(common)), parts=(road, rest))
    found, wanted = gain_errors(both), errors(gray(common))
    assert found is not None
    # 10 and 14 waves, and the drive's ends.
    assert found.removed == pytest.approx(wanted.removed, rel=0.1)
    assert found.agreement < 0.6
    assert wanted.agreement == pytest.approx(1)
    # Waves that have nothing to do with each other.
    apart = gain_errors(replace(both, parts=(alone, rest)))
    assert apart is not None
    # Of the square a quarter: the waves are a few and the drive ends.
    assert apart.removed < 0.5 * wanted.removed


def test_an_image_that_one_kind_of_points_does_not_link_does_not_count():
    """The road is not seen in the images of instant 50: they have no gain of their own, and are no neighbors."""
    wave = gains(gray(0.1 * torch.sin(torch.arange(COUNT) * torch.pi / 10)))
    road = wave.parts[0]
    kept = (road.links.images != 50).all(1)
    links = Links(road.links.images[kept], road.links.ratios[kept], road.links.errors[kept], road.links.shared[kept])
    without = road.log_gains.clone()
    without[50] = 0.3
    found = gain_errors(replace(wave, parts=(replace(road, log_gains=without, links=links), road)))
    assert found is not None
    assert found.images == COUNT - 2 - 1
    wanted = gain_errors(wave)
    assert wanted is not None
    # Two of 200 images have neighbors farther away.
    assert found.removed == pytest.approx(wanted.removed, rel=0.02)
