"""A log that is written in DriveStudio's layout and read again is the log that it was."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from sparsestreet.cli.config.compose import CONF
from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioReader, DriveStudioWriter
from sparsestreet.data.drivestudio.annotations import KNOWN, class_in
from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.types import Frame, Shutter
from tests.conftest import unchecked
from tests.data.drivestudio.folders import (
    FIRST_STAMP,
    STEP,
    make_nuscenes,
    make_waymo,
    write_image,
    write_lines,
    write_stamps,
)
from tests.data.drivestudio.test_bodies import person, write_people
from tests.data.nuscenes.written import write_nuscenes
from tests.data.plan import (
    Plan,
    check_same_masks,
    check_same_sweeps,
    check_same_track,
    check_same_views,
    in_data_set,
    levels,
    make_log,
)
from tests.typed import there

LOSSLESS = DriveStudioWriter(jpeg_quality=None)
MAP = np.array([5.4e6, -3.2e5, 40.0])


def written(log: DrivingLog, folder: Path, writer: DriveStudioWriter = LOSSLESS) -> DrivingLog:
    convert(log, Source(log.name, "0" * 12), writer, folder)
    assert DriveStudioReader(folder).check() == []
    return DriveStudioReader(folder).read()


@pytest.fixture
def everything(tmp_path) -> DrivingLog:
    """A log with all that the layout has room for: lens, hood, own instants, bodies, far from the world's origin."""
    root = make_nuscenes(tmp_path / "from", frames=4, offset=MAP)
    write_lines(root / "intrinsics/1.txt", [40.0, 41, 20, 12, -0.3, 0.05, 0.002, -0.001, 0.01])
    for path in (root / "lidar").iterdir():
        rows = np.fromfile(path, "<f4").reshape(-1, 4)
        rows[:, 3] = levels(len(rows))
        rows.tofile(path)
    hood = np.zeros((24, 40), np.uint8)
    hood[-5:] = 255
    write_image(root / "ego_masks/0.png", hood)
    write_stamps(root, [FIRST_STAMP + frame * STEP + 20_000_000 for frame in range(4)], "timestamps_1.txt")
    write_people(root, {0: person()})
    log = DriveStudioReader(root).read()
    return replace(log, tracks=(replace(log.tracks[0], class_name="vehicle.truck"),))


def test_everything_comes_back(everything, tmp_path):
    found = written(everything, tmp_path / "out")
    check_same_views(found, everything)
    check_same_sweeps(found, everything)
    for index in everything.sweeps.indices:
        intensities = there(found.sweeps.load_intensities(index))
        assert intensities.any()
        assert torch.equal(intensities, there(everything.sweeps.load_intensities(index)))
    for one, other in zip(found.frames, everything.frames, strict=True):
        assert torch.equal(one.image, other.image)
        check_same_masks(one, other)
        torch.testing.assert_close(one.depth, other.depth, atol=1e-5, rtol=0)  # float32 points
    (one,), (other,) = found.tracks, everything.tracks
    assert (one.name, one.class_name, one.span) == (other.name, other.class_name, other.span)
    check_same_track(found, one, everything, other)
    assert found.frames[0].sky is not None
    assert one.body is not None
    assert found.notes == everything.notes
    assert LOSSLESS.losses(everything) == ()


@pytest.mark.parametrize("flavor", ["auto", "waymo", "nuscenes"])
def test_mounted_cameras_come_back(flavor, tmp_path):
    log = DriveStudioReader(make_waymo(tmp_path / "from", offset=MAP)).read()
    writer = replace(LOSSLESS, flavor=flavor)
    found = written(log, tmp_path / "out", writer)
    assert (tmp_path / "out/ego_pose").is_dir() == (flavor != "nuscenes")
    check_same_views(found, log)
    check_same_sweeps(found, log)
    check_same_track(found, found.tracks[0], log, log.tracks[0])
    if flavor == "nuscenes":
        assert found.tracks[0].class_name == "vehicle.car"
        assert [line.split(":")[0] for line in writer.losses(log)] == [
            "the path of the vehicle is lost",
            "classes get names that DriveStudio knows in its flavor nuscenes (objects)",
        ]
        return
    assert (writer.losses(log), found.tracks[0].class_name) == ((), "Vehicle")
    assert found.vehicle is not None
    assert log.vehicle is not None
    poses = (of.dataset_from_world @ of.vehicle.poses for of in (found, log))
    torch.testing.assert_close(*poses, atol=1e-9, rtol=0)  # float64, as text with all digits
    # A part of its cameras keeps their numbers.
    part = DriveStudioReader(tmp_path / "from", cameras=[1], last_frame=1).read()
    assert written(part, tmp_path / "part", writer).camera_names == ("1",)


