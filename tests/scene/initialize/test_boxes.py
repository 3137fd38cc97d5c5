import torch

from sparsestreet.scene.initialize.boxes import box_surface_points


def test_box_points_are_spread_by_area():
    size = torch.tensor([4.0, 2.0, 1.0])
    points = box_surface_points(9000, size, torch.Generator().manual_seed(0))
    on_face = (points.abs() - size / 2).abs() < 1e-6
    assert (on_face.sum(1) == 1).all()
    assert (points.abs() <= size / 2 + 1e-6).all()
    share = on_face.float().mean(0)
    # Areas 2, 4, 8 of 14; standard deviation of a share of 9,000 draws is 0.005.
    torch.testing.assert_close(share, torch.tensor([2.0, 4.0, 8.0]) / 14, atol=0.02, rtol=0)
    assert ((points[:, 2] > 0).float().mean() - 0.5).abs() < 0.03
