"""Accelerations from logged speeds, against motions known in closed form."""

import numpy as np

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

    jumps, integral = come(t - delay)
    swing = 40.0 * np.sin(12.0 * t[:, None] + [0.0, 1.0])
    ddq = jumps @ answer + swing
    dq = integral @ answer + 40.0 / 12.0 * -np.cos(12.0 * t[:, None] + [0.0, 1.0])
    dq += 0.002 * rng.standard_normal(dq.shape)
    smeared = np.sqrt(np.mean((local_slope(t, dq, 0.008) - ddq) ** 2))
    smooth, found = split_acceleration("ddq_smooth", t, dq, local_slope(t, dq, 0.008), integral)
    sharp = np.sqrt(np.mean((smooth + jumps @ found - ddq) ** 2))
    np.testing.assert_allclose(found, answer, rtol=0.03, atol=10.0)
    assert smeared > 100.0  # rad/s^2
    assert sharp < 3.0
