"""Experiments on the whole stack: demo walks, recorded runs, ground-truth benchmarks, faults on topics."""
