"""Pure mathematics of the mechanism, in SI units: kinematics, closure, dynamics, motion laws and cam tables.

Lives here: functions and frozen values; numeric kernels are numba. May enter: nothing of the other rooms; no clock,
no bus.
"""
