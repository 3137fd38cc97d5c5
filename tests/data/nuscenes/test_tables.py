"""Tables are searched in pieces, and give what the standard parser gives."""

import json
import tracemalloc
from pathlib import Path

import pytest

from sparsestreet.data.nuscenes import tables
from sparsestreet.data.nuscenes.tables import all_rows, rows_of_tokens, rows_where
from sparsestreet.data.problems import LogError


def written(path: Path, count: int, **json_options) -> list[dict]:
    rows = [
        {
            "token": f"t{n}",
            "sample_token": f"s{n % 7}",
            "numbers": [[n, 0.5], [1e-9, -n]],
            "prev": "",
            "is_key_frame": True,
        }
        for n in range(count)
    ]
    path.write_text(json.dumps(rows, **json_options))
    return rows


@pytest.mark.parametrize("options", [{"indent": 0}, {}, {"indent": 4}, {"separators": (",", ":")}])
@pytest.mark.parametrize("chunk", [64, 1000, 1 << 22])
def test_rows_are_those_of_the_standard_parser(options, chunk, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_CHUNK", chunk)
    rows = written(tmp_path / "t.json", 200, **options)
    found = rows_where(tmp_path / "t.json", "sample_token", {"s3", "s5"})
    assert [row.values for row in found] == [row for row in rows if row["sample_token"] in ("s3", "s5")]
    assert rows_of_tokens(tmp_path / "t.json", {"t17"})["t17"].values == rows[17]


def test_an_empty_list_is_a_table(tmp_path):
    (tmp_path / "t.json").write_text(" [ \n ] \n")
    assert rows_where(tmp_path / "t.json", "token", {"t"}) == []
    assert all_rows(tmp_path / "t.json") == []


def test_memory_is_that_of_the_rows_found(tmp_path, monkeypatch):
    """A table of 2.4 MB in pieces of 16 kB: what is held is a few pieces and one row."""
    monkeypatch.setattr(tables, "_CHUNK", 1 << 14)
    written(tmp_path / "t.json", 20_000, indent=0)
    tracemalloc.start()
    rows = rows_where(tmp_path / "t.json", "token", {"t19999"})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(rows) == 1
    assert peak < 200_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the table is cut short"),
        ("{}", "must be a JSON list"),
        ('[{"token": "a"}', "the table is cut short"),
        ('[{"token": "a"}, {"token": "b"', "the table is cut short"),
        ('[{"token": "a", "name": "}"}]', "the row with token 'a' is no JSON object"),
        ('[{"token": "a", "more": {"token": "b"}}]', "the row with token 'a' is no JSON object"),
        ('[{"token": "a", "token": "c"}]', "token 'a' is not in a row of its own"),
        ('[{"token": "a"}, {"token": "a"}]', "1 rows have the token of another row"),
        ('[{"token": "b"}]', "1 rows that other tables name are missing, the first is 'a'"),
        ('[{"token": "a", "n": ' + "[" * 100_000 + "}]", "is no JSON object"),
        ('[{"token": "a", "n": ' + "9" * 10_000 + "}]", "is no JSON object"),
        ("[" + " " * 2_000_000, "no row ends within 1048576 bytes"),
    ],
)
def test_what_is_no_table_of_flat_rows_is_refused(text, said, tmp_path):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(LogError, match=said) as caught:
        rows_of_tokens(tmp_path / "t.json", {"a"})
    assert caught.value.problems[0].path == tmp_path / "t.json"


def test_a_table_that_is_parsed_at_once_has_a_limit(tmp_path):
    with (tmp_path / "t.json").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(LogError, match="the table has 1073741824 bytes, more than 67108864"):
        all_rows(tmp_path / "t.json")


def test_more_rows_than_a_scene_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_MOST_ROWS", 10)
    written(tmp_path / "t.json", 200)
    with pytest.raises(LogError, match="more than 10 rows belong to one scene"):
        rows_where(tmp_path / "t.json", "sample_token", {"s3"})
