"""The recording car is found in images of a moving camera, and only there."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from sparsestreet.data import datamodule
from sparsestreet.data import hood as hood_module
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.hood import Hood, find_dirt, find_hoods, with_ego
from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.effects import DirtSettings
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.types import Camera, Frame, Sweep
from tests.data.plan import make_log
from tests.evidence import wall

HEIGHT, WIDTH, COUNT = 24, 40, 12
HOOD = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
HOOD[-5:, 4:] = True
NO_LIDAR = Sweeps.of(())
FOUND = HOOD.clone()
FOUND[-6, 4:] = True  # the row in which a pixel may show both


def frames(hood: torch.Tensor | None, step: float = 3.0, noise: int = 2, camera: int = 0) -> Frames:
    """A camera that drives through noise, behind a dark hood whose pixels have a little noise of their own."""
    random = torch.Generator().manual_seed(camera)
    made = []
    for index in range(COUNT):
        image = torch.randint(120, 250, (HEIGHT, WIDTH, 3), generator=random, dtype=torch.uint8)
        if hood is not None:
            dark = torch.randint(20, 20 + noise, (HEIGHT, WIDTH, 1), generator=random, dtype=torch.uint8)
            image = torch.where(hood[..., None], dark.expand(-1, -1, 3), image)
        pose = torch.eye(4)
        pose[2, 3] = -step * index
        made.append(Frame(Camera(pose, torch.eye(3), WIDTH, HEIGHT), index / COUNT, index, camera, image=image))
    return as_frames(made)


def shares(found: Frames) -> dict[int, float]:
    return {camera: hood.share for camera, hood in find_hoods(found, NO_LIDAR).items()}


def test_every_pixel_of_a_hood_and_no_other():
    hood = find_hoods(frames(HOOD), NO_LIDAR)[0]
    assert torch.equal(hood.mask, FOUND)
    assert hood.share == pytest.approx(5 * 36 / (HEIGHT * WIDTH))
    assert hood.error < 0.01  # six images each, of which noise alone hides or adds an edge in a column or two


@pytest.mark.parametrize("hood", [None, HOOD & (torch.arange(WIDTH) < 12)])
def test_nothing_and_what_is_narrow_is_no_hood(hood):
    assert shares(frames(hood)) == {0: 0.0}


def test_columns_without_an_edge_lie_between_others():
    """A reflection of the street in three columns."""
    hood = HOOD.clone()
    hood[-5:-2, 20:23] = False
    assert torch.equal(find_hoods(frames(hood), NO_LIDAR)[0].mask[:, 20:23], FOUND[:, 20:23])


def test_a_camera_whose_exposure_changes():
    """From 0.8 to 1.2, evenly: a hood of 90 gray levels has its median change at 9, more than what counts as still."""
    bright = []
    for index, frame in enumerate(frames(HOOD)):
        image = torch.where(HOOD[..., None], frame.image + 70, frame.image).float()
        bright.append(replace(frame, image=(image * (0.8 + 0.4 * index / (COUNT - 1))).clamp(max=255).byte()))
    assert torch.equal(find_hoods(as_frames(bright), NO_LIDAR)[0].mask[-5:], FOUND[-5:])


LEFT = (torch.arange(WIDTH) < WIDTH // 2).expand(HEIGHT, WIDTH)


@pytest.mark.parametrize("moving", [torch.ones_like(LEFT), torch.zeros_like(LEFT), ~LEFT])
def test_what_moves_as_the_lidar_says_is_street(moving: torch.Tensor):
    """A camera with 10 px of focal length moves by a meter aside, in front of a wall 10 m away: 1 px.

    The mask is lower in the left half, so that each half is judged alone.
    """
    intrinsics = torch.tensor([[10.0, 0.0, WIDTH / 2], [0.0, 10.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    wall = torch.randint(0, 250, (HEIGHT, 3 * WIDTH, 1), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    seen, sweeps = [], []
    points = torch.cartesian_prod(
        torch.arange(-10.0, 40.0) + 0.5, torch.arange(-11.0, 11.0) + 0.5, torch.tensor([10.0])
    )
    for index in range(4):
        pose = torch.eye(4)
        pose[0, 3] = -index
        street, still = wall[:, WIDTH + index : 2 * WIDTH + index], wall[:, WIDTH : 2 * WIDTH]
        image = torch.where(moving[..., None], street, still).expand(-1, -1, 3)
        seen.append(Frame(Camera(pose, intrinsics, WIDTH, HEIGHT), index / 4, index, 0, image=image))
        sweeps.append(Sweep(index, 0.0, points, torch.zeros_like(points), torch.zeros(len(points), dtype=torch.bool)))
    mask = ~LEFT | (torch.arange(HEIGHT)[:, None] >= HEIGHT // 2)
    found = hood_module._without_street(mask, as_frames(seen), Sweeps.of(tuple(sweeps)))
    assert torch.equal(found, mask & ~moving)


def test_a_camera_that_stands_says_nothing():
    assert shares(frames(HOOD, step=1.5)) == {}  # 16.5 m


def test_what_stays_dark_without_an_edge_is_no_hood():
    """A shadow that gets darker towards the border by less than the least edge."""
    found = frames(HOOD)
    ramp = torch.linspace(250, 20, 60)[:, None, None].expand(-1, WIDTH, 3).byte()

    def shaded(frame: Frame) -> Frame:
        return Frame.of(frame, image=torch.cat((frame.image[:0], ramp[-HEIGHT:])))

    assert shares(as_frames([shaded(frame) for frame in found])) == {0: 0.0}


def test_frames_get_it_beside_their_own_masks():
    own = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    own[0, 0] = True
    first, second = frames(HOOD), frames(None, camera=1)
    masked = as_frames([Frame.of(frame, image=frame.image, ego=own) for frame in first])
    every: Sequence[Frame] = (*masked, *second)
    hoods = find_hoods(as_frames(every), NO_LIDAR)
    seen = with_ego(as_frames(every), {camera: hood.mask for camera, hood in hoods.items()})
    assert torch.equal(seen[0].ego, own | FOUND)
    assert seen[COUNT].ego is None  # the other camera shows none


def test_nothing_is_looked_for_in_held_out_frames():
    found, read = frames(HOOD), set()
    lazy = Frames(found.views, lambda view: read.add(view.frame_index) or found[view.frame_index])
    log = replace(make_log(COUNT), frames=lazy, num_frames=COUNT, num_cameras=1)
    StreetData(log, stride=4, offset=2, hood=0.02, dirt=0.02)
    assert read == {index for index in range(COUNT) if index % 4 != 2}


def test_spots_on_the_lens_join_the_hood(monkeypatch: pytest.MonkeyPatch):
    hood, spot = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    hood[-6:], spot[2:9, 3:9] = True, True
    monkeypatch.setattr(datamodule, "find_hoods", lambda *_: {0: Hood(hood, 0.0)})
    monkeypatch.setattr(datamodule, "find_dirt", lambda *_: {0: Hood(spot, 0.0)})
    log = replace(make_log(COUNT), frames=frames(None), num_frames=COUNT, num_cameras=1)
    data = StreetData(log, stride=4, offset=2, hood=0.02, dirt=0.02)
    assert torch.equal(data.split.train[0].ego, hood | spot)


def test_training_and_held_out_frames_lose_its_pixels():
    log = make_log(COUNT)
    moving = as_frames([Frame.of(frame, image=frame.image) for frame in frames(HOOD)])
    log = replace(log, frames=moving, num_frames=COUNT, num_cameras=1)
    data = StreetData(log, stride=4, offset=2, hood=0.02)
    for part in (data.split.train, data.split.held_out, data.driving_log.frames):
        assert torch.equal(part[0].ego, FOUND)
    assert data.driving_log.hoods[0].share > 0.1
    # Less than what is asked for, and not asked for at all.
    for hood in (0.5, None):
        assert StreetData(log, stride=4, offset=2, hood=hood).split.train[0].ego is None


INSTANTS = 40
"""24 m of driving."""
SPOT = torch.zeros(wall.HEIGHT, wall.WIDTH, dtype=torch.bool)
SPOT[12:18, 30:37] = True


def spotted_frames(opacity: float = 0.95, spot: torch.Tensor = SPOT) -> Frames:
    """The first of two cameras sees the wall through a dark spot."""
    made = []
    for instant in range(INSTANTS):
        for number in (0, 1):
            frame = wall.frame(instant, number, torch.full((3,), 1.5))
            dirty = torch.where(spot[..., None], (1 - opacity) * frame.image + opacity * 20, frame.image).byte()
            made.append(replace(frame, image=frame.image if number else dirty))
    return as_frames(made)


def sweeps() -> Sweeps:
    return Sweeps.of(tuple(replace(wall.sweep(instant), index=instant) for instant in range(INSTANTS)))


def test_a_spot_is_masked_with_its_soft_edge():
    found = find_dirt(spotted_frames(), sweeps(), ())
    assert found[0].mask[SPOT].all()
    # Half of its radius of 3.7 pixels around 42 pixels.
    assert SPOT.sum() < found[0].mask.sum() < 2.5 * SPOT.sum()
    assert found[0].error < 0.01
    assert not found[1].mask.any()


@pytest.mark.parametrize("opacity", [0.0, 0.5])
def test_nothing_and_what_hides_half_is_no_dirt(opacity: float):
    assert not find_dirt(spotted_frames(opacity), sweeps(), ())[0].mask.any()


def test_what_no_return_passes_behind_is_not_told():
    assert not find_dirt(spotted_frames(), Sweeps.of(()), ())[0].mask.any()
    beside = SPOT.roll(-12, 0)  # in the rows above the wall that the lidar sees
    above = [_below(sweep, -1.5) for sweep in sweeps()]
    assert not find_dirt(spotted_frames(spot=beside), Sweeps.of(tuple(above)), ())[0].mask.any()


def _below(sweep: Sweep, height: float) -> Sweep:
    kept = sweep.points[:, 1] > height
    return replace(sweep, points=sweep.points[kept], colors=sweep.colors[kept], colored=sweep.colored[kept])


def test_a_line_that_stays_is_no_spot():
    line = torch.zeros_like(SPOT)
    line[:, 30:33] = True
    assert not find_dirt(spotted_frames(spot=line), sweeps(), ())[0].mask.any()


def test_frames_lose_its_pixels_and_the_plan_says_so():
    log = DrivingLog("wall", spotted_frames(), sweeps(), (), INSTANTS, 2, torch.eye(4, dtype=torch.float64))
    data = StreetData(log, stride=20, offset=5, dirt=0.005)
    mask = data.driving_log.dirt[0].mask
    for part in (data.split.train, data.split.held_out, data.driving_log.frames):
        assert torch.equal(part[0].ego, mask)
        assert part[1].ego is None
    found = DirtSettings().detect(TrainingData(data.driving_log, data.split.train, frozenset()))
    assert (found.called_for, found.missing) == (True, None)
    assert found.value == pytest.approx(float(mask.float().mean()))
    assert StreetData(log, stride=20, offset=5).split.train[0].ego is None


def test_a_camera_that_stands_has_no_dirt():
    still = spotted_frames().at(range(20))  # 5.4 m
    assert find_dirt(still, sweeps(), ()) == {}
    log = DrivingLog("wall", still, sweeps(), (), 10, 2, torch.eye(4, dtype=torch.float64))
    found = DirtSettings().detect(TrainingData(log, still, frozenset()))
    assert not found.called_for
    assert "no camera of wall moves by 20 m" in found.reason
