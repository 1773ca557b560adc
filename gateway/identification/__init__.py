"""Parameters of the coupled machine from what it did: regressor fit, confidence, excitation, and what comes of it.

What may enter: what computes on recorded samples or on the plan of a run. Nothing here opens a bus, and nothing knows
the emulator.
"""
