"""Tests, thresholds, intervals and model-free baselines."""
