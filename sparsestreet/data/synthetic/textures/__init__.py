"""Procedural textures, filtered over the pixel's footprint."""