def moving_mount(log: DrivingLog) -> DrivingLog:
    def change(frame: Frame) -> Frame:
        pose = frame.camera.camera_from_world.clone()
        pose[0, 3] += 0.1 * (frame.indices == (2, 1))
        return replace(frame, camera=replace(frame.camera, camera_from_world=pose))

    return changed(log, change)


def named(log: DrivingLog, class_name: str) -> DrivingLog:
    return replace(log, tracks=(replace(log.tracks[0], class_name=class_name),))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda log: replace(log, vehicle=None), "the log does not tell where its vehicle was"),
        (moving_mount, r"camera 1 moves by up to 0.1 \(meters or radians\) in its own"),
        (lambda log: replace(log, camera_names=("left", "right")), None),
        (lambda log: named(log, "Car"), None),
    ],
)
def test_what_is_not_of_waymo_gets_a_pose_for_each_image(change, said, tmp_path):
    log = change(DriveStudioReader(make_waymo(tmp_path / "from")).read())
    paths = {file.path for file in LOSSLESS.files(log)}
    assert "ego_pose/000.txt" not in paths
    assert "extrinsics/000_0.txt" in paths
    forced = replace(LOSSLESS, flavor="waymo")
    if said is None:
        assert "ego_pose/000.txt" in {file.path for file in forced.files(log)}
        return
    with pytest.raises(ValueError, match=said + ": say flavor=nuscenes"):
        list(forced.files(log))


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"flavor": "kitti"}, "flavor must be one of auto, waymo, nuscenes, got 'kitti'"),
        ({"jpeg_quality": 0}, "jpeg_quality lies in 1 to 100, got 0"),
        ({"jpeg_quality": 101}, "jpeg_quality lies in 1 to 100, got 101"),
    ],
)
def test_options_that_cannot_be(option, said):
    with unchecked(), pytest.raises(ValueError, match=said):
        DriveStudioWriter(**option)


def test_what_drivestudio_itself_needs_a_change_for_is_said(everything):
    sizes, hood, stand_ins = replace(LOSSLESS, flavor="nuscenes").notes(everything)
    assert sizes.endswith("camera 0 has 40x24, not 1600x900, 1 has 40x24, not 1600x900; write these sizes there")
    assert hood.endswith("in data/ego_masks/nuscenes: copy those of ego_masks")
    assert "cameras 2, 3, 4, 5 too" in stand_ins
    bare = replace(make_log(), tracks=())
    chosen, _, absent = LOSSLESS.notes(bare)
    assert chosen == "the flavor is nuscenes, which has a pose for each image; flavor=... names another"
    assert absent == (
        "DriveStudio asks for what is not there, unless data.pixel_source says so: lidar, without which it does not "
        "start, boxes (load_objects=false), bodies (load_smpl=false), human and vehicle masks (load_dynamic_mask=false)"
    )


def test_what_a_log_lacks_is_not_written(tmp_path):
    log = make_log()  # no clock, no lidar, no objects; masks of the sky alone
    found = written(log, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "conversion.json", "extrinsics", "images", "intrinsics", "sky_masks",
    }  # fmt: skip
    assert (found.stamps, found.tracks, len(found.sweeps)) == ({}, (), 0)
    check_same_views(found, log)


def test_another_data_sets_drive_is_as_it_was_planned(tmp_path):
    """Own instants of cameras, of a lidar and of boxes; the plan says where everything is."""
    plan = Plan()
    log = NuScenesReader(root=write_nuscenes(tmp_path / "from", plan).root).read()
    found = written(log, tmp_path / "out")
    check_same_views(found, log)
    check_same_sweeps(found, log)
    for view in found.views:
        frame, number = view.indices
        camera = plan.cameras[number]
        assert view.stamp == plan.image_stamp(frame, camera)
        # The log holds the pose as float32 around its origin.
        assert np.allclose(in_data_set(found, view), plan.world_from_camera(frame, camera), rtol=0, atol=1e-5)
        assert np.array_equal(found.frames[2 * frame + number].image, log.frames[2 * frame + number].image)
    assert LOSSLESS.losses(log)[0] == "names of cameras are lost (2): CAM_FRONT, CAM_FRONT_LEFT become 0, 1"


def test_boxes_with_stamps_of_their_own_are_moved_to_those_of_their_frames(everything, tmp_path):
    """An object at 10 m/s, whose boxes are 30 ms late, lies 0.3 m farther back at the stamps of the frames."""
    (track,) = everything.tracks
    start, end = 0.0, everything.views[-1].time
    assert everything.frame_periods == pytest.approx(3.2)  # 3 frames, and 20 ms
    times = torch.linspace(start, 3 / 3.2, 4, dtype=torch.float64) + 0.03 / 0.32
    poses = track.world_from_object.clone()
    poses[:, 0, 3] += torch.arange(4)
    moving = replace(track, times=times, world_from_object=poses, body=None)
    parked = replace(track, name="1", times=times, body=None)
    late = replace(everything, tracks=(moving, parked))
    assert end == 1.0
    found = written(late, tmp_path / "out").tracks[0]
    expected = poses[:, 0, 3] - 0.3
    torch.testing.assert_close(
        found.world_from_object[:, 0, 3], expected, atol=1e-7, rtol=0
    )  # stamps are rounded to ns
    (said,) = LOSSLESS.losses(late)
    assert said == (
        "boxes are up to 30.0 ms from the stamps of their frames (objects: 2), and moved there, by up to 0.3 m"
    )


