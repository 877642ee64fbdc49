"""Training of quadvel's policy, velocity estimator and leg classifier."""
