"""When what is drawn: small while something moves, whole at rest, at the frame rate that was asked for."""

import numpy as np
import pytest

from sparsestreet.viewing.canvas import REST, Canvas, Shot
from sparsestreet.viewing.pace import Pace
from sparsestreet.viewing.stage import Eye


def eye(width: int = 1200, height: int = 600) -> Eye:
    return Eye(np.eye(4), 1.0, width, height)


def there(shot: Shot | None) -> Shot:
    assert shot is not None
    return shot


def test_a_moving_camera_gets_small_pictures_and_then_a_whole_one():
    canvas = Canvas(Pace(10.0))
    assert canvas.due(0, 0.0) is None
    canvas.look(eye(), 1.0)
    small = there(canvas.due(0, 1.0))
    assert (small.whole, small.width / small.height) == (False, pytest.approx(2, rel=0.01))
    assert small.width < 1200
    canvas.drawn(small, 0.05, 1.05)
    assert canvas.due(0, 1.1) is None
    whole = there(canvas.due(0, 1.01 + REST))
    assert whole == Shot(small.eye, 1200, 600, whole=True)
    canvas.drawn(whole, 0.3, 1.5)
    assert canvas.due(0, 9.0) is None


def test_a_change_of_the_scene_is_drawn_like_a_move():
    canvas = Canvas(Pace(10.0))
    canvas.look(eye(), 0.0)
    canvas.drawn(there(canvas.due(0, 0.0)), 0.01, 0.01)
    canvas.drawn(there(canvas.due(0, 1.0)), 0.01, 1.0)
    changed = there(canvas.due(1, 2.0))
    assert not changed.whole
    canvas.drawn(changed, 0.01, 2.01)
    assert canvas.due(1, 2.1) is None
    assert there(canvas.due(1, 2.01 + REST)).whole


def test_a_move_while_a_picture_is_drawn_is_not_forgotten():
    canvas = Canvas(Pace(10.0))
    canvas.look(eye(), 0.0)
    first = there(canvas.due(0, 0.0))
    canvas.look(eye(), 0.05)
    canvas.drawn(first, 0.1, 0.1)
    assert not there(canvas.due(0, 0.2)).whole


def test_no_more_pictures_than_a_browser_shows():
    canvas = Canvas(Pace(10.0))
    canvas.look(eye(), 0.0)
    canvas.drawn(there(canvas.due(0, 0.0)), 0.001, 0.001)
    canvas.look(eye(), 0.002)
    assert canvas.due(0, 0.003) is None
    assert there(canvas.due(0, 0.035)) is not None


@pytest.mark.parametrize(("overhead", "rate"), [(0.0, 2e6), (0.02, 4e6), (0.05, 1e7)])
def test_the_pace_settles_at_the_frame_rate(overhead, rate):
    pace = Pace(10.0)
    for _ in range(40):
        pace.note(overhead + pace.pixels / rate)
    assert overhead + pace.pixels / rate == pytest.approx(0.1, rel=0.02)


def test_a_machine_that_is_too_slow_gets_the_smallest_picture():
    pace = Pace(30.0)
    for _ in range(50):
        pace.note(0.5)
    width, height = pace.size(1000, 500)
    assert (width, height) == (282, 141)


def test_a_small_window_is_not_enlarged():
    assert Pace(10.0).size(100, 60) == (100, 60)
