"""A segment of version 1: one file."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.problems import Problem, fault
from sparsestreet.data.reader import LogFiles
from sparsestreet.data.waymo import segment
from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    REMEDY,
    BoxLabel,
    ImageMotion,
    Returns,
    Segment,
    transform,
)
from sparsestreet.data.waymo.v1 import messages as fields
from sparsestreet.data.waymo.v1.records import Records
from sparsestreet.data.waymo.v1.wire import Message


class RecordSegment(Segment):
    """Lengths tell where the parts of a frame lie; the parts are decoded when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Raise LogError for a file whose frames cannot be told apart."""
        self.source = self.calibration_file = self.image_file = path
        self.box_file = self.lidar_file = self.label_file = path
        self._records = Records(path)
        if not len(self._records):
            raise fault(path, "the file has no records", REMEDY)
        self._frames = [Message(self._records[n], path, f"frame {n}") for n in range(len(self._records))]
        context = self._frames[0].message(fields.CONTEXT, "context")
        self.name = context.text(1)
        self.cameras, self.lidars = fields.read_cameras(context), fields.read_lidars(context)
        self.stamps = [frame.integer(fields.STAMP) for frame in self._frames]
        for frame in self._frames[1:]:
            other = frame.message(fields.CONTEXT, "context").text(1)
            if other != self.name:
                raise frame.error(f"it is of the segment {other!r}, the frames before are of {self.name!r}")

    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        pose = self._frames[frame].message(fields.POSE, "pose")
        return transform(pose.doubles(1), self.source, pose.what)

    def images(self, frame: int) -> Mapping[str, ImageMotion]:
        images = self._images(frame)
        return {name: fields.read_motion(image) for name, image in images.items() if len(image.data(fields.JPEG))}

    def jpeg(self, frame: int, camera: str) -> bytes:
        return bytes(self._images(frame)[camera].data(fields.JPEG))

    def boxes(self, frame: int) -> Sequence[BoxLabel]:
        return [fields.read_label(label) for label in self._frames[frame].messages(fields.LABELS, "laser_labels")]

    @cached_property
    def has_boxes(self) -> bool:
        return any(fields.LABELS in frame for frame in self._frames)

    @cached_property
    def labelled(self) -> frozenset[tuple[int, str]]:
        return frozenset(
            (frame, name)
            for frame in range(len(self._frames))
            for name, image in self._images(frame).items()
            if len(image.message(fields.PANOPTIC, "camera_segmentation_label").data(2))
        )

    def panoptic(self, frame: int, camera: str) -> tuple[bytes, int]:
        label = self._images(frame)[camera].message(fields.PANOPTIC, "camera_segmentation_label")
        return bytes(label.data(2)), label.integer(1)

    def has_returns(self, frame: int) -> bool:
        return any(len(first.data(2)) for _, first, _ in self._lasers(frame))

    def returns(self, frame: int) -> Sequence[Returns]:
        found = []
        for name, first, second in self._lasers(frame):
            images = [fields.range_image(image, 2, 4) for image in (first, second)]
            poses = fields.range_image(first, 4, 6) if name == "TOP" else None
            images = [image for image in images if image is not None]
            if images:
                found.append(segment.returns_of(name, images, poses))
        return found

    def files(self) -> LogFiles:
        return LogFiles(recorded=[self.source])

    def check_files(self) -> list[Problem]:
        return self._records.check()

    def _images(self, frame: int) -> dict[str, Message]:
        images = self._frames[frame].messages(fields.IMAGES, "images")
        return {fields.named(image, CAMERAS): image for image in images}

    def _lasers(self, frame: int) -> list[tuple[str, Message, Message]]:
        """Name, first and second return of the lidars that are told by name."""
        lasers = self._frames[frame].messages(fields.LASERS, "lasers")
        return [
            (fields.named(one, LIDARS), one.message(2, "ri_return1"), one.message(3, "ri_return2"))
            for one in lasers
            if fields.NAME in one
        ]
