"""Logs of robots whose drives do something that nobody declared: the blind test of the identification.

Everything here is written apart from the product: it imports nothing of it, has its own plant, its own laws and its
own measure of what an effect is worth. `cases.make_case` is the entry.
"""
