"""Generator of logs with undeclared effects, for a blind test of the identification.

It imports nothing of the product: it has its own plant, its own laws and its own measure of an
effect's size. `cases.make_case` is the entry.
"""
