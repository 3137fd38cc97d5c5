"""From the files of a log to a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from sparsestreet.data.argoverse2.layout import EGO_ROWS, Selection, find_log, select
from sparsestreet.data.argoverse2.tables import (
    MountedCamera,
    read_boxes,
    read_cameras,
    read_path,
    read_points,
    read_sweep,
)
from sparsestreet.data.ego import bottom_rows
from sparsestreet.data.extent import check_extent
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import image_size, read_image
from sparsestreet.data.lidar import empty_notes
from sparsestreet.data.marks import Marks
from sparsestreet.data.motion import PosePath
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera


@dataclass(frozen=True, kw_only=True)
class Argoverse2Reader(RecordedReader):
    """A log of Argoverse 2's sensor data set. An instant is a sweep, at 10 Hz; cameras have instants of their own.

    The world is the city's. Pinholes, whose images are shipped without the lens, with global shutters.
    """

    marks = Marks(("city_SE3_egovehicle.feather",), depth=2)

    scene: str | int | float | None = None
    """First characters of the log's name (a command line may take them for a whole number); None: the only one."""

    def recording(self) -> Recording:
        chosen = self._selection()
        path, duplicates = read_path(chosen.layout)
        _check_covered(chosen, path)
        mounts = read_cameras(chosen.layout)
        rig = [self._camera(chosen, mounts, name, index) for index, name in enumerate(chosen.images)]
        shots = _shots(chosen, mounts, path)
        boxes, homeless = _boxes(chosen, path)
        placed = [(chosen.layout.poses, shot.world_from_camera[:3, 3]) for shot in shots]
        placed += [(one.path, position) for one in boxes or () for position in torch.from_numpy(one.poses[:, :3, 3])]
        given = None if self.masks is None else GivenMasks(Path(self.masks))
        problems = check_extent(placed)
        if given is not None:
            problems += given.check((rig[shot.camera].name, shot.stem) for shot in shots)
        if problems:
            raise LogError(problems)
        return Recording(
            name=chosen.layout.root.resolve().name,
            rig=rig,
            shots=shots,
            read_image=partial(_read_image, rig),
            read_masks=partial(_read_masks, rig, mounts, given),
            mask_kinds=frozenset({"ego"} if EGO_ROWS.keys() & chosen.images.keys() else ()).union(
                given.kinds if given else ()
            ),
            frame_stamps=chosen.instants,
            sweeps=_sweeps(chosen, path) if self.lidar else None,
            boxes=boxes,
            vehicle=_driven(chosen, path),
            notes=(
                *_notes(chosen, duplicates, homeless, len(shots)),
                *empty_notes(read_points, [chosen.sweeps[stamp] for stamp in chosen.instants] if self.lidar else []),
            ),
        )

    def files(self) -> LogFiles:
        chosen = self._selection()
        layout = chosen.layout
        images = [
            chosen.image(name, one) for name, stamps in chosen.images.items() for one in stamps if one is not None
        ]
        points = [chosen.sweeps[stamp] for stamp in chosen.instants] if self.lidar else []
        return LogFiles((layout.poses, layout.intrinsics, layout.mounts, layout.boxes), (*images, *points))

    def _selection(self) -> Selection:
        return select(find_log(self.folder, self.scene), self.cameras, self.first_frame, self.last_frame)

    def _camera(self, chosen: Selection, mounts: Mapping[str, MountedCamera], name: str, index: int) -> RigCamera[str]:
        if name not in mounts:
            message = f"camera {name} has images but no row"
            raise fault(chosen.layout.intrinsics, message, "fetch the file again, or name the cameras that it has")
        mount = mounts[name]
        image = chosen.image(name, next(stamp for stamp in chosen.images[name] if stamp is not None))
        if (size := image_size(image)) != mount.size:
            message = f"the image is {size[0]}x{size[1]}, the calibration says {mount.size[0]}x{mount.size[1]}"
            raise fault(image, message, "fetch images and calibration of the same log; data.log.width scales them")
        return self.pinhole(name, index, mount.intrinsics, mount.size)


