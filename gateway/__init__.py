"""The application: commissioning, the cyclic loop, guarding, recording, monitor, report and the command line.

Lives here: whatever a user of the gateway starts or reads. May enter: ``config``, ``drivers`` and ``mechanism``;
``sim_drive`` in the command line alone, where the emulator is started beside the gateway.
"""
