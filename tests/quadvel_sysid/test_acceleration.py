"""Accelerations from logged speeds, against motions known in closed form."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

from quadvel_sysid.data.acceleration import local_slope, split_acceleration


def _stamps(rng, count=2000):
    """s, every millisecond more or less, with a gap."""
    t = 1e-3 * (np.arange(count) + rng.uniform(-0.2, 0.2, count))
    return np.delete(t, slice(700, 730))


def test_slope_of_a_line_is_exact_at_the_ends_and_next_to_a_gap():
    t = _stamps(np.random.default_rng(0))
    lines = np.stack([3.0 * t + 1.0, -7.0 * t], axis=1)
    for half_width in (0.002, 0.008):
        np.testing.assert_allclose(local_slope(t, lines, half_width), [[3.0, -7.0]] * len(t), rtol=1e-9)


def test_acceleration_is_sharp_where_a_command_arrives():
    """Two coupled joints, commands every 5 ms with zero-order hold: a step of torque shows on both."""
    rng = np.random.default_rng(1)
    t, sent_at = _stamps(rng), np.arange(-0.1, 2.1, 0.005)
    q_des = rng.uniform(-0.3, 0.3, (len(sent_at), 2))
    answer = np.array([[900.0, -150.0], [-100.0, 1200.0]])  # of both joints for a radian of each command
    delay = 0.0123
    steps = np.diff(sent_at, append=3.0)[:, None]
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(q_des * steps, axis=0)])

    def come(at):
        row = np.searchsorted(sent_at, at, side="right") - 1
        return q_des[row], sums[row] + q_des[row] * (at - sent_at[row])[:, None]

    def speed(at):
        return come(at - delay)[1] @ answer - 40.0 / 12.0 * np.cos(12.0 * at[:, None] + [0.0, 1.0])

    jumps, integral = come(t - delay)
    ddq = jumps @ answer + 40.0 * np.sin(12.0 * t[:, None] + [0.0, 1.0])
    fine = np.arange(t[0], t[-1] + 1e-4, 1e-4)
    angle = cumulative_trapezoid(speed(fine), fine, axis=0, initial=0.0)
    q = np.stack([np.interp(t, fine, one) for one in angle.T], axis=1)
    dq = speed(t) + 0.002 * rng.standard_normal(q.shape)
    smeared = np.sqrt(np.mean((local_slope(t, dq, 0.008) - ddq) ** 2))
    smooth, found = split_acceleration("ddq_smooth", t, (q, dq), local_slope(t, dq, 0.008), integral)
    sharp = np.sqrt(np.mean((smooth + jumps @ found - ddq) ** 2))
    np.testing.assert_allclose(found, answer, rtol=0.03, atol=10.0)
    assert smeared > 100.0  # rad/s^2
    assert sharp < 3.0


def test_acceleration_is_sharp_in_a_log_slower_than_the_motion():
    """A joint under a PD law, whose own motion changes the slope of dq as much as the commands do."""
    rng, stiffness, damping, tick = np.random.default_rng(2), 900.0, 30.0, 1e-4  # 1/s^2, 1/s, s
    t = np.arange(0.0, 6.0, tick)
    smooth_target = 0.4 * np.sin(6.0 * t) + 0.1 * np.sin(23.0 * t)
    target = smooth_target[(t // 0.01 * 0.01 / tick).astype(int)]
    q, dq, states = 0.0, 0.0, np.empty((len(t), 3))
    for k, wanted in enumerate(target):
        ddq = stiffness * (wanted - q) - damping * dq
        states[k] = q, dq, ddq
        dq += tick * ddq
        q += tick * dq
    rows = np.arange(23, len(t), 50)  # every 5 ms
    at, acting = t[rows], (np.cumsum(target) * tick)[rows, None]
    angle, speed = (states[rows, k][:, None] + 1e-3 * rng.standard_normal((len(rows), 1)) * k for k in (0, 1))
    smooth, found = split_acceleration("ddq_sharp", at, (angle, speed), local_slope(at, speed, 0.002), acting)
    np.testing.assert_allclose(found, [[stiffness]], rtol=0.05)
    error = smooth[:, 0] + target[rows] * found[0, 0] - states[rows, 2]
    assert np.sqrt(np.mean(error**2)) < 0.03 * np.sqrt(np.mean(states[rows, 2] ** 2))
