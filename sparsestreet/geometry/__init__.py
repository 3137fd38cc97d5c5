"""Formulas of space: ``quaternions``, ``cameras``, ``lenses``, ``boxes``, ``trajectories`` and the ``skeleton``."""
