"""A file of a run's folder: where it is, whether it is there, and what a table refuses."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from sparsestreet.records.file import CsvFile, JsonFile, check_links
from sparsestreet.records.strict_json import RecordError, significant


@dataclass(frozen=True)
class Size:
    width: int


@dataclass(frozen=True)
class Pixel:
    x: int
    value: float | None


def cells(pixel):
    return pixel.x, None if pixel.value is None else significant(pixel.value, f"pixel {pixel.x}")


SIZE = JsonFile("records/size.json", Size)
PIXELS = CsvFile("pixels.csv", ("x", "value"), cells, lambda one: Pixel(int(one[0]), float(one[1])), "draw it")


def test_a_file_is_there_from_its_writing_to_its_removal(tmp_path):
    assert SIZE.path(tmp_path) == tmp_path / "records" / "size.json"
    assert (SIZE.exists(tmp_path), SIZE.find(tmp_path), PIXELS.find(tmp_path)) == (False, None, None)
    SIZE.write(tmp_path, Size(3))
    PIXELS.write(tmp_path, [])
    assert (SIZE.exists(tmp_path), SIZE.find(tmp_path), PIXELS.find(tmp_path)) == (True, Size(3), [])
    for _ in range(2):  # the second time there is nothing to remove
        SIZE.remove(tmp_path)
        assert not SIZE.exists(tmp_path)
    with pytest.raises(RecordError, match=r"records/size\.json: cannot be read"):
        SIZE.read(tmp_path)
    PIXELS.remove(tmp_path)
    with pytest.raises(RecordError, match=r"pixels\.csv: does not exist; draw it first"):
        PIXELS.read(tmp_path)


def test_runs_are_found_by_their_file(tmp_path):
    for name in ("b", "a/inner", "a"):
        SIZE.write(tmp_path / name, Size(1))
        PIXELS.write(tmp_path / name, [])
    (tmp_path / "size.json").write_text("{}")  # of no records folder
    assert SIZE.runs(tmp_path) == [tmp_path / "a" / "inner", tmp_path / "a", tmp_path / "b"]
    assert PIXELS.runs(tmp_path / "b") == SIZE.runs(tmp_path / "b") == [tmp_path / "b"]


def test_what_cannot_be_written_is_named_and_leaves_the_old_table(tmp_path):
    PIXELS.write(tmp_path, [Pixel(1, 2.0)])
    with pytest.raises(RecordError, match=r"^\S*pixels\.csv: pixel 7 is nan, which a record has no number for"):
        PIXELS.write(tmp_path, [Pixel(1, 2.0), Pixel(7, float("nan"))])
    assert PIXELS.read(tmp_path) == [Pixel(1, 2.0)]


def test_a_table_that_was_half_written_leaves_the_old_one(tmp_path, monkeypatch):
    PIXELS.write_to(tmp_path / "else" / "where.csv", [Pixel(4, None)])
    assert (tmp_path / "else" / "where.csv").read_text() == "x,value\n4,\n"
    shutil.rmtree(tmp_path / "else")
    PIXELS.write(tmp_path, [Pixel(1, 2.0)])

    def full(path, text, **options):
        path.write_bytes(text[: len(text) // 2].encode())
        raise OSError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="the disk is full"):
            PIXELS.write(tmp_path, [Pixel(3, 4.0)])
    assert PIXELS.read(tmp_path) == [Pixel(1, 2.0)]
    assert [path.name for path in tmp_path.iterdir()] == ["pixels.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"the header is \[\], expected x,value; draw it again"),
        ("value,x\n", r"the header is \[\['value', 'x'\]\], expected x,value; draw it again"),
        ("x,value\n1,2\n3\n", "line 3: 1 cells, expected 2; draw it again"),
        ("x,value\n1,2,3\n", "line 2: 3 cells, expected 2; draw it again"),
        ("x,value\n1,two\n", "line 2: could not convert string to float: 'two'; draw it again"),
    ],
)
def test_a_malformed_table_names_file_line_and_remedy(tmp_path, text, message):
    PIXELS.path(tmp_path).write_text(text)
    with pytest.raises(RecordError, match=rf"pixels\.csv(,|:) {message}"):
        PIXELS.read(tmp_path)


@pytest.mark.parametrize("name", ["records", "predictions/held_out", "records/summary.json", "train.log", "curves/a/b"])
@pytest.mark.parametrize("there", [True, False])
def test_a_link_out_of_a_run_is_refused(name, there, tmp_path):
    """Whether or not something is where it leads; what leads to another place of the run is its own matter."""
    run, other = tmp_path / "run", tmp_path / "run_of_others"
    (run / name).parent.mkdir(parents=True)
    if there:
        other.mkdir()
    (run / name).symlink_to(other)
    (tmp_path / "link").symlink_to(run)
    for folder in (run, tmp_path / "link"):
        with pytest.raises(OSError, match=rf"{name} is a link out of the run's folder, to {other}: nothing was"):
            check_links(folder)
    (run / name).unlink()
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "last.ckpt").symlink_to("before_0.6.ckpt")
    (run / "checkpoints" / "loop").symlink_to("loop")
    check_links(tmp_path / "link")
    check_links(tmp_path / "not_there")
