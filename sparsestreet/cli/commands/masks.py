"""``sparsestreet data masks``: sky, people and vehicles in a log's images, by a segmenter in ONNX's format."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sparsestreet.cli.commands.options import parse_options, shown
from sparsestreet.cli.config.log_from_options import configured_log, reader_of, without_folder

if TYPE_CHECKING:
    from jaxtyping import Bool, UInt8
    from omegaconf import DictConfig

    from sparsestreet.segmentation.model import Preparation
    from sparsestreet.segmentation.write import LogImages

NO_LOG = "no log is named: say sparsestreet data masks DIR model=FILE classes=cityscapes"
ONE_LOG = "masks are of one recorded log at a time: name one folder"
COLORS = {"sky": (86, 180, 233), "human": (213, 94, 0), "vehicle": (240, 228, 66)}
"""RGB of Okabe and Ito's palette, which any color vision tells apart."""
SHEET = "masks.png"
_SHOWN, _COLUMNS, _TILE_WIDTH = 12, 3, 480
_OPACITY = 0.5


@dataclass(frozen=True)
class MaskOptions:
    """Words of the command that are neither of the log nor of how the model sees an image."""

    model: Path
    classes: str
    to: Path | None = None
    threads: int = 0

    def __post_init__(self) -> None:
        if self.threads < 0:
            raise ValueError(f"threads must be 0 or more, got {self.threads}: leave it out for all processors")


def masks(arguments: Sequence[str]) -> int:
    """Write, print and draw. Raises UsageError and OptionError for words that cannot be followed."""
    from sparsestreet.segmentation.model import Preparation

    words, folder = without_folder(arguments, ONE_LOG)
    own, seen = (
        [text for text in words if text.partition("=")[0] in _keys(kind)] for kind in (MaskOptions, Preparation)
    )
    options, preparation = parse_options(own, MaskOptions), parse_options(seen, Preparation)
    words = [text for text in words if text not in (*own, *seen)]
    cfg, told = configured_log(words, folder, no_log=NO_LOG, one_log=ONE_LOG)
    if told:
        print(told)
    try:
        for line in _lines(cfg, options, preparation):
            print(line, flush=True)
    except KeyboardInterrupt:
        print(
            "sparsestreet data masks: stopped, what is written stays: give the same command to go on", file=sys.stderr
        )
        return 130
    return 0


def _keys(kind: type) -> set[str]:
    return {field.name for field in fields(kind)}


def _lines(cfg: "DictConfig", options: MaskOptions, preparation: "Preparation") -> Iterator[str]:
    from sparsestreet.segmentation.classes import segmentation_classes
    from sparsestreet.segmentation.model import Segmenter
    from sparsestreet.segmentation.write import LogImages, write_masks

    classes = segmentation_classes(options.classes)
    segmenter = Segmenter(options.model, classes, preparation, options.threads)
    log = LogImages.of(reader_of(cfg), tuple(classes.kinds))
    out = Path("outputs/masks") / log.name if options.to is None else options.to
    yield f"{log.name}: {len(log)} images by {options.model.name} on {segmenter.provider}; {classes}"
    written = write_masks(log, segmenter, out, shown)
    if written.made:
        shares = ", ".join(f"{kind} {share:.1%}" for kind, share in written.shares.items())
        yield f"{written.made} images, of whose pixels are: {shares}"
    if written.found:
        yield f"{written.found} images have their masks already"
    if written.made or not (out / SHEET).is_file():
        _draw(log, out)
        yield f"drawn: {out / SHEET}, which says whether the classes are right"
    yield f"masks: {out}, which readers take as data.log.masks={out}"


def _draw(log: "LogImages", out: Path) -> None:
    """Write a sheet of some of the images, spread over the log, with their masks in colors."""
    from PIL import Image

    from sparsestreet.atomic import atomic_file
    from sparsestreet.data.lazy import spread
    from sparsestreet.pictures.sheets import Tile, tile_sheet

    tiles = []
    for place in spread(len(log), _SHOWN):
        image, (camera, stem) = log.image(place), log.image_name(place)
        tiles.append(Tile(f"{camera}, {stem}", overlaid(image, log.masks(place, out))))
    title = f"{log.name}: sky is blue, people are red, vehicles are yellow"
    sheet = tile_sheet(tiles, title=title, columns=_COLUMNS, tile_width=_TILE_WIDTH)
    with atomic_file(out / SHEET) as file:
        Image.fromarray(sheet).save(file)


def overlaid(
    image: "UInt8[np.ndarray, 'h w 3']", masks: "Mapping[str, Bool[np.ndarray, 'h w']]"
) -> "UInt8[np.ndarray, 'h w 3']":
    """Return the image with the pixels of each kind tinted in its color."""
    tinted = image.astype(np.float64)
    for kind, mask in masks.items():
        tinted[mask] += _OPACITY * (np.array(COLORS[kind]) - tinted[mask])
    return tinted.round().astype(np.uint8)
