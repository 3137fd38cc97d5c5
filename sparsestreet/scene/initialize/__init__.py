"""Starts the Gaussians of a node from the data that training may see."""
