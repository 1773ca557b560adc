"""Brings a machine up, runs it and shuts it down: preparation, commissioning, the session, its processes and hosts.

Lives here: whatever a run is, around the cycle. May enter: every room of the gateway but ``reporting`` and ``cli``.
"""
