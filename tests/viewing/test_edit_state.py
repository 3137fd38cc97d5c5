"""Edits by hand: a file of edits that says what was done, whatever it said before."""

import math
from dataclasses import asdict

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sparsestreet.scene.edits import REMOVED, Change, Edits, Moved, edits_of, placed
from sparsestreet.viewing.edit_state import EditState, Offset, own_frame
from tests.export.street import stored_street

SECONDS = 4.0
SCENE = stored_street().scene.eval()


def never(path):
    raise AssertionError("no other scene is named")


def state(said=None) -> EditState:
    return EditState(SCENE, said or {}, SECONDS, never)


def read_back(edits: EditState) -> Edits:
    return edits_of(yaml.safe_load(edits.text()), SECONDS, never)


def test_nothing_is_done_at_first():
    edits = state()
    assert edits.names == ("car", "tram")
    assert edits.said() == {}
    assert read_back(edits) == Edits()
    assert edits.life("tram") == (0.0, 2.0)


def test_what_is_done_is_what_the_file_says():
    edits = state()
    edits.hide("tram", True)
    edits.move("car", Offset(right=3.0, turn=90.0))
    assert read_back(edits).changes == {"tram": REMOVED, "car": Change(Moved(right=3.0, turn=math.pi / 2))}
    assert edits.is_hidden("tram")
    assert edits.offset("car") == Offset(right=3.0, turn=90.0)
    edits.hide("tram", False)
    edits.move("car", Offset())
    assert read_back(edits) == Edits()


def test_a_moved_object_that_is_hidden_comes_back_where_it_was_moved_to():
    edits = state()
    edits.move("car", Offset(up=1.0))
    edits.hide("car", True)
    assert read_back(edits).changes == {"car": REMOVED}
    edits.hide("car", False)
    assert read_back(edits).changes == {"car": Change(Moved(up=1.0))}


def test_what_the_file_said_stays():
    said = {
        "hide": {"tram": [1.0, 2.0]},
        "move": {"car": {"right": 1.0, "during": [1.0, 3.0]}},
        "copy": {"second": {"of": "car", "forward": -5.0}},
    }
    edits = state(said)
    assert edits.said() == said
    edits.move("tram", Offset(forward=2.0))
    edits.move("car", Offset(right=2.5))
    assert edits.said() == {
        "move": {
            "tram": {"hide": [1.0, 2.0], "forward": 2.0},
            "car": {"during": [1.0, 3.0], "right": 2.5},
        },
        "copy": said["copy"],
    }
    assert "second" in edits.scene.nodes
    assert said["move"]["car"]["right"] == 1.0
    edits.move("car", Offset())  # where it was recorded: there is no move whose time could be said
    assert edits.said()["move"].keys() == {"tram"}


def test_an_object_on_a_way_of_its_own_is_not_moved():
    edits = state({"move": {"car": {"hold": 1.0}}})
    assert edits.goes_its_own_way("car")
    with pytest.raises(ValueError, match="car has a hold: or path:"):
        edits.move("car", Offset(up=1.0))
    assert edits.said() == {"move": {"car": {"hold": 1.0}}}


def test_a_slip_in_the_file_is_found_at_once():
    with pytest.raises(ValueError, match="no object 'bus'"):
        state({"remove": ["bus"]})
    with pytest.raises(ValueError, match="did you mean move"):
        state({"moove": {}})


@given(*(st.floats(-20, 20) for _ in range(3)), st.floats(-179, 179))
def test_what_was_dragged_stands_where_it_was_dropped(forward, right, up, turn):
    recorded = placed(5.0, -3.0, 1.0, 0.7)
    wanted = recorded @ placed(forward, -right, up, math.radians(turn))
    offset = Offset.of(own_frame(recorded, wanted))
    # Millimeters and hundredths of a degree are kept.
    np.testing.assert_allclose(list(asdict(offset).values()), [forward, right, up, turn], atol=0.0051)
    np.testing.assert_allclose((recorded @ offset.frame)[:3, 3], wanted[:3, 3], atol=0.0011)


def test_a_turn_is_to_the_left_and_right_is_right():
    """x ahead, y left: after a quarter turn what was ahead is on the left."""
    frame = Offset(right=2.0, turn=90.0).frame
    assert np.allclose(frame[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.allclose(frame[:3, 3], [0.0, -2.0, 0.0])
