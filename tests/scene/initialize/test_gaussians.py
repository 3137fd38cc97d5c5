import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.gaussians import init_gaussians, lie_flat, neighbor_scales


def seeded(
    points: Tensor, colors: Tensor, opacity: float = 0.1, sh_degree: int = 3, mask_columns: dict | None = None
) -> Rows:
    generator = torch.Generator().manual_seed(0)
    return init_gaussians(
        points,
        colors,
        neighbor_scales(points),
        sh_degree=sh_degree,
        opacities=torch.full((len(points),), opacity),
        generator=generator,
        mask_columns=mask_columns,
    )


def test_against_all_distances():
    points = torch.randn(57, 3, generator=torch.Generator().manual_seed(0))
    nearest = torch.cdist(points.double(), points.double()).sort(dim=1).values[:, 1:4]
    torch.testing.assert_close(neighbor_scales(points).double(), nearest.mean(1), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("count", "expected"), [(0, []), (1, [1e-3]), (2, [2.0, 2.0])])
def test_fewer_than_four_points(count: int, expected: list[float]):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])[:count]
    torch.testing.assert_close(neighbor_scales(points), torch.tensor(expected))


def test_coincident_points_have_a_logarithm():
    rows = seeded(torch.ones(6, 3), torch.rand(6, 3))
    torch.testing.assert_close(rows.log_scales, torch.full((6, 3), 1e-3).log())


def test_rows_of_points():
    colors = torch.tensor([[1.0, 0.0, 0.5], [0.2, 0.3, 0.4]])
    rows = seeded(torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]]), colors)
    # color = 0.5 + basis_0 sh_0 with basis_0 = 0.28209479
    # Black starts half a gray level above 0, where a color has a gradient.
    torch.testing.assert_close(0.5 + 0.28209479177387814 * rows.sh_dc[:, 0], colors.clamp(min=1 / 510))
    assert rows.sh_rest.shape == (2, 15, 3)
    assert (rows.sh_rest == 0).all()
    torch.testing.assert_close(torch.sigmoid(rows.opacity_logits), torch.full((2,), 0.1))
    torch.testing.assert_close(rows.log_scales.exp(), torch.full((2, 3), 5.0))
    torch.testing.assert_close(rows.quaternions.norm(dim=1), torch.ones(2))
    assert "mask_logits" not in rows.columns()
    one = torch.full((2,), 0.5).double()
    exact = init_gaussians(
        colors.double(), colors.double(), one, opacities=one, sh_degree=1, generator=torch.Generator()
    )
    assert {column.dtype for column in exact.columns().values()} == {torch.float32}


@pytest.mark.parametrize("opacity", [0.0, 1.0, -0.1])
def test_impossible_opacities_are_errors(opacity: float):
    with pytest.raises(ValueError, match="initial opacities must lie between 0 and 1, got"):
        seeded(torch.rand(3, 3), torch.rand(3, 3), opacity=opacity)


def test_an_unknown_degree_is_an_error():
    with pytest.raises(ValueError, match="sh_degree=4"):
        seeded(torch.rand(3, 3), torch.rand(3, 3), sh_degree=4)


def test_gaussians_lie_flat_on_their_surface_and_others_stay():
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator), dim=1)
    normals[:, 2] = normals[:, 2].abs()
    normals[0], normals[1] = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])
    normals[5] = torch.nan
    points = torch.rand(6, 3, generator=generator)
    rows, before = seeded(points, points), seeded(points, points)
    lie_flat(rows, normals)
    # scipy's quaternions end with w.
    turned = Rotation.from_quat(rows.quaternions[:5].detach().roll(-1, 1).numpy()).apply([0.0, 0.0, 1.0])
    torch.testing.assert_close(torch.from_numpy(turned).float(), normals[:5])
    assert rows.log_scales[:5, 2].exp().tolist() == pytest.approx([0.01] * 5)
    assert torch.equal(rows.log_scales[:, :2], before.log_scales[:, :2])
    assert torch.equal(rows.quaternions[5], before.quaternions[5])
    assert torch.equal(rows.log_scales[5], before.log_scales[5])


def test_what_is_thinner_than_a_surface_stays_so():
    rows = seeded(torch.zeros(2, 3), torch.ones(2, 3))
    lie_flat(rows, torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3))
    assert rows.log_scales.exp().flatten().tolist() == pytest.approx([1e-3] * 6)
