"""Orders that wait for execution: STOP first, the newest of each kind, and never many."""

from __future__ import annotations

from quadvel_view.order_queue import MAX_WAITING_ORDERS, OrderQueue
from quadvel_view.page_protocol import Hold, LetGo, Passive, Record, Release, Seek, StandUp, Stop


def test_orders_of_several_kinds_keep_their_order() -> None:
    queue = OrderQueue()
    for order in (StandUp(), Hold((0.1, 0.0, 0.0)), Passive()):
        queue.put(1, order)
    assert queue.take_all() == [(1, StandUp()), (1, Hold((0.1, 0.0, 0.0))), (1, Passive())]
    assert queue.take_all() == []


def test_the_newest_order_of_a_kind_replaces_the_others_and_comes_last() -> None:
    queue = OrderQueue()
    for order in (Seek(1.0), Passive(), Seek(2.0)):
        queue.put(1, order)
    assert queue.take_all() == [(1, Passive()), (1, Seek(2.0))]


def test_each_page_has_its_own_hold_and_its_end_replaces_it() -> None:
    queue = OrderQueue()
    for page, order in ((1, Hold((0.1, 0.0, 0.0))), (2, Hold((0.2, 0.0, 0.0))), (1, LetGo())):
        queue.put(page, order)
    assert queue.take_all() == [(2, Hold((0.2, 0.0, 0.0))), (1, LetGo())]


def test_stop_passes_all_orders_and_removes_those_that_it_blocks() -> None:
    queue = OrderQueue()
    for order in (Record(), Release(), StandUp(), Hold((0.1, 0.0, 0.0))):
        assert not queue.put(1, order)
    assert queue.put(2, Stop())
    assert not queue.put(3, Stop())
    queue.put(1, Passive())
    assert queue.take_all() == [(3, Stop()), (1, Record()), (1, Passive())]
    assert queue.put(2, Stop())


def test_holds_of_many_pages_fill_a_limited_queue_that_still_takes_a_stop() -> None:
    queue = OrderQueue()
    for page in range(10 * MAX_WAITING_ORDERS):
        queue.put(page, Hold((0.1, 0.0, 0.0)))
    assert queue.put(0, Stop())
    queue.put(0, Release())
    for page in range(10 * MAX_WAITING_ORDERS):
        queue.put(page, LetGo())
    taken = queue.take_all()
    assert len(taken) == MAX_WAITING_ORDERS
    assert taken[:2] == [(0, Stop()), (0, Release())]
