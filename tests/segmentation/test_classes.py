"""Which classes of a segmenter are of which kind."""

import pytest

from sparsestreet.segmentation.classes import segmentation_classes


def test_tables_are_those_of_the_data_sets():
    """Cityscapes and ADE20K as SegFormer counts them (DriveStudio takes the first), COCO's 133 as Mask2Former does."""
    city, ade, coco, things = map(segmentation_classes, ("cityscapes", "ade20k", "coco", "coco80"))
    assert [city.count, ade.count, coco.count, things.count] == [19, 150, 133, 80]
    assert [city.numbers(kind) for kind in ("sky", "human", "vehicle")] == [[10], [11, 12, 17, 18], [13, 14, 15]]
    assert [ade.numbers(kind) for kind in ("sky", "human", "vehicle")] == [[2], [12, 116, 127], [20, 80, 83, 102]]
    assert [coco.numbers(kind) for kind in ("sky", "human", "vehicle")] == [[119], [0, 1, 3], [2, 5, 7]]
    assert things.kinds.keys() == {"human", "vehicle"}
    assert str(things) == "human: person, bicycle, motorcycle; vehicle: car, bus, truck"


def test_a_file_names_the_classes(tmp_path):
    path = tmp_path / "names.txt"
    path.write_text("ground\r\nCar\r\n vehicle \r\ncar\r\n\r\n")
    classes = segmentation_classes(str(path))
    assert (classes.count, classes.kinds) == (4, {"vehicle": {"Car": [1], "vehicle": [2], "car": [3]}})
    assert classes.numbers("vehicle") == [1, 2, 3]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"road\nwall\n", "none of the 2 classes of .* is of a kind of masks: call those that are sky, "),
        (b"road\n\ncar", "line 2 of .* is empty"),
        (b"", "line 1 of .* is empty"),
        (b"\xff\xfe", "is no text"),
    ],
)
def test_a_file_of_other_content_is_refused(content, said, tmp_path):
    (tmp_path / "names.txt").write_bytes(content)
    with pytest.raises(ValueError, match=said):
        segmentation_classes(str(tmp_path / "names.txt"))


def test_what_is_no_table_is_refused():
    with pytest.raises(ValueError, match="classes=citiscapes is none of cityscapes, ade20k, coco, coco80, and no file"):
        segmentation_classes("citiscapes")
