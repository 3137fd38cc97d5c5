"""A run of a small scene whose renders are darker than the images."""

import torch

from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.evaluation.speed import Timing
from tests.evaluation.frames import make_frame, make_run
from tests.evaluation.scenes import OPTIONS, small_scene

MADE = make_run("streetgs+paper", 3, training_seconds=12.5, caps={"road": 2}, config={"loss.weight": 0.012345678901})


def darker(view):
    return view.image.float() / 255 * 0.9


def evaluate(out, held_out, training=(), pictures=2, device="cpu", **replaced):
    return evaluate_scene(
        small_scene(),
        held_out if isinstance(held_out, Frames) else tuple(held_out),
        tuple(training),
        out=out,
        device=device,
        pictures=pictures,
        **{"run": MADE, "options": OPTIONS, "command": "sparsestreet evaluate run=x", "timing": Timing(1, 2, 1)}
        | replaced,
    )


def make_frames(count: int = 5, first: int = 0):
    frames = []
    for index in range(count):
        vehicle = torch.zeros(9, 12, dtype=torch.bool)
        vehicle[:, : 2 * index] = True
        frames.append(make_frame(first + 10 * index, index % 2, vehicle=vehicle))
    return frames
