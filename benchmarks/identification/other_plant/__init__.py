"""A second generator of logs with undeclared effects, which shares no code with the first one.

It differs in what a log of somebody else differs in: integrator, form of friction, motions, rates,
noise, and stamps that jitter or arrive in bursts. `cases.make_case` makes a log and its truth.
"""
