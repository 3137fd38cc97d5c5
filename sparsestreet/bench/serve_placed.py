"""Objects that requests place, beside the same street traced with the actors there."""

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO

import numpy as np
from jaxtyping import Float64
from PIL import Image
from torch import Tensor

from sparsestreet.bench.edits import Beside, Show, actors_of, compared, in_words
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.serve import Say
from sparsestreet.bench.serve_client import PNG, Client, place
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.truth import street_truth
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.types import View

LEFT, DOWN = 2.0, 100.0
"""Meters by which an object is moved, and by which it is taken away."""


def run_placed(
    client: Client,
    views: Sequence[View],
    settings: StreetSettings,
    street_from_world: Float64[Tensor, "4 4"],
    file: RecordFile,
    say: Say = print,
) -> int:
    """Moves each object that is seen to the left, and puts it below the street; returns the number of records."""
    world, count = build_world(settings), 0
    truth = street_truth(settings, street_from_world)
    before = _shown(client, None, 0.0, 0.0)
    for name, actor, index in actors_of(client.served.stored, world, settings, street_from_world):
        others = [*world.actors[:index], *world.actors[index + 1 :]]
        beside = replace(actor, path=Beside(actor.path, -LEFT))
        for kind, actors, left, down in (("moved", [*others, beside], LEFT, 0.0), ("removed", others, 0.0, DOWN)):
            other = street_truth(settings, street_from_world, replace(world, actors=tuple(actors)))
            shown = (before, _shown(client, name, left, down))
            record = compared(kind, name, actor, shown, views, (truth, other))
            if record is not None:
                file.write("placed", record)
                say(f"placed, {in_words(record)}")
                count += 1
    return count


def _shown(client: Client, name: str | None, left: float, down: float) -> Show:
    """What the server shows, with an object to the left of where it was logged, or farther down."""

    def show(view: View) -> Float64[np.ndarray, "h w 3"]:
        request = client.request(view, image_format=PNG)
        box = None if name is None else client.box(name, view.time)
        if name is not None and box is not None:
            offset = np.eye(4)
            offset[1, 3], offset[2, 3] = left, -down
            place(request, name, box @ offset)
        with Image.open(BytesIO(client.ask(request).image)) as image:
            return np.asarray(image, dtype=np.float64) / 255

    return show
