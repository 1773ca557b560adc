"""What runs inside the cycle: the loop, its demand and feed-forward, the guard and its reactions.

Lives here: cores without I/O, which allocate and format nothing in a cycle. May enter: ``config``, ``drivers``,
``mechanism``, ``gateway.learning.law`` and the sample of ``gateway.record``.
"""
