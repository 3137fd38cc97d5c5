"""Means over images: against torchmetrics where it defines the same, and of two processes against one."""

import math
from datetime import timedelta
from functools import partial
from statistics import fmean
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torchmetrics.image import PeakSignalNoiseRatio
from torchmetrics.image.fid import _compute_fid
from torchmetrics.image.kid import poly_mmd

from sparsestreet.metrics.image import GAUSS11
from sparsestreet.metrics.lpips import ALEX, Lpips
from sparsestreet.metrics.reported import ImageMetric, PerceptualDistance, Psnr, SetDistances, Ssim, reported_metrics
from tests.metrics.images import image_pair
from tests.metrics.networks import random_weights
from tests.training.parallel.several import PATIENCE, several

COUNT = 5
"""Images: no multiple of two processes."""
REGIONS = ("full", "human", "vehicle")


class MeanColor:
    name = "colors"

    def __call__(self, image):
        return image.double().mean((0, 1)).numpy()


def images() -> list[tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]]:
    """Pairs with masks: people are in the second alone, and the vehicle mask of the third is empty."""
    found = []
    for index in range(COUNT):
        image, truth = image_pair((36, 40), seed=index, dtype=torch.float32)
        vehicle = torch.rand(36, 40, generator=torch.Generator().manual_seed(index)) < 0.3
        masks = {"vehicle": vehicle & (index != 2)} | ({"human": ~vehicle} if index == 1 else {})
        found.append((image, truth, masks))
    return found


def metrics() -> dict[str, ImageMetric]:
    return {"psnr": Psnr(REGIONS), **{"ssim": Ssim(REGIONS), "alex": PerceptualDistance(alex(), REGIONS)}}


def alex() -> Lpips:
    return Lpips(random_weights(ALEX))


def means(rank: int = 0, size: int = 1) -> dict[str, Any]:
    """All means, of the share of a process among several."""
    if size > 1:
        dist.init_process_group("gloo", rank=rank, world_size=size, timeout=timedelta(seconds=PATIENCE))
    found: dict[str, Any] = metrics()
    sets = SetDistances(MeanColor())
    for image, truth, masks in images()[rank::size]:
        for metric in found.values():
            metric.update(image, truth, masks)
        sets.update(image, real=False)
        sets.update(truth, real=True)
    return {name: metric.compute() for name, metric in found.items()} | {"sets": sets.compute()}


def test_two_processes_have_the_bits_of_one(tmp_path):
    one = means()
    for answer in several(2, partial(means, size=2), tmp_path):
        # The order of the images turns with the processes: sums of matrices have other last bits.
        assert answer.pop("sets") == pytest.approx(one["sets"], rel=1e-9)
        assert answer == {name: value for name, value in one.items() if name != "sets"}


def test_a_mean_is_over_the_images_that_have_the_region():
    found = metrics()["psnr"]
    values = []
    for image, truth, masks in images():
        found.update(image, truth, masks)
        values.append(found.measure(image, truth, masks))
    assert found.compute() == {
        region: fmean(value[region] for value in values if value.get(region) is not None) for region in REGIONS
    }
    assert [value["vehicle"] is None for value in values] == [False, False, True, False, False]
    found.reset()
    found.update(*images()[0][:2])
    assert list(found.compute()) == ["full"]


def test_psnr_is_torchmetrics_mean_over_images():
    ours, theirs = Psnr(), PeakSignalNoiseRatio(data_range=1.0, dim=(1, 2, 3))
    for image, truth, _ in images():
        ours.update(image, truth)
        theirs.update(*(each.permute(2, 0, 1)[None].double() for each in (image, truth)))
    assert ours.compute()["full"] == pytest.approx(float(theirs.compute()), rel=1e-6)  # it returns a float32


def test_distances_of_sets_are_torchmetrics():
    """With more images than features, where its square root of a matrix has all digits."""
    sets = SetDistances(MeanColor())
    shown = {real: [torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(2 * seed + real), dtype=torch.float64)
                    for seed in range(20)] for real in (True, False)}  # fmt: skip
    for real, pictures in shown.items():
        for picture in pictures:
            sets.update(picture, real=real)
    rendered, real = (
        torch.stack([torch.from_numpy(MeanColor()(one)) for one in shown[kind]]) for kind in (False, True)
    )
    moments = [moment for one in (rendered, real) for moment in (one.mean(0), torch.cov(one.T))]
    found = sets.compute()
    assert found["frechet_colors"] == pytest.approx(float(_compute_fid(*moments)), rel=1e-6)
    # torchmetrics sums over equal rows in the order of the rendered images first.
    assert found["kernel_colors"] == pytest.approx(float(poly_mmd(rendered, real, degree=3)), abs=1e-12)
    sets.reset()
    for picture in shown[False][:5]:
        sets.update(picture, real=False)
    assert math.isfinite(sets.compute()["frechet_colors"])  # the real ones are still there


def test_small_images_have_no_value_where_a_window_or_a_network_does_not_fit():
    image, truth = image_pair((10, 40))
    found = {
        name: metric.measure(image, truth, {}) for name, metric in reported_metrics({"lpips_alex": alex()}).items()
    }
    assert [name for name, value in found.items() if value["full"] is None] == ["ssim_gauss11", "lpips_alex"]
    image, truth = image_pair((11, 40))
    assert Ssim(window=GAUSS11).measure(image, truth, {})["full"] is not None
