"""Faults on command: what can go wrong, when it is to, and the core that makes it happen."""
