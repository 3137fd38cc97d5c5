"""What a trained scene is worth, measured where the run is.

``run`` measures a scene and writes a run's files, with ``evaluate`` (renders against images), ``geometry`` (ranges
against lidar sweeps) and ``speed`` (a frame, each node and effect); ``extra`` measures what somebody asks for beside
them. What the files hold is in the room of records.
"""
