"""Tracks from lidar: what moves is found by the rays that pass where it was, and followed.

``find`` leads from ``scans`` to ``objects``, with the thresholds of ``settings``. ``ground`` and ``free_space`` tell
what moves, which ``drive`` holds. ``clusters``, ``association`` and ``joining`` make chains of it. ``fit`` gives each
chain a ``shape`` and a ``path``, and ``extension`` follows it to where it stands.
"""
