"""What is reported of an image. ``definitions`` says in words what each number is (no torch); ``image`` computes them.

Nothing is imported here, so that a report reads the definitions without torch.
"""
