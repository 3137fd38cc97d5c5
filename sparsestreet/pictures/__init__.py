"""Draws pictures of views, sheets of pictures and curves of a run, without torch."""
