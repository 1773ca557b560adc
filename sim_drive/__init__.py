"""The other end of the cable: CiA 402 drives, their servo loops and resolvers, and the coupled plant between them.

Lives here: the emulated drive (its CiA 402 table is written from the standard, independently of the master's in
``drivers``), the plant, and the server that offers the emulated bus to other programs. May enter: ``config``,
``drivers`` and ``mechanism``.
"""
