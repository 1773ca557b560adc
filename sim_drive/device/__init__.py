"""The emulated node's side of CiA 402: state machine, modes, set-points, limits, inputs; the drive as a whole.

Lives here: what a drive is on the bus, its PDOs included. May enter: ``sim_drive.communication``, ``config`` and
``drivers``.
"""
