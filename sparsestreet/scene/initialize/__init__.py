"""Starts the Gaussians of a node from the data that training may see.

``training_data`` is that data. ``points`` are colored points, ``boxes`` finds the points in each object, ``coverage``
measures what the images show, and ``gaussians`` makes a table from points.
"""
