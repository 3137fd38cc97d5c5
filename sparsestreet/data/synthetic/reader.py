"""Read the embedded street, which is made when it is first needed, and its exact truth."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.frame_cache import CacheSize
from sparsestreet.data.log import DrivingLog, SceneExtent, Truth
from sparsestreet.data.problems import Problem
from sparsestreet.data.reader import LogReader
from sparsestreet.data.synthetic.capture import Instant, StreetCamera, captured
from sparsestreet.data.synthetic.render import developed
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import HUMAN_CLASSES, VEHICLE_CLASSES, make_street, street_name, with_declared
from sparsestreet.data.synthetic.world import World, build_world
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Frame, MaskSource, View


def street_truth(
    settings: StreetSettings, street_from_world: Float64[Tensor, "4 4"], world: World | None = None
) -> Truth:
    """Return a function: a camera and a time in the log's world -> what the street's camera would record there.

    ``world`` is the street with other things in it than the settings say; None: as they say.

    What belongs to a recorded image alone is left out: its exposure, white balance, blur, hood and compression. It is
    what the view's own pose sees, so at a recorded view whose pose is noisy it is not the recorded image.

    It returns None if the camera is inside an annotated object. Masks hold people and vehicles up to
    ``annotation_range`` from the camera, annotated or not. A view's lens is applied, and its shutter's motion if that
    has its ``seconds``.
    """
    world, (first, last) = build_world(settings) if world is None else world, settings.recorded
    instant_at = lru_cache(maxsize=64)(lambda seconds: Instant.at(world, seconds))

    def truth(view: View) -> Frame | None:
        middle = first + view.time * (last - first)
        moved_at = partial(camera_at, view.camera, street_from_world)
        camera, instant = moved_at(0.0), instant_at(middle)
        if instant.inside_an_actor(camera):
            return None
        shutter = view.camera.shutter
        if shutter is None or not shutter.seconds:
            sight = instant.seen_by(camera, settings.supersampling)
        else:
            reading = replace(settings, readout=shutter.seconds, readout_direction=shutter.direction)
            sight = captured(reading, lambda seconds: instant_at(middle + seconds), moved_at)
        image = developed(camera, sight)
        near = instant.actors_within(settings.annotation_range, camera)

        def of_classes(names: tuple[str, ...]) -> Tensor:
            chosen = [index for index in near if world.actors[index].model.class_name in names]
            return torch.from_numpy(np.isin(image.object_indices, chosen))

        return Frame.of(
            view,
            image=torch.from_numpy(image.rgb),
            sky=torch.from_numpy(image.sky),
            human=of_classes(HUMAN_CLASSES),
            vehicle=of_classes(VEHICLE_CLASSES),
        )

    return truth


def camera_at(camera: Camera, street_from_world: Float64[Tensor, "4 4"], seconds: float) -> StreetCamera:
    """Return the camera where its shutter moves it to within ``seconds`` from the middle of the readout."""
    world_from_camera = (street_from_world @ inverse(camera.camera_from_world.double())).numpy()
    if camera.shutter is not None and seconds:
        motion, share = np.eye(4), seconds / camera.shutter.seconds
        motion[:3, :3] = Rotation.from_rotvec(share * camera.shutter.rotation.double().numpy()).as_matrix()
        motion[:3, 3] = share * camera.shutter.translation.double().numpy()
        world_from_camera = world_from_camera @ motion
    return StreetCamera(
        world_from_camera,
        camera.intrinsics.double().numpy(),
        camera.width,
        camera.height,
        () if camera.distortion is None else tuple(camera.distortion.tolist()),
    )


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreetReader(LogReader):
    """Makes the street in its folder unless it is there, and reads it like a recorded drive.

    ``check`` and ``read`` raise FileExistsError if the folder holds anything else.
    """

    settings: StreetSettings
    root: Path | str | None = None
    """The street's folder; None: a folder under ``parent`` that is named after all settings."""
    parent: Path | str = "outputs/streets"
    lidar: bool = True
    """False: the log has no lidar, although the street is traced with it."""
    bodies: bool = True
    """False: the log has no body poses of the street's pedestrians."""
    undistort: bool = False
    lidar_ahead: Sequence[float | int] | None = None
    extent: SceneExtent = "world"
    """This and the two above as ``DriveStudioReader`` has them."""
    cache_mb: CacheSize = "auto"
    """Decoded frames kept in memory, MB (1e6 bytes)."""

    @property
    def folder(self) -> Path:
        return Path(self.parent) / street_name(self.settings) if self.root is None else Path(self.root)

    def check(self) -> list[Problem]:
        return self._made().check()

    def read(self) -> DrivingLog:
        log = with_declared(self._made().read(), self.settings, self.folder)
        masks: dict[str, MaskSource] = dict.fromkeys(log.masks or (), "true")
        return replace(log, masks=masks, truth=street_truth(self.settings, log.dataset_from_world))

    def data_hash(self) -> str:
        """Return the street's name, which holds a hash of all settings: they determine what the street shows."""
        return street_name(self.settings)

    def _made(self) -> DriveStudioReader:
        root = make_street(self.settings, self.folder, self._report)
        return DriveStudioReader(
            root,
            lidar=self.lidar,
            bodies=self.bodies,
            undistort=self.undistort,
            lidar_ahead=self.lidar_ahead,
            extent=self.extent,
            cache_mb=self.cache_mb,
        )

    def _report(self, done: int, total: int) -> None:
        """Reports each time another quarter of the frames is traced."""
        if done * 4 // total > (done - 1) * 4 // total:
            log.info("tracing a street into %s: %d of %d frames", self.folder.absolute(), done, total)
