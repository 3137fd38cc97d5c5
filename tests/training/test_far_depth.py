"""The term of depths far ahead, beside sums by hand in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.far_depth import FarDepthTerm
from sparsestreet.triangulation import SweepSettings, TriangulatedPoints
from sparsestreet.types import Camera, Frame
from tests.scene.street import triangulated
from tests.training.stubs import StubTrainer, background, frame_at, make_system
from tests.training.test_losses import rendering

WIDTH, HEIGHT = 8, 6


def turned(degrees: float, shift: tuple[float, float, float]) -> torch.Tensor:
    """camera_from_world of a camera that is turned about an axis that is none of the world's."""
    axis = torch.tensor([1.0, 2.0, -1.0]).double()
    x, y, z = axis / axis.norm()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.matrix_exp(np.radians(degrees) * skew)
    pose[:3, 3] = torch.tensor(shift)
    return pose.float()


def frame(index: int, camera_index: int, pose: torch.Tensor) -> Frame:
    intrinsics = torch.tensor([[9.0, 0, 4.0], [0, 9.0, 3.0], [0, 0, 1]])
    camera = Camera(pose, intrinsics, WIDTH, HEIGHT)
    return Frame(camera, 0.3, index, camera_index, image=torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))


FRAMES = [frame(4, 1, turned(40, (1, 2, 3))), frame(9, 0, turned(-75, (0, -30, 8))), frame(9, 1, turned(10, (5, 5, 5)))]
PIXELS = {0: [(1.5, 0.5), (7.99, 5.99), (3.2, 2.7)], 2: [(0.1, 4.4)]}
DEPTHS = {0: [30.0, 55.0, 90.0], 2: [44.0]}


def points() -> TriangulatedPoints:
    """Some of the first and of the last view, mixed."""
    rows = [(2, 0), (0, 0), (0, 1), (0, 2)]
    positions = []
    for place, row in rows:
        camera = FRAMES[place].camera
        at = torch.tensor([*PIXELS[place][row], 1.0]).double()
        local = DEPTHS[place][row] * torch.linalg.solve(camera.intrinsics.double(), at)
        pose = camera.camera_from_world.double()
        positions.append(torch.linalg.solve(pose[:3, :3], local - pose[:3, 3]).numpy())
    pixels = np.array([PIXELS[place][row] for place, row in rows], np.float32)
    nothing = np.zeros((4, 3), np.float32)
    views = np.array([place for place, _ in rows])
    return TriangulatedPoints(np.array(positions, np.float32), nothing, nothing[:, 0], np.arange(4), views, pixels)


def term(weight: float = 0.7) -> FarDepthTerm:
    return FarDepthTerm(points(), FRAMES, SweepSettings(depth_weight=weight, width=WIDTH))


def drawn(height: int = HEIGHT, width: int = WIDTH, alpha: float = 0.9) -> SceneRendering:
    depth = 20 + 50 * torch.rand(height, width, generator=torch.Generator().manual_seed(2))
    return rendering(torch.zeros(height, width, 3), torch.full((height, width), alpha), depth.requires_grad_())


def by_hand(seen: SceneRendering, place: int, weight: float = 0.7, pixels: int = WIDTH * HEIGHT) -> float:
    depth = seen.depth.detach().double().numpy()
    height, width = depth.shape
    logs = [
        np.log(depth[int(y * height / HEIGHT), int(x * width / WIDTH)] / swept)
        for (x, y), swept in zip(PIXELS[place], DEPTHS[place], strict=True)
    ]
    return weight * float(np.abs(logs).sum()) / pixels


@pytest.mark.parametrize("place", [0, 2])
def test_the_term_is_the_mean_over_the_image_of_what_logarithms_differ(place):
    seen = drawn()
    value = term()(seen, FRAMES[place])
    assert value.item() == pytest.approx(by_hand(seen, place), rel=1e-5)
    value.backward()
    expected = torch.zeros(HEIGHT, WIDTH)
    for (x, y), swept in zip(PIXELS[place], DEPTHS[place], strict=True):
        rendered = float(seen.depth[int(y), int(x)].detach())
        expected[int(y), int(x)] = 0.7 / (WIDTH * HEIGHT) * (1 if rendered > swept else -1) / rendered
    torch.testing.assert_close(seen.depth.grad, expected)


def test_an_image_of_another_size_is_compared_at_the_same_places():
    for height, width in ((3, 4), (12, 16), (5, 7)):
        seen = drawn(height, width)
        assert term()(seen, FRAMES[0]).item() == pytest.approx(by_hand(seen, 0), rel=1e-5)


def test_a_sweep_of_smaller_images_weighs_as_much():
    """It has fewer points of as many fewer pixels."""
    seen = drawn()
    assert term()(seen, FRAMES[0]).item() == pytest.approx(by_hand(seen, 0), rel=1e-5)
    camera = replace(FRAMES[0].camera, width=16, height=12)
    large = [replace(FRAMES[0], camera=camera), *FRAMES[1:]]
    half = FarDepthTerm(replace(points(), pixels=2 * points().pixels), large, SweepSettings(depth_weight=0.7, width=8))
    assert half(drawn(), large[0]).item() == pytest.approx(by_hand(seen, 0), rel=1e-5)


def test_sky_and_fog_are_not_asked():
    seen = drawn(alpha=0.5)
    value = term()(seen, FRAMES[0])
    value.backward()
    assert value.item() == 0
    assert seen.depth.grad.count_nonzero() == 0
    nothing = rendering(torch.zeros(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH))
    assert term()(nothing, FRAMES[0]).item() == 0


def test_a_view_that_was_not_swept_has_no_term():
    assert [term().applies(one) for one in FRAMES] == [True, False, True]
    assert not term(0.0).applies(FRAMES[0])


def test_a_step_adds_the_term_of_a_swept_view():
    swept = triangulated([[0.0, 0.0, 40.0]], [(0, 0, 6.5, 4.5)])
    far = FarDepthTerm(swept, [frame_at()], SweepSettings(depth_weight=3.0))

    def step(index: int, term: FarDepthTerm | None) -> tuple[float, float]:
        system = make_system({"background": background(400, seed=3)}, far_depth=term)
        value = StubTrainer(system, max_steps=12).system.training_step(frame_at(index), 0).item()
        return value, system.said.newest.get("train/far_depth", 0.0)

    (plain, _), (more, said) = step(0, None), step(0, far)
    assert said > 1e-3
    assert more - plain == pytest.approx(said, rel=1e-3)
    assert step(1, far) == step(1, None)
