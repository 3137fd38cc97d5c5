"""What gains would remove from held-out images, for gains of which it is known."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.evidence.exposure import EV, GainErrors, ImageGains, Links, PartGains, gain_errors
from sparsestreet.types import Camera, View

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
