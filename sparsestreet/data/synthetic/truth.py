"""The true image of a camera anywhere in a street, which no recorded drive has."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.log import Truth
from sparsestreet.data.synthetic.cameras import StreetCamera
from sparsestreet.data.synthetic.render import Instant, render_image
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.data.synthetic.write import HUMAN_CLASSES, VEHICLE_CLASSES
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import Frame, View


def street_truth(settings: StreetSettings, street_from_world: Float64[Tensor, "4 4"]) -> Truth:
    """Returns a function: a camera and a time in the log's world -> what the street's camera would record there.

    What belongs to a recorded image alone is left out: its exposure and white balance. It is
    what the view's own pose sees, so at a recorded view whose pose is noisy it is not the recorded image.

    It returns None if the camera is inside an annotated object. Masks hold people and vehicles up to
    ``annotation_range`` from the camera, annotated or not. A view's lens is applied; its shutter is ignored, because
    streets have none.
    """
    world, (first, last) = build_world(settings), settings.recorded
    instant_at = lru_cache(maxsize=1)(lambda seconds: Instant.at(world, seconds))

    def truth(view: View) -> Frame | None:
        camera = view.camera
        world_from_camera = street_from_world @ inverse(camera.camera_from_world.double())
        traced = StreetCamera(
            world_from_camera.numpy(),
            camera.intrinsics.double().numpy(),
            camera.width,
            camera.height,
            () if camera.distortion is None else tuple(camera.distortion.tolist()),
        )
        instant = instant_at(first + view.time * (last - first))
        if instant.inside_an_actor(traced):
            return None
        image = render_image(settings, instant, traced)
        near = instant.actors_within(settings.annotation_range, traced)

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
