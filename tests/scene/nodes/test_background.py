import pytest
import torch

from sparsestreet.scene.gaussians import Rows
from tests.scene.street import background, degree, random_rows, static_mask, view_at


def test_activations_by_hand():
    columns = {
        "means": torch.tensor([[1.0, 2.0, 3.0]]),
        "log_scales": torch.log(torch.tensor([[0.5, 1.0, 2.0]])),
        "quaternions": torch.tensor([[0.0, 2.0, 0.0, 0.0]]),
        "opacity_logits": torch.log(torch.tensor([3.0])),  # 3 / (1 + 3)
        "sh_dc": torch.tensor([[[0.1, 0.2, 0.3]]]),
        "sh_rest": torch.arange(24.0).reshape(1, 8, 3),
    }
    gaussians = background(Rows(columns)).gaussians_at(view_at(0.7), degree(1))
    assert torch.equal(gaussians.means, columns["means"])
    torch.testing.assert_close(gaussians.scales, torch.tensor([[0.5, 1.0, 2.0]]))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.75]))
    assert torch.equal(gaussians.quaternions, columns["quaternions"])
    assert torch.equal(gaussians.dense_sh()[:, :1], columns["sh_dc"])
    assert torch.equal(gaussians.dense_sh()[:, 1:], columns["sh_rest"][:, :3])


@pytest.mark.parametrize(("active", "terms"), [(0, 1), (1, 4), (2, 9), (3, 9)])
def test_sh_terms_up_to_the_stored_degree(active: int, terms: int):
    node = background(random_rows(5, 0, sh_degree=2))
    assert node.gaussians_at(view_at(0.0), degree(active)).dense_sh().shape == (5, terms, 3)


def test_extreme_opacity_logits_stay_finite():
    rows = random_rows(2, 0)
    with torch.no_grad():
        rows.opacity_logits.copy_(torch.tensor([1e4, -1e4]))
    opacities = background(rows).gaussians_at(view_at(0.0), degree(0)).opacities
    assert torch.isfinite(opacities).all()
    assert 0 < opacities[1] < 1e-6
    assert 1 - 1e-6 < opacities[0] <= 1


def test_mask_and_its_logits_come_together():
    mask = static_mask()
    with pytest.raises(ValueError, match="mask_logits"):
        background(random_rows(2, 0), mask)
    with pytest.raises(ValueError, match="mask_logits"):
        background(random_rows(2, 0, mask=mask))


def test_masked_rows_vanish_and_the_table_stays_unmasked():
    mask = static_mask()
    node = background(random_rows(6, 0, mask=mask), mask)
    hidden = torch.tensor([False, True, False, False, True, True])
    plain = background(random_rows(6, 0)).gaussians_at(view_at(0.0), degree(1))
    with torch.no_grad():
        node.rows.mask_logits[hidden] = -5.0  # 0.0067 < 0.01
    gaussians = node.gaussians_at(view_at(0.0), degree(1))
    assert (gaussians.opacities[hidden] == 0).all()
    assert (gaussians.scales[hidden] == 0).all()
    # Multiplying by exactly 1 changes no bit.
    assert torch.equal(gaussians.opacities[~hidden], plain.opacities[~hidden])
    assert torch.equal(gaussians.scales[~hidden], plain.scales[~hidden])
    assert torch.isfinite(node.rows.log_scales).all()


def test_the_mask_multiplies_opacity_and_scale_in_the_gradient():
    """d/dm of sum(c_o o M + c_s . s M) = (c_o o + c_s . s) sigma'(m), by the straight-through rule."""
    mask = static_mask()
    rows = random_rows(5, 1, mask=mask)
    node = background(rows, mask)
    generator = torch.Generator().manual_seed(2)
    opacity_weight, scale_weight = torch.randn(5, generator=generator), torch.randn(5, 3, generator=generator)
    gaussians = node.gaussians_at(view_at(0.0), degree(0))
    loss = (gaussians.opacities * opacity_weight).sum() + (gaussians.scales * scale_weight).sum()
    loss.backward()
    sigma = torch.sigmoid(rows.mask_logits.detach().double())
    opacities = torch.sigmoid(rows.opacity_logits.detach().double())
    scales = rows.log_scales.detach().double().exp()
    by_hand = (opacity_weight * opacities + (scale_weight * scales).sum(1)) * sigma * (1 - sigma)
    torch.testing.assert_close(rows.mask_logits.grad.double(), by_hand, rtol=1e-5, atol=1e-6)  # float32 sums


def test_sizes_are_float32_without_the_mask():
    mask = static_mask()
    node = background(random_rows(3, 0, sh_degree=3, mask=mask), mask)
    assert node.row_bytes() == 3 * 59 * 4  # 3 + 3 + 4 + 1 + 48, the 59 numbers of 3DGS
    assert node.pose_bytes() == 0
