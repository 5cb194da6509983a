"""The slot between threads: newest wins, drops are counted, closing wakes everybody."""

import threading
import time

from sags_node.node.latest import Latest


def test_newest_wins_and_the_replaced_are_counted() -> None:
    slot: Latest[int] = Latest()
    for value in (1, 2, 3):
        slot.put(value)
    assert slot.get() == 3
    assert slot.dropped == 2
    assert slot.get(timeout=0.01) is None


def test_close_delivers_what_is_left_then_ends() -> None:
    slot: Latest[int] = Latest()
    slot.put(7)
    slot.close()
    assert not slot.closed
    assert slot.get() == 7
    assert slot.closed
    assert slot.get() is None


def test_close_wakes_a_waiter() -> None:
    slot: Latest[int] = Latest()
    got: list[int | None] = []
    waiter = threading.Thread(target=lambda: got.append(slot.get()))
    waiter.start()
    slot.close()
    waiter.join(timeout=60)
    assert got == [None]


def test_hand_over_drops_nothing() -> None:
    slot: Latest[int] = Latest()
    sender = threading.Thread(target=lambda: [slot.hand_over(i) for i in range(50)] and slot.close())
    sender.start()
    got = []
    while (value := slot.get(timeout=60)) is not None:
        time.sleep(0.001)
        got.append(value)
    sender.join(timeout=60)
    assert got == list(range(50))
    assert slot.dropped == 0


def test_on_put_is_called_for_values_and_for_the_end() -> None:
    calls = []
    slot: Latest[int] = Latest(on_put=lambda: calls.append(1))
    slot.put(1)
    slot.close()
    assert len(calls) == 2
