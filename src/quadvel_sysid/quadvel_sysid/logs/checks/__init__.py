"""Checks of a measured log, one module for each kind of defect; `table` has them in their order."""
