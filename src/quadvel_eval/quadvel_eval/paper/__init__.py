"""Section 4 of the paper, measured on this project's robot: one module a figure, and `study`, which runs them."""
