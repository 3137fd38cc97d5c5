"""Segmenters whose answer is known for each pixel: the class is that of the nearest of some colors."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sparsestreet.segmentation.model import Preparation
from tests.segmentation.onnx_file import FLOAT, FLOAT16, INT64, Shape, node, tensor, write_model

COLORS = np.array([[120, 110, 100], [90, 160, 250], [220, 60, 50], [30, 40, 160]], np.uint8)
"""RGB of the classes: road, sky, person, car."""
NAMES = "road\nsky\nperson\ncar\n"


def weights(preparation: Preparation, colors: np.ndarray = COLORS) -> tuple[np.ndarray, np.ndarray]:
    """Of scores w x + b, the highest of which is that of the nearest color: |c|^2 - 2 c x is the squared distance less
    |x|^2. Colors and x are as the model sees them."""
    seen = (colors / 255 - np.array(preparation.mean)) / np.array(preparation.std)
    return (2 * seen).astype(np.float32), -(seen**2).sum(1).astype(np.float32)


def nearest_color(
    path: Path,
    sides: Sequence[int | str] = ("h", "w"),
    *,
    preparation: Preparation | None = None,
    answer: str = "scores",
    stride: int = 1,
    half: bool = False,
    channels_last: bool = False,
    colors: np.ndarray = COLORS,
    input_shape: Shape | None = None,
) -> Path:
    """Write the model. ``answer``: scores, scores_last, classes ([1, h, w]) or kept ([1, 1, h, w])."""
    w, b = weights(preparation or Preparation(), colors)
    shape = ["n", *sides, 3] if channels_last else ["n", 3, *sides]
    nodes, name = [], "image"
    if half:
        nodes.append(node("Cast", [name], "single", to=FLOAT))
        name = "single"
    if channels_last:
        nodes.append(node("Transpose", [name], "first", perm=[0, 3, 1, 2]))
        name = "first"
    nodes.append(node("Conv", [name, "w", "b"], "scores", strides=[stride, stride]))
    open_sides: Shape = ["n", "c", "rows", "columns"]
    ends = {"scores": ("scores", FLOAT, open_sides)}
    if answer == "scores_last":
        nodes.append(node("Transpose", ["scores"], answer, perm=[0, 2, 3, 1]))
        ends[answer] = (answer, FLOAT, open_sides)
    elif answer != "scores":
        nodes.append(node("ArgMax", ["scores"], answer, axis=1, keepdims=int(answer == "kept")))
        ends[answer] = (answer, INT64, open_sides if answer == "kept" else ["n", "rows", "columns"])
    tensors = [tensor("w", w[:, :, None, None]), tensor("b", b)]
    kind = FLOAT16 if half else FLOAT
    return write_model(path, nodes, tensors, [("image", kind, input_shape or shape)], [ends[answer]])


def random_classes(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, len(COLORS), (height, width))
