"""Training of quadvel's policy and velocity estimator. Needs torch; nothing of the run-time stack imports it."""
