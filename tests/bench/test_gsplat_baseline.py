"""gsplat beside our op: what agrees, with a fake gsplat."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks import gsplat_baseline
from sparsestreet.bench.accuracy import Errors, GradientError, ImageError, agrees
from sparsestreet.bench.scenes import frustum_camera
from tests.bench.fake_gsplat import fake_gsplat

CPU = torch.device("cpu")


def test_the_same_image_agrees(rows):
    found = gsplat_baseline.parity(fake_gsplat(), rows, frustum_camera(48, 32), "cpu")
    assert found.image.psnr is None
    assert agrees(found)
    assert rows.means.grad is None
    assert gsplat_baseline.draw(fake_gsplat(), rows, frustum_camera(48, 32), packed=True)[2] == 7


def test_another_image_or_another_gradient_disagrees(rows):
    found = gsplat_baseline.parity(fake_gsplat(brightness=1.02), rows, frustum_camera(48, 32), "cpu")
    assert not agrees(found)
    assert found.gradients["sh"].relative_l2 == pytest.approx(0.02, rel=1e-3)
    # A thousandth of the colors is within the limits.
    slight = gsplat_baseline.parity(fake_gsplat(brightness=1.001), rows, frustum_camera(48, 32), "cpu")
    assert agrees(slight)


def test_a_gradient_alone_can_disagree():
    image = ImageError(0.0, 0.0, None)
    good, bad = GradientError(1e-3, 1e-3), GradientError(6e-3, 1e-3)
    assert agrees(Errors(image, {"means": good, "sh": good}))
    assert not agrees(Errors(image, {"means": good, "sh": bad}))
    assert not agrees(Errors(image, {"means": GradientError(None, None)}))


@pytest.mark.parametrize(
    ("version", "alpha_max"),
    [("1.5.3", 0.999), ("1.6.0", 0.99), ("1.10.0rc1", 0.99), ("2.0", 0.99), ("unknown", 0.999)],
)
def test_settings_are_those_of_its_version(version, alpha_max):
    settings = gsplat_baseline.settings_beside(fake_gsplat(version=version))
    assert (settings.stop, settings.alpha_max, settings.near_plane) == ("exclusive", alpha_max, 0.01)
    assert gsplat_baseline.settings_beside(None).alpha_max == 0.999


def test_a_newer_version_agrees_where_its_clamp_shows(rows):
    """Opacities above 0.99: the settings of the older version would differ."""
    with torch.no_grad():
        rows.opacities.fill_(0.998)
    camera = frustum_camera(48, 32)
    assert agrees(gsplat_baseline.parity(fake_gsplat(version="1.6.0"), rows, camera, "cpu"))
    older = gsplat_baseline.answer(rows, camera, gsplat_baseline.settings_beside(None), "cpu", torch.float32)
    newer = gsplat_baseline.answer(
        rows, camera, gsplat_baseline.settings_beside(fake_gsplat(version="1.6.0")), "cpu", torch.float32
    )
    assert not agrees(gsplat_baseline.errors(older, newer))


def test_gsplat_is_looked_for_on_a_cuda_device_only(monkeypatch):
    assert "CUDA" in str(gsplat_baseline.find_gsplat(CPU))
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)  # makes the import fail
    assert "cannot be imported" in str(gsplat_baseline.find_gsplat(torch.device("cuda")))
    module = fake_gsplat()
    monkeypatch.setitem(__import__("sys").modules, "gsplat", module)
    assert gsplat_baseline.find_gsplat(torch.device("cuda")) is module


@pytest.mark.parametrize("mode", gsplat_baseline.MODES)
def test_what_gsplat_saw_is_of_all_rows(mode):
    """Packed answers are of the rows in view, here 3 and 1."""
    gradients, radii = torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([[5, 6], [8, 7]], dtype=torch.int32)
    if mode == "packed":
        meta = {"means2d": SimpleNamespace(absgrad=gradients), "radii": radii, "gaussian_ids": torch.tensor([3, 1])}
        wanted = torch.tensor([[0.0, 0.0], [3.0, 4.0], [0.0, 0.0], [1.0, 2.0]]), torch.tensor([0.0, 8.0, 0.0, 6.0])
    else:
        meta = {"means2d": SimpleNamespace(absgrad=gradients[None]), "radii": radii[None]}
        wanted = gradients, torch.tensor([6.0, 8.0])
    found = gsplat_baseline.seen(meta, 4 if mode == "packed" else 2)
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))
