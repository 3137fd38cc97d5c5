"""From ``rig.json`` and the files that it names to a recording."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sparsestreet.data.extent import check_extent
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import check_camera_images, check_image_sizes
from sparsestreet.data.lidar import empty_notes
from sparsestreet.data.marks import Marks
from sparsestreet.data.problems import LogError, Missing, Problem, attempt, check_missing, missing_files, missing_notes
from sparsestreet.data.recording import RecordedImage, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera, check_lens_camera, lens_camera
from sparsestreet.data.rig_json.part import Part, entry_of, read_masks, read_pixels
from sparsestreet.data.rig_json.sweeps import read_rows
from sparsestreet.data.rig_json.table import read_table, with_files
from sparsestreet.data.window import chosen_cameras, frame_window


@dataclass(frozen=True, kw_only=True)
class RigJsonReader(RecordedReader):
    """A folder with a ``rig.json`` that somebody wrote by hand (docs/datasets/rig_json.md)."""

    marks = Marks(("rig.json",))

    pinhole_fov: float | None = None
    """Degrees that the pinhole of a lens that is not simulated sees from left to right; None: its resolution is that of
    the lens's center."""
    missing: Missing = "error"
    """skip: images that are listed and have no file are left out with a note, as are frames without any."""

    def __post_init__(self) -> None:
        check_missing(self.missing)

    def recording(self) -> Recording:
        part = self._part()
        rig, shots = [self._camera(part, index) for index in range(len(part.cameras))], part.shots()
        if problems := self._problems(part, shots, decode=False):
            raise LogError(problems)
        given = None if self.masks is None else GivenMasks(Path(self.masks))
        kinds = given.kinds if given else frozenset[str]()
        ego = any(part.table.cameras[name].ego_mask for name in part.cameras)
        return Recording(
            name=self.folder.resolve().name,
            rig=rig,
            shots=shots,
            read_image=partial(read_pixels, rig),
            read_masks=partial(read_masks, part.table, rig, given),
            mask_kinds=kinds | {"ego"} if ego else kinds,
            frame_stamps=part.stamps,
            sweeps=part.sweeps(shots) if self.lidar else None,
            boxes=part.boxes(),
            vehicle=part.vehicle,
            notes=self._notes(part),
        )

    def check_contents(self) -> list[Problem]:
        part = self._part()
        shots = part.shots()
        problems = self._problems(part, shots, decode=True)
        for sweep in ((part.sweeps(shots) if self.lidar else None) or {}).values():
            attempt(problems, sweep.read)
        return problems

    def files(self) -> LogFiles:
        part = self._part()
        return LogFiles([part.table.path], _recorded(part))

    def _part(self) -> Part:
        table = read_table(self.folder / "rig.json")
        table = with_files(table) if self.missing == "skip" else table
        window = frame_window(len(table.frames), self.first_frame, self.last_frame, self.folder)
        names = chosen_cameras(list(table.cameras), self.cameras, self.folder)
        places = [place for place in window if not table.frames[place].images.keys().isdisjoint(names)]
        if not places:
            frames = f"frames {window.start} to {window.stop - 1}"
            raise ValueError(f"{frames} have no image of {', '.join(names)}: {self.folder}")
        return Part(table, names, places)

    def _notes(self, part: Part) -> tuple[str, ...]:
        window = frame_window(len(part.table.frames), self.first_frame, self.last_frame, self.folder)
        left_out = len(window) - len(part.places)
        absent = missing_notes(part.table.absent, part.table.listed)
        sweeps = [frame.sweep for frame in part.frames if frame.sweep is not None] if self.lidar else []
        empty = empty_notes(lambda path: read_rows(path, part.table.lidar.columns)[0], sweeps)
        homeless = [f"{left_out} of {len(window)} frames have no image and are left out"] if left_out else []
        return (*absent, *homeless, *empty)

    def _camera(self, part: Part, index: int) -> RigCamera[str]:
        name = part.cameras[index]
        entry = part.table.cameras[name]
        check_lens_camera(part.table.path, entry.lens, entry.size)
        return lens_camera(
            name,
            index,
            lens=entry.lens,
            recorded_size=entry.size,
            width=self.width,
            pinhole_fov=self.pinhole_fov,
        )

    def _problems(self, part: Part, shots: Sequence[RecordedImage], *, decode: bool) -> list[Problem]:
        problems = missing_files(_recorded(part))
        for index, name in enumerate(part.cameras):
            images = [entry_of(shot).path for shot in shots if shot.camera == index]
            mask, size = part.table.cameras[name].ego_mask, part.table.cameras[name].size
            problems += check_camera_images(name, images, [mask] if mask else [], decode=decode)
            problems += check_image_sizes(name, size, images)
        if self.lidar and part.table.lidar.vehicle_from_lidar is not None:
            unposed = [place for place in part.places if part.table.frames[place].world_from_vehicle is None]
            problems += [_no_pose(part, place) for place in unposed if part.table.frames[place].sweep is not None]
        if self.masks is not None:
            stems = [(part.cameras[shot.camera], shot.stem) for shot in shots]
            given = GivenMasks(Path(self.masks))
            problems += given.check(stems)
            for name in part.cameras if decode else ():
                own = [(camera, stem) for camera, stem in stems if camera == name]
                problems += given.check_pixels(own, part.table.cameras[name].size)
        return problems or check_extent([(part.table.path, shot.world_from_camera[:3, 3]) for shot in shots])


def _recorded(part: Part) -> list[Path]:
    """Images, masks and points, each once."""
    masks = [mask for name in part.cameras if (mask := part.table.cameras[name].ego_mask)]
    images = [frame.images[name].path for frame in part.frames for name in part.cameras if name in frame.images]
    sweeps = [frame.sweep for frame in part.frames if frame.sweep is not None]
    return list(dict.fromkeys((*masks, *images, *sweeps)))


def _no_pose(part: Part, place: int) -> Problem:
    message = f"frames[{place}] has points in the lidar's frame, but no world_from_vehicle"
    return Problem(part.table.path, message, "write it, or write points in the world and leave out vehicle_from_lidar")
