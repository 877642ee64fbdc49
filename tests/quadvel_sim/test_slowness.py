"""Tests of the log lines about a machine that is too slow."""

from quadvel_sim.slowness import SUMMARY_PERIOD_S, SlownessLog


def test_a_machine_that_is_always_too_slow_is_named_once_and_then_summed_up() -> None:
    log = SlownessLog()
    lines = [log.next_line(float(second), 0.01 * second) for second in range(121)]
    lines_by_second = {second: line for second, line in enumerate(lines) if line}
    assert list(lines_by_second) == [1, 1 + int(SUMMARY_PERIOD_S)]
    assert "0.01 s" in lines_by_second[1]
    assert "0.60 s" in lines_by_second[61]


def test_a_machine_that_is_fast_enough_is_not_mentioned() -> None:
    log = SlownessLog()
    assert log.next_line(1.0, 0.0) == ""
    assert log.next_line(2.0, 0.1) != ""
    assert log.next_line(500.0, 0.1) == ""
