"""Everything that speaks CANopen, and the hosts that tie those cores to a bus and a clock.

Lives here: frames, the object dictionary, SDO, PDO, NMT, EMCY, the CiA 402 master side, the bus ports and the
virtual-time and real-time hosts. The protocol cores read no clock and open no socket. May enter: nothing of the other
rooms.
"""
