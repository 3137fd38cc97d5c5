"""Tracks from lidar: what moves is found by the rays that pass where it was, and followed.

``scans`` holds what is looked at, ``settings`` the thresholds, ``objects`` what comes out. ``find`` leads from one to
the other.
"""