def _check_covered(chosen: Selection, path: PosePath) -> None:
    """Raises LogError where the path of the vehicle begins after, or ends before, an image or a sweep that is read."""
    stamps = [one for images in chosen.images.values() for one in images if one is not None]
    for stamp in sorted((*stamps, *chosen.instants)):
        if not int(path.stamps[0]) <= stamp <= int(path.stamps[-1]):
            message = f"poses from {int(path.stamps[0])} to {int(path.stamps[-1])} do not cover what is of {stamp}"
            remedy = "read only frames with poses (data.log.first_frame, .last_frame)"
            raise fault(chosen.layout.poses, message, remedy)


def _driven(chosen: Selection, path: PosePath) -> PosePath:
    """The vehicle at the stamps of the frames."""
    stamps = torch.tensor(chosen.instants)
    return PosePath(stamps, path.at(stamps))


def _shots(chosen: Selection, mounts: Mapping[str, MountedCamera], path: PosePath) -> list[RecordedImage]:
    """The images, each with the pose of its own stamp. All rows of one are exposed at once (the data set's guide)."""
    found = [
        (frame, camera, name, stamps[frame])
        for frame in range(len(chosen.instants))
        for camera, (name, stamps) in enumerate(chosen.images.items())
    ]
    taken = [(frame, camera, name, stamp) for frame, camera, name, stamp in found if stamp is not None]
    poses = path.at(torch.tensor([stamp for *_, stamp in taken]))
    return [
        RecordedImage(
            frame=frame,
            camera=camera,
            world_from_camera=pose @ mounts[name].ego_from_camera,
            key=chosen.image(name, stamp),
            stem=str(stamp),
            stamp=stamp,
        )
        for (frame, camera, name, stamp), pose in zip(taken, poses, strict=True)
    ]


def _sweeps(chosen: Selection, path: PosePath) -> dict[int, LidarSweep]:
    poses = path.at(torch.tensor(chosen.instants))
    return {
        frame: LidarSweep(partial(read_sweep, chosen.sweeps[stamp], poses[frame]), stamp)
        for frame, stamp in enumerate(chosen.instants)
    }


def _boxes(chosen: Selection, path: PosePath) -> tuple[list[Boxes] | None, int]:
    """None where the log has none, as those of the test split."""
    if not chosen.layout.boxes.is_file():
        return None, 0
    frames = {stamp: frame for frame, stamp in enumerate(chosen.instants)}
    return read_boxes(chosen.layout, list(chosen.sweeps), frames, path)


def _read_image(rig: Sequence[RigCamera[str]], shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
    return read_image(Path(str(shot.key)), rig[shot.camera].size)


def _read_masks(
    rig: Sequence[RigCamera[str]], mounts: Mapping[str, MountedCamera], given: GivenMasks | None, shot: RecordedImage
) -> dict[str, Bool[Tensor, "h w"]]:
    """Rows of the own car, and what somebody made, which counts where both are."""
    camera = rig[shot.camera]
    own = {"ego": bottom_rows(camera.size, *EGO_ROWS[camera.name])} if camera.name in EGO_ROWS else {}
    if given is None:
        return own
    return own | given.read(camera.name, shot.stem, recorded_size=mounts[camera.name].size, size=camera.size)


def _notes(chosen: Selection, duplicates: int, homeless: int, shots: int) -> tuple[str, ...]:
    """What a user should know about how it was read."""
    lacking = len(chosen.instants) * len(chosen.images) - shots
    said = {
        f"{duplicates} poses within a microsecond of another one are left out": duplicates,
        f"{chosen.dropped} sweeps have no image of these cameras and are left out": chosen.dropped,
        f"{lacking} of {lacking + shots} images are missing: their instants are seen by the other cameras": lacking,
        f"{homeless} boxes are of instants whose sweeps are not here, and are left out": homeless,
    }
    return tuple(sentence for sentence, count in said.items() if count)
