"""Starts the Gaussians of a node from the data that training may see.

``training_data`` is that data, and measures what its images cover. ``gaussians`` finds the points in each object and
makes a table of Gaussians from colored points, ``sources`` draws the points of the background.
"""
