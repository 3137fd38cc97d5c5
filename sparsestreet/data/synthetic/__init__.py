"""Synthetic streets: a ray-traced drive with exact truth, written as a log on disk."""