def test_jpegs_have_full_color_and_are_near_the_pixels(everything, tmp_path):
    found = written(everything, tmp_path / "out", DriveStudioWriter())
    for one, other in zip(found.frames, everything.frames, strict=True):
        # Flat colors: what is left is the rounding of color to YCbCr and back.
        assert int((one.image.int() - other.image.int()).abs().max()) <= 2
    with Image.open(tmp_path / "out/images/000_0.jpg") as image:
        assert (image.format, image.layer) == ("JPEG", [(1, 1, 1, 0), (2, 1, 1, 1), (3, 1, 1, 1)])  # pyright: ignore


def changed(log: DrivingLog, change: Callable[[Frame], Frame]) -> DrivingLog:
    return replace(log, frames=as_frames([change(frame) for frame in log.frames]))


def with_shutter(frame: Frame) -> Frame:
    shutter = Shutter(torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.0, 0.01, 0.0]))
    return replace(frame, camera=replace(frame.camera, shutter=shutter)) if frame.camera_index == 1 else frame


def without(frame: Frame, kind: str, number: int, camera: int) -> Frame:
    return replace(frame, **{kind: None}) if frame.indices == (number, camera) else frame


LOST = {
    "shutter": (
        lambda log: changed(log, with_shutter),
        "rolling shutters are lost (cameras 1): while an image is read out, its camera moves by up to 0.3 m and turns "
        "by up to 0.01 rad",
    ),
    "a mask": (
        lambda log: changed(log, lambda frame: without(frame, "human", 2, 1)),
        "human masks are lost: there must be one for each of the 8 images, and that of frame 2, camera 1 has none",
    ),
    "a hood": (
        lambda log: changed(log, lambda frame: without(frame, "ego", 3, 0)),
        "masks of the recording car are lost (cameras 0): there is one a camera, and theirs change",
    ),
    "name": (
        lambda log: replace(log, tracks=(replace(log.tracks[0], name="car-1"),)),
        "names of objects are lost (1): they are the ids in instances_info.json",
    ),
}


@pytest.mark.parametrize("name", LOST)
def test_what_the_layout_has_no_room_for_is_said(name, everything, tmp_path):
    change, said = LOST[name]
    log = change(everything)
    assert LOSSLESS.losses(log) == (said,)
    found = written(log, tmp_path / "out")  # and what is left can be read
    if name == "a mask":
        assert {frame.human is None for frame in found.frames} == {True}
        assert {frame.vehicle is None for frame in found.frames} == {False}
    if name == "name":
        (entry,) = json.loads((tmp_path / "out/instances/instances_info.json").read_text()).values()
        assert (entry["id"], entry["original_class_name"]) == (log.tracks[0].name, log.tracks[0].class_name)


def test_masks_that_a_log_never_had_are_no_loss(tmp_path):
    log = DriveStudioReader(make_nuscenes(tmp_path / "from")).read()
    bare = replace(
        changed(log, lambda frame: replace(frame, sky=None)), notes=("no sky masks: nothing but the images",)
    )
    assert LOSSLESS.losses(named(bare, "animal")) == ()


def test_a_calibration_that_changes_cannot_be_written(everything):
    def zoomed(frame: Frame) -> Frame:
        if frame.indices != (2, 1):
            return frame
        return replace(frame, camera=replace(frame.camera, intrinsics=frame.camera.intrinsics + 1))

    with pytest.raises(ValueError, match=r"that of camera 1 changes at frame 2: convert the frames before"):
        list(LOSSLESS.files(changed(everything, zoomed)))


def test_names_of_classes_keep_what_other_readers_take_them_for():
    classes = {path.stem: OmegaConf.load(path).classes for path in (CONF / "data").glob("*.yaml")}
    role = {name: which for which, names in classes["drivestudio"].items() for name in names}
    given = {
        name: which for of in classes for which, names in classes[of].items() for name in names
    }  # fmt: skip
    assert len(given) > 70
    for flavor, known in KNOWN.items():
        found = {name: class_in(flavor, name) for name in given}
        assert set(found.values()) <= set(known)
        unlike = {given[name] for name, written in found.items() if role[written] != given[name]}
        # Waymo has a name for nothing else.
        assert unlike == ({"other"} if flavor == "waymo" else set())
