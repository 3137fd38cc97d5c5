"""One image through a segmenter in a file of ONNX: what it wants to see, and what its answer means."""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image

from sparsestreet.segmentation.classes import SegmentationClasses

MULTIPLE = 32
"""Pixels that sides of the input are multiples of where the model leaves them open: strides of segmenters divide it."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
_ENDINGS = ("", ".data", "_data")
"""Of the files that exporters spread a model over, behind its own name."""


@dataclass(frozen=True)
class Preparation:
    """What an image becomes before the model sees it: (color / 255 - mean) / std, red first, at a size.

    The defaults are ImageNet's.
    """

    size: int | None = None
    """Pixels of the longer side, a multiple of 32; None: about those of the image. Of models that leave it open."""
    mean: tuple[float, ...] = (0.485, 0.456, 0.406)
    std: tuple[float, ...] = (0.229, 0.224, 0.225)

    def __post_init__(self) -> None:
        if self.size is not None and (self.size <= 0 or self.size % MULTIPLE):
            raise ValueError(f"size must be a positive multiple of {MULTIPLE}, got {self.size}: say size=1024")
        if len(self.mean) != 3 or len(self.std) != 3 or not all(map(math.isfinite, (*self.mean, *self.std))):
            raise ValueError(f"mean and std must be 3 numbers each, got {self.mean} and {self.std}: leave them out")
        if min(self.std) <= 0:
            raise ValueError(f"std must be positive, got {self.std}: leave it out for ImageNet's")

    def side(self, side: int, longer: int) -> int:
        """Return to how many pixels a side is scaled, of an image whose longer side is given.

        >>> Preparation().side(1242, 1242), Preparation(size=640).side(375, 1242)
        (1248, 192)
        """
        scale = 1.0 if self.size is None else self.size / longer
        return MULTIPLE * max(1, round(scale * side / MULTIPLE))


class Segmenter:
    """A model whose first output is a score for each class and pixel, or a class for each pixel."""

    def __init__(self, path: Path, classes: SegmentationClasses, preparation: Preparation, threads: int = 0) -> None:
        """
        Args:
            path: of the model; weights that it keeps in other files lie beside it.
            classes: that it tells apart.
            preparation: of images, as it was trained.
            threads: of the processor; 0: as many as this process has processors.

        Raises ModuleNotFoundError without onnxruntime, OSError for a file that is not there, and ValueError for one
        that is no model of one image.
        """
        self.path, self.classes, self.preparation = path, classes, preparation
        self._session = _opened(path, threads)
        inputs = self._session.get_inputs()
        shapes = ", ".join(f"{one.name} {one.shape} of {one.type}" for one in inputs)
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].type not in _TYPES:
            remedy = "export the segmenter alone, without its preprocessing"
            raise ValueError(
                f"{path} takes {shapes or 'nothing'}, not one image [1, 3, h, w] of tensor(float): {remedy}"
            )
        self._input = inputs[0]
        batch, *sides = self._input.shape
        self._channels_last = sides[0] != 3 and sides[2] == 3
        channels, rows, columns = (sides[2], *sides[:2]) if self._channels_last else sides
        if (isinstance(batch, int) and batch != 1) or (isinstance(channels, int) and channels != 3):
            raise ValueError(f"{path} takes {shapes}, not [1, 3, h, w] or [1, h, w, 3]: export it for one color image")
        self._fixed = [side if isinstance(side, int) else None for side in (columns, rows)]
        if None not in self._fixed and preparation.size is not None:
            raise ValueError(f"{path} takes images of {columns}x{rows} only: leave size={preparation.size} out")

    @property
    def provider(self) -> str:
        """What computes, such as CPU."""
        return self._session.get_providers()[0].removesuffix("ExecutionProvider")

    def digest(self) -> str:
        """Return the SHA-256 of the model, with the weights that are kept beside it."""
        found = hashlib.sha256()
        for ending in _ENDINGS:
            if (part := self.path.with_name(self.path.name + ending)).is_file():
                with part.open("rb") as file:
                    found.update(hashlib.file_digest(file, "sha256").digest())
        return found.hexdigest()

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Return a mask for each kind that the classes have.

        Raises ValueError where the model fails on the image, or answers with something else than its classes.
        """
        height, width = image.shape[:2]
        try:
            asked = [self._session.get_outputs()[0].name]
            answer = np.asarray(self._session.run(asked, {self._input.name: self._seen(image)})[0])
        except Exception as error:  # each of onnxruntime's is a class of its own
            message = f"{self.path} fails on an image of {width}x{height} ({_said(error)})"
            raise ValueError(f"{message}: say another size=..., or export it again") from error
        labels = _labels(answer, self.classes, (width, height), self.path)
        return {kind: np.isin(labels, self.classes.numbers(kind), kind="table") for kind in self.classes.kinds}

    def _seen(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "one a b c"]:
        """Return the image as the model wants it."""
        height, width = image.shape[:2]
        free = [self.preparation.side(side, max(width, height)) for side in (width, height)]
        columns, rows = (known or other for known, other in zip(self._fixed, free, strict=True))
        pixels = Image.fromarray(image).resize((columns, rows), Image.Resampling.BILINEAR)
        mean, std = (np.array(three, np.float32) for three in (self.preparation.mean, self.preparation.std))
        seen = (np.asarray(pixels, np.float32) / 255 - mean) / std
        seen = seen if self._channels_last else seen.transpose(2, 0, 1)
        return np.ascontiguousarray(seen[None], _TYPES[self._input.type])


