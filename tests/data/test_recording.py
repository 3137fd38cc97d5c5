"""The log that follows from what a reader found: here, of a camera whose lens is taken out of its images."""

import math
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.data.doubts import doubts
from sparsestreet.data.problems import fault
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage, RecordedReader, Recording, log_of
from sparsestreet.data.rig import RigCamera, lens_camera
from sparsestreet.geometry.lenses import Fisheye, Lens, Rational
from sparsestreet.types import Shutter
from tests.typed import there

SIZE = (24, 16)
WIDE = Fisheye(fx=8.0, fy=8.0, cx=12.0, cy=8.0, k1=-0.02)
FLAT = Rational(fx=30.0, fy=30.0, cx=12.0, cy=8.0)
HOOD = torch.zeros(16, 24, dtype=torch.bool)
HOOD[13:] = True


def camera(lens: Lens) -> RigCamera[str]:
    return lens_camera("front", 0, lens=lens, recorded_size=SIZE, pinhole_fov=None if lens is FLAT else 150.0)


@pytest.mark.parametrize("user", [{}, {"ego": HOOD}], ids=["no mask", "a hood"])
@pytest.mark.parametrize("lens", [WIDE, FLAT], ids=["fisheye", "pinhole"])
def test_no_loss_sees_what_the_lens_did_not_record(lens, user):
    mounted = camera(lens)
    recording = Recording(
        name="a",
        rig=[mounted],
        shots=[RecordedImage(0, 0, torch.eye(4, dtype=torch.float64), key=None, stem="0")],
        read_image=lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8),
        read_masks=lambda shot: user,
    )
    log = log_of(recording, cache_bytes=0, check=list)
    ego = log.frames[0].ego
    if lens is FLAT:
        assert ego is user.get("ego")
        assert "resampled" not in " ".join(log.notes)
    else:
        blank = there(there(mounted.undistortion).blank)
        assert 0 < int(blank.sum()) < blank.numel()
        assert torch.equal(there(ego), blank | HOOD if user else blank)
        assert any("resampled to a pinhole of 150 degrees" in note for note in log.notes)
    assert user in ({}, {"ego": HOOD})  # what a reader keeps is not changed


def test_points_that_came_with_the_log_are_in_its_world_and_give_no_depth():
    pose, reads = torch.eye(4, dtype=torch.float64), []
    pose[:3, 3] = torch.tensor([4e6, -2e6, 100.0])
    ahead = pose[:3, 3] + torch.tensor([[0.0, 0.25, 5.0]], dtype=torch.float64)
    recording = Recording(
        name="a",
        rig=[camera(FLAT)],
        shots=[RecordedImage(0, 0, pose, key=None, stem="0")],
        read_image=lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8),
        read_masks=lambda shot: {},
        sparse_points=lambda: reads.append(1) or (ahead, torch.tensor([[0.25, 0.5, 0.75]])),
    )
    log = log_of(recording, cache_bytes=0, check=list)
    assert not reads  # nothing is decoded when a log is opened
    sparse = there(log.sparse_points)
    assert sparse().positions.tolist() == [[0.0, 0.25, 5.0]]
    assert sparse().colors.tolist() == [[0.25, 0.5, 0.75]]
    assert len(reads) == 1
    assert log.frames[0].depth is None
    assert not len(log.sweeps)


@pytest.mark.parametrize("broken", [math.nan, math.inf, -1e39])
def test_points_that_are_not_finite_are_left_out_and_gray_ones_are_told(broken):
    """-1e39 m is finite in the file, and not in float32."""
    places = torch.tensor([[0.0, 1.0, 5.0]] * 5, dtype=torch.float64)
    places[3, 1], places[4, 2] = broken, math.nan
    recording = Recording(
        name="a",
        rig=[camera(FLAT)],
        shots=[RecordedImage(0, 0, torch.eye(4, dtype=torch.float64), key=None, stem="0")],
        read_image=lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8),
        read_masks=lambda shot: {},
        sparse_points=lambda: (places, torch.full((5, 3), 0.5)),
        points_file=Path("cloud.ply"),
    )
    log = log_of(recording, cache_bytes=0, check=list)
    assert there(log.sparse_points)().positions.tolist() == [[0.0, 1.0, 5.0]] * 3
    lost, gray = doubts(replace(log, frames=log.frames[:0]))
    assert lost == "2 of 5 points of cloud.ply are not finite, the first is point 3: left out"
    assert gray.startswith("the points of cloud.ply have no colors that are known")


