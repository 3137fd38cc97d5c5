"""Measure what the splat op costs in time, memory and accuracy: ``sparsestreet bench``.

``scenes`` makes what is drawn. ``timing`` and ``accuracy`` measure it. ``settings_sweep`` and ``step`` are
the modes of the command. ``records`` writes one JSON line per measurement, and ``figures`` draws from those lines.
"""
