"""What the splat op costs in time, memory and accuracy: ``sparsestreet bench``.

``blend`` times the stages beside a vectorized torch version, ``knobs`` sweeps what accuracy costs, ``scaling`` fits
time against work, ``gpu`` measures a CUDA device beside gsplat. All write records: one JSON object a line.
"""