def test_points_far_from_the_origin_keep_their_millimeters():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([4e6, -2e6, 100.0])
    ahead = torch.tensor([[0.123, 0.456, 5.789]], dtype=torch.float64)
    recording = Recording(
        name="a",
        rig=[camera(FLAT)],
        shots=[RecordedImage(0, 0, pose, key=None, stem="0")],
        read_image=lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8),
        read_masks=lambda shot: {},
        sweeps={0: LidarSweep(lambda: pose[:3, 3] + ahead)},
    )
    points = log_of(recording, cache_bytes=0, check=list).sweeps[0].points
    torch.testing.assert_close(points.double(), ahead, rtol=0, atol=1e-6)  # float32 of 6 m


def test_the_recording_car_has_no_returns():
    points = torch.tensor([[0.0, 0.5, 5.0], [0.0, 1.3, 5.0]], dtype=torch.float64)  # rows 11 and 15.8
    recording = Recording(
        name="a",
        rig=[camera(FLAT)],
        shots=[RecordedImage(0, 0, torch.eye(4, dtype=torch.float64), key=None, stem="0")],
        read_image=lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8),
        read_masks=lambda shot: {"ego": HOOD},
        sweeps={0: LidarSweep(lambda: points)},
    )
    log = log_of(recording, cache_bytes=0, check=list)
    assert there(log.frames[0].depth).nonzero().tolist() == [[11, 12]]
    assert log.sweeps[0].colored.tolist() == [True, False]


def test_a_declared_shutter_arrives_at_the_view():
    rolling = Shutter(torch.tensor([0.0, 0.0, 0.4]), torch.zeros(3), direction="left")
    shots = [
        RecordedImage(frame, 0, torch.eye(4, dtype=torch.float64), key=None, stem="", shutter=shutter)
        for frame, shutter in enumerate((rolling, None))
    ]
    recording = Recording(
        "a", [camera(FLAT)], shots, lambda shot: torch.zeros(16, 24, 3, dtype=torch.uint8), lambda shot: {}
    )
    log = log_of(recording, cache_bytes=0, check=list)
    assert [view.camera.shutter for view in log.views] == [rolling, None]


