"""Records are strict JSON lines that name their code and machine; the committed ones can be read and drawn."""

import json
from dataclasses import dataclass
from math import inf, nan
from pathlib import Path

import pytest

from sparsestreet.bench.figures import draw_pareto
from sparsestreet.bench.records import Provenance, RecordFile, read_records, settings_entries
from sparsestreet.ops import SplatSettings
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.strict_json import RecordError

MACHINE = Machine(processor="a processor", cores=2, system="Linux", python="3.12", torch="2.13")
PROVENANCE = Provenance("sparsestreet bench", 1, MACHINE, CodeVersion("abc", False))
COMMITTED = Path(__file__).parents[2] / "benchmarks"


@dataclass(frozen=True)
class Sample:
    name: str
    values: tuple[float, ...]


def test_lines_are_there_as_soon_as_written(tmp_path):
    file = RecordFile(tmp_path / "deep" / "er" / "a.jsonl", PROVENANCE)
    file.write("sample", Sample("one", (1.0, 1 / 3)))
    assert len(read_records(file.path)) == 1
    file.write("sample", Sample("two", ()))
    first, second = read_records(file.path)
    assert (first["kind"], first["name"], first["values"]) == ("sample", "one", [1.0, 0.333333])
    assert first["load"] >= 0
    assert first["provenance"]["command"] == "sparsestreet bench"
    assert first["provenance"]["source"]["commit"] == "abc"
    assert first["provenance"]["machine"]["cores"] == 2
    assert (second["name"], second["provenance"]) == ("two", first["provenance"])


def test_settings_are_numbers_that_json_has():
    assert settings_entries(SplatSettings(max_sigma=3.33))["max_sigma"] == 3.33
    entries = settings_entries(SplatSettings())
    assert entries["max_sigma"] is None
    assert entries["alpha_min"] == SplatSettings().alpha_min


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_a_number_without_a_value_is_refused_and_nothing_written(tmp_path, value):
    file = RecordFile(tmp_path / "a.jsonl", PROVENANCE)
    with pytest.raises(RecordError, match=r"sample: values\[1\] is "):
        file.write("sample", Sample("bad", (0.0, value)))
    assert read_records(file.path) == []


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1', "Infinity"])
def test_a_line_that_is_not_strict_json_is_refused(tmp_path, text):
    path = tmp_path / "a.jsonl"
    path.write_text(json.dumps({"a": 1}) + "\n" + text + "\n")
    with pytest.raises(RecordError, match=r"a\.jsonl:2: is not strict JSON"):
        read_records(path)


@pytest.mark.parametrize("mode", ["knobs", "scaling"])
def test_committed_records_are_read(mode):
    records = read_records(COMMITTED / f"{mode}.jsonl")
    assert records
    assert all(record["provenance"]["command"].startswith(f"sparsestreet bench {mode}") for record in records)


@pytest.mark.slow
def test_committed_records_are_drawn(tmp_path):
    assert len(draw_pareto(read_records(COMMITTED / "knobs.jsonl"), tmp_path)) == 4
