"""Records are strict JSON lines that name their code and machine."""

import json
from dataclasses import dataclass
from math import inf, nan

import pytest

from sparsestreet.bench.records import Provenance, RecordFile, encode, read_records
from sparsestreet.ops import SplatSettings

PROVENANCE = Provenance("sparsestreet bench", "abc", False, "a processor", 2, 1, "Linux", "3.12", "2.13")


@dataclass(frozen=True)
class Sample:
    name: str
    values: tuple[float, ...]
    settings: SplatSettings | None = None


def test_lines_are_there_as_soon_as_written(tmp_path):
    file = RecordFile(tmp_path / "deep" / "a.jsonl", PROVENANCE)
    file.write("sample", Sample("one", (1.0, 1 / 3)))
    assert len(read_records(file.path)) == 1
    file.write("sample", Sample("two", (), SplatSettings()))
    first, second = read_records(file.path)
    assert first["values"] == [1.0, 0.333333]
    assert first["kind"] == "sample"
    assert first["provenance"]["commit"] == "abc"
    assert second["settings"]["max_sigma"] is None
    assert second["settings"]["alpha_min"] == pytest.approx(1 / 255, rel=1e-5)


def test_a_finite_box_is_a_number():
    assert encode(SplatSettings(max_sigma=3.33), "settings")["max_sigma"] == 3.33


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_no_number_without_a_value(tmp_path, value):
    file = RecordFile(tmp_path / "a.jsonl", PROVENANCE)
    with pytest.raises(ValueError, match=r"sample\.values\[1\] is "):
        file.write("sample", Sample("bad", (0.0, value)))
    assert read_records(file.path) == []


def test_no_type_without_a_json_value():
    with pytest.raises(ValueError, match=r"x\.y is <object"):
        encode({"y": object()}, "x")


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1', "Infinity"])
def test_a_line_that_is_not_strict_json_is_refused(tmp_path, text):
    path = tmp_path / "a.jsonl"
    path.write_text(json.dumps({"a": 1}) + "\n" + text + "\n")
    with pytest.raises(ValueError, match=r"a\.jsonl:2 is no record"):
        read_records(path)
