"""What the drives move, and the loops that move it: linkage, motors, friction, servo loops, energy.

Lives here: physics in SI units, no frames. May enter: ``mechanism``.
"""
