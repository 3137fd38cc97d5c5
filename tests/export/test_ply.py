"""Our .ply files, read back by plyfile with the layout that INRIA's code writes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sparsestreet.export.ply import (
    MAX_CAMERAS,
    instance_names,
    plain_factors,
    scene_gaussians,
    spread_cameras,
    write_ply,
)
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.scene.nodes import Rigid
from sparsestreet.types import Camera, Gaussians, View
from tests.export.street import CAR_ROWS, ROAD_ROWS, TRAM_ROWS, stored_street
from tests.typed import as_a


def gaussians(count: int = 7, terms: int = 9) -> Gaussians:
    generator = torch.Generator().manual_seed(5)
    return Gaussians(
        torch.randn(count, 3, generator=generator) * 100,
        torch.randn(count, 4, generator=generator) * 3,
        torch.rand(count, 3, generator=generator) + 0.001,
        torch.rand(count, generator=generator) * 0.9 + 0.05,
        torch.randn(count, terms, 3, generator=generator),
    )


def columns(path, *names: str) -> torch.Tensor:
    vertices = PlyData.read(path)["vertex"]
    return torch.tensor(np.stack([vertices[name] for name in names], axis=1))


def numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{index}" for index in range(count)]


def test_plyfile_reads_the_same_gaussians(tmp_path):
    path, written = tmp_path / "street.ply", gaussians()
    assert write_ply(path, written) == 7
    assert torch.equal(columns(path, "x", "y", "z"), written.means)
    assert torch.equal(columns(path, "nx", "ny", "nz"), torch.zeros(7, 3))
    # exp and sigmoid of a float32 that was rounded once: a few units of its last digit.
    torch.testing.assert_close(columns(path, *numbered("scale", 3)).exp(), written.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(columns(path, "opacity").sigmoid().squeeze(1), written.opacities, rtol=1e-6, atol=0)
    unit = written.quaternions / written.quaternions.norm(dim=1, keepdim=True)
    torch.testing.assert_close(columns(path, *numbered("rot", 4)), unit, rtol=0, atol=1e-7)
    assert torch.equal(columns(path, *numbered("f_dc", 3)), written.dense_sh()[:, 0])
    for channel in range(3):
        for term in range(8):
            rest = columns(path, f"f_rest_{channel * 8 + term}").squeeze(1)
            assert torch.equal(rest, written.dense_sh()[:, 1 + term, channel]), (channel, term)


def test_the_layout_is_inrias(tmp_path):
    path = tmp_path / "street.ply"
    write_ply(path, gaussians(terms=16))
    data = PlyData.read(path)
    expected = ["x", "y", "z", "nx", "ny", "nz", *numbered("f_dc", 3), *numbered("f_rest", 45)]
    expected += ["opacity", *numbered("scale", 3), *numbered("rot", 4)]
    assert [item.name for item in data["vertex"].properties] == expected
    assert {item.val_dtype for item in data["vertex"].properties} == {"f4"}
    assert (data.text, data.byte_order) == (False, "<")


def test_rows_that_are_not_there_are_left_out(tmp_path):
    """Without harmonics there are no columns for them; a flat Gaussian has finite numbers."""
    opacities, flat = torch.tensor([0.0, 0.5, 0.0, 1.0, 0.2, 0.0, 0.3]), gaussians().scales.clone()
    flat[1, 1] = 0
    assert write_ply(tmp_path / "some.ply", replace(gaussians(terms=1), opacities=opacities, scales=flat)) == 4
    names = [item.name for item in PlyData.read(tmp_path / "some.ply")["vertex"].properties]
    assert not [name for name in names if name.startswith("f_rest")]
    logs = columns(tmp_path / "some.ply", *numbered("scale", 3))
    assert logs.isfinite().all()
    assert logs.exp()[0, 1] < 1e-20
    read = columns(tmp_path / "some.ply", "opacity").sigmoid().squeeze(1)
    torch.testing.assert_close(read, opacities[opacities > 0], rtol=1e-6, atol=0)
    assert torch.equal(columns(tmp_path / "some.ply", "x", "y", "z"), gaussians().means[opacities > 0])
    # The tram has left.
    assert write_ply(tmp_path / "late.ply", scene_gaussians(stored_street(), 1.0)) == ROAD_ROWS + CAR_ROWS


def test_what_cannot_be_written_is_said_and_leaves_no_file(tmp_path):
    with pytest.raises(ValueError, match="opacity above 0"):
        write_ply(tmp_path / "a.ply", replace(gaussians(), opacities=torch.zeros(7)))
    means = gaussians().means.clone()
    means[3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"means must be finite, but row 3 has nan"):
        write_ply(tmp_path / "a.ply", replace(gaussians(), means=means))
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written"):
        write_ply(tmp_path / "file" / "a.ply", gaussians())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_scene_at_a_time_is_all_its_nodes():
    stored = stored_street()
    whole = scene_gaussians(stored, 0.0)
    assert len(whole) == ROAD_ROWS + CAR_ROWS + TRAM_ROWS
    assert whole.dense_sh().shape[1] == 9  # the background's degree; the objects' lower one is padded
    # The car starts at (8, 1, 1) without a turn.
    car = scene_gaussians(stored, 0.0, instances=["car"])
    box = stored.scene.nodes["rigid"].rows.means[:CAR_ROWS].detach()
    torch.testing.assert_close(car.means, box + torch.tensor([8.0, 1.0, 1.0]))
    assert not car.means.requires_grad


def test_nodes_and_instances_choose(tmp_path):
    stored = stored_street()
    whole = scene_gaussians(stored, 0.25)
    assert torch.equal(scene_gaussians(stored, 0.25, nodes=["background"]).means, whole.means[:ROAD_ROWS])
    assert torch.equal(scene_gaussians(stored, 0.25, nodes=["rigid"]).means, whole.means[ROAD_ROWS:])
    tram = scene_gaussians(stored, 0.25, instances=["tram"])
    assert torch.equal(tram.means, whole.means[ROAD_ROWS + CAR_ROWS :])
    both = scene_gaussians(stored, 0.25, instances=["tram", "car"])
    assert torch.equal(both.means, whole.means[ROAD_ROWS:])
    assert instance_names(stored) == ["car", "tram"]


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"instances": ["cart"]}, r"no instance 'cart'; it has car, tram"),
        ({"nodes": ["rigids"]}, r"no node 'rigids'; it has background, rigid"),
        ({"instances": ["tram"]}, r"tram is not in the scene at time 0\.8: it is there from 0\.000 to 0\.500"),
        ({"instances": ["car"], "nodes": ["rigid"]}, "leave one out"),
    ],
)
def test_a_choice_that_is_not_there_names_what_is(choice, said):
    with pytest.raises(ValueError, match=said):
        scene_gaussians(stored_street(), 0.8, **choice)
    with pytest.raises(ValueError, match=r"time runs from 0 .* got 1\.2"):
        scene_gaussians(stored_street(), 1.2)


def test_an_object_that_is_there_between_two_even_frames_is_found():
    stored = stored_street()
    as_a(Rigid, stored.scene.nodes["rigid"]).spans[1] = torch.tensor([0.26, 0.37])
    with pytest.raises(ValueError, match=r"it is there from 0\.260 to 0\.370"):
        scene_gaussians(stored, 0.8, instances=["tram"])


def test_a_file_that_claims_frames_without_end_is_answered_in_time():
    endless = replace(stored_street(), num_frames=10**12)
    with pytest.raises(ValueError, match=r"tram is not in the scene at time 0\.8: it is there from 0\.000 to 0\.500"):
        scene_gaussians(endless, 0.8, instances=["tram"])


MIP = SplatSettings(antialias=True)


def ahead(distance: float, *, focal: float = 40.0) -> Camera:
    """Looks along z from so far before the origin."""
    pose = torch.eye(4)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[focal, 0.0, 20.3], [0.0, focal, 16.8], [0.0, 0.0, 1.0]])
    return Camera(pose, intrinsics, 41, 33)


def some(*, behind: bool = False) -> Gaussians:
    """Three of other sizes side by side, that do not overlap; the last one may lie behind all cameras."""
    means = torch.tensor([[-2.0, 0.0, 0.0], [0.3, 0.4, 0.1], [2.0, -0.5, -900.0 if behind else 0.2]])
    scales = torch.tensor([[0.02, 0.03, 0.02], [0.1, 0.04, 0.2], [0.3, 0.2, 0.25]])
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.8, 0.0, 0.6, 0.0], [0.6, 0.0, 0.0, 0.8]])
    sh = torch.zeros(3, 1, 3)
    sh[:, 0] = torch.tensor([[0.9, 0.1, 0.5], [0.3, 1.2, 0.2], [0.6, 0.6, 1.4]])
    return Gaussians(means, turns, scales, torch.tensor([0.9, 0.7, 0.5]), sh)


def test_one_camera_then_sees_without_antialias_what_it_sees_with_it():
    gaussians, camera = some(), ahead(10.0)
    factors = plain_factors([(gaussians, [camera])], MIP)
    assert factors[0] < 0.1 < factors[1] < 0.5 < factors[2] < 1
    wanted = splat(gaussians, camera, settings=MIP).rgb
    baked = replace(gaussians, opacities=gaussians.opacities * factors)
    # float32, of colors up to 1; without factors the images differ by 0.3.
    torch.testing.assert_close(splat(baked, camera, settings=SplatSettings()).rgb, wanted, rtol=0, atol=1e-5)
    assert (splat(gaussians, camera, settings=SplatSettings()).rgb - wanted).abs().max() > 0.1


def test_several_cameras_count_alike_and_whom_none_sees_keeps_its_opacity():
    near, far, gaussians = ahead(4.0), ahead(30.0), some(behind=True)
    moved = replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0.0, 3.0]))
    looks = [(gaussians, near), (gaussians, far), (moved, far)]
    alone = [plain_factors([(one, [camera])], MIP) for one, camera in looks]
    both = plain_factors([(gaussians, [near, far]), (moved, [far])], MIP)
    torch.testing.assert_close(both[:2], torch.stack(alone).mean(0)[:2])
    assert alone[0][0] > 2 * alone[1][0]
    assert both[2] == 1


def test_without_antialias_nothing_changes():
    assert plain_factors([(some(), [ahead(10.0)])], SplatSettings()) == 1


@pytest.mark.parametrize("count", [1, 36, 100])
def test_cameras_are_spread_over_all_views(count):
    views = [View(ahead(float(place)), 0.0) for place in range(count)]
    places = [float(camera.camera_from_world[2, 3]) for camera in spread_cameras(views)]
    assert len(places) == min(count, MAX_CAMERAS)
    assert (places[0], places[-1]) == (0.0, float(count - 1))
