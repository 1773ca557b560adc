"""The emulated node's side of CiA 301 and CiA 305: NMT, SDO, EMCY, heartbeats, LSS, stored parameters.

Lives here: services of a node, without I/O and without knowledge of CiA 402. May enter: ``drivers``.
"""
