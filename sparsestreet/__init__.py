"""Sparse Gaussian scene graphs of streets: train them, make them small, measure what it costs."""

__version__ = "0.1.0"
