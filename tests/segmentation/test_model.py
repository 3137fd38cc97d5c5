"""What a segmenter sees, and what is made of its answer."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparsestreet.segmentation.classes import segmentation_classes
from sparsestreet.segmentation.model import Preparation, Segmenter
from tests.segmentation.models import COLORS, NAMES, nearest_color, random_classes, weights
from tests.segmentation.onnx_file import FLOAT, INT64, node, tensor, write_model

KINDS = {"sky": 1, "human": 2, "vehicle": 3}


@pytest.fixture
def names(tmp_path: Path) -> str:
    (tmp_path / "names.txt").write_text(NAMES)
    return str(tmp_path / "names.txt")


def opened(path: Path, names: str, preparation: Preparation | None = None) -> Segmenter:
    return Segmenter(path, segmentation_classes(names), preparation or Preparation(), threads=1)


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"answer": "scores_last"},
        {"answer": "classes"},
        {"answer": "kept"},
        {"channels_last": True, "answer": "scores_last"},
        {"half": True},
        {"preparation": Preparation(mean=(0.0, 0.5, 0.25), std=(1.0, 0.5, 2.0))},
    ],
)
def test_a_model_of_the_images_size_is_read_pixel_by_pixel(form: dict[str, Any], tmp_path, names):
    found = opened(nearest_color(tmp_path / "m.onnx", (23, 37), **form), names, form.get("preparation"))(
        COLORS[classes := random_classes(23, 37)]
    )
    assert found.keys() == KINDS.keys()
    for kind, number in KINDS.items():
        assert found[kind].dtype == bool
        assert np.array_equal(found[kind], classes == number), kind


def bilinear(plane: np.ndarray, width: int, height: int) -> np.ndarray:
    """In float64, by corners: pixel centers lie at +0.5, and the border is continued."""
    rows, columns = ((np.arange(n) + 0.5) * m / n - 0.5 for n, m in ((height, plane.shape[0]), (width, plane.shape[1])))
    low = [np.floor(place).astype(int) for place in (rows, columns)]
    over_rows, over_columns = (place - floor for place, floor in zip((rows, columns), low, strict=True))
    r = [np.clip(low[0] + step, 0, plane.shape[0] - 1) for step in (0, 1)]
    c = [np.clip(low[1] + step, 0, plane.shape[1] - 1) for step in (0, 1)]
    upper, lower = ((1 - over_columns) * plane[np.ix_(at, c[0])] + over_columns * plane[np.ix_(at, c[1])] for at in r)
    return (1 - over_rows)[:, None] * upper + over_rows[:, None] * lower


@pytest.mark.parametrize(("size", "seen"), [(None, (96, 32)), (64, (64, 32))])
def test_an_open_model_sees_multiples_of_32_and_its_scores_are_enlarged(size, seen, tmp_path, names):
    image = COLORS[np.kron(random_classes(5, 13, seed=1), np.ones((8, 7), int))]  # 40 x 91
    found = opened(nearest_color(tmp_path / "m.onnx", stride=4), names, Preparation(size=size))(image)
    resized = np.asarray(Image.fromarray(image).resize(seen, Image.Resampling.BILINEAR)) / 255
    w, b = weights(Preparation())
    prepared = (resized - np.array(Preparation.mean)) / np.array(Preparation.std)
    scores = (prepared @ w.T.astype(np.float64) + b)[::4, ::4]
    large = np.stack([bilinear(scores[..., number], 91, 40) for number in range(len(COLORS))])
    best = np.sort(large, 0)
    clear = best[-1] - best[-2] > 1e-3  # scores are up to 30, in float32, and OpenCV has weights of float32
    assert clear.mean() > 0.99
    for kind, number in KINDS.items():
        assert np.array_equal(found[kind][clear], (large.argmax(0) == number)[clear])


def test_labels_take_the_pixel_in_which_the_center_lies(tmp_path, names):
    image = np.repeat(np.repeat(COLORS[random_classes(8, 8)], 4, 0), 4, 1)
    found = opened(nearest_color(tmp_path / "m.onnx", (32, 32), answer="classes", stride=4), names)(image)
    assert np.array_equal(found["sky"], (image == COLORS[1]).all(-1))
    wide = np.concatenate([image, image[:, :1]], 1)  # 33 columns of 8 labels: 4.125 each
    found = opened(nearest_color(tmp_path / "m.onnx", (32, 32), answer="classes", stride=4), names)(wide)
    assert found["sky"].shape == (32, 33)
    assert np.array_equal(found["sky"][:, 0], (image[:, 0] == COLORS[1]).all(-1))


def fixed_answer(path: Path, values: np.ndarray) -> Path:
    kind = INT64 if values.dtype == np.int64 else FLOAT
    nodes = [node("Identity", ["values"], "answer")]
    return write_model(
        path, nodes, [tensor("values", values)], [("image", FLOAT, [1, 3, "h", "w"])], [("answer", kind, values.shape)]
    )


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros((1, 5, 2, 2), np.float32), r"float32, \(1, 5, 2, 2\), .* wants scores \[1, 4, h, w\] or classes"),
        (np.zeros((2, 4, 2, 2), np.float32), r"float32, \(2, 4, 2, 2\)"),
        (np.zeros((1, 100, 5), np.float32), r"float32, \(1, 100, 5\)"),
        (np.zeros((1, 4, 0, 2), np.float32), r"\(1, 4, 0, 2\)"),
        (np.zeros((1, 1), np.int64), r"int64, \(1, 1\)"),
        (np.zeros((), np.int64), r"int64, \(\)"),
        (np.zeros((1, 4, 2, 2), np.int64), r"int64, \(1, 4, 2, 2\)"),
        (np.full((1, 2, 2), 4), "classes 4 to 4, and .* from 0 to 3: say its classes="),
        (np.full((1, 2, 2), -1), "classes -1 to -1"),
        (np.full((1, 4, 2, 2), np.nan, np.float32), "scores that are not finite: export it as float32"),
    ],
)
def test_an_answer_that_is_none_is_refused(values, said, tmp_path, names):
    segmenter = opened(fixed_answer(tmp_path / "m.onnx", values), names)
    with pytest.raises(ValueError, match=said):
        segmenter(np.zeros((3, 5, 3), np.uint8))


def one_node(path: Path, *inputs: tuple[str, int, list[int | str]]) -> Path:
    return write_model(
        path, [node("Identity", ["image"], "answer")], [], inputs, [("answer", inputs[0][1], inputs[0][2])]
    )


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ([("image", FLOAT, [1, 1, "h", "w"])], r"not \[1, 3, h, w\] or \[1, h, w, 3\]: export it for one color image"),
        ([("image", FLOAT, [4, 3, "h", "w"])], "for one color image"),
        ([("image", 2, [1, 3, "h", "w"])], r"tensor\(uint8\), not one image .* without its preprocessing"),
        ([("image", FLOAT, [3, "h", "w"])], "not one image"),
        ([("image", FLOAT, [1, 3, "h", "w"]), ("size", FLOAT, [1, 3, 4, 4])], "size .* not one image"),
    ],
)
def test_a_model_of_other_inputs_is_refused(inputs, said, tmp_path, names):
    with pytest.raises(ValueError, match=said):
        opened(one_node(tmp_path / "m.onnx", *inputs), names)


def test_what_is_no_model_is_refused(tmp_path, names, monkeypatch):
    whole = nearest_color(tmp_path / "m.onnx", (32, 32))
    with pytest.raises(ValueError, match="takes images of 32x32 only: leave size=64 out"):
        opened(whole, names, Preparation(size=64))
    for number, content in enumerate((whole.read_bytes()[:-60], b"no model", b"")):
        damaged = tmp_path / f"{number}.onnx"
        damaged.write_bytes(content)
        with pytest.raises(ValueError, match=r"is no model that onnxruntime opens \(.*\): export it again"):
            opened(damaged, names)
    with pytest.raises(FileNotFoundError, match="is no file: name the model"):
        opened(tmp_path / "none.onnx", names)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sparsestreet\[masks\]'"):
        opened(whole, names)


def test_a_model_that_fails_on_an_image_is_said(tmp_path, names):
    big = np.zeros((4, 3, 200, 200), np.float32)
    nodes = [node("Conv", ["image", "w"], "scores")]
    shape: list[int | str] = [1, "c", "h", "w"]
    path = write_model(
        tmp_path / "m.onnx", nodes, [tensor("w", big)], [("image", FLOAT, [1, 3, "h", "w"])], [("scores", FLOAT, shape)]
    )
    with pytest.raises(ValueError, match=r"fails on an image of 5x3 \(.*\): say another size=..., or export it again"):
        opened(path, names)(np.zeros((3, 5, 3), np.uint8))


def test_weights_beside_the_model_count(tmp_path, names):
    model = nearest_color(tmp_path / "m.onnx")
    before = opened(model, names).digest()
    (tmp_path / "m.onnx.data").write_bytes(b"weights")
    assert opened(model, names).digest() != before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"size": 100}, "size must be a positive multiple of 32, got 100"),
        ({"size": 0}, "size must be"),
        ({"mean": (0.5,)}, "mean and std must be 3 numbers each"),
        ({"std": (1.0, 0.0, 1.0)}, "std must be positive"),
        ({"mean": (0.5, np.nan, 0.5)}, "mean and std must be 3 numbers"),
    ],
)
def test_a_wrong_preparation_is_refused(words, said):
    with pytest.raises(ValueError, match=said):
        Preparation(**words)