def moving(frames: list[int], stamps: list[int]) -> Boxes:
    """1 m along x for each 10 ns, turning about z by 0.01 rad for each."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, 0, 3] = np.array(stamps) / 10
    poses[:, :3, :3] = Rotation.from_rotvec([[0, 0, 0.01 * stamp] for stamp in stamps]).as_matrix()
    return Boxes("car", "Car", np.array(frames), poses, np.ones((len(frames), 3)), Path("boxes"), tuple(stamps))


def test_boxes_of_one_object_that_differ_in_size_are_told():
    """One grows in length; the other is measured to a few centimeters."""
    grown, measured = moving([0, 1, 2], [100, 110, 125]), replace(moving([0, 2], [100, 125]), name="van")
    grown.sizes[2, 0], measured.sizes[1, 2] = 3.0, 1.09
    shots = [RecordedImage(frame, 0, torch.eye(4, dtype=torch.float64), None, "", 100 + frame) for frame in range(3)]
    black = torch.zeros(16, 24, 3, dtype=torch.uint8)
    recording = Recording(
        "a", [camera(FLAT)], shots, lambda shot: black, lambda shot: {}, frame_stamps=(100, 101, 102),
        boxes=[grown, measured],
    )  # fmt: skip
    said = [note for note in log_of(recording, cache_bytes=0, check=list).notes if "differ" in note]
    assert said == ["the boxes of some objects differ in size, their mean is taken: car, length 1.00 to 3.00 m"]


@pytest.mark.parametrize(
    ("frames", "annotated", "there"),
    [
        ([0, 4], {0, 4}, [0, 1, 2, 3, 4]),
        ([0, 4], {0, 2, 4}, [0, 4]),  # seen to be absent at 2
        ([0, 2], {0, 2, 4}, [0, 1, 2]),
        ([-2, 2], {-2, 2, 6}, [0, 1, 2]),
        ([2, 6], {-2, 2, 6}, [2, 3, 4]),
        ([0, 4], None, [0, 4]),
    ],
)
def test_an_object_is_on_its_way_between_annotated_instants(
    frames: list[int], annotated: set[int] | None, there: list[int]
):
    stamps = [100, 110, 125, 130, 140]  # images do not come evenly
    own = {-2: 80, 0: 100, 2: 121, 4: 141, 6: 160}  # nor are boxes where images are
    shots = [
        RecordedImage(frame, 0, torch.eye(4, dtype=torch.float64), None, "", stamp)
        for frame, stamp in enumerate(stamps)
    ]
    boxes = moving(frames, [own[frame] for frame in frames])
    black = torch.zeros(16, 24, 3, dtype=torch.uint8)
    recording = Recording(
        "a", [camera(FLAT)], shots, lambda shot: black, lambda shot: {}, frame_stamps=tuple(stamps), boxes=[boxes],
        annotated=None if annotated is None else frozenset(annotated),
    )  # fmt: skip
    (track,) = log_of(recording, cache_bytes=0, check=list).tracks
    assert track.frames.tolist() == there
    at = [own[frame] if frame in frames else stamps[frame] for frame in there]
    assert track.world_from_object[:, 0, 3].tolist() == pytest.approx([stamp / 10 for stamp in at], abs=1e-9)
    turned = Rotation.from_matrix(track.world_from_object[:, :3, :3].numpy()).as_rotvec()[:, 2]
    assert turned == pytest.approx([0.01 * stamp for stamp in at], abs=1e-9)


def test_a_box_between_two_has_the_size_of_the_one_before():
    """The two boxes between the three that are annotated; the size of the object is the mean of all."""
    boxes, stamps = moving([0, 2, 4], [100, 121, 141]), (100, 110, 121, 130, 141)
    boxes.sizes[:, 0] = 1.0, 1.05, 1.09
    shots = [
        RecordedImage(frame, 0, torch.eye(4, dtype=torch.float64), None, "", stamp)
        for frame, stamp in enumerate(stamps)
    ]
    black = torch.zeros(16, 24, 3, dtype=torch.uint8)
    recording = Recording(
        "a", [camera(FLAT)], shots, lambda shot: black, lambda shot: {}, frame_stamps=stamps, boxes=[boxes],
        annotated=frozenset({0, 2, 4}),
    )  # fmt: skip
    (track,) = log_of(recording, cache_bytes=0, check=list).tracks
    assert track.size.tolist() == pytest.approx([(1.0 + 1.0 + 1.05 + 1.05 + 1.09) / 5, 1.0, 1.0], abs=1e-6)


class Broken(RecordedReader):
    """One image, one mask and one sweep, of which none can be read."""

    def recording(self) -> Recording:
        where = Path(self.root)

        def broken(what: str) -> NoReturn:
            raise fault(where / what, "it is broken", "write it again")

        shot = RecordedImage(0, 0, torch.eye(4, dtype=torch.float64), where / "image.png", "image")
        return Recording(
            "a", [camera(FLAT)], [shot], lambda shot: broken("image.png"), lambda shot: broken("mask.png"),
            mask_kinds=frozenset({"sky"}), sweeps={0: LidarSweep(lambda: broken("sweep.bin"))},
        )  # fmt: skip


def test_a_check_reads_images_masks_and_sweeps(tmp_path: Path):
    (tmp_path / "image.png").write_bytes(b"no image")
    found = {problem.path.name for problem in Broken(root=tmp_path).check_contents()}
    assert found == {"image.png", "mask.png", "sweep.bin"}
