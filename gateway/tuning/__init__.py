"""Gains of both position controllers: their stability margins, their search, and how they come into file and drives.

What may enter: what computes on a `config.schema.GatewayConfig`, on `mechanism`, and on a simulated or real machine
that is handed in as an object (`closed_loop.SimulatedLoop`, a run as a callable). Nothing here opens a bus, and nothing
knows the emulator.
"""
