"""Turns at a device: one at a time, in order, and those who gave up do not hold up the others."""

import threading
import time

import pytest

from sparsestreet.serving.cameras import Turns


def wait_for(condition) -> None:
    for _ in range(2000):
        if condition():
            return
        time.sleep(0.001)
    raise AssertionError("nothing happened for two seconds")


def test_turns_come_in_the_order_of_asking():
    turns, order, at_once, most = Turns(), [], 0, 0

    def take(number: int) -> None:
        nonlocal at_once, most
        with turns.turn(lambda: None):
            at_once += 1
            most = max(most, at_once)
            order.append(number)
            time.sleep(0.002)
            at_once -= 1

    threads = [threading.Thread(target=take, args=(number,)) for number in range(12)]
    with turns.turn(lambda: None):
        for count, thread in enumerate(threads, start=2):
            thread.start()
            wait_for(lambda count=count: len(turns._queue) == count)
    for thread in threads:
        thread.join()
    assert order == list(range(12))
    assert most == 1


def test_who_gives_up_leaves_the_queue_and_an_error_ends_a_turn():
    turns = Turns()

    def gone() -> None:
        raise TimeoutError

    with turns.turn(lambda: None), pytest.raises(TimeoutError), turns.turn(gone):
        raise AssertionError("it had its turn")
    with pytest.raises(ZeroDivisionError), turns.turn(lambda: None):
        _ = 1 / 0
    with pytest.raises(TimeoutError), turns.turn(gone):
        raise AssertionError("nobody wanted it any more")
    with turns.turn(lambda: None):
        assert len(turns._queue) == 1
