"""What a run leaves behind: the sample, the shared-memory ring, the recorder and the MCAP file.

Lives here: formats, and their readers and writers. May enter: ``config`` and ``drivers``.
"""
