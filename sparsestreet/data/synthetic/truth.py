"""The true image of a camera anywhere in a street, which no recorded drive has."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from sparsestreet.data.log import Truth
from sparsestreet.data.synthetic.cameras import StreetCamera
from sparsestreet.data.synthetic.capture import captured
from sparsestreet.data.synthetic.instant import Instant
from sparsestreet.data.synthetic.render import developed
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import World, build_world
from sparsestreet.data.synthetic.write import HUMAN_CLASSES, VEHICLE_CLASSES
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Frame, View


def street_truth(
    settings: StreetSettings, street_from_world: Float64[Tensor, "4 4"], world: World | None = None
) -> Truth:
    """Returns a function: a camera and a time in the log's world -> what the street's camera would record there.

    ``world`` is the street with other actors; None: as the settings make it.

    What belongs to a recorded image alone is left out: its exposure, white balance, blur, hood and compression. It is
    what the view's own pose sees, so at a recorded view whose pose is noisy it is not the recorded image.

    It returns None if the camera is inside an annotated object. Masks hold people and vehicles up to
    ``annotation_range`` from the camera, annotated or not. A view's lens is applied, and its shutter's motion if that
    has its ``seconds``.
    """
    world, (first, last) = world or build_world(settings), settings.recorded
    instant_at = lru_cache(maxsize=64)(lambda seconds: Instant.at(world, seconds))

    def truth(view: View) -> Frame | None:
        middle = first + view.time * (last - first)
        camera_at = partial(_camera_at, view.camera, street_from_world)
        camera, instant = camera_at(0.0), instant_at(middle)
        if instant.inside_an_actor(camera):
            return None
        shutter = view.camera.shutter
        if shutter is None or not shutter.seconds:
            sight = instant.seen_by(camera, settings.supersampling)
        else:
            reading = replace(settings, readout=shutter.seconds, readout_direction=shutter.direction)
            sight = captured(reading, lambda seconds: instant_at(middle + seconds), camera_at)
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


def _camera_at(camera: Camera, street_from_world: Float64[Tensor, "4 4"], seconds: float) -> StreetCamera:
    """Returns the camera where its shutter moves it to within ``seconds`` from the middle of the readout."""
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