def _opened(path: Path, threads: int) -> Any:
    """Return a session of onnxruntime."""
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"masks need {error.name}: pip install 'sparsestreet[masks]'") from error
    if not path.is_file():
        raise FileNotFoundError(f"model={path} is no file: name the model, in ONNX's format")
    options = onnxruntime.SessionOptions()
    # Said, because onnxruntime would otherwise pin threads to processors that may not be this process's.
    options.intra_op_num_threads = threads or cv2.getNumberOfCPUs()
    options.log_severity_level = 3  # errors are raised; of the rest it says much
    there = onnxruntime.get_available_providers()
    try:
        return onnxruntime.InferenceSession(path, options, [name for name in _PROVIDERS if name in there])
    except Exception as error:  # each of its own is a class of its own
        raise ValueError(f"{path} is no model that onnxruntime opens ({_said(error)}): export it again") from error


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def _labels(
    answer: np.ndarray, classes: SegmentationClasses, size: tuple[int, int], path: Path
) -> Int[np.ndarray, "h w"]:
    """Return a class for each pixel of an image of (width, height). Raises ValueError for an answer that is none."""
    count, shape, kind = classes.count, answer.shape, answer.dtype.kind
    one = answer.ndim in (3, 4) and shape[0] == 1 and answer.size > 0
    if one and kind == "f" and answer.ndim == 4 and count in (shape[1], shape[3]):
        scores = answer[0] if shape[1] == count else answer[0].transpose(2, 0, 1)
        if not np.isfinite(scores).all():
            raise ValueError(f"{path} answers with scores that are not finite: export it as float32")
        return _best(scores, size)
    if one and kind in "iu" and (answer.ndim == 3 or 1 in (shape[1], shape[3])):
        labels = answer.reshape(shape[2:] if answer.ndim == 4 and shape[1] == 1 else shape[1:3])
        if labels.min() >= 0 and labels.max() < count:
            # The pixel in whose area the center lies.
            columns, rows = ((np.arange(n) + 0.5) * m // n for n, m in zip(size, labels.shape[::-1], strict=True))
            return labels[np.ix_(rows.astype(int), columns.astype(int))].astype(np.int64)
        shape = f"classes {labels.min()} to {labels.max()}"
    wanted = f"scores [1, {count}, h, w] or classes [1, h, w] from 0 to {count - 1}"
    raise ValueError(
        f"{path} answers with {answer.dtype}, {shape}, and {classes.name} wants {wanted}: say its classes="
    )


def _best(scores: Float[np.ndarray, "c h w"], size: tuple[int, int]) -> Int[np.ndarray, "rows columns"]:
    """Return the class of the highest score, the first of equal ones, after scores were brought to (width, height).

    One class at a time, because all of 150 would take a gigabyte.
    """
    best = cv2.resize(scores[0].astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    labels = np.zeros(best.shape, np.int64)
    for number in range(1, len(scores)):
        plane = cv2.resize(scores[number].astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        labels[plane > best] = number
        np.maximum(best, plane, out=best)
    return labels
