"""What is made of a recording or of a live ring: figures, plots, pages, and the monitor on a terminal.

Lives here: whatever only reads. May enter: ``gateway.record``, ``config`` and ``mechanism``.
"""
