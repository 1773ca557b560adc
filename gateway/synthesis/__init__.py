"""Synthesis for users: from a wanted curve to a machine's files, its report and its animation.

Lives here: what surrounds the searches of ``mechanism.synthesis``: reading the task, running it (in this process, in
several, on a dask cluster), interrupting and resuming it, and writing what was found. May enter: nothing that searches
or judges mechanisms itself (that is ``mechanism.synthesis``), nothing of the command line (``gateway.cli``), no bus.
"""
