"""Measurements on the images, sweeps and boxes of training: what a scene's effects are decided from.

One file a measurement. Each is a pure function that returns a number with its standard error, how much it is from, and
what a picture of the evidence needs. None knows scenes.
"""
