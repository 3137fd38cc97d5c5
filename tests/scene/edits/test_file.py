"""Files of edits: what they mean in Python, and one sentence about what is wrong in them."""

import math
from pathlib import Path

import pytest

from sparsestreet.scene.edits import (
    REMOVED,
    Added,
    AsRecorded,
    Change,
    Driven,
    Edits,
    Held,
    Moved,
    edits_of,
    read_edits,
)
from sparsestreet.scene.storage import StoredScene
from tests.scene.stored import stored

SECONDS = 4.0


@pytest.fixture(scope="module")
def other():
    return stored()


def read(text: str, tmp_path: Path, other: StoredScene) -> Edits:
    path = tmp_path / "edits.yaml"
    path.write_text(text)
    return read_edits(path, SECONDS, lambda scene: (other, 8.0))


def test_a_file_says_what_python_says(tmp_path, other):
    found = read(
        """
        remove: [a, 7]
        hide: {b: [1, 2], c: [[0, 1], [3, 4]]}
        move:
          d: {right: 3, during: [1, 3]}
          e: {hold: 2.0, hide: [0, 1]}
          f: {path: [[0, 5.0, -2], [3, 20, -2]]}
          g: {turn: 90}
        copy: {h: {of: d, forward: -8}}
        insert: {i: {scene: somewhere, of: tram 12, path: [[0, 1, 2, 0.9, 180]]}}
        replace: {j: {scene: somewhere, of: tram 12}, k: {of: d}}
        """,
        tmp_path,
        other,
    )
    assert found.changes == {
        "a": REMOVED,
        "7": REMOVED,
        "b": Change(hidden=((0.25, 0.5),)),
        "c": Change(hidden=((0.0, 0.25), (0.75, 1.0))),
        "d": Change(Moved(right=3.0, during=(0.25, 0.75))),
        "e": Change(Held(0.5), hidden=((0.0, 0.25),)),
        "f": Change(Driven([0.0, 0.75], [(5.0, -2.0), (20.0, -2.0)])),
        "g": Change(Moved(turn=math.pi / 2)),
        "j": REMOVED,
        "k": REMOVED,
    }
    placed = Driven([0.0], [(1.0, 2.0)], [0.9], [math.pi])
    assert found.added == {
        "h": Added("d", Change(Moved(forward=-8.0))),
        "i": Added("tram 12", Change(placed), scene=other.scene, speed=0.5),
        "j replaced": Added("tram 12", Change(AsRecorded()), "j", other.scene, speed=0.5),
        "k replaced": Added("d", Change(AsRecorded()), "k"),
    }


def test_an_empty_file_edits_nothing(tmp_path, other):
    assert read("", tmp_path, other) == Edits() == edits_of({}, SECONDS, lambda scene: (stored(), 1.0))


def test_other_scenes_are_looked_for_beside_the_file(tmp_path, other):
    asked = []
    path = tmp_path / "edits.yaml"
    path.write_text("replace: {j: {scene: there, of: tram 12}}")
    read_edits(path, SECONDS, lambda scene: (asked.append(scene), (other, 8.0))[1])
    assert asked == [tmp_path / "there"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("remove: {a: 1}", "remove: is a list of names"),
        ("removed: [a]", "has no key 'removed'; did you mean remove"),
        ("[a]", "has entries name: value"),
        ("hide: {a: [2, 1]}", r"hide: a goes from a time to a later one, got \[2, 1\]"),
        ("hide: {a: 2}", r"hide: a is \[from, to\] in seconds, got 2"),
        ("move: {a: {left: 1}}", "move: a has no key 'left'"),
        ("move: {a: {right: fast}}", "move: a: right takes finite numbers, got 'fast'"),
        ("move: {a: {right: .inf}}", "takes finite numbers, got inf"),
        ("move: {a: {right: true}}", "takes finite numbers, got True"),
        ("move: {a: {hold: 1, right: 2}}", "hold, right exclude each other"),
        ("move: {a: {path: [[0, 1]]}}", r"is a list of \[seconds, x, y\]"),
        ("move: {a: {path: [[0, 1, 2], [1, 2, 3, 4]]}}", r"is a list of \[seconds, x, y\]"),
        ("move: {a: {path: [[1, 1, 2], [0, 2, 3]]}}", "increasing times"),
        ("move: {a: {path: 5}}", r"is a list of \[seconds, x, y\]"),
        ("copy: {a: {right: 2}}", "copy: a: of: is missing"),
        (
            "insert: {a: {scene: there, of: cow, path: [[0, 1, 2]]}}",
            "insert: a: in there: the scene has no object 'cow'",
        ),
        ("replace: {a: {scene: there, of: cow}}", "replace: a: in there: the scene has no object 'cow'"),
        ("{remove: [a], hide: {a: [0, 1]}}", "a is edited twice"),
        ("remove: [a", "is no YAML"),
        (f"remove: [{'9' * 5000}]", r"is no YAML: Exceeds the limit"),
    ],
)
def test_a_wrong_file_gets_one_sentence_that_names_it(text, said, tmp_path, other):
    with pytest.raises(ValueError, match=f"edits.yaml.*{said}"):
        read(text, tmp_path, other)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file of edits at"):
        read_edits(tmp_path / "none.yaml", SECONDS, lambda scene: (stored(), 1.0))
