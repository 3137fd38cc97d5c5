"""Where the Gaussians of a node start, from what training may see.

``training_data`` is what a node may look at; ``points`` colored points from lidar and at random; ``boxes`` which points
lie in which object; ``gaussians`` a table from points.
"""
