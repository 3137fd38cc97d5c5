"""Runs: their folders, how they go on, sweeps of them, and the devices that they take."""
