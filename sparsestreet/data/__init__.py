"""Driving logs: read from many data sets, checked, and given to training.

``log.DrivingLog`` is what the rest of the package sees, ``reader.LogReader`` what each data set offers, and
``recording.Recording`` what a reader hands over. ``recording.SceneFolder`` decodes frames, ``frame_cache`` keeps
them, and ``datamodule.StreetData`` splits a log and loads them.
"""
