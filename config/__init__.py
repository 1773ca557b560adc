"""Machines, axes and buses as YAML, EDS files and curves; and the schema that says what the YAML may hold.

Lives here: data that travels in the wheel, the pydantic models of it, and their loader. Both the gateway and the
emulated drive read the same file, so the schema stands below both. May enter: nothing of the other rooms but the
values of ``drivers`` and ``mechanism``; no bus, no clock.
"""
